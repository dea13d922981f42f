"""`python -m benchmarks.raw`: trains variants of the JMVAE of scans, see `benchmarks.raw`."""

import dataclasses
import json
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import measure, studies
from benchmarks.raw.looks import Looks, simulate
from benchmarks.raw.training import PARTS, compiled, split
from benchmarks.raw.variants import DRAWN, TABLES, Variant
from jaxsense import Key
from jaxsense.config.checks import check_fields, limited, require
from jaxsense.run import cli

PROGRAM = "benchmarks.raw"
_COMPILED_AT_ONCE = 4


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Trains variants of the JMVAE of scans."""

    tables: tuple[Literal["ablation", "ratio", "depth"], ...] = limited(
        ("ablation", "ratio", "depth"), min_items=1
    )
    """The variants: what one thing matters, ratios of the windows' sizes, depths of the networks.
    Several programs can train a table each."""
    seeds: int = limited(10, at_least=1)
    """Trainings of each variant, side by side."""
    first_seed: int = 100
    """Seed of the first one, and of the scans."""
    steps: int = limited(4000, at_least=PARTS)
    """Gradient steps of each; a multiple of ten."""
    scans: int = limited(98304, at_least=288)
    """Simulated scans by each sensor."""
    json: Path | None = None
    """File to write the figures to; must be new."""

    def __post_init__(self):
        check_fields(self, bits=64)
        require(self.steps % PARTS == 0, self, "steps", f"must be a multiple of {PARTS}")

    @property
    def range(self) -> range:
        """The seeds."""
        return range(self.first_seed, self.first_seed + self.seeds)


def chosen(arguments: Arguments) -> list[tuple[str, Variant]]:
    """Every variant with the name of its table.

    Args:
      arguments: of the program.
    """
    return [
        (table, variant.but(variant.name, steps=arguments.steps))
        for table in dict.fromkeys(arguments.tables)
        for variant in TABLES[table]
    ]


def trained(
    variants: list[Variant], looks: Looks, keys: Key
) -> Iterator[tuple[Variant, dict, float]]:
    """Yields each variant, its figures and the seconds it took; others are compiled meanwhile.

    Args:
      variants: the ways of training.
      looks: of all PoIs.
      keys: `[seeds]` random keys.
    """
    data = {view: split(looks, view) for view in dict.fromkeys(x.view for x in variants)}

    def work(variant: Variant) -> Callable[[], dict]:
        return compiled(variant, data[variant.view], keys)

    with ThreadPoolExecutor(_COMPILED_AT_ONCE) as pool:
        for variant, program in zip(variants, pool.map(work, variants), strict=True):
            begin = time.perf_counter()
            found = program()
            yield variant, found, time.perf_counter() - begin


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    measure.reserve(PROGRAM, "json", arguments.json)
    # The trainings consume the keys of the seeds.
    simulate_key = jax.random.fold_in(jax.random.key(arguments.first_seed), 1)
    looks = simulate(simulate_key, arguments.scans)
    keys = jnp.stack([jax.random.key(seed) for seed in arguments.range])
    tables = chosen(arguments)
    whole = {
        **measure.origin(studies.command(PROGRAM, arguments)),
        "seeds": [*arguments.range],
        "steps": arguments.steps,
        "scans": arguments.scans,
    }
    rows = []
    found = trained([variant for _, variant in tables], looks, keys)
    for (table, _), (variant, figures, seconds) in zip(tables, found, strict=True):
        rows.append({"table": table, "name": variant.name, **_as_json(variant, figures)})
        right = np.asarray(figures["pair"])
        print(
            f"{table}: {variant.name}: a pair right {right.mean():.3f} "
            f"({right.min():.3f} to {right.max():.3f}), {seconds:.1f} s",
            flush=True,
        )
        if arguments.json is not None:
            # After each variant, so that what was measured before a failure is kept.
            text = json.dumps({**whole, "variants": rows})
            arguments.json.write_text(text + "\n", encoding="utf-8")


def _as_json(variant: Variant, figures: dict) -> dict:
    """Lists over the seeds; posteriors of the first seed alone, of variants that are drawn."""
    posteriors = figures.pop("posteriors")
    lists = {name: np.round(x.astype(float), 5).tolist() for name, x in figures.items()}
    if variant.name not in DRAWN:
        return lists
    first = {name: np.round(x[0].astype(float), 3).tolist() for name, x in posteriors.items()}
    return {**lists, "posteriors": first}


if __name__ == "__main__":
    main()
