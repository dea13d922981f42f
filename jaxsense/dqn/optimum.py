"""The value of looks at a PoI, by dynamic programming on the posterior over its classes.

Points of interest are independent, and looks take no time in the map MDP, so whether another look
pays can be decided for each PoI on its own. What an agent knows of a PoI is the posterior over its
classes, a point of a simplex. The values are tabulated on a lattice in that simplex and
interpolated linearly over the simplices of Freudenthal's triangulation (Lovejoy 1991, Operations
Research 39(1), Sec. 3).

In nats the values live on a smaller simplex. A robot's looks change only the posterior p over the
L labels of its own sensor: `H(class) = H(p) + sum_l p_l h_l`, where `h_l`, the entropy of the
classes with label l, stays as it is. The second term is a martingale, whose expected change is 0
under any stopping rule. So the values depend on p alone, for any number of classes.
"""

import itertools
import math
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsense.config import MdpConfig
from jaxsense.core import checks
from jaxsense.core.types import Belief, product, pytree
from jaxsense.dqn.rewards import Reward

MAX_POINTS = 2**13
_MAX_STEPS = 512
_POINTS_AT_ONCE = 256


@pytree
class LookValues:
    """Expected rewards of one modality's looks at a PoI.

    Attributes:
      one_step: `[P]` of the next look alone, at the points of the lattice.
      q: `[P]` of the next look and all worthwhile looks after it.
      one_step_unseen: `[]` of the first look at a PoI alone.
      q_unseen: `[]` of the first look and all worthwhile looks after it.
      labels: `[C, L]` float32, 1 where a class has a label of the sensor and 0 elsewhere, if the
        lattice is of the labels; None if it is of the classes.
    """

    one_step: jax.Array
    q: jax.Array
    one_step_unseen: jax.Array
    q_unseen: jax.Array
    labels: jax.Array | None = None

    def of_next(
        self, probabilities: Float[Array, " C"], is_seen: Bool[Array, ""]
    ) -> Float[Array, ""]:
        """Value of the next look alone."""
        return jnp.where(is_seen, self._read(self.one_step, probabilities), self.one_step_unseen)

    def of_all(
        self, probabilities: Float[Array, " C"], is_seen: Bool[Array, ""]
    ) -> Float[Array, ""]:
        """Value of the next look and all worthwhile looks after it."""
        return jnp.where(is_seen, self._read(self.q, probabilities), self.q_unseen)

    def _read(self, table: jax.Array, probabilities: jax.Array) -> jax.Array:
        """A table at class probabilities."""
        of_labels = probabilities if self.labels is None else product(probabilities, self.labels)
        return interpolate(table, of_labels)


def steps_of_lattice(num_classes: int, max_points: int = MAX_POINTS) -> int:
    """Steps of the lattice along each edge of the simplex; the more classes, the fewer."""
    fits = [n for n in range(1, _MAX_STEPS + 1) if _num_points(n, num_classes) <= max_points]
    return max(fits, default=1)


def _num_points(steps: int, num_classes: int) -> int:
    return math.comb(steps + num_classes - 1, num_classes - 1)


def lattice(num_classes: int, max_points: int = MAX_POINTS) -> Float[np.ndarray, "P C"]:
    """Class probabilities at the points of the lattice, in the order of a table's rows."""
    steps = steps_of_lattice(num_classes, max_points)
    each = itertools.combinations(range(steps + num_classes - 1), num_classes - 1)
    # C - 1 bars divide the steps among the classes.
    bars = np.array(list(each), int).reshape(_num_points(steps, num_classes), num_classes - 1)[
        :, ::-1
    ]
    sums = bars - np.arange(num_classes - 1)[::-1]
    ends = np.full((len(sums), 1), steps), sums, np.zeros((len(sums), 1), int)
    weights = -np.diff(np.concatenate(ends, axis=1), axis=1) / steps
    return weights[np.argsort(_rows(sums, steps))]


def _rows(sums, steps: int):
    """Row of each point: its number in the combinatorial number system."""
    size = sums.shape[-1]
    # Clip unused binomials that would overflow int32.
    table = [
        [min(math.comb(n, k), 2**31 - 1) for k in range(size + 1)] for n in range(steps + size)
    ]
    ranks = np.broadcast_to(np.arange(size, 0, -1), sums.shape)
    arrays = sums.__array_namespace__()  # of NumPy or of JAX
    choose = arrays.asarray(table, dtype=np.int32)
    return choose[sums + ranks - 1, ranks].sum(axis=-1)


