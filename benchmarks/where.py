"""`python -m benchmarks.where RUN`: what it is worth to choose from where to look.

One robot, one PoI in view. By the rule of missions, the robot looks at once from where it stands,
and again from there if at least half of a second look is new, or else from the nearest such place
near the PoI. The alternative chooses before each look: from here, or from another side or distance,
after the drive there. Dynamic programming over the posterior of the label, the distance and the
number of looks there yields the least mean of time plus the price of an error, and so the
shortest mean time for each accuracy. Looks are those of the run's detector from several distances,
and looks from one place count as fusion weighs them, but are drawn anew each time: that flatters
them, since looks from one place repeat their errors.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense import Config, Key, Live, Models
from jaxsense.config.checks import check_fields
from jaxsense.config.options import Name
from jaxsense.run import cli, rundir
from jaxsense.sim.world import make_world

PROGRAM = "benchmarks.where"
_DISTANCES = (0.5, 0.9, 1.5, 2.5, 3.5)  # m
_NEAR = 1  # of the distances, to which the rule drives
_SCENES = 4096
_AT_ONCE = 512
_POINTS = 401  # of the posterior
_HORIZON = 8  # looks
_LOOKS_FROM_ONE_PLACE = 4
_SLIGHTLY = 0.026  # of common strength, with which a look counts .95
_PRICES = np.geomspace(20, 4000, 25)  # s, of an error
_ACCURACIES = (0.95, 0.98, 0.99)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Compare the rule from where robots look with the best choice."""

    run: Annotated[Path, Name("RUN")]
    """The directory of a finished run, or `latest`."""

    def __post_init__(self):
        check_fields(self)


def ratios_from(key: Key, config: Config, models: Models, distance: float) -> list[np.ndarray]:
    """Log-likelihood ratios of looks from a distance, signed towards the true label.

    Args:
      key: random key.
      config: all settings.
      models: of a finished run.
      distance: from the PoI, in metres.

    Returns:
      For each modality with two labels, one number for each look.
    """
    near, far = distance - 0.02, distance + 0.02
    viewpoint = dataclasses.replace(config.viewpoint, min_distance=near, max_distance=far)
    world = dataclasses.replace(make_world(config), viewpoint=viewpoint)
    class_key, look_key = jax.random.split(key)
    num_classes, num_pois = len(config.arena.classes), config.arena.num_pois
    classes = jax.random.randint(class_key, (_SCENES, num_pois), 0, num_classes)

    @jax.jit
    def look(live: Live, keys: Key, classes: jax.Array) -> tuple[jax.Array, ...]:
        """Features of looks at the first PoI of each scene, `[S, D_m]` for each modality."""

        def at_scene(scene: tuple[Key, jax.Array]) -> tuple[jax.Array, ...]:
            scene_key, *look_keys = jax.random.split(scene[0], 1 + live.num_modalities)
            drawn, poi = live.scene(scene_key, scene[1]), jnp.int32(0)
            return tuple(live.observe(k, drawn, poi, m)[0] for m, k in enumerate(look_keys))

        return jax.lax.map(at_scene, (keys, classes), batch_size=_AT_ONCE)

    keys = jax.random.split(look_key, _SCENES)
    features = look(Live(world, models.detectors), keys, classes)
    found = []
    for name, of_modality in zip(config.modalities, features, strict=True):
        labels = np.array(config.label_of_class(name))
        share = np.bincount(labels) / len(labels)
        ratio = np.log(np.clip(np.asarray(of_modality), 1e-6, 1)) - np.log(share)
        sign = np.where(labels[np.asarray(classes[:, 0])] == 1, 1.0, -1.0)
        found.append((sign * (ratio[..., 1] - ratio[..., 0])).reshape(-1))
    return found


