"""The map MDP with stored detections in NumPy, one environment at a time."""

import dataclasses

import numpy as np

from jaxsense import Config, make_jmvae
from jaxsense.core.networks import Params
from jaxsense.core.types import Samples


@dataclasses.dataclass
class NumpyMap:
    """The map, and what it is a map of.

    Attributes:
      mean: `[N, D]` float32.
      std: `[N, D]` float32.
      seen: `[N, M]` bool.
      classes: `[N]` true classes.
      steps: actions so far.
    """

    mean: np.ndarray
    std: np.ndarray
    seen: np.ndarray
    classes: np.ndarray
    steps: int


class NumpyMdp:
    """`dqn.mdp` of one robot on a bank of detections, with the same rewards and the same maps."""

    def __init__(self, config: Config, params: Params, bank: Samples, modality: int):
        """Takes a JMVAE's parameters, a bank `[C, S, D_m]` per modality, and the own sensor."""
        self.config = config
        self.modality = modality
        self.num_pois = config.arena.num_pois
        self.num_modalities = len(config.modalities)
        self._shape = make_jmvae(config)
        self._bank = [np.asarray(features) for features in bank]
        self._encoders = {name: _layers(p) for name, p in params["encoders"].items()}
        self._decoders = [_layers(params["decoders"][name]) for name in config.modalities]
        self._unseen_std = np.sqrt(np.float32(20.0))

    @property
    def observation_size(self) -> int:
        """Numbers in an observation."""
        return 2 * self.num_pois * self._shape.latent_size

    def reset(
        self,
        rng: np.random.Generator,
        classes: np.ndarray | None = None,
        seen: np.ndarray | None = None,
        first: np.ndarray | None = None,
    ) -> NumpyMap:
        """The start of an episode: some modalities have seen some of the PoIs.

        Args:
          rng: of everything that is random.
          classes: `[N]` true classes; random if not given.
          seen: `[N, M]` who has seen what; random if not given.
          first: `[N]` modality from which on a PoI's looks are written; random if not given.

        Returns:
          The map.
        """
        shape = self.num_pois, self.num_modalities
        if classes is None:
            classes = rng.integers(len(self.config.arena.classes), size=self.num_pois)
        if seen is None:
            seen = rng.random(shape) < 0.5
        if first is None:
            first = rng.integers(self.num_modalities, size=self.num_pois)
        latent = self.num_pois, self._shape.latent_size
        mean = np.zeros(latent, np.float32)
        std = np.full(latent, self._unseen_std, np.float32)
        state = NumpyMap(mean, std, np.zeros(shape, bool), classes, 0)
        for poi in range(self.num_pois):
            for i in range(self.num_modalities):
                modality = int(first[poi] + i) % self.num_modalities
                if seen[poi, modality]:
                    self._look(rng, state, poi, modality)
        return state

    def step(
        self, rng: np.random.Generator, state: NumpyMap, action: int
    ) -> tuple[float, bool, bool]:
        """Looks at a PoI, or ends the episode; changes `state`.

        Returns:
          The reward, whether the episode has ended by NOP, and whether it was cut.
        """
        state.steps += 1
        if action == self.num_pois:
            return 0.0, True, False
        before = 1.0 / np.linalg.norm(state.std[action])
        self._look(rng, state, action, self.modality)
        gain = 1.0 / np.linalg.norm(state.std[action]) - before
        reward = float(gain) if gain > self.config.mdp.min_increase else -1.0
        return reward, False, state.steps >= self.config.mdp.max_steps

    def observation(self, state: NumpyMap) -> np.ndarray:
        """`[N * 2D]` the map as a Q-network sees it."""
        return np.concatenate([state.mean, state.std], axis=-1).reshape(-1)

    def _look(self, rng: np.random.Generator, state: NumpyMap, poi: int, modality: int) -> None:
        """Writes a detection into the map, in place of what was there."""
        samples = self._bank[modality][state.classes[poi]]
        features = samples[rng.integers(len(samples))]
        inputs = {
            m: features if m == modality else _apply(self._decoders[m], state.mean[poi])
            for m in range(self.num_modalities)
            if m == modality or state.seen[poi, m]
        }
        encoder = self._encoders[self._shape.encoder_name(tuple(inputs))]
        mean, log_var = np.split(_apply(encoder, np.concatenate(list(inputs.values()))), 2)
        state.mean[poi], state.std[poi] = mean, np.exp(0.5 * log_var)
        state.seen[poi, modality] = True


def _layers(params: Params) -> list[tuple[np.ndarray, np.ndarray]]:
    """Kernels and biases of an MLP, from the first layer to the last."""
    layers = params["params"]
    names = sorted(layers, key=lambda name: int(name.split("_")[1]))
    return [(np.asarray(layers[n]["kernel"]), np.asarray(layers[n]["bias"])) for n in names]


def _apply(layers: list[tuple[np.ndarray, np.ndarray]], x: np.ndarray) -> np.ndarray:
    for kernel, bias in layers[:-1]:
        x = np.maximum(x @ kernel + bias, 0.0)
    kernel, bias = layers[-1]
    return x @ kernel + bias
