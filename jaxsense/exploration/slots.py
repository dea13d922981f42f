"""A map of objects: a fixed number of slots, each for one object that robots have found.

Scans yield candidates; `associate` says which slot each is of, `with_candidates` and `with_misses`
update the slots, `merged` unites two slots of one object, and `gospa` scores the map.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsense.core.types import Belief, T, product, pytree
from jaxsense.exploration.proposals import Candidates
from jaxsense.mission.state import RECENT_LOOKS
from jaxsense.models import Models

_GATE = 9.21  # chi-square of 2 degrees of freedom at .99
_UNKNOWN = 0.01  # new objects per m2 that a scan may show
_TOLERANCE = 0.1  # of twice a log-likelihood
_DRIFT = 1e-5  # m2 a scan; errors that scans share, such as those of poses, do not average out
_FAR = 1e3  # m, where no robot comes near
_SUREST = 10.0  # log-odds; more would hold out against too many misses
_SURE = 3.0  # log-odds; slots below its negative are cleared
_EVIDENCE = 0.9, -3.9  # factor of log-odds, and addend: logistic regression on 224 missions
_FIRST = -2.0  # log-odds; of candidates that no other scan confirms, few are objects


Number = Float[Array, ""] | float


@pytree
class Slots:
    """S slots for objects; unused ones are far away and hold the prior.

    Attributes:
      existence: log-odds that there is an object.
      position: in metres.
      covariance: of the position, in square metres.
      belief: `[S, D]`.
      log_posterior: logarithms of the classes' probabilities by exact Bayes.
      times_seen: number of detections by each modality.
      looked_from: places of each modality's latest detections, in metres, as in `MissionState`.
      overflow: number of candidates so far that found no free slot.
    """

    existence: Float[Array, " S"]
    is_used: Bool[Array, " S"]
    position: Float[Array, "S 2"]
    covariance: Float[Array, "S 2 2"]
    belief: Belief
    log_posterior: Float[Array, "S C"]
    times_seen: Int[Array, "S M"]
    looked_from: Float[Array, "S M K 2"]
    overflow: Int[Array, ""]


@pytree
class Association:
    """Which candidate of a scan is of which slot.

    Attributes:
      slot: of each candidate; S for a new object, -1 for none: not valid, or a second candidate of
        a new object.
      candidate: that updates each slot, the most likely one of it; C for none.
    """

    slot: Int[Array, " C"]
    candidate: Int[Array, " S"]

    @property
    def is_seen(self) -> Bool[Array, " S"]:
        """Which slots have a candidate."""
        return self.candidate < self.slot.shape[-1]


@pytree
class Gospa:
    """GOSPA and its parts (Rahmathullah, Garcia-Fernandez and Svensson 2017, with alpha = 2).

    Attributes:
      total: in metres; its power p is the sum of the three parts.
      localisation: sum of `distance^p` over the objects found.
      missed: `cutoff^p / 2` for each object without a slot.
      false: `cutoff^p / 2` for each slot without an object.
      duplicates: number of these slots within the cutoff of an object that has one.
      slot: of each object, S for none.
      position_error: mean distance of the objects found from their slots, in metres; 0 for none.
    """

    total: Float[Array, ""]
    localisation: Float[Array, ""]
    missed: Float[Array, ""]
    false: Float[Array, ""]
    duplicates: Int[Array, ""]
    slot: Int[Array, " N"]
    position_error: Float[Array, ""]


def empty(models: Models, number: int) -> Slots:
    """Slots before any scan."""
    shape = number, len(models.bayes.labels)
    return Slots(
        existence=jnp.zeros(number),
        is_used=jnp.zeros(number, bool),
        position=jnp.full((number, 2), _FAR, jnp.float32),
        covariance=jnp.tile(jnp.eye(2), (number, 1, 1)),
        belief=jax.tree.map(lambda x: jnp.tile(x, (number, 1)), models.fusion.prior),
        log_posterior=jnp.tile(models.bayes.prior, (number, 1)),
        times_seen=jnp.zeros(shape, jnp.int32),
        looked_from=jnp.full((*shape, RECENT_LOOKS, 2), jnp.inf, jnp.float32),
        overflow=jnp.int32(0),
    )


def found(slots: Slots) -> Bool[Array, " S"]:
    """Which slots almost surely hold an object."""
    return slots.is_used & (slots.existence >= _SURE)


def probability(slots: Slots) -> Float[Array, " S"]:
    """Probability that a slot holds an object, and no better slot does.

    Evidence counts less than its sum, because scans share their errors, and a slot may be the
    second of one object.
    """
    return jax.nn.sigmoid(_EVIDENCE[0] * slots.existence + _EVIDENCE[1])


def associate(slots: Slots, candidates: Candidates, radius: Number) -> Association:
    """Assigns all candidates of a scan at once, with the largest likelihood by an auction.

    A candidate may be of a slot within the gate, or of one so near that two bodies would overlap.
    Of candidates that a slot is too small for, one is of it, and so are those that would overlap
    with that one; all others are new objects, however near they are to known ones.

    Args:
      radius: of the objects, in metres.
    """
    squared, log_det, apart, overlap = _compared(candidates, slots, radius)
    may_be = candidates.is_valid[:, None] & slots.is_used[None] & ((squared < _GATE) | overlap)
    # The distance decides among slots outside of the gate.
    cost = jnp.minimum(squared, _GATE) + log_det + apart + 2 * jnp.log(2 * jnp.pi * _UNKNOWN)
    slot = auction(jnp.where(may_be, -cost, -jnp.inf), _TOLERANCE)

    number, index = len(slots.is_used), jnp.arange(len(slot))
    candidate = jnp.full(number, len(index)).at[slot].set(index, mode="drop")

    *_, apart, overlap = _compared(candidates, candidates, radius)
    # One that is assigned is the nearest to itself.
    apart = jnp.where(overlap & (slot < number)[None], apart, jnp.inf)
    slot = jnp.where(jnp.min(apart, axis=1) < jnp.inf, slot[jnp.argmin(apart, axis=1)], number)
    is_new = candidates.is_valid & (slot == number)
    earlier = overlap & is_new[None] & (index[None] < index[:, None])
    is_any = candidates.is_valid & ~(is_new & jnp.any(earlier, axis=1))
    return Association(jnp.where(is_any, slot, -1), candidate)


def with_candidates(
    slots: Slots,
    candidates: Candidates,
    association: Association,
    detection: Number,
    clutter: Number,
) -> Slots:
    """Updates the slots that candidates are of, and fills free ones with new objects.

    The existence follows integrated probabilistic data association (Musicki, Evans and Stankovic
    1994) with one candidate a slot.

    Args:
      detection: probability that a scan yields a candidate of an object in view.
      clutter: false candidates per scan and square metre in view.
    """
    number, most = len(slots.is_used), len(candidates.is_valid)
    is_free, is_new = ~slots.is_used, association.slot == number
    # The first free slot takes the first new object, and so on.
    first, *_ = jnp.nonzero(is_new, size=number, fill_value=most)
    own = jnp.where(is_free, first[jnp.cumsum(is_free) - 1], association.candidate)
    seen = jax.tree.map(lambda x: x.at[own].get(mode="clip"), candidates)

    known, log_density = _fused(slots, seen)
    odds = jnp.logaddexp(jnp.log1p(-detection), jnp.log(detection / clutter) + log_density)
    existence = jnp.minimum(slots.existence + odds, _SUREST)
    known = dataclasses.replace(known, existence=existence)
    first_seen = {"position": seen.position, "covariance": seen.covariance}
    first_seen |= {"existence": jnp.full(number, _FIRST), "is_used": jnp.ones(number, bool)}
    new = dataclasses.replace(slots, **first_seen)
    after = _where(own < most, _where(is_free, new, known), slots)
    overflow = slots.overflow + jnp.maximum(jnp.sum(is_new) - jnp.sum(is_free), 0)
    return dataclasses.replace(after, overflow=overflow)


def with_misses(
    models: Models, slots: Slots, missed: Bool[Array, " S"], detection: Number
) -> Slots:
    """Lowers the existence of slots that a scan should have shown, and clears unlikely ones.

    Args:
      missed: slots in view and not hidden, of which the scan has no candidate.
      detection: as for `with_candidates`.
    """
    lost = jnp.where(missed & slots.is_used, jnp.log1p(-detection), 0.0)
    slots = dataclasses.replace(slots, existence=slots.existence + lost)
    return _where(slots.existence < -_SURE, empty(models, len(lost)), slots)


def merged(models: Models, slots: Slots, radius: Number) -> Slots:
    """Unites pairs of slots that would overlap; of three, the third follows at the next call.

    The slot with more looks stays, with its belief.
    """
    index = jnp.arange(len(slots.is_used))
    *_, apart, overlap = _compared(slots, slots, radius)
    may_be = slots.is_used[:, None] & slots.is_used[None] & (index[:, None] != index[None])
    apart = jnp.where(overlap & may_be, apart, jnp.inf)
    partner = jnp.argmin(apart, axis=1)
    is_pair = (jnp.min(apart, axis=1) < jnp.inf) & (partner[partner] == index)
    more = jnp.sum(slots.times_seen - slots.times_seen[partner], axis=1)
    stays = (more > 0) | ((more == 0) & (index < partner))

    other = jax.tree.map(lambda x: x[partner] if x.ndim else x, slots)
    united, _ = _fused(slots, other)
    evidence = slots.log_posterior + other.log_posterior - models.bayes.prior[None]
    # The looks at the other one follow in the ring.
    turn = (jnp.arange(RECENT_LOOKS)[None, None] - slots.times_seen[..., None]) % RECENT_LOOKS
    follow = jnp.take_along_axis(other.looked_from, turn[..., None], axis=2)
    is_later = (turn < other.times_seen[..., None])[..., None]
    united = dataclasses.replace(
        united,
        existence=jnp.maximum(slots.existence, other.existence),
        log_posterior=jax.nn.log_softmax(evidence),
        times_seen=slots.times_seen + other.times_seen,
        looked_from=jnp.where(is_later, follow, slots.looked_from),
    )
    slots = _where(is_pair & stays, united, slots)
    return _where(is_pair & ~stays, empty(models, len(index)), slots)


def gospa(
    positions: Float[Array, "S 2"],
    is_found: Bool[Array, " S"],
    truth: Float[Array, "N 2"],
    is_present: Bool[Array, " N"],
    cutoff: float = 0.3,
    p: int = 1,
) -> Gospa:
    """Error of a map, with an assignment by an auction: up to .001 `cutoff^p` an object too large.

    Args:
      cutoff: distance at which a slot is not of an object, in metres.
    """
    distance = jnp.linalg.norm(positions[:, None] - truth[None], axis=-1)
    may_be = is_found[:, None] & is_present[None] & (distance < cutoff)
    own = auction(jnp.where(may_be, cutoff**p - distance**p, -jnp.inf), 1e-3 * cutoff**p)
    is_pair = own[:, None] == jnp.arange(len(truth))[None]
    has_slot, has_object = jnp.any(is_pair, axis=0), jnp.any(is_pair, axis=1)
    localisation = jnp.sum(jnp.where(is_pair, distance, 0.0) ** p)
    missed = jnp.sum(is_present & ~has_slot) * cutoff**p / 2
    false = jnp.sum(is_found & ~has_object) * cutoff**p / 2
    is_again = jnp.any(may_be & has_slot[None], axis=1) & ~has_object
    error = jnp.sum(jnp.where(is_pair, distance, 0.0)) / jnp.maximum(jnp.sum(is_pair), 1)
    total = (localisation + missed + false) ** (1 / p)
    slot = jnp.where(has_slot, jnp.argmax(is_pair, axis=0), len(is_found))
    return Gospa(total, localisation, missed, false, jnp.sum(is_again), slot, error)


def auction(profit: Float[Array, "C S"], tolerance: float) -> Int[Array, " C"]:
    """Assigns rows to columns, each at most once, with the largest sum of profits.

    The auction of Bertsekas 1988, in which each row may also stay without a column, for no profit.
    The sum falls short of the largest one by at most `tolerance` for each row.

    Args:
      profit: minus infinity where a row must not have a column.

    Returns:
      The column of each row, S for none.
    """
    rows, columns = (jnp.arange(size) for size in profit.shape)
    with_none = jnp.append(profit, jnp.zeros((len(rows), 1)), axis=1)

    def bid(state: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        owner, price, _ = state
        values, best = jax.lax.top_k(with_none - jnp.append(price, 0.0)[None], 2)
        is_best = ~jnp.isin(rows, owner)[:, None] & (best[:, :1] == columns[None])
        rise = values[:, :1] - values[:, 1:] + tolerance
        offers = jnp.where(is_best, price[None] + rise, -jnp.inf)
        has_offer = jnp.any(is_best, axis=0)
        owner = jnp.where(has_offer, jnp.argmax(offers, axis=0), owner)
        return owner, jnp.where(has_offer, jnp.max(offers, axis=0), price), jnp.any(has_offer)

    start = jnp.full(len(columns), len(rows)), jnp.zeros(len(columns)), jnp.bool_(True)
    owner, *_ = jax.lax.while_loop(lambda state: state[2], bid, start)
    return jnp.full(len(rows), len(columns)).at[owner].set(columns, mode="drop")


def _where(is_new: Bool[Array, " S"], new: T, old: T) -> T:
    """Replaces rows of all arrays; numbers that are not of slots stay."""
    mask = lambda x: is_new.reshape(-1, *[1] * (x.ndim - 1))  # noqa: E731
    return jax.tree.map(lambda x, y: jnp.where(mask(x), x, y) if x.ndim else y, new, old)


def _compared(
    some: Slots | Candidates, others: Slots | Candidates, radius: Number
) -> tuple[jax.Array, ...]:
    """`[A, B]` for all pairs.

    Returns:
      The squared Mahalanobis distance, log-determinant of the summed covariances, distance in
      metres, and whether two bodies there would overlap, surely or as far as is known.
    """
    apart = some.position[:, None] - others.position[None]
    total = some.covariance[:, None] + others.covariance[None]
    squared, log_det, _ = _gauge(apart, total)
    distance = jnp.linalg.norm(apart, axis=-1)
    spread = jnp.sqrt(jnp.trace(total, axis1=-2, axis2=-1))
    is_near = distance + jnp.where(squared < _GATE, 0.0, spread) < 2 * radius
    return squared, log_det, distance, is_near


def _gauge(apart: Float[Array, "*A 2"], total: Float[Array, "*A 2 2"]) -> tuple[jax.Array, ...]:
    """Squared Mahalanobis distance; log-determinant and inverse of the covariance."""
    xx, xy, yy = total[..., 0, 0], total[..., 0, 1], total[..., 1, 1]
    determinant = xx * yy - xy**2
    inverse = jnp.stack([yy, -xy, -xy, xx], -1).reshape(total.shape) / determinant[..., None, None]
    squared = jnp.sum(apart * product(inverse, apart[..., None])[..., 0], axis=-1)
    return squared, jnp.log(determinant), inverse


def _fused(slots: Slots, others: Slots | Candidates) -> tuple[Slots, Float[Array, " S"]]:
    """Kalman update of each slot by one of the others, in Joseph's form.

    Outside of the gate, the covariance of the others grows until they are at about its edge.

    Returns:
      Slots, and log-densities of the others, per square metre.
    """
    covariance = slots.covariance + _DRIFT * jnp.eye(2)[None]
    apart = others.position - slots.position
    squared, *_ = _gauge(apart, covariance + others.covariance)
    noise = others.covariance * jnp.maximum(squared / _GATE, 1.0)[:, None, None]
    squared, log_det, inverse = _gauge(apart, covariance + noise)
    gain = product(covariance, inverse)
    rest = jnp.eye(2)[None] - gain
    joseph = [product(product(a, x), a.mT) for a, x in ((rest, covariance), (gain, noise))]
    after = joseph[0] + joseph[1]
    moved = slots.position + product(gain, apart[..., None])[..., 0]
    fused = dataclasses.replace(slots, position=moved, covariance=(after + after.mT) / 2)
    return fused, -(squared + log_det) / 2 - jnp.log(2 * jnp.pi)
