"""Draws and writes what people see of a finished run: plots, the film, the page."""

from jaxsense.config import Config
from jaxsense.run import files
from jaxsense.run.pipeline import Learned, Played
from jaxsense.run.rundir import RunDirectory
from jaxsense.show import animation, page, plots
from jaxsense.show.artist import Pictures
from jaxsense.summary import Results, Summary


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


def write(run: RunDirectory, pictures: Pictures, found: Summary) -> None:
    """Writes pictures and the page that shows them.

    Args:
      run: its directory.
      pictures: of the run.
      found: its summary.

    Raises:
      OSError: if a file cannot be written.
    """
    for name, content in pictures.items():
        files.write(run.path / name, content)
    files.write(run.path / "report.html", page.render(run.path, run.settings.config, found))
