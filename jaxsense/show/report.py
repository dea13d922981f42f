"""Draws and writes what people see of a finished run: plots, the film, the page."""

from collections.abc import Mapping

from jaxsense.config import Config
from jaxsense.run import files
from jaxsense.run.clock import Clock
from jaxsense.run.pipeline import RunResult
from jaxsense.run.rundir import RunDirectory
from jaxsense.show import animation, page, plots, timeline
from jaxsense.summary import Summary, profile

Pictures = Mapping[str, bytes | str]
"""The content of plots and films, by the names of their files."""


def draw(config: Config, result: RunResult) -> Pictures:
    """Draws the plots and the film of a run.

    Args:
      config: its settings.
      result: of the run.
    """
    recording = result.recording
    pictures = plots.of_run(
        config, result.results, result.posteriors, result.windows, result.reliability
    )
    pictures |= plots.of_seeds(result.rewards, result.results)
    title = f"{config.mission.policies[0]} policy".replace("_", " ")
    fusion, fields_of_view = result.models.fusion, result.fields_of_view
    film = animation.draw(config, recording.records, recording.end, fusion, fields_of_view, title)
    return {**pictures, "mission.svg": film}


def write(
    run: RunDirectory, pictures: Pictures, found: Summary, clock: Clock | None = None
) -> None:
    """Writes pictures, the page that shows them, and `timing.json`.

    Args:
      run: its directory.
      pictures: of the run.
      found: its summary.
      clock: of the run; none with several seeds, of which each has a chart of its own.

    Raises:
      OSError: if a file cannot be written.
    """
    clock, has_chart = clock or Clock(), clock is not None
    with clock.record("save", "report"):
        for name, content in pictures.items():
            files.write(run.path / name, content)
    spans = clock.spans if has_chart else []
    with clock.record("draw", "report"):
        if has_chart:
            files.write(run.path / "timing.png", plots.png(timeline.timeline(spans)))
        rendered = page.render(run.path, run.settings.config, found, spans=spans)
    with clock.record("save", "report"):
        files.write(run.path / "report.html", rendered)
    if has_chart:
        files.write(run.path / profile.FILE, profile.as_text(clock.spans))