def interpolate(table: Float[Array, " P"], probabilities: Float[Array, " C"]) -> Float[Array, ""]:
    """Interpolates a table of values linearly between the points of the lattice."""
    checks.require_shape("probabilities", probabilities, (None,))
    chex.assert_rank(table, 1)
    steps = steps_of_lattice(len(probabilities), len(table))
    number = _num_points(steps, len(probabilities))
    if len(table) != number:
        reason = f"must be {number} or another size of a grid"
        raise ValueError(f"length of table = {len(table)}: {reason}")
    rows, shares = _corners(probabilities, steps)
    return jnp.sum(shares * table[rows])


def _corners(weights: jax.Array, steps: int) -> tuple[jax.Array, jax.Array]:
    """`[C]` rows of the points of the lattice around a posterior, and their shares in it."""
    sums = steps * jnp.cumsum(weights[::-1])[::-1][1:]
    base = jnp.clip(jnp.floor(sums), 0, steps - 1)
    rest = jnp.clip(sums - base, 0.0, 1.0)
    # From the base one step along each axis, the one with the largest rest first. On a CPU, under
    # `vmap`, sorting takes many times as long as comparing all pairs.
    axes = jnp.arange(len(rest))
    ahead = (rest[None] > rest[:, None]) | (
        (rest[None] == rest[:, None]) & (axes[None] < axes[:, None])
    )
    rank = jnp.sum(ahead, axis=1)
    ordered = jnp.sum(jnp.where(rank[None] == axes[:, None], rest[None], 0.0), axis=1)
    falling = jnp.pad(ordered, 1, constant_values=(1, 0))
    walk = rank[None, :] < jnp.arange(len(weights))[:, None]
    return _rows(base.astype(jnp.int32)[None, :] + walk.astype(jnp.int32), steps), falling[
        :-1
    ] - falling[1:]


@checks.typed
def value_iteration(
    likelihoods: Float[Array, "C K C"],
    reward: Reward,
    mixture: Callable[[jax.Array], Belief],
    prior: Belief,
    config: MdpConfig,
    horizon: int,
    max_points: int = MAX_POINTS,
    start: Float[Array, " C"] | None = None,
) -> LookValues:
    """Computes the values of one modality's looks by dynamic programming.

    Instead of classes, all may be of a sensor's labels, if the reward depends on them alone.

    Args:
      likelihoods: for a PoI of each class and each of K equally likely looks at it, logarithms of
        the likelihoods of all classes, up to a constant.
      start: probabilities of an unseen PoI's classes; by default, they are equally likely.

    Returns:
      The values at the points of the lattice. The optimal policy takes every look whose `q` is
      above 0, that of no operation.
    """
    chex.assert_rank(likelihoods, 3)
    number, num_looks, _ = likelihoods.shape
    chex.assert_shape(likelihoods, (number, None, number))
    checks.require_finite("likelihoods", likelihoods)
    checks.require_number("horizon", horizon)
    points = jnp.asarray(lattice(number, max_points), likelihoods.dtype)
    steps = steps_of_lattice(number, len(points))
    # The unseen PoI is the last row, to which no look leads.
    start = jnp.full(number, 1 / number, points.dtype) if start is None else start
    checks.require_shape("start", start, (number,))
    checks.require_probabilities("start", start)
    points = jnp.concatenate([points, start[None]])

    def information(probabilities: jax.Array) -> jax.Array:
        return reward.information(mixture(probabilities), probabilities)

    before = jax.vmap(information)(points)
    before = before.at[-1].set(reward.information(prior, points[-1]))

    def looks(row: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        """`[C, K]` rewards of the looks, and the corners around the posteriors after them."""
        probabilities, before = row

        def look(likelihood: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            after = probabilities * jnp.exp(likelihood - jnp.max(likelihood))
            # Keep the prior if the look contradicts every class.
            after = jnp.where(jnp.sum(after) > 0, after, probabilities)
            after /= jnp.sum(after)
            rows, shares = _corners(after, steps)
            return reward.of_gain(information(after) - before), rows, shares

        return jax.vmap(jax.vmap(look))(likelihoods)

    rewards, rows, shares = jax.lax.map(looks, (points, before), batch_size=_POINTS_AT_ONCE)
    chances = points[:, :, None] / num_looks
    one_step = jnp.sum(chances * rewards, axis=(1, 2))

    def earlier(q: jax.Array, left: jax.Array) -> tuple[jax.Array, None]:
        following = jnp.sum(shares * jnp.maximum(q, 0.0)[rows], axis=-1)
        longer = one_step + jnp.sum(chances * following, axis=(1, 2))
        return jnp.where(left <= config.max_steps, longer, q), None

    q, _ = jax.lax.scan(earlier, one_step, jnp.arange(2, horizon + 1))
    return LookValues(one_step[:-1], q[:-1], one_step[-1], q[-1])
