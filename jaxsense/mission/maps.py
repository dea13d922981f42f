"""Maps that robots decide by: one that all share, or one of each robot, with messages between them.

With maps of their own, the evidence of looks adds up in log-likelihoods of the classes, so a
robot's map follows from the sums that each robot keeps of its own looks. A message holds the whole
sums of its sender and how many looks they are of. Of two messages from one sender, a receiver keeps
the one of more looks: messages that come late or twice change nothing, and the next one makes up
for those that are lost.

So all that a robot knows of another are the first k of its looks, for some k that only grows. This
module stores every look once and, for each robot, when it heard of it, which is the same.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxsense.config.mission import CommunicationConfig
from jaxsense.core.types import Belief, Fusion, Index, Key, product, pytree
from jaxsense.models import Models
from jaxsense.vae import readout

MOST_LOOKS = 256
"""Detections that a robot remembers in a mission; further ones do not reach any robot's map."""


@pytree
class Evidence:
    """Log-likelihoods of the classes given one or several looks, up to a constant.

    Attributes:
      log_likelihood: by fusion.
      exact: by exact Bayes.
    """

    log_likelihood: Float[Array, "*S C"]
    exact: Float[Array, "*S C"]


@pytree
class Memory:
    """The L looks that each of R robots remembers, and when each robot heard of them.

    Attributes:
      modality: index of each robot's sensor.
      number: detections so far.
      poi: PoI of each look.
      place: from where, as the robot believes, in metres.
      evidence: of each look, as far as it is new.
      heard_at: seconds from the start at which the first robot heard of a look of the second;
        infinite for never.
    """

    modality: Int[Array, " R"]
    number: Int[Array, " R"]
    poi: Int[Array, "R L"]
    place: Float[Array, "R L 2"]
    evidence: Evidence
    heard_at: Float[Array, "R R L"]

    def known_to(self, robot: Index, seconds: Float[Array, ""] | float) -> Bool[Array, "R L"]:
        """Which looks a robot knows of."""
        return self.heard_at[robot] <= seconds

    def taken(self) -> Bool[Array, "R L"]:
        """Which looks have been taken."""
        return jnp.arange(MOST_LOOKS)[None] < self.number[:, None]

    def total(self, known: Bool[Array, "R L"], num_pois: int) -> Evidence:
        """`[N, C]` sums of the evidence of some looks for each PoI."""
        return jax.tree.map(lambda x: self.sum(known, x, num_pois), self.evidence)

    def sum(
        self, known: Bool[Array, "R L"], values: Shaped[Array, "R L X"], num_pois: int
    ) -> Shaped[Array, "N X"]:
        """Sums of values of some looks for each PoI."""
        # A product, because an accelerator adds scattered rows in any order.
        is_at = (jnp.arange(num_pois)[:, None, None] == self.poi[None]) & known[None]
        flat = values.reshape(-1, values.shape[-1])
        is_at = is_at.reshape(num_pois, -1).astype(values.dtype)
        return product(is_at, flat)

    def with_look(
        self,
        robot: Index,
        poi: Int[Array, ""],
        place: Float[Array, "2"],
        evidence: Evidence,
        seconds: Float[Array, ""],
        applies: Bool[Array, ""],
    ) -> "Memory":
        """Adds a look, which at first only the robot itself knows of.

        Args:
          place: from where, in metres.
        """
        # Beyond the end, which drops it.
        slot = jnp.where(applies, self.number[robot], MOST_LOOKS)
        put = lambda rows, row: rows.at[robot, slot].set(row, mode="drop")  # noqa: E731
        return dataclasses.replace(
            self,
            number=self.number.at[robot].add(applies),
            poi=put(self.poi, poi),
            place=put(self.place, place),
            evidence=jax.tree.map(put, self.evidence, evidence),
            heard_at=self.heard_at.at[robot, robot, slot].set(seconds, mode="drop"),
        )

    def after_messages(
        self,
        key: Key,
        config: CommunicationConfig,
        seconds: Float[Array, ""],
        sends: Bool[Array, " R"],
    ) -> "Memory":
        """Some robots tell all others of all looks that they have taken themselves."""
        lost_key, delay_key = jax.random.split(key)
        links = len(sends), len(sends)
        is_lost = jax.random.bernoulli(lost_key, config.loss, links)
        delay = config.delay * jax.random.uniform(delay_key, links, maxval=2.0)
        arrives = jnp.where(is_lost | ~sends[None], jnp.inf, seconds + delay)
        told = jnp.where(self.taken()[None], arrives[..., None], jnp.inf)
        return dataclasses.replace(self, heard_at=jnp.minimum(self.heard_at, told))


