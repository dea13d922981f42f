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
_SPEED, _TURN_RATE, _VIEW = 0.2, 1.0, 0.9  # m/s, rad/s and m
_MESSAGES = 8
_NOTHING = -1e6  # value of a PoI that is not present


class PoolingNetwork(nn.Module):
    """The network of a team, for its Q-values and its tours.

    Attributes:
      hidden: sizes of the hidden layers, the same for each PoI.
      features: numbers known of each PoI; the last three are its presence and its position.
    """

    hidden: tuple[int, ...]
    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "S ..."]) -> Float[Array, "A ..."]:
        """`[F * N]` to `[N + 1]` values, NOP's last; or `[F * N, B]` to `[N + 1, B]`."""
        batch = x.shape[1:]
        chex.assert_is_divisible(x.shape[0], self.features)
        x = x.reshape(self.features, x.shape[0] // self.features, *batch)
        present, place = x[-3][None], x[-2:]
        known = x[:-2]
        flat = known.reshape(known.shape[0], -1)
        for i, size in enumerate(self.hidden):
            flat = nn.relu(Dense(size, nn.initializers.he_normal(), name=f"PoI_{i}")(flat))
        each = flat.reshape(-1, *known.shape[1:]) * present
        number = jnp.maximum(jnp.sum(present, axis=1), 1.0)
        pool = jnp.concatenate([jnp.sum(each, axis=1) / number, jnp.max(each, axis=1)])
        around = self._messages(flat, present, place)
        own = jnp.concatenate([known, each, around])
        size = self.hidden[-1]
        last = nn.initializers.lecun_normal()
        context = Dense(size, nn.initializers.he_normal(), name="Context")(pool)
        of_poi = Dense(size, nn.initializers.he_normal(), name="Own")(own.reshape(own.shape[0], -1))
        of_poi = nn.relu(of_poi.reshape(size, *known.shape[1:]) + context[:, None])
        value = Dense(1, last, name="Value")(of_poi.reshape(size, -1))
        value = value.reshape(*known.shape[1:])
        # Nothing follows NOP.
        nop = jnp.zeros((1, *batch))
        return jnp.concatenate([jnp.where(present[0] > 0, value, _NOTHING), nop])

    def _messages(self, flat: jax.Array, present: jax.Array, place: jax.Array) -> jax.Array:
        """Sums the messages of all PoIs, weighted by travel time."""
        sent = Dense(_MESSAGES, nn.initializers.lecun_normal(), name="Message")(flat)
        sent = nn.relu(sent).reshape(_MESSAGES, *present.shape[1:]) * present
        seconds = _seconds_between(place)
        near, far = (jnp.exp(-seconds / reach) for reach in _REACHES)
        of_near = jnp.sum(near[None] * sent[:, None], axis=2)
        # A mean, so that many distant PoIs do not count like a near one.
        of_far = jnp.sum(far[None] * sent[:, None], axis=2)
        of_far /= 1.0 + jnp.sum(far * present, axis=1)[None]
        return jnp.concatenate([of_near, of_far])


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
