"""The plot of when a run did what."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from jaxsense.show.colours import ACTIVITIES
from jaxsense.summary.profile import Span

_COMMAND = "command"  # the row of what is done for no stage
_ABOVE = {"trace", "lower", "compile", "load"}  # in a row, all else is below
_HEIGHT = 0.38  # of a bar, where a row is 1


def timeline(spans: Sequence[Span]) -> Figure:
    """When each stage was traced, compiled, loaded, waited for, run and saved.

    Above in each row are the programs of a stage on their way, below is what is done with them.

    Args:
      spans: of all threads.
    """
    shown = sorted((s for s in spans if s.kind in ACTIVITIES), key=lambda span: span.start_s)
    # In the order in which they run, or are done.
    used = [span for span in shown if span.kind not in _ABOVE and span.kind != "wait_program"]
    rows = list(dict.fromkeys(span.stage or _COMMAND for span in [*used, *shown]))
    figure = Figure(figsize=(10, 1.2 + 0.3 * len(rows)), layout="constrained")
    ax = figure.subplots()
    for name, colour in dict.fromkeys(ACTIVITIES.values()):
        # Bars of one call, so that neighbours leave no seams.
        for y, row in enumerate(rows):
            for above in (True, False):
                bars = [
                    (span.start_s, span.seconds)
                    for span in shown
                    if ACTIVITIES[span.kind] == (name, colour)
                    and (span.stage or _COMMAND) == row
                    and (span.kind in _ABOVE) == above
                ]
                ax.broken_barh(bars, (y - above * _HEIGHT, _HEIGHT), facecolors=colour)
        ax.broken_barh([], (0, 0), facecolors=colour, label=name)
    ax.set_yticks(range(len(rows)), rows)
    ax.set(xlabel="seconds since the command was started", ylim=(len(rows) - 0.4, -0.6))
    ax.set_xlim(left=min((span.start_s for span in shown), default=0.0))
    ax.grid(axis="x", alpha=0.3)
    ax.set_axisbelow(True)
    figure.legend(loc="outside upper center", ncols=4, frameon=False)
    return figure
