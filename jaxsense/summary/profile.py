"""When a run did what: the spans of `timing.json`, and what they add up to."""

import dataclasses
import itertools
import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, cast

from jaxsense.config import parse_json
from jaxsense.summary.blocks import StageTiming

Kind = Literal[
    "import", "start", "trace", "lower", "compile", "load", "read", "run", "summarise", "save",
    "draw", "wait_stages", "wait_program", "wait_saving", "wait_drawing",
]  # fmt: skip
"""What a thread does: `load` reads a traced or compiled program from the cache, `read` a
checkpoint."""

MAIN = "MainThread"
FILE = "timing.json"
_MOST_NAMED = 3  # stages
_NAMES: dict[Kind, str] = {
    "import": "importing", "start": "starting", "trace": "tracing", "lower": "lowering",
    "compile": "compiling", "load": "loading", "read": "reading the checkpoint of",
    "run": "running", "summarise": "summing up", "save": "saving", "draw": "drawing",
    "wait_stages": "waiting for stages",
    "wait_program": "waiting for programs of", "wait_saving": "waiting for saving",
    "wait_drawing": "waiting for drawing",
}  # fmt: skip
COMPILING = ("trace", "lower", "compile", "load")


@dataclasses.dataclass(frozen=True)
class Span:
    """What a thread did for a while.

    Attributes:
      kind: what it did.
      stage: for which stage or whose program; empty if for none.
      program: which of the stage's programs; empty if none.
      thread: its name.
      start_s: when it began, in seconds since the process started.
      end_s: when it ended.
    """

    kind: Kind
    stage: str
    program: str
    thread: str
    start_s: float
    end_s: float

    @property
    def seconds(self) -> float:
        """How long it took."""
        return self.end_s - self.start_s

    @property
    def waits(self) -> bool:
        """Whether the thread waited for others."""
        return self.kind.startswith("wait_")


def as_text(spans: Sequence[Span]) -> str:
    """The content of `timing.json`, with a line for each span in the order of their starts."""
    lines = [
        json.dumps({**vars(s), "start_s": round(s.start_s, 4), "end_s": round(s.end_s, 4)})
        for s in sorted(spans, key=lambda span: span.start_s)
    ]
    return '{"spans": [\n' + ",\n".join(lines) + "\n]}\n"


def read(run: Path) -> list[Span]:
    """The spans of a run; none if it has written none or their file is damaged.

    Args:
      run: its directory.
    """
    try:
        content = cast(dict, parse_json((run / FILE).read_text(encoding="utf-8")))
        return [Span(**span) for span in content["spans"]]
    except (OSError, ValueError, TypeError, KeyError):
        return []


def of_stages(spans: Sequence[Span]) -> dict[str, StageTiming]:
    """Seconds of each stage, as in `timing.stages`: of all threads together."""
    found: dict[str, StageTiming] = {}
    for span in spans:
        if span.kind == "run" or (span.stage and span.kind in COMPILING):
            stage = found.setdefault(span.stage, {"compile_s": 0.0, "run_s": 0.0})
            stage["run_s" if span.kind == "run" else "compile_s"] += span.seconds
    return found


def parts(spans: Sequence[Span]) -> dict[tuple[Kind, str], float]:
    """Divides the wall clock among the stages and what was done for them, the largest part first.

    A moment in which the main thread works counts for its work. While it waits, the moment counts
    for the stages that run; if none runs, for the programs that are traced, compiled or loaded; and
    else for what the main thread waits for. Several share it equally.

    Args:
      spans: of all threads.

    Returns:
      Seconds by kind and stage; they add up to the time that the spans cover.
    """
    moments = sorted({moment for span in spans for moment in (span.start_s, span.end_s)})
    found: defaultdict[tuple[Kind, str], float] = defaultdict(float)
    for start, end in itertools.pairwise(moments):
        now = [span for span in spans if span.start_s <= start and end <= span.end_s]
        if now:
            first = min(map(_rank, now))
            sharing: set[tuple[Kind, str]] = {
                (span.kind, span.stage) for span in now if _rank(span) == first
            }
            for part in sharing:
                found[part] += (end - start) / len(sharing)
    return dict(sorted(found.items(), key=lambda part: (-part[1], part[0])))


def verdict(spans: Sequence[Span]) -> str | None:
    """The largest part of a run's time, and what it waited for, in words; None without spans."""
    found = parts(spans)
    if not found:
        return None
    (kind, stage), most = next(iter(found.items()))
    total = sum(found.values())
    text = f"The largest part of {total:.1f} s was {_NAMES[kind]} {stage}".rstrip()
    text = f"{text}: {most:.1f} s."
    waited: defaultdict[str, float] = defaultdict(float)
    for (kind, stage), seconds in found.items():
        if kind in COMPILING:
            waited[stage] += seconds
    if waited:
        total = f"{sum(waited.values()):.1f}"
        most_waited = sorted(waited.items(), key=lambda part: -part[1])[:_MOST_NAMED]
        stages = ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in most_waited)
        text += f" For {total} s no stage ran, because programs were traced, compiled or loaded; "
        text += f"most of it for {stages}."
    return text


def _rank(span: Span) -> int:
    """Which of the spans of a moment it counts for; see `parts`."""
    if span.thread == MAIN and not span.waits:
        return 0
    if span.kind == "run":
        return 1
    if span.kind in COMPILING:
        return 2
    return 3 if span.thread == MAIN else 4