def empty(modality: Int[Array, " R"], num_classes: int) -> Memory:
    """Memory before the first look."""
    shape = len(modality), MOST_LOOKS
    nothing = jnp.zeros((*shape, num_classes))
    return Memory(
        modality=modality,
        number=jnp.zeros(len(modality), jnp.int32),
        poi=jnp.zeros(shape, jnp.int32),
        place=jnp.zeros((*shape, 2)),
        evidence=Evidence(nothing, nothing),
        heard_at=jnp.full((len(modality), *shape), jnp.inf, jnp.float32),
    )


def belief_of(fusion: Fusion, log_likelihood: Float[Array, " C"]) -> Belief:
    """Belief that holds some evidence, `[D]`; the prior if there is none.

    Args:
      log_likelihood: sum of the looks' log-likelihoods, up to a constant; 0 for no looks.
    """
    mixed = readout.mixture(fusion.classes, jax.nn.softmax(log_likelihood))
    is_none = jnp.all(log_likelihood == 0)
    return jax.tree.map(lambda new, old: jnp.where(is_none, old, new), mixed, fusion.prior)


@pytree
class Contents:
    """What a map says of N PoIs.

    Attributes:
      log_posterior: logarithms of the classes' probabilities by exact Bayes.
      times_seen: number of detections of each PoI by each modality.
    """

    belief: Belief
    log_posterior: Float[Array, "N C"]
    times_seen: Int[Array, "N M"]


@pytree
class SharedMap(Contents):
    """The map of all looks, which every robot knows without delay.

    Attributes:
      looked_from: places of recent looks, see `MissionState`.
    """

    looked_from: Float[Array, "N M K 2"]

    @property
    def version(self) -> Int[Array, ""]:
        """Number of looks."""
        return jnp.sum(self.times_seen)

    def read(self, models: Models) -> Contents:
        """What the map says."""
        del models
        return self

    def apart(
        self, positions: Float[Array, "P 2"], poi: Int[Array, ""], modality: Index
    ) -> Float[Array, "P K"]:
        """Distances from the recent looks by a sensor at a PoI, in metres; infinite for none."""
        places = self.looked_from[poi, modality]
        return jnp.linalg.norm(positions[:, None] - places[None], axis=-1)


@pytree
class OwnMap:
    """The map of one robot, from its own looks and from what the others have told it.

    Attributes:
      is_known: which of them the robot knows of.
    """

    memory: Memory
    is_known: Bool[Array, "R L"]
    num_pois: int = struct.field(pytree_node=False)

    @property
    def version(self) -> Int[Array, ""]:
        """Number of looks that the robot knows of."""
        return jnp.sum(self.is_known)

    def read(self, models: Models) -> Contents:
        """What the map says."""
        known, looks = self.is_known, self.memory
        total = looks.total(known, self.num_pois)
        is_by = jax.nn.one_hot(looks.modality, len(models.detectors), dtype=jnp.int32)
        by_look = jnp.broadcast_to(is_by[:, None], (*known.shape, len(models.detectors)))
        return Contents(
            belief=jax.vmap(belief_of, (None, 0))(models.fusion, total.log_likelihood),
            log_posterior=jax.nn.log_softmax(models.bayes.prior[None] + total.exact),
            times_seen=looks.sum(known, by_look, self.num_pois),
        )

    def apart(
        self, positions: Float[Array, "P 2"], poi: Int[Array, ""], modality: Index
    ) -> Float[Array, "P K"]:
        """The same as in `SharedMap`, from the looks that the robot knows of."""
        looks = self.memory
        counts = self.is_known & (looks.poi == poi) & (looks.modality == modality)[:, None]
        away = positions[:, None] - looks.place.reshape(1, -1, 2)
        return jnp.where(counts.reshape(1, -1), jnp.linalg.norm(away, axis=-1), jnp.inf)


def evidence_of(
    models: Models, features: Float[Array, " D_m"], modality: int, weight: Float[Array, ""]
) -> Evidence:
    """What one look says, as far as it is new.

    Args:
      weight: share of the look that is new evidence, see `core.novelty`.
    """
    fusion, nobody = models.fusion, jnp.zeros(len(models.detectors), bool)
    alone = fusion.update(fusion.prior, nobody, features, modality, weight)
    return Evidence(
        log_likelihood=jnp.log(fusion.class_probabilities(alone)),
        exact=weight * models.bayes.log_likelihoods(features, modality),
    )
