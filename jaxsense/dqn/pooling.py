"""A network for any number of points of interest, which treats them all alike.

One small network reads each PoI, its surroundings and a pool over all PoIs (Zaheer et al. 2017,
Deep Sets). PoIs that are not present are masked out.
"""

import chex
import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from jaxsense.core.networks import Dense

_REACHES = (2.0, 6.0)  # s, within which PoIs count as near
# Those with which the networks that ship have learned.
_SPEED, _TURN_RATE, _VIEW = 0.2, 1.0, 0.9  # m/s, rad/s and m
_MESSAGES = 8
_NOTHING = -1e6  # value of a PoI that is not present


class PoolingNetwork(nn.Module):
    """The Q-network of robots that travel.

    Attributes:
      features: numbers known of each PoI; the last three are its presence and its position.
    """

    hidden: tuple[int, ...]
    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "S ..."]) -> Float[Array, "A ..."]:
        """`[F * N]` to `[N + 1]` values, NOP's last; or `[F * N, B]` to `[N + 1, B]`."""
        batch = x.shape[1:]
        shape = self.features, x.shape[0] // self.features, *batch
        chex.assert_shape(x, (shape[0] * shape[1], *batch))
        x = x.reshape(shape)
        present, place, known = x[-3][None], x[-2:], x[:-2]

        def dense(size: int, name: str, x: jax.Array, last: bool = False) -> jax.Array:
            kind = nn.initializers.lecun_normal() if last else nn.initializers.he_normal()
            flat = Dense(size, kind, name=name)(x.reshape(x.shape[0], -1))
            return flat.reshape(size, *x.shape[1:])

        each = known
        for i, size in enumerate(self.hidden):
            each = nn.relu(dense(size, f"PoI_{i}", each))
        each = each * present
        message = nn.relu(dense(_MESSAGES, "Message", each, last=True)) * present
        number = jnp.maximum(jnp.sum(present, axis=1), 1.0)
        pool = jnp.concatenate([jnp.sum(each, axis=1) / number, jnp.max(each, axis=1)])
        own = jnp.concatenate([known, each, _heard(message, present, place)])
        context = dense(self.hidden[-1], "Context", pool)
        of_poi = nn.relu(dense(self.hidden[-1], "Own", own) + context[:, None])
        value = dense(1, "Value", of_poi, last=True)[0]
        # Nothing follows NOP.
        return jnp.concatenate([jnp.where(present[0] > 0, value, _NOTHING), jnp.zeros((1, *batch))])


def _heard(message: jax.Array, present: jax.Array, place: jax.Array) -> jax.Array:
    """Sums the messages of all PoIs, weighted by travel time."""
    seconds = _seconds_between(place)
    near, far = (jnp.exp(-seconds / reach) for reach in _REACHES)
    heard = lambda weights: jnp.sum(weights[None] * message[:, None], axis=2)  # noqa: E731
    # A mean, so that many distant PoIs do not count like a near one.
    return jnp.concatenate([heard(near), heard(far) / (1.0 + jnp.sum(far * present, axis=1)[None])])


def _seconds_between(place: jax.Array) -> jax.Array:
    """Rough travel time from one PoI to the next, `[N, N, ...]` seconds: a measure of nearness.

    Args:
      place: `[2, N, ...]` positions of the PoIs in metres from where the robot sets out.
    """
    apart = jnp.sqrt(jnp.sum(place**2, axis=0) + 1e-6)
    course = place / apart[None]
    stop = course * jnp.maximum(apart - _VIEW, 0.0)[None]
    path = place[:, None] - stop[:, :, None]
    length = jnp.sqrt(jnp.sum(path**2, axis=0) + 1e-6)
    ahead = jnp.sum(path * course[:, :, None], axis=0) / length
    # From 0 for straight on to a half turn, without the cost of an arc cosine.
    turn = jnp.pi / 2 * (1.0 - ahead)
    return turn / _TURN_RATE + jnp.maximum(length - _VIEW, 0.0) / _SPEED
