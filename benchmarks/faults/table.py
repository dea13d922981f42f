"""The table of all faults."""

from collections.abc import Mapping
from typing import Any

from benchmarks import studies


def table(results: Mapping[str, Any]) -> str:
    """How many trials of each fault ended as they must, in Markdown.

    Args:
      results: the content of the JSON file.
    """
    rows = [[fault, f"{sum(found)} of {len(found)}"] for fault, found in results["passed"].items()]
    return studies.with_origin(studies.as_table(["fault", "passed"], rows), results)
