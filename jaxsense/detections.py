"""What trained detectors make of surveys: the JMVAE's bank, and what is measured with."""

import jax
import numpy as np
from flax import struct

from jaxsense.config import Config
from jaxsense.programs import (
    Programs,
    Surveys,
    num_held_out_per_class,
    num_scene_starts,
    num_scenes,
)
from jaxsense.sim.world import Scene
from jaxsense.vae.detectors import Detector


@struct.dataclass
class Detections:
    """What the detectors make of surveys that they were not trained on.

    Attributes:
      train: for each modality a `[C, S, D_m]` bank for training.
      held_out: the same from other scenes, for measuring.
      starts: classes, scenes and `[S, N, D_m]` features for each modality, in which episodes start.
      accuracy: for each modality, on held-out looks.
      windows: for each modality `[C, 1, F]` one look at each class.
    """

    train: tuple[np.ndarray, ...]
    held_out: tuple[np.ndarray, ...]
    starts: tuple[np.ndarray, Scene, tuple[np.ndarray, ...]]
    accuracy: dict[str, float]
    windows: dict[str, np.ndarray]


def detect(
    programs: Programs, trained: tuple[Detector, ...], surveys: Surveys, config: Config
) -> Detections:
    """Applies the detectors to the surveys that they were not trained on.

    Args:
      programs: of the run; waits for the one that detects.
      trained: the detectors.
      surveys: all of them, on the host.
      config: all settings.
    """
    num_train, num_bank, _ = num_scenes(config)
    others = jax.tree.map(lambda x: x[num_train:], surveys)
    features = jax.tree.map(np.asarray, programs.detect(trained, others.windows))
    is_bank = np.arange(len(others.classes)) < num_bank

    def by_class(values: np.ndarray, chosen: np.ndarray, number: int) -> np.ndarray:
        classes = others.classes[chosen]
        return np.stack(
            [values[chosen][classes == c][:number] for c in range(len(config.arena.classes))]
        )

    held_out = tuple(by_class(f, ~is_bank, num_held_out_per_class(config)) for f in features)
    accuracy = {
        name: float(np.mean(looks.argmax(axis=-1) == labels_of_classes(config, m)[:, None]))
        for m, (name, looks) in enumerate(zip(config.modalities, held_out, strict=True))
    }
    number = num_scene_starts(config)
    return Detections(
        train=tuple(by_class(f, is_bank, config.jmvae.samples_per_class) for f in features),
        held_out=held_out,
        starts=jax.tree.map(lambda x: x[:number], (others.classes, others.scenes, features)),
        accuracy=accuracy,
        windows={
            name: by_class(windows, ~is_bank, 1)
            for name, windows in zip(config.modalities, others.windows, strict=True)
        },
    )


def labels_of_classes(config: Config, modality: int) -> np.ndarray:
    """`[C]` int32 what a modality detects of each class."""
    return np.array(config.label_of_class(config.modalities[modality]), np.int32)
