"""The list of all stages of a training, and its composition.

`learn` composes the list into one pure function, which you can `vmap` over seeds and settings.
`jaxsense.run` executes the same list from the host with the same keys; between two chunks it
reports, saves, and stops if asked to.
"""

from collections.abc import Mapping

from jaxsense.config import Config
from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.models import Models, make_models
from jaxsense.sim.arena import Arena
from jaxsense.sim.world import make_world
from jaxsense.training import (
    agents,
    comparison,
    detections,
    fusions,
    jmvaes,
    measures,
    repeats,
    scans,
    surveys,
)
from jaxsense.training.stage import Learned, Output, Stage, compose, key_of


def _from_detections(config: Config, arena: Arena) -> list[Stage]:
    """The stages from surveys to class beliefs and novelty; see `scans.make_stages`."""
    return [
        *detections.make_stages(config),
        *jmvaes.make_stages(config),
        repeats.novelty_stage(arena, config),
    ]


_LEARNS_FROM = {"detections": _from_detections, "scans": scans.make_stages}


def stages(config: Config, arena: Arena | None = None) -> list[Stage]:
    """Stages of a training, each after the stages whose outputs it takes.

    Args:
      config: all settings; its static fields determine the stages and all sizes.
      arena: from `sim.make_world(config)`; compiled anew by default.
    """
    arena = make_world(config).arena if arena is None else arena
    detected, fusion = {"detections": "detections"}, {"fusion": "fusion"}
    classes = {"classes": "class_beliefs"}
    policies = {
        name: {
            "modality": m,
            "q_network": agents.learner(config, name),
            "look_values": "look_values",
            **fusion,
            **detected,
        }
        for m, name in enumerate(config.modalities)
    }
    return [
        Stage("scenes", surveys.draw_scenes, is_passing=True),
        surveys.survey_stage(arena),
        Stage("examples", detections.split_examples, {"surveys": "survey"}, is_passing=True),
        *_LEARNS_FROM[config.jmvae.learns_from](config, arena),
        Stage("detector_metrics", measures.detector_metrics, detected),
        *fusions.make_stages(config),
        Stage("latent_space", measures.latent_space, {**fusion, **detected}),
        Stage("look_values", agents.look_values, {**classes, **detected}, is_kept=True),
        Stage("beliefs", measures.beliefs, {**fusion, **detected}),
        *agents.agent_stages(arena, config),
        *agents.tour_stages(config),
        *(
            Stage(f"policies_{name}", comparison.play_policies, inputs, shares="policies")
            for name, inputs in policies.items()
        ),
        *(
            Stage(f"numbers_{name}", comparison.play_numbers, inputs, shares="numbers")
            for name, inputs in policies.items()
            if config.evaluation.num_pois
        ),
    ]


@checks.typed
def learn(
    key: Key, config: Config, arena: Arena | None = None, *, until: str | None = None
) -> Learned:
    """Runs the whole training as one pure function.

    Args:
      key: the only source of randomness.
      config: all settings. Fields declared `Traced` may be traced, so that `jax.vmap` varies them.
      arena: from `sim.make_world(config)`; compiled anew by default.
      until: name of the last stage; all stages by default.

    Returns:
      The outputs of the stages: the trained networks, see `models`, and all measurements of a run
      except its missions.

    Raises:
      ValueError: if `config` is no `Config`, or no stage has this name.
    """
    checks.require_key(key)
    found = stages(config, arena)
    names = [stage.name for stage in found]
    if until is not None and until not in names:
        raise ValueError(f"until = {until!r}: must be one of {', '.join(names)}")
    return compose(key, config, found[: None if until is None else names.index(until) + 1])


def models(outputs: Mapping[str, Output], config: Config) -> Models:
    """Collects the models from the outputs of all stages.

    Args:
      outputs: by the name of the stage.
      config: all settings.
    """
    return make_models(
        config,
        detectors=tuple(outputs[f"detector_{name}"] for name in config.modalities),
        jmvae=outputs["best_jmvae"],
        fusion=outputs["fusion"],
        novelty=outputs["novelty"],
        look_values=outputs["look_values"],
        q_networks=tuple(outputs[agents.learner(config, name)] for name in config.modalities),
        tours=tuple(outputs[stage.name] for stage in agents.tour_stages(config)),
    )


def mission_key(key: Key) -> Key:
    """Key of the missions that follow a training with this key."""
    return key_of(key, "mission")
