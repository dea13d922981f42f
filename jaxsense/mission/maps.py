"""Maps that robots decide by: one that all share, or one of each robot."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxsense.core.types import Belief, Index, pytree
from jaxsense.mission import memory
from jaxsense.mission.memory import Evidence, Memory
from jaxsense.mission.state import Mission, MissionState
from jaxsense.models import Models


@pytree
class Contents:
    """What a map says of N PoIs.

    Attributes:
      belief: `[N, D]`.
      log_posterior: `[N, C]` logarithms of the classes' probabilities by exact Bayes.
      times_seen: `[N, M]` int32, number of detections of each PoI by each modality.
    """

    belief: Belief
    log_posterior: Float[Array, "N C"]
    times_seen: Int[Array, "N M"]


@pytree
class Learned:
    """What a look changes.

    Attributes:
      belief: `[D]` belief about its PoI after all looks.
      log_posterior: `[C]` the same by exact Bayes.
      evidence: `[C]` of the look, as far as it is new; None where all robots share a map.
    """

    belief: Belief
    log_posterior: Float[Array, " C"]
    evidence: Evidence | None


@pytree
class SharedMap:
    """The map of all looks, which every robot knows without delay.

    Attributes:
      contents: of the map.
      looked_from: `[N, M, K, 2]` places of recent looks, see `MissionState`.
      version: `[]` int32, number of updates.
    """

    contents: Contents
    looked_from: Float[Array, "N M K 2"]
    version: Int[Array, ""]

    def read(self, models: Models) -> Contents:
        """What the map says.

        Args:
          models: not used.
        """
        del models
        return self.contents

    def apart(
        self, positions: Float[Array, "P 2"], poi: Int[Array, ""], modality: Index
    ) -> Float[Array, "P K"]:
        """Distances from the recent looks by a sensor at a PoI, in metres; infinite for none.

        Args:
          positions: `[P, 2]` places to look from.
          poi: index of the PoI.
          modality: index of the sensor.
        """
        places = self.looked_from[poi, modality]
        return jnp.linalg.norm(positions[:, None] - places[None], axis=-1)

    def learn(
        self,
        models: Models,
        poi: Int[Array, ""],
        features: Float[Array, " D_m"],
        modality: int,
        weight: Float[Array, ""],
    ) -> Learned:
        """What one more look changes.

        Args:
          models: trained models.
          poi: index of the PoI.
          features: `[D_m]` probabilities of the labels.
          modality: index of the sensor; static.
          weight: `[]` share of the look that is new evidence, see `vae.Novelty`.
        """
        old: Contents = jax.tree.map(lambda x: x[poi], self.contents)
        seen = old.times_seen > 0
        return Learned(
            belief=models.fusion.update(old.belief, seen, features, modality, weight),
            log_posterior=models.bayes.update(old.log_posterior, features, modality, weight),
            evidence=None,
        )


@pytree
class OwnMap:
    """The map of one robot, from its own looks and from what the others have told it.

    Attributes:
      memory: the looks of all robots.
      is_known: `[R, L]` bool, which of them the robot knows of.
      num_pois: N.
    """

    memory: Memory
    is_known: Bool[Array, "R L"]
    num_pois: int = struct.field(pytree_node=False)

    @property
    def version(self) -> Int[Array, ""]:
        """Number of looks that the robot knows of, `[]` int32."""
        return jnp.sum(self.is_known)

    def read(self, models: Models) -> Contents:
        """What the map says.

        Args:
          models: trained models.
        """
        total = self.memory.total(self.is_known, self.num_pois)
        of_pois = jax.vmap(lambda found: memory.belief_of(models.fusion, found))
        num_modalities = len(models.detectors)
        return Contents(
            belief=of_pois(total.log_likelihood),
            log_posterior=jax.nn.log_softmax(models.bayes.prior[None] + total.exact),
            times_seen=self.memory.times_seen(self.is_known, self.num_pois, num_modalities),
        )

    def apart(
        self, positions: Float[Array, "P 2"], poi: Int[Array, ""], modality: Index
    ) -> Float[Array, "P K"]:
        """Distances from the looks by a sensor at a PoI that the robot knows of, see `SharedMap`.

        Args:
          positions: `[P, 2]` places to look from.
          poi: index of the PoI.
          modality: index of the sensor.
        """
        return self.memory.apart(self.is_known, positions, poi, modality)

    def learn(
        self,
        models: Models,
        poi: Int[Array, ""],
        features: Float[Array, " D_m"],
        modality: int,
        weight: Float[Array, ""],
    ) -> Learned:
        """What one more look changes in the map of all looks, and what the robot remembers of it.

        Args:
          models: trained models; their fusion must accumulate looks.
          poi: index of the PoI.
          features: `[D_m]` probabilities of the labels.
          modality: index of the sensor; static.
          weight: `[]` share of the look that is new evidence, see `vae.Novelty`.
        """
        found = Evidence(
            log_likelihood=log_likelihood(models, features, modality, weight),
            exact=weight * models.bayes.log_likelihoods(features, modality),
        )
        before = self.memory.total(self.memory.taken(), self.num_pois)
        after: Evidence = jax.tree.map(lambda rows, new: rows[poi] + new, before, found)
        return Learned(
            belief=memory.belief_of(models.fusion, after.log_likelihood),
            log_posterior=jax.nn.log_softmax(models.bayes.prior + after.exact),
            evidence=found,
        )


def log_likelihood(
    models: Models, features: Float[Array, " D_m"], modality: int, weight: Float[Array, ""]
) -> Float[Array, " C"]:
    """Log-likelihoods of the classes given one look, up to a constant.

    Args:
      models: trained models; their fusion must accumulate looks.
      features: `[D_m]` probabilities of the labels.
      modality: index of the sensor; static.
      weight: `[]` share of the look that is new evidence, see `vae.Novelty`.
    """
    fusion, nobody = models.fusion, jnp.zeros(len(models.detectors), bool)
    alone = fusion.update(fusion.prior, nobody, features, modality, weight)
    return jnp.log(fusion.class_probabilities(alone))


def map_of(mission: Mission, state: MissionState, robot: Index) -> SharedMap | OwnMap:
    """The map that a robot decides by.

    Args:
      mission: the mission.
      state: the current state.
      robot: index of the robot.
    """
    if state.memory is None:
        contents = Contents(state.belief, state.log_posterior, state.times_seen)
        return SharedMap(contents, state.looked_from, state.version)
    is_known = state.memory.known_to(robot, mission.time(state))
    return OwnMap(state.memory, is_known, mission.config.arena.num_pois)
