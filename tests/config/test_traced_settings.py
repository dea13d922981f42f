"""Every number that may be traced does what the same constant does, in one program for all."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import dqn
from jaxsense.config import Config, DetectorConfig, DqnConfig, JmvaeConfig, MdpConfig
from jaxsense.core import supervised
from jaxsense.core.types import Belief
from jaxsense.looks import Bank, make_mdp
from jaxsense.models import init, make_in_place, make_jmvae
from jaxsense.vae import detectors, jmvae

CONFIG = Config(
    detector=DetectorConfig(hidden=(2,), steps=3, batch=4),
    jmvae=JmvaeConfig(hidden=(4,), steps=4, batch=4, annealing=0.5),
    mdp=MdpConfig(max_steps=3),
    dqn=DqnConfig(
        task="map", hidden=(4,), num_envs=8, epochs=6, updates=1, batch=8, replay_capacity=32,
        target_period=2,
    ),
)  # fmt: skip
# Two values of each. Large learning rates, so that a few steps show; a threshold among the gains.
VALUES = {
    "detector.learning_rate": (0.01, 0.05),
    "jmvae.alpha": (0.1, 3.0),
    "jmvae.beta": (0.01, 0.3),
    "jmvae.initial_beta": (0.7, 5.0),
    "jmvae.annealing": (0.1, 1.0),
    "jmvae.learning_rate": (0.02, 0.08),
    "mdp.min_increase": (0.05, 0.65),
    "mdp.max_steps": (3, 1),
    "dqn.discount": (0.5, 0.9),
    "dqn.learning_rate": (0.02, 0.1),
    "dqn.epsilon_min": (0.02, 0.2),
    "dqn.epsilon_decay": (0.3, 0.6),
    "dqn.target_period": (2, 3),
}


def learn(config):
    """A few steps of each training, on numbers drawn at random in place of scans."""
    keys = jax.random.split(jax.random.key(0), 8)
    windows = jax.random.normal(keys[0], (12, 3))
    detector = detectors.init(keys[1], windows, 2, config.detector)
    looks = detectors.Looks(windows, jnp.ones(12))
    problem = detectors.problem(config.detector, detector, looks, jnp.arange(12) % 2, looks)
    state = supervised.start(detector.params, problem)
    fit, _ = supervised.fit(keys[2], state, problem, config.detector.steps)

    model = make_jmvae(config)
    bank = tuple(jax.random.uniform(k, (3, 5, 2)) for k in keys[3:5])
    params = jmvae.init(keys[5], model)
    latent, _ = jmvae.train(keys[6], params, model, bank, config.jmvae)

    # Apart from the JMVAE that was trained: what its settings change must not stand for those here.
    models = init(keys[5], config)
    classes = Belief(jnp.eye(3, 2), jnp.full((3, 2), 0.2))
    models = dataclasses.replace(models, fusion=make_in_place(config, params, classes))
    mdp = make_mdp(config, models, Bank(bank))
    state, info = dqn.train(keys[7], dqn.Environment(models.agent, mdp), config.dqn)
    return {"detector": fit.params, "jmvae": latent, "dqn": (state.params, info)}


def with_values(values):
    """The settings with other values of some fields, by their names."""
    sections = {}
    for name, value in values.items():
        section, _, field = name.partition(".")
        sections.setdefault(section, {})[field] = value
    changed = {n: dataclasses.replace(getattr(CONFIG, n), **v) for n, v in sections.items()}
    return dataclasses.replace(CONFIG, **changed)


@pytest.fixture(scope="module")
def together():
    """All at their first value, all at their second, and both but for one, in one program."""
    first, second = (np.array([v[i] for v in VALUES.values()]) for i in (0, 1))
    one = np.eye(len(VALUES), dtype=bool)
    rows = [first, second, *np.where(one, second, first), *np.where(one, first, second)]

    def train(values):
        return learn(with_values(dict(zip(VALUES, values, strict=True))))

    return jax.jit(jax.vmap(train))(jnp.array(np.stack(rows), jnp.float32))


@pytest.mark.slow
def test_all_settings_together_do_what_the_constants_do(together):
    second = {name: values[1] for name, values in VALUES.items()}
    alone = jax.jit(lambda: learn(with_values(second)))()
    here = jax.tree.map(lambda x: x[1], together)
    chex.assert_trees_all_close(here, alone, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", VALUES)
def test_each_setting_changes_its_training_and_no_other(together, name):
    place, part = list(VALUES).index(name), name.partition(".")[0].replace("mdp", "dqn")
    for base, row in ((0, 2 + place), (1, 2 + len(VALUES) + place)):
        differ = {
            n: max(float(np.max(np.abs(x[base] - x[row]))) for x in map(np.asarray, leaves))
            for n, tree in together.items()
            if (leaves := jax.tree.leaves(jax.tree.map(lambda x: x.astype(jnp.float32), tree)))
        }
        assert differ.pop(part) > 1e-3
        assert max(differ.values()) < 1e-6


def test_weights_of_reconstruction_may_be_traced():
    model, key = make_jmvae(CONFIG), jax.random.key(1)
    params = jmvae.init(key, model)

    def loss(weights):
        settings = dataclasses.replace(CONFIG.jmvae, reconstruction_weights=weights)
        features = jnp.ones(2), jnp.zeros(2)
        weights = settings.reconstruction_weights
        noise, columns = jax.random.normal(key, (2, 1)), tuple(x[:, None] for x in features)
        found, _ = jmvae.losses(
            noise, params, model, columns, alpha=0.1, beta=0.1, reconstruction_weights=weights
        )
        return found[0]

    traced, constant = jax.jit(loss), jax.jit(lambda: loss((3.0, 0.5)))
    np.testing.assert_allclose(traced((3.0, 0.5)), constant(), rtol=1e-5)
    assert abs(traced((3.0, 0.5)) - traced((1.0, 0.5))) > 0.1


def test_arrays_are_checked_like_numbers_unless_they_are_traced_or_a_batch():
    assert dataclasses.replace(CONFIG.jmvae, alpha=jnp.float32(0.5)).alpha == 0.5
    with pytest.raises(ValueError, match=r"jmvae.alpha = .*-1.*: must be a number, from 0 to"):
        dataclasses.replace(CONFIG.jmvae, alpha=jnp.float32(-1.0))
    batch = jnp.array([0.5, 2.0])
    many = dataclasses.replace(CONFIG.viewpoint, min_distance=batch)
    assert dataclasses.replace(CONFIG, viewpoint=many).viewpoint.min_distance is batch
    traced = jax.jit(lambda x: dataclasses.replace(CONFIG.viewpoint, min_distance=x))(2.0)
    assert traced.min_distance == 2.0


def test_a_traced_number_leaves_the_relations_of_others_checked():
    def alone(alpha):
        settings = dataclasses.replace(CONFIG.jmvae, alpha=alpha)
        return dataclasses.replace(CONFIG, jmvae=settings, modalities=("camera",)).jmvae.alpha

    with pytest.raises(ValueError, match=r"jmvae\.reconstruction_weights = "):
        jax.jit(alone)(0.5)
