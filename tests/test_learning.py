"""`learn` and a run of the same key spend the same keys on the same stages."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import pipeline, programs
from jaxsense.config import PRESETS, MissionConfig
from jaxsense.learning import learn
from jaxsense.monitor import Monitor
from jaxsense.sim.world import make_world

SMOKE = PRESETS["smoke"]
# As little as shows every stage: learning is chaotic, and two programs round differently.
CONFIG = dataclasses.replace(
    SMOKE,
    detector=dataclasses.replace(
        SMOKE.detector, hidden=(8,), num_scans=96, num_held_out=48, steps=3, batch=16
    ),
    jmvae=dataclasses.replace(
        SMOKE.jmvae, hidden=(8,), restarts=2, samples_per_class=32, steps=3, batch=16
    ),
    dqn=dataclasses.replace(
        SMOKE.dqn, hidden=(8,), num_envs=8, epochs=4, chunk=2, updates=2, batch=16,
        replay_capacity=64, num_starts=8,
    ),
    mission=MissionConfig(episodes=1, time_limit=0.5),
)  # fmt: skip
TOLERANCE = 1e-5


@pytest.fixture(scope="module", params=["bank", "live"])
def both(request):
    """What `learn` and a run come to."""
    config = dataclasses.replace(CONFIG, dqn=dataclasses.replace(CONFIG.dqn, observe=request.param))
    key, monitor = jax.random.key(7), Monitor()
    learned = jax.jit(lambda key: learn(key, config, make_world(config)))(key)
    with pipeline.compiled(config, monitor) as compiled:
        return learned, pipeline.run(key, config, compiled, monitor)


@pytest.mark.slow  # compiles everything twice
def test_both_come_to_the_same_models(both):
    learned, run = both
    assert bool(learned.is_finite)
    close = lambda x, y: np.testing.assert_allclose(x, y, rtol=TOLERANCE, atol=TOLERANCE)  # noqa: E731
    jax.tree.map(close, learned.models, run.models)
    np.testing.assert_allclose(
        learned.reward, np.stack(list(run.rewards.values())), rtol=TOLERANCE, atol=TOLERANCE
    )


@pytest.mark.slow
def test_both_come_to_the_same_figures(both):
    learned, run = both
    accuracy = [block["accuracy"] for block in run.summary["detectors"].values()]
    np.testing.assert_allclose(learned.perception.accuracy, accuracy, atol=1e-6)
    for policy, name in enumerate(("camera", "lidar")):
        total = np.asarray(learned.totals[policy])[0, -CONFIG.evaluation.num_starts :].mean()
        assert run.summary["dqn"][name]["return"] == pytest.approx(total, abs=1e-3)


def test_scenes_for_training_and_for_measuring_are_different_ones():
    rows = programs.survey_rows(CONFIG, 4)
    numbers = programs.num_scenes(CONFIG)
    assert len(rows) % 4 == 0
    assert set(rows.tolist()) == set(range(sum(numbers)))
    classes = programs.survey_scenes(jax.random.key(0), jnp.arange(4), CONFIG, make_world(CONFIG))
    others = programs.survey_scenes(jax.random.key(0), jnp.arange(2, 6), CONFIG, make_world(CONFIG))
    # A scene is the same whoever works it out; two scenes are not.
    same = jax.tree.map(lambda x, y: np.abs(x[2:] - y[:2]).max(), classes.scenes, others.scenes)
    assert max(jax.tree.leaves(same)) < 1e-6
    assert np.abs(classes.scenes.poses[0] - classes.scenes.poses[1]).max() > 0.01
