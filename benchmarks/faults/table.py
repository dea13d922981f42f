"""The table of all faults."""

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks import measure, studies


def table(results: Sequence[Mapping[str, Any]]) -> str:
    """How many trials of each fault ended as they must, in Markdown.

    Args:
      results: contents of JSON files; a later one replaces the rows that it has tried again.
    """
    passed = {fault: found for each in results for fault, found in each["passed"].items()}
    rows = [[fault, f"{sum(found)} of {len(found)}"] for fault, found in passed.items()]
    origins = (measure.describe(each) for each in results)
    return "\n\n".join([studies.as_table(["fault", "passed"], rows), *origins])
