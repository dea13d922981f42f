"""The whole training, from top to bottom.

`learn` executes it as one pure function, which you can `vmap` over seeds and settings.
`jaxsense.run` executes it from the host with the same keys; between two chunks it reports, saves,
and stops if asked to.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxsense.config import Config
from jaxsense.config.section import require_known
from jaxsense.core import checks
from jaxsense.core.types import Key, pytree
from jaxsense.models import Models, make_models
from jaxsense.training import agents, comparison, detections, jmvaes, measures, scans
from jaxsense.training.stage import (
    Drive,
    Output,
    Progress,
    Stage,
    is_finite,
    restarts,
    scan,
)


@pytree
class Learned:
    """Result of `learn`: the outputs of all stages, and their losses.

    Attributes:
      outputs: of every stage, by its name.
      progress: `[steps]` of every stage that has steps, by its name.
      is_finite: `[]` bool, whether all losses and outputs are finite; optional stages are ignored.
    """

    outputs: dict[str, Output]
    progress: dict[str, Progress]
    is_finite: Bool[Array, ""]


def train(drive: Drive, config: Config) -> None:
    """The training. Outputs pass through `drive` alone, so that it may return anything for them.

    Args:
      drive: executes each stage, and keeps what is needed of its output.
      config: all settings; its static fields determine the stages and all sizes.
    """
    scenes = drive(Stage("scenes", detections.draw_scenes))
    survey = Stage("survey", detections.survey, finish=detections.divide)
    surveyed = drive(survey, scenes=scenes)
    examples = drive(Stage("examples", detections.looks_at_nothing), surveys=surveyed)
    perceive = _learn_from_scans if config.jmvae.learns_from == "scans" else _learn_from_detections
    learned = perceive(drive, config, surveys=surveyed, examples=examples)
    detectors, params, classes, detected, shown = learned
    learn_novelty = Stage("novelty", detections.learn_novelty)
    novelty = drive(learn_novelty, trained=detectors, scenes=scenes, **shown)
    known = {"detections": detected}
    drive(Stage("detector_metrics", measures.detector_metrics), **known)

    if config.jmvae.fusion == "in_place":
        fit = Stage("fusion", jmvaes.fit_in_place)
        known["fusion"] = drive(fit, params=params, classes=classes, **known)
    else:
        # A stage of its own, whose name determines its key.
        fitted = drive(jmvaes.filter_stage(config), classes=classes, **known)
        known["fusion"] = drive(Stage("fusion", lambda key, config, fusion: fusion), fusion=fitted)
    drive(Stage("latent_space", measures.latent_space), **known)
    solve = Stage("look_values", agents.look_values)
    values = drive(solve, classes=classes, detections=detected)
    drive(Stage("beliefs", measures.beliefs), **known)

    networks, known["starts"] = agents.train(
        drive, config, detectors=detectors, novelty=novelty, **known
    )
    for m, name in enumerate(config.modalities):
        network = networks[agents.learner(config, name)]
        given = {"modality": jnp.int32(m), "q_network": network, "look_values": values, **known}
        drive(Stage(f"policies_{name}", comparison.play_policies, shares="policies"), **given)
        if config.evaluation.num_pois:
            drive(Stage(f"numbers_{name}", comparison.play_numbers, shares="numbers"), **given)


_Perception = tuple[tuple[Output, ...], Output, Output, Output, dict[str, Output]]
"""Detectors, parameters of the JMVAE, class beliefs, detections, and what looks show together."""


def _learn_from_detections(
    drive: Drive, config: Config, *, surveys: Output, examples: Output
) -> _Perception:
    """Trains detectors, and a JMVAE on what they say."""
    given = {"surveys": surveys, "examples": examples}
    stages = [detections.detector_stage(m, config) for m in range(len(config.modalities))]
    trained = tuple(drive(stage, **given) for stage in stages)
    detected = drive(Stage("detections", detections.detect), surveys=surveys, trained=trained)
    each = tuple(drive(stage, detections=detected) for stage in restarts(config, jmvaes.start))
    choose = Stage("best_jmvae", jmvaes.best)
    params = drive(choose, restarts=each, detections=detected)
    average = Stage("class_beliefs", jmvaes.class_beliefs)
    classes = drive(average, params=params, detections=detected)
    return trained, params, classes, detected, {}


def _learn_from_scans(
    drive: Drive, config: Config, *, surveys: Output, examples: Output
) -> _Perception:
    """Trains a JMVAE on scans, whose encoders serve as detectors; see `scans`."""
    seen = drive(Stage("views", scans.views), surveys=surveys)
    each = tuple(drive(stage, views=seen) for stage in restarts(config, scans.start))
    params = drive(Stage("best_jmvae", jmvaes.best), restarts=each)
    learned = {"params": params, "views": seen, "surveys": surveys}
    classes = drive(Stage("class_beliefs", scans.class_beliefs), **learned)
    learned["classes"] = classes
    shown = drive(Stage("shown", scans.shown), **learned)
    stages = [scans.encoder_stage(m, config) for m in range(len(config.modalities))]
    trained = tuple(drive(stage, examples=examples, shown=shown, **learned) for stage in stages)
    find = Stage("detections", detections.detect)
    detected = drive(find, surveys=surveys, trained=trained, shown=shown)
    return trained, params, classes, detected, {"shown": shown}


def stages(config: Config) -> list[Stage]:
    """The stages of a training, in the order of `train`."""
    found: list[Stage] = []
    train(lambda stage, **_: found.append(stage), config)
    return found


@checks.typed
def learn(key: Key, config: Config, *, until: str | None = None) -> Learned:
    """Runs the whole training as one pure function.

    Args:
      key: the only source of randomness.
      config: all settings. Fields declared `Traced` may be traced, so that `jax.vmap` varies them.
      until: name of the last stage; all stages by default.
    """
    if until is not None:
        require_known("until", until, [stage.name for stage in stages(config)])
    outputs, progress, finite = dict[str, Output](), dict[str, Progress](), [jnp.bool_(True)]

    def drive(stage: Stage, **inputs: Output) -> Output:
        if until in outputs:
            return None
        outputs[stage.name], steps = scan(key, config, stage, inputs)
        if steps is not None:
            progress[stage.name] = steps
        if not stage.is_optional:
            losses = () if steps is None else steps.loss
            finite.append(is_finite((outputs[stage.name], losses)))
        return outputs[stage.name]

    train(drive, config)
    return Learned(outputs, progress, jnp.stack(finite).all())


def sources(config: Config) -> dict[str, str | tuple[str, ...]]:
    """The stages whose outputs are the trained parts of `Models`, by the names of these."""
    same = {name: name for name in ("fusion", "novelty", "look_values")}
    detectors = tuple(f"detector_{name}" for name in config.modalities)
    networks = agents.learners(config)
    return {"detectors": detectors, "jmvae": "best_jmvae", "q_networks": networks, **same}


def models(outputs: Mapping[str, Output], config: Config) -> Models:
    """Collects the models from the outputs of all stages, by name."""
    return make_models(config, **jax.tree.map(outputs.__getitem__, sources(config)))
