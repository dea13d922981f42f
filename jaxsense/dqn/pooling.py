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
      features: numbers known of each PoI; the last three are its presence and its position.
    """

    hidden: tuple[int, ...]
    features: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "S ..."], others: Float[Array, "S ..."] | None = None
    ) -> Float[Array, "A ..."]:
        """`[F * N]` to `[N + 1]` values, NOP's last; or `[F * N, B]` to `[N + 1, B]`.

        Args:
          others: what each PoI's value takes the other PoIs to be; as in `x` by default. Presence
            and positions are those of `x`.
        """
        batch = x.shape[1:]
        shape = self.features, x.shape[0] // self.features, *batch
        chex.assert_shape(x, (shape[0] * shape[1], *batch))
        x = x.reshape(shape)
        present, place, known = x[-3][None], x[-2:], x[:-2]
        layers = [
            Dense(size, nn.initializers.he_normal(), name=f"PoI_{i}")
            for i, size in enumerate(self.hidden)
        ]
        message = Dense(_MESSAGES, nn.initializers.lecun_normal(), name="Message")

        def embed(known: jax.Array) -> tuple[jax.Array, jax.Array]:
            """What each PoI adds to the pool, and its message."""
            flat = known.reshape(known.shape[0], -1)
            for layer in layers:
                flat = nn.relu(layer(flat))
            each, sent = (x.reshape(-1, *known.shape[1:]) for x in (flat, nn.relu(message(flat))))
            return each * present, sent * present

        each, sent = embed(known)
        number = jnp.maximum(jnp.sum(present, axis=1, keepdims=True), 1.0)
        if others is None:
            mean = jnp.sum(each, axis=1, keepdims=True) / number
            pool = [mean, jnp.max(each, axis=1, keepdims=True)]
            around = _heard(sent, sent, present, place)
        else:
            rest, told = embed(others.reshape(shape)[:-2])
            mean = (each + jnp.sum(rest, axis=1, keepdims=True) - rest) / number
            pool = [mean, jnp.maximum(each, _max_of_others(rest))]
            around = _heard(sent, told, present, place)
        pool = jnp.concatenate(pool)
        own = jnp.concatenate([known, each, around])
        size = self.hidden[-1]
        last = nn.initializers.lecun_normal()
        context = Dense(size, nn.initializers.he_normal(), name="Context")(
            pool.reshape(pool.shape[0], -1)
        ).reshape(size, *pool.shape[1:])
        of_poi = Dense(size, nn.initializers.he_normal(), name="Own")(own.reshape(own.shape[0], -1))
        of_poi = nn.relu(of_poi.reshape(size, *known.shape[1:]) + context)
        value = Dense(1, last, name="Value")(of_poi.reshape(size, -1))
        value = value.reshape(*known.shape[1:])
        # Nothing follows NOP.
        nop = jnp.zeros((1, *batch))
        return jnp.concatenate([jnp.where(present[0] > 0, value, _NOTHING), nop])


def _max_of_others(x: jax.Array) -> jax.Array:
    """`[F, N, ...]` maximum over all PoIs but this one, of `[F, N, ...]` that are not negative."""
    most = jnp.max(x, axis=1, keepdims=True)
    is_most = x == most
    second = jnp.max(jnp.where(is_most, 0.0, x), axis=1, keepdims=True)
    is_alone = jnp.sum(is_most, axis=1, keepdims=True) == 1
    return jnp.where(is_most & is_alone, second, most)


def _heard(own: jax.Array, others: jax.Array, present: jax.Array, place: jax.Array) -> jax.Array:
    """Sums the messages of all PoIs, weighted by travel time."""
    seconds = _seconds_between(place)
    near, far = (jnp.exp(-seconds / reach) for reach in _REACHES)

    def heard(weights: jax.Array) -> jax.Array:
        total = jnp.sum(weights[None] * others[:, None], axis=2)
        if own is others:
            return total
        of_itself = jnp.moveaxis(jnp.diagonal(weights), -1, 0)
        return total + of_itself[None] * (own - others)

    # A mean, so that many distant PoIs do not count like a near one.
    of_far = heard(far) / (1.0 + jnp.sum(far * present, axis=1)[None])
    return jnp.concatenate([heard(near), of_far])


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
