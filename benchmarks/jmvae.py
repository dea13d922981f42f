"""Training of the JMVAE, against MultiVae's."""

import dataclasses

import jax
import numpy as np

from benchmarks import measure, peers
from benchmarks.measure import Options, Row
from jaxsense import PRESETS, make_jmvae
from jaxsense.vae import jmvae as our_jmvae

_STEPS, _STEPS_QUICK = 2000, 5
_SAMPLES_PER_CLASS = 10000


def jmvae(options: Options) -> Row:
    """Samples per second of forward, backward and Adam, batches drawn from the same bank."""
    steps = _STEPS_QUICK if options.quick else _STEPS
    config = dataclasses.replace(PRESETS["default"].jmvae, steps=steps)
    model = make_jmvae(PRESETS["default"])
    num_classes = len(PRESETS["default"].arena.classes)
    bank = random_bank(jax.random.key(0), model.feature_sizes, num_classes, _SAMPLES_PER_CLASS)

    def train(key: jax.Array, bank: tuple[jax.Array, ...]):
        init_key, train_key = jax.random.split(key)
        params = our_jmvae.init(init_key, model)
        return our_jmvae.train(train_key, params, model, bank, config)

    work, batch = steps * config.batch, config.batch
    ours = [measure.compiled(train, jax.random.key(1), bank, work=work, batch=batch)]
    peer = peers.load("multivae", options.peers)
    theirs = peer.sides(model, config, [np.asarray(x) for x in bank], options) if peer else []
    return measure.compare(
        "jmvae",
        "samples/s",
        ours,
        theirs,
        options,
        peer="MultiVae JMVAE",
        packages=("multivae", "torch"),
    )


def random_bank(
    key: jax.Array, feature_sizes: tuple[int, ...], num_classes: int, samples: int
) -> tuple[jax.Array, ...]:
    """For each modality `[C, S, D_m]` probabilities: what they are does not change the speed."""
    keys = jax.random.split(key, len(feature_sizes))
    return tuple(
        jax.nn.softmax(4.0 * jax.random.normal(k, (num_classes, samples, size)))
        for k, size in zip(keys, feature_sizes, strict=True)
    )
