"""Figures of runs with different seeds: `python -m benchmarks.seeds RUN...`.

Reads finished runs of presets and their evaluations, and writes `benchmarks/results/seeds.json`,
from which `python -m benchmarks.results` makes the tables of README and of docs/figures.md.
`benchmarks.seeds.plan` holds the runs of these tables; `python -m benchmarks.seeds.measure` trains
and evaluates them.
"""
