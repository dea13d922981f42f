"""Clusters of points by k-means, and their names."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsense.core.types import Key, product

_TRIES = 16
_STEPS = 30


def centres(key: Key, points: Float[Array, "S D"], number: int) -> Float[Array, "{number} D"]:
    """Centres of clusters: of several k-means (Lloyd 1982), those nearest to the points.

    Args:
      key: random key of the starts, which are spread as k-means++ spreads them (Arthur and
        Vassilvitskii 2007).
      points: `[S, D]`.
      number: of clusters; static.
    """
    found, far = jax.lax.map(lambda k: _one(k, points, number), jax.random.split(key, _TRIES))
    return found[jnp.argmin(far)]


def nearest(points: Float[Array, "S D"], centres: Float[Array, "K D"]) -> Int[Array, " S"]:
    """Index of the nearest centre to each point, int32.

    Args:
      points: `[S, D]`.
      centres: `[K, D]`.
    """
    return jnp.argmin(_distances(points, centres), axis=1).astype(jnp.int32)


def named(
    members: Int[Array, " S"], classes: Int[Array, " S"], num_classes: int
) -> Int[Array, " C"]:
    """The cluster of each class, none of two: those that share most points first.

    Args:
      members: `[S]` cluster of each point.
      classes: `[S]` int32 class of each point.
      num_classes: C, the number of classes and of clusters; static.
    """
    counts = jnp.zeros((num_classes, num_classes), jnp.int32).at[classes, members].add(1)

    def name(_: int, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        left, found = carry
        poi_class, cluster = jnp.unravel_index(jnp.argmax(left), left.shape)
        left = left.at[poi_class].set(-1).at[:, cluster].set(-1)
        return left, found.at[poi_class].set(cluster)

    found = jnp.zeros(num_classes, jnp.int32)
    return jax.lax.fori_loop(0, num_classes, name, (counts, found))[1]


def _one(key: Key, points: jax.Array, number: int) -> tuple[jax.Array, jax.Array]:
    """Centres of one k-means, and the `[]` mean square distance of the points from them."""
    first_key, *keys = jax.random.split(key, number)
    chosen = points[jax.random.randint(first_key, (1,), 0, len(points))]
    for next_key in keys:
        far = jnp.min(_distances(points, chosen), axis=1)
        row = jax.random.categorical(next_key, jnp.log(far + 1e-12))
        chosen = jnp.concatenate([chosen, points[row][None]])

    def move(centres: jax.Array, _: None) -> tuple[jax.Array, None]:
        is_member = jax.nn.one_hot(nearest(points, centres), number)
        counts = jnp.sum(is_member, axis=0)[:, None]
        moved = product(is_member.T, points)
        return jnp.where(counts > 0, moved / jnp.maximum(counts, 1), centres), None

    found, _ = jax.lax.scan(move, chosen, None, _STEPS)
    return found, jnp.mean(jnp.min(_distances(points, found), axis=1))


def _distances(points: jax.Array, centres: jax.Array) -> jax.Array:
    """`[S, K]` squared distances."""
    return jnp.sum((points[:, None] - centres[None]) ** 2, axis=-1)
