"""Draws and writes what people see of a finished run: plots, the film, the page."""

from jaxsense.config import Config
from jaxsense.run import files
from jaxsense.run.clock import Clock
from jaxsense.run.pipeline import Learned, Played
from jaxsense.run.rundir import RunDirectory
from jaxsense.show import animation, page, plots, timeline
from jaxsense.show.artist import Pictures
from jaxsense.summary import Results, Summary, profile


def of_training(config: Config, learned: Learned) -> Pictures:
    """Draws the plots of a training.

    Args:
      config: its settings.
      learned: its results.
    """
    pictures = plots.of_run(
        config, learned.results, learned.posteriors, learned.windows, learned.reliability
    )
    return {**pictures, **plots.of_learning(learned.rewards, learned.results)}


def of_missions(config: Config, learned: Learned, played: Played) -> Pictures:
    """Draws the plots and the film of missions.

    Args:
      config: settings of the run.
      learned: results of its training.
      played: results of its missions.
    """
    title = f"{config.mission.policies[0]} policy".replace("_", " ")
    recording, fusion = played.recording, learned.models.fusion
    film = animation.draw(
        config, recording.records, recording.end, fusion, learned.fields_of_view, title
    )
    return {**plots.of_missions(played.missions), "mission.svg": film}


def of_seeds(curves: plots.Curves, results: Results) -> Pictures:
    """Draws the plots of several seeds together.

    Args:
      curves: see `plots.rewards`.
      results: means and intervals.
    """
    return {**plots.of_learning(curves, results), **plots.of_missions(results["mission"])}


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