class Problem:
    """One PoI, one sensor: what a look from each place does to the posterior.

    A state is a point of the posterior, a distance, and the number of looks from there.
    """

    def __init__(
        self,
        ratios: list[np.ndarray],
        weights: np.ndarray,
        apart: float,
        speed: float,
        stays: bool,
    ):
        """Looks from each of the distances.

        Args:
          ratios: for each distance, log-likelihood ratios of looks towards the true label.
          weights: `[K]` of the first to the K-th look from one place, which says nothing more.
          apart: distance between places whose looks are independent, in metres.
          speed: of the robot, in metres per second.
          stays: whether the rule looks again from the same place.
        """
        self.logits = np.linspace(-12, 12, _POINTS)
        self.right = 1 / (1 + np.exp(-self.logits))  # probability of label 1
        self.after = np.stack(
            [np.stack([self._moved(weight * ratio) for ratio in ratios]) for weight in weights]
        )
        distance = np.abs(np.subtract.outer(_DISTANCES, _DISTANCES))
        self.seconds = np.maximum(distance, apart) / speed
        self.stays = stays

    def _moved(self, ratios: np.ndarray) -> np.ndarray:
        """`[P, P]` chances of the posteriors after a look from those before it."""
        draws = np.quantile(ratios, (np.arange(64) + 0.5) / 64)
        chances = np.zeros((_POINTS, _POINTS))
        step = self.logits[1] - self.logits[0]
        for sign, share in ((1, self.right), (-1, 1 - self.right)):
            ends = np.clip(self.logits[:, None] + sign * draws, self.logits[0], self.logits[-1])
            place = (ends - self.logits[0]) / step
            low = np.minimum(place.astype(int), _POINTS - 2)
            rows = np.arange(_POINTS)[:, None]
            np.add.at(chances, (rows, low), share[:, None] * (1 - place + low) / 64)
            np.add.at(chances, (rows, low + 1), share[:, None] * (place - low) / 64)
        return chances

    def actions(self, distance: int, looks: int, by_rule: bool) -> list[tuple[int, float, int]]:
        """Distance to look from, seconds until the look, and the number of looks from there.

        Args:
          distance: index of the present one.
          looks: number of looks from the robot's place.
          by_rule: whether it follows the rule of missions.
        """
        look = 0.1
        here = [(distance, look, looks)] if looks < len(self.after) else []
        if by_rule:
            away = [(_NEAR, self.seconds[distance, _NEAR] + look, 0)]
            return here if here and (self.stays or not looks) else away
        others = range(len(_DISTANCES))
        return [*here, *((d, self.seconds[distance, d] + look, 0) for d in others)]

    def solve(self, price: float, by_rule: bool) -> tuple[float, float]:
        """Mean time and accuracy of the best policy, from equal odds and a random far distance.

        Args:
          price: of an error, in seconds.
          by_rule: whether the robot follows the rule of missions, and only chooses when to stop.
        """
        wrong = np.minimum(self.right, 1 - self.right)
        shape = len(_DISTANCES), len(self.after) + 1, _POINTS
        cost = np.broadcast_to(price * wrong, shape).copy()
        time, error = np.zeros(shape), np.broadcast_to(wrong, shape).copy()
        for _ in range(_HORIZON):
            new = [x.copy() for x in (cost, time, error)]
            new[0][:], new[1][:], new[2][:] = price * wrong, 0.0, wrong
            for d, taken in np.ndindex(shape[:2]):
                for to, seconds, number in self.actions(d, taken, by_rule):
                    chances, then = self.after[number, to], (to, number + 1)
                    of_look = (
                        seconds + chances @ cost[then],
                        seconds + chances @ time[then],
                        chances @ error[then],
                    )
                    better = of_look[0] < new[0][d, taken]
                    for old, found in zip(new, of_look, strict=True):
                        old[d, taken] = np.where(better, found, old[d, taken])
            cost, time, error = new
        start = _POINTS // 2
        return float(time[2:, 0, start].mean()), 1 - float(error[2:, 0, start].mean())


def at(accuracy: float, points: list[tuple[float, float]]) -> float:
    """Mean time for an accuracy, interpolated between points of (time, accuracy).

    Args:
      accuracy: to reach.
      points: of a curve.
    """
    times, accuracies = zip(*sorted(points), strict=True)
    return float(np.interp(accuracy, accuracies, times, right=np.nan))


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    config, models = rundir.load(cli.find_run(arguments.run))
    key = jax.random.key(0)
    ratios = [ratios_from(key, config, models, distance) for distance in _DISTANCES]
    for m, name in enumerate(config.modalities):
        of_sensor = [each[m] for each in ratios]
        shares = ", ".join(
            f"{np.mean(x > 0):.3f} at {d} m" for d, x in zip(_DISTANCES, of_sensor, strict=True)
        )
        print(f"{name}: single looks right {shares}")
        fresh = float(models.novelty.fresh_distance(m))
        weights = np.array(
            [float(models.novelty.weight(jnp.zeros(k), m)) for k in range(_LOOKS_FROM_ONE_PLACE)]
        )
        strength, length = float(models.novelty.strength[m]), float(models.novelty.length[m])
        apart = length * np.sqrt(2 * np.log(max(strength / _SLIGHTLY, 1.0)))
        print(f"  looks from one place count {', '.join(f'{w:.2f}' for w in weights)}")
        print(f"  looks {apart:.2f} m apart are nearly independent")
        speed = float(config.team.travel.speed)
        problem = Problem(of_sensor, weights, apart, speed, stays=fresh == 0)
        curves = [[problem.solve(p, by_rule) for p in _PRICES] for by_rule in (True, False)]
        for accuracy in _ACCURACIES:
            rule, best = (at(accuracy, curve) for curve in curves)
            print(
                f"  accuracy {accuracy}: rule {rule:.2f} s, best choice {best:.2f} s, "
                f"{100 * (1 - best / rule):.1f} % less"
            )


if __name__ == "__main__":
    main()
