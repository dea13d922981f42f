"""The runs whose figures `benchmarks/results/seeds.json` holds, see `benchmarks.seeds.measure`."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path


@dataclasses.dataclass(frozen=True)
class Group:
    """Trainings that differ in their seeds, and their evaluations.

    Attributes:
      name: of the group in the file.
      preset: that is trained.
      seeds: of the trainings.
      options: of `jaxsense.train`, with their values.
      evaluations: options of each `jaxsense.evaluate`.
      shares: group with the same trainings, whose run directories this one evaluates, too.
    """

    name: str
    preset: str
    seeds: range
    options: Mapping[str, str] = dataclasses.field(default_factory=dict)
    evaluations: tuple[str, ...] = ()
    shares: str | None = None

    def run(self, folder: Path, seed: int) -> Path:
        """The run directory of a seed.

        Args:
          folder: of all run directories.
          seed: of the training.
        """
        return folder / f"{self.shares or self.name}-{seed}"

    def train(self, seed: object) -> str:
        """The command that trains a seed.

        Args:
          seed: of the training.
        """
        options = "".join(f" {name} {value}" for name, value in self.options.items())
        return f"python -m jaxsense.train --preset {self.preset} --seed {seed}{options}"

    def evaluate(self, run: str, words: str) -> str:
        """The command of an evaluation.

        Args:
          run: its directory.
          words: one of `evaluations`.
        """
        return f"python -m jaxsense.evaluate {run} {words}"


_TEN, _THREE, _TWO = range(100, 110), range(100, 103), range(100, 102)
_SCANS = {
    "--jmvae.learns-from": "scans",
    "--jmvae.hidden": "128 128",
    "--jmvae.alpha": "3",
    "--jmvae.alpha-start": ".4",
    "--jmvae.beta": "1",
    "--jmvae.initial-beta": ".01",
    "--jmvae.annealing": ".3",
    "--jmvae.restarts": "1",
    "--jmvae.steps": "4000",
    "--jmvae.batch": "128",
    "--jmvae.reconstruction-weights": "300 300",
}
_OF_MANY = {"--jmvae.latent-size": "4", "--jmvae.reconstruction-weights": "1000 1000"}
_ARENAS = (
    "--arena.num-pois 3 --arena.side 4",
    "--arena.num-pois 8 --arena.side 4",
    *(
        " ".join(["--arena.num-pois 16 --arena.side 6 --robots", *robots])
        for robots in (["camera"] * 2 + ["lidar"] * 2, ["camera"] * 3 + ["lidar"] * 3)
    ),
)
GROUPS: Mapping[str, Group] = {
    group.name: group
    for group in (
        Group("default", "default", _TEN, {"--mission.episodes": "128"}, ("--episodes 512",)),
        Group("paper", "paper", _TEN, {"--mission.episodes": "128"}),
        Group("raw", "raw", _TEN, {"--mission.episodes": "128"}),
        Group("noisy", "noisy", _THREE, {"--mission.episodes": "1024"}, ("--episodes 1024",)),
        Group("many", "many", _THREE, {"--mission.episodes": "128"}, ("--episodes 128",)),
        Group(
            "team",
            "team",
            _THREE,
            evaluations=("--arena.num-pois 16 --arena.side 6 --episodes 1024 --policy policies",),
        ),
        Group(
            "team_sizes",
            "team",
            _THREE,
            evaluations=tuple(
                f"{arena} --seed 1 --episodes 512 --policy policies" for arena in _ARENAS
            ),
            shares="team",
        ),
        Group("raw_noisy", "noisy", _THREE, _SCANS),
        Group("raw_many", "many", _TWO, {**_SCANS, **_OF_MANY}),
    )
}
"""All groups by name."""
