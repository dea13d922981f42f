"""`python -m benchmarks.where RUN`: what it is worth to choose from where to look.

In missions a robot looks again from the nearest place where at least half of a look is new
evidence, and from as far away as `navigation.view_range`. This trial plays the same arenas with
other shares, from 0, where robots stay as long as looks pay, to .9, and with shorter ranges. Looks
from one place share their light and the beams that graze an edge, as in any mission, so a policy
that takes them for new pays with accuracy and with confidence that is too high. A second table
compares, with several costs of a look, the time that robots which mostly stay and robots which
mostly drive need for the same accuracy.
"""

import dataclasses
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import stats

from benchmarks import studies
from benchmarks.curves import Curves, of_costs
from benchmarks.measure import reserve
from benchmarks.same_accuracy import as_block, as_table, stacked
from jaxsense import Config, Key, Models, pytree
from jaxsense.config.checks import check_fields, require
from jaxsense.config.options import Name
from jaxsense.run import cli
from jaxsense.vae.novelty import LEAST_NEW, Novelty

PROGRAM = "benchmarks.where"
SHARES = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9)
CURVES = (0.1, 0.25, LEAST_NEW)
"""Shares that are compared at the same accuracy. With 0 some robots would look on from one place
for ever, since the values of looks take each look for a new one."""
_KEYS = {"accuracy": 3, "confidence": 3, "looks": 2, "time": 1}
"""What is compared, with its decimals in the table."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Plays missions in which robots look from other places."""

    run: Annotated[Path, Name("RUN")]
    """The directory of a finished run, `latest`, or `pretrained:PRESET`."""
    episodes: int = 256
    """Missions of each policy with each rule."""
    seed: int = 0
    """Seed of the arenas."""
    policies: tuple[str, ...] = ("latent", "auction")
    """The policies that play."""
    ranges: tuple[float, ...] = (1.0, 2.0, 3.0)
    """Distances in metres up to which a robot looks at once, to compare with the run's."""
    costs: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.5)
    """Costs of a look with which robots are compared at the same accuracy."""
    json: Path | None = None
    """File to write; must be new."""

    def __post_init__(self):
        check_fields(self, bits=64)
        require(self.episodes >= 2, self, "episodes", "must be at least 2")


@pytree
class FromWhere(Novelty):
    """Weights of looks as learned, and robots that ask another share of a look to be new.

    Attributes:
      share: `[]` of a look that must be new where a robot looks again, up to 1.
    """

    share: Float[Array, ""]

    @property
    def most_near(self) -> Float[Array, ""]:
        """The term `a sum_k ...` of the weight of a look of which just this share is new."""
        return jnp.maximum(self.share, 1e-9) ** -0.5 - 1


def with_share(models: Models, share: float) -> Models:
    """Models whose robots look again only where this share of a look is new.

    Args:
      models: of a finished run.
      share: see `FromWhere`.
    """
    learned = models.novelty
    changed = FromWhere(learned.strength, learned.length, jnp.float32(share))
    return dataclasses.replace(models, novelty=changed)


def within(config: Config, farthest: float) -> Config:
    """Settings with another `navigation.view_range`.

    Args:
      config: all settings.
      farthest: distance in metres.

    Raises:
      ConfigError: if a robot cannot look from there.
    """
    nearer = tuple(d for d in config.navigation.view_distances if d <= farthest)
    navigation = dataclasses.replace(
        config.navigation, view_range=farthest, view_distances=nearer or (farthest,)
    )
    return dataclasses.replace(config, navigation=navigation)


def compare(
    found: dict[str, np.ndarray],
    usual: dict[str, np.ndarray],
    keys: Sequence[str] = tuple(_KEYS),
) -> dict[str, list[float]]:
    """Means, and differences from the usual rule in the same arenas with their 95% half-widths.

    Args:
      found: `[E]` figures of missions.
      usual: the same of the usual rule.
      keys: which figures.

    Returns:
      By figure its mean, the mean difference and its half-width.
    """

    def of(key: str) -> list[float]:
        less = found[key] - usual[key]
        width = stats.sem(less) * stats.t.ppf(0.975, len(less) - 1)
        return [float(found[key].mean()), float(less.mean()), float(width)]

    return {key: of(key) for key in keys}


def by_rule(
    key: Key, config: Config, models: Models, own: Curves, arguments: Arguments
) -> Iterator[dict]:
    """Figures of each policy by each rule of where to look from.

    Args:
      key: random key of the arenas.
      config: all settings.
      models: of a finished run.
      own: plays missions with these settings.
      arguments: of the program.
    """
    rules = [(f"share {share:g}", own, share) for share in SHARES]
    for farthest in arguments.ranges:
        nearer = Curves(key, within(config, farthest), arguments.episodes, only=arguments.policies)
        rules.append((f"range {farthest:g} m", nearer, LEAST_NEW))
    for policy in arguments.policies:
        usual = own.play(with_share(models, LEAST_NEW), policy)
        for rule, curves, share in rules:
            found = compare(curves.play(with_share(models, share), policy), usual)
            yield {"policy": policy, "rule": rule, **found}


def by_cost(
    key: Key, config: Config, models: Models, own: Curves, arguments: Arguments
) -> Iterator[dict]:
    """The curve of each policy with each of the shares `CURVES`.

    Args:
      key: random key of the trainings.
      config: all settings.
      models: of a finished run.
      own: plays missions with these settings.
      arguments: of the program.
    """
    priced = of_costs(key, config, models, jnp.array(arguments.costs))
    each = [jax.tree.map(lambda x: x[k], priced) for k in range(len(arguments.costs))]  # noqa: B023
    for policy in arguments.policies:
        for share in CURVES:
            points = stacked([own.play(with_share(model, share), policy) for model in each])
            name = f"{policy}, share {share:g}"
            yield as_block(name, {"look_cost": arguments.costs}, points)


def table(results: Mapping[str, Any]) -> str:
    """What each rule of where to look from changes, in Markdown.

    Args:
      results: the content of the JSON file.
    """
    heads = ["policy", "rule", "right", "confidence", "looks per PoI", "mean time [s]"]
    rows = [
        [
            f"`{row['policy']}`",
            row["rule"],
            *(as_cell(row[key], digits) for key, digits in _KEYS.items()),
        ]
        for row in results["rows"]
    ]
    return studies.with_origin(studies.as_table(heads, rows), results)


def of_accuracies(results: Mapping[str, Any]) -> str:
    """What robots need for the same accuracy, in Markdown.

    Args:
      results: the content of the JSON file.
    """
    return studies.with_origin(as_table(results["curves"]), results)


def as_cell(compared: Sequence[float], digits: int) -> str:
    """A mean, its difference and the half-width of that, unless nothing differs.

    Args:
      compared: a value of `compare`.
      digits: decimals.
    """
    mean, less, width = compared
    text = f"{mean:.{digits}f}"
    return f"{text}, {less:+.{digits}f} ± {width:.{digits}f}" if less or width else text


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    config, models = studies.load(PROGRAM, arguments.run)
    reserve(PROGRAM, "json", arguments.json)
    play_key = jax.random.key(arguments.seed)
    train_key = jax.random.fold_in(play_key, 1)
    own = Curves(play_key, config, arguments.episodes, only=arguments.policies)
    results = {
        **studies.origin(PROGRAM, arguments),
        "rows": [*by_rule(play_key, config, models, own, arguments)],
        "curves": [*by_cost(train_key, config, models, own, arguments)],
    }
    studies.write(arguments.json, results)
    print(table(results), of_accuracies(results), sep="\n\n")


if __name__ == "__main__":
    main()
