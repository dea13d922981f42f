"""Draws and writes what people see of a finished run: plots, the film, the page."""

from jaxsense.config import Config
from jaxsense.run import files
from jaxsense.run.clock import Clock
from jaxsense.run.pipeline import Learned, Played
from jaxsense.run.rundir import RunDirectory
from jaxsense.show import animation, drawing, page, plots, timeline
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
    """Draws the plots of missions and the film of one, also under naive exploration.

    Args:
      config: settings of the run.
      learned: results of its training.
      played: results of its missions.
    """
    films = {f"{config.mission.policies[0]} policy": played.recording}
    if played.naive is not None:
        films["naive policy"] = played.naive
    lasts = max(animation.duration_of(config, each.end) for each in films.values())
    fusion, fields = learned.models.fusion, learned.fields_of_view
    drawn = [
        animation.draw(config, film.records, film.end, fusion, fields, title, lasts)
        for title, film in films.items()
    ]
    names = (f"{name}.svg" for name in page.OWN_FILMS)
    pictures = plots.of_missions(played.missions, config.arena.num_pois)
    return {**pictures, **dict(zip(names, drawn, strict=False))}


def of_seeds(config: Config, curves: plots.Curves, results: Results) -> Pictures:
    """Draws the plots of several seeds together.

    Args:
      config: their settings.
      curves: see `learning_plots.rewards`.
      results: means and intervals.
    """
    missions = plots.of_missions(results["mission"], config.arena.num_pois)
    return {**plots.of_learning(curves, results), **missions}


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
            files.write(run.path / "timing.svg", drawing.svg(timeline.timeline(spans)))
        rendered = page.render(run.path, run.settings.config, found, spans=spans)
    with clock.record("save", "report"):
        files.write(run.path / "report.html", rendered)
    if has_chart:
        files.write(run.path / profile.FILE, profile.as_text(clock.spans))
