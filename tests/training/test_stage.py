"""A stage: its keys, chunks and inputs, and how stages are composed."""

import dataclasses
import gc
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import KEY, TINY, stage_of

from jaxsense import training
from jaxsense.training import Progress, Stage
from jaxsense.training.stage import compose
from jaxsense.training.stages import mission_key


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        (300, (20, 15)),
        (4000, (20, 200)),
        (7, (7, 1)),
        (1, (1, 1)),
        (4001, (20, 201)),
        (23, (12, 2)),
    ],
)
def test_steps_are_cut_into_chunks_also_if_their_number_is_prime(steps, expected):
    config = dataclasses.replace(TINY, detector=dataclasses.replace(TINY.detector, steps=steps))
    stage = stage_of("detector_camera", config)
    size = -(-steps // stage.chunks)
    assert (stage.chunks, size) == expected
    assert (stage.chunks - 1) * size < stage.steps <= stage.chunks * size


def keys_of(stage):
    return [stage.key(KEY), *stage.chunk_keys(KEY)]


def data(keys):
    return [tuple(jax.random.key_data(key).tolist()) for key in keys]


def test_keys_follow_from_the_names_of_stages_alone():
    more = dataclasses.replace(TINY, jmvae=dataclasses.replace(TINY.jmvae, restarts=5))
    few, many = (
        {s.name: data(keys_of(s)) for s in training.stages.stages(c)} for c in (TINY, more)
    )
    assert all(many[name] == keys for name, keys in few.items())
    used = [key for keys in few.values() for key in keys] + data([mission_key(KEY)])
    assert len(set(used)) == len(used)


def begin(value):
    """`begin` of a stage whose output is a number."""
    return lambda key, config: jnp.float32(value)


def test_inputs_are_passed_by_name():
    outputs = {"a": "of a", "b": "of b", "c": "of c"}
    inputs = {"second": "a", "both": ("c", "b"), "number": 3, "first": "b"}
    stage = Stage("last", begin(0), inputs)
    found = stage.select(outputs)
    assert (found.pop("number"), found) == (
        3, {"second": "of a", "both": ("of c", "of b"), "first": "of b"}
    )  # fmt: skip
    assert stage.select(outputs)["number"].dtype == jnp.int32
    assert stage.sources == ("a", "c", "b", "b")


def count(stages):
    """Composes stages that are told what they take."""

    def last(key, config, *, one, others):
        assert config is TINY
        return one + 10 * others[0] + 100 * others[1]

    inputs = {"one": "two", "others": ("one", "three")}
    return compose(KEY, TINY, [*stages, Stage("last", last, inputs)])


def test_a_composition_hands_each_output_to_the_argument_that_names_it():
    stages = [Stage(name, begin(i)) for i, name in enumerate(("one", "two", "three"), 1)]
    found = count(stages)
    assert found.outputs == {"one": 1, "two": 2, "three": 3, "last": 2 + 10 * 1 + 100 * 3}
    assert found.progress == {}
    assert bool(found.is_finite)
    assert list(found.outputs) == ["one", "two", "three", "last"]


def steps_of(name, losses, *, is_optional=False, output=0.0):
    """A stage of five steps in three chunks, the last step of which is none."""

    def advance(key, config, state, *, offset=0):
        del key, config
        chunk = jax.lax.dynamic_slice(jnp.array(losses), (2 * state,), (2,))
        return state + 1, Progress(chunk + offset, {"twice": 2 * chunk})

    def finish(config, state, *, offset=0):
        del config, offset
        return state + jnp.float32(output)

    return Stage(
        name, lambda key, config, **_: jnp.int32(0), {}, advance, finish, 5, 3, is_optional
    )


def test_chunks_are_put_together_and_end_with_the_last_step():
    found = compose(KEY, TINY, [steps_of("s", [1.0, 2.0, 3.0, 4.0, 5.0, np.nan])])
    np.testing.assert_array_equal(found.progress["s"].loss, [1, 2, 3, 4, 5])
    np.testing.assert_array_equal(found.progress["s"].metrics["twice"], [2, 4, 6, 8, 10])
    assert found.outputs["s"] == 3  # chunks
    assert bool(found.is_finite)


@pytest.mark.parametrize("is_optional", [False, True])
@pytest.mark.parametrize("wrong", [None, "loss", "output"])
def test_optional_stages_may_diverge_and_no_others(is_optional, wrong):
    losses = [1.0, 2.0, np.nan if wrong == "loss" else 3.0, 4.0, 5.0, 6.0]
    stage = steps_of(
        "s", losses, is_optional=is_optional, output=np.inf if wrong == "output" else 0.0
    )
    found = compose(KEY, TINY, [Stage("before", begin(1)), stage, Stage("after", begin(2))])
    assert bool(found.is_finite) == (is_optional or wrong is None)
    assert set(found.outputs) == {"before", "s", "after"}


def test_a_stage_without_steps_does_not_advance():
    with pytest.raises(TypeError, match="does not advance"):
        Stage("s", begin(0)).advance(KEY, TINY, 0)


def test_every_stage_is_called_as_it_is_in_the_list():
    stages = training.stages.stages(TINY)
    names = [stage.name for stage in stages]
    assert len(set(names)) == len(names)
    for i, stage in enumerate(stages):
        assert set(stage.sources) <= set(names[:i])
    restarts = [stage.name for stage in stages if stage.is_optional]
    assert restarts == ["jmvae_1", "jmvae_2"]
    assert stage_of("best_jmvae").sources == ("jmvae_1", "jmvae_2", "detections")
    assert names == [
        "scenes", "survey", "examples", "detector_camera", "detector_lidar", "detections",
        "jmvae_1", "jmvae_2", "best_jmvae", "class_beliefs", "novelty", "detector_metrics",
        "fusion", "latent_space", "look_values", "beliefs", "starts", "dqn_camera", "dqn_lidar",
        "policies_camera", "policies_lidar",
    ]  # fmt: skip


def test_a_filter_and_a_team_have_stages_of_their_own():
    filtered = dataclasses.replace(TINY.jmvae, fusion="filter")
    dqn = dataclasses.replace(TINY.dqn, task="team", observe="bank")
    config = dataclasses.replace(TINY, jmvae=filtered, dqn=dqn)
    names = [stage.name for stage in training.stages.stages(config)]
    assert len(set(names)) == len(names)
    plain = [stage.name for stage in training.stages.stages(TINY)]
    assert set(names) - set(plain) == {"filter", "dqn_team", "tours"}
    assert set(plain) - set(names) == {"dqn_camera", "dqn_lidar"}
    assert names.index("filter") + 1 == names.index("fusion")


def test_inputs_that_were_selected_are_not_held():
    class Output:
        """Something that can be referred to weakly."""

    outputs = {"first": Output(), "second": Output()}
    references = [weakref.ref(output) for output in outputs.values()]
    stage = Stage("third", lambda key: key, {"both": ("first", "second"), "index": 1})
    gc.disable()
    try:
        stage.select(outputs)
        outputs.clear()
        assert [reference() for reference in references] == [None, None]
    finally:
        gc.enable()
