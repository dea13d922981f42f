"""A network that treats all points of interest alike, for any number of them.

One small network reads every pair of PoIs, with the way between them, and another every PoI, with
what its pairs and a pool over all PoIs tell of the rest (Zaheer et al. 2017, Deep Sets; Santoro et
al. 2017, A simple neural network module for relational reasoning). PoIs that are not present count
nowhere.
"""

import chex
import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxsense.networks import Dense

_SPEED, _TURN_RATE, _VIEW = 0.2, 1.0, 0.9  # m/s, rad/s and m
_FAR, _NEAR = 10.0, 3.0  # s, in which the network reads ways between PoIs
_NOTHING = -1e6  # value of a PoI that is not present


class PoolingNetwork(nn.Module):
    """The network of a team, for its Q-values and its tours.

    Attributes:
      hidden: sizes of the hidden layers: the first of each pair of PoIs, the others of each PoI.
      features: numbers known of each PoI; the last three are its presence and its place.
    """

    hidden: tuple[int, ...]
    features: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """`[F * N]` to `[N + 1]` values, NOP's last; or `[F * N, B]` to `[N + 1, B]`."""
        batch = x.shape[1:]
        chex.assert_is_divisible(x.shape[0], self.features)
        x = x.reshape(self.features, x.shape[0] // self.features, *batch)
        known, present, place = x[:-2], x[-3], x[-2:]
        from_pairs = self._pairs(known, present, place)
        each = jnp.concatenate([known, from_pairs])
        for i, size in enumerate(self.hidden[1:]):
            each = nn.relu(_layer(size, f"PoI_{i}", each))
        own = jnp.concatenate([known, from_pairs, each])
        pool = _pool(each, present)
        context = _layer(self.hidden[-1], "Context", pool)
        of_poi = nn.relu(_layer(self.hidden[-1], "Own", own) + context[:, None])
        value = _layer(1, "Value", of_poi)[0]
        # A robot's part ends with NOP.
        nop = jnp.zeros((1, *batch))
        return jnp.concatenate([jnp.where(present > 0, value, _NOTHING), nop])

    def _pairs(self, known: jax.Array, present: jax.Array, place: jax.Array) -> jax.Array:
        """`[2H, N, ...]` what each PoI hears from its pairs with the others."""
        size, number = self.hidden[0], present.shape[0]
        seconds = jnp.swapaxes(_seconds_between(place), 0, 1)
        between = jnp.stack([seconds / _FAR, jnp.exp(-seconds / _NEAR)])
        of_one, of_other = (_layer(size, name, known) for name in ("One", "Other"))
        pair = of_other[:, :, None] + of_one[:, None] + _layer(size, "Between", between)
        is_other = 1.0 - jnp.eye(number).reshape(number, number, *[1] * (present.ndim - 1))
        return _pool(nn.relu(pair), present[:, None] * is_other)


def _layer(size: int, name: str, x: jax.Array) -> jax.Array:
    """`[F, ...]` to `[size, ...]`, the same layer for each column."""
    layer = Dense(size, nn.initializers.he_normal(), name=name)
    return layer(x.reshape(x.shape[0], -1)).reshape(size, *x.shape[1:])


def _pool(x: jax.Array, counts: jax.Array) -> jax.Array:
    """`[2F, ...]` mean and largest of `[F, N, ...]` numbers over those that count, `[N, ...]`."""
    counted = x * counts[None]
    number = jnp.maximum(jnp.sum(counts, axis=0), 1.0)
    return jnp.concatenate([jnp.sum(counted, axis=1) / number[None], jnp.max(counted, axis=1)])


def _seconds_between(place: jax.Array) -> jax.Array:
    """About how long a robot takes from one PoI to the next, `[N, N, ...]` seconds.

    It is only a measure of nearness, and so a rough model of travel is enough.

    Args:
      place: `[2, N, ...]` of the PoIs in metres from where the robot sets out.
    """
    apart = jnp.sqrt(jnp.sum(place**2, axis=0) + 1e-6)
    course = place / apart[None]
    stop = course * jnp.maximum(apart - _VIEW, 0.0)[None]
    way = place[:, None] - stop[:, :, None]
    length = jnp.sqrt(jnp.sum(way**2, axis=0) + 1e-6)
    ahead = jnp.sum(way * course[:, :, None], axis=0) / length
    # From 0 for straight on to a half turn, without the cost of an arc cosine.
    turn = jnp.pi / 2 * (1.0 - ahead)
    return turn / _TURN_RATE + jnp.maximum(length - _VIEW, 0.0) / _SPEED
