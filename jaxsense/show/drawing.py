"""Figures as files, and the plots and films of a finished run."""

import io
from pathlib import Path
from typing import TypeAlias

import matplotlib as mpl
from matplotlib.figure import Figure

from jaxsense.config import Config
from jaxsense.run import files
from jaxsense.run.pipeline import Learned, Played
from jaxsense.show import film, latent_plots, page, result_plots
from jaxsense.summary import Results, Summary

Pictures: TypeAlias = dict[str, bytes | str]
"""The content of plots and films, by the names of their files."""
# On a dark page lightness is inverted and hues stay, except in images, which are inverted twice.
_STYLE = """<style>text{font-family:system-ui,-apple-system,"Segoe UI",Roboto,sans-serif!important}
@media (prefers-color-scheme:dark){svg,image{filter:invert(.91) hue-rotate(180deg)}}</style>"""


def encoded(figure: Figure, path: Path) -> bytes:
    """A figure as an SVG file if the path ends in `.svg`, else as a PNG file."""
    if path.suffix == ".svg":
        return svg(figure)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=120)
    return content.getvalue()


def svg(figure: Figure) -> bytes:
    """A figure as an SVG file, the same for the same figure, that is dark on a dark page."""
    content = io.StringIO()
    # Texts remain texts, and names of parts do not depend on chance.
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "jaxsense"}):
        figure.savefig(content, format="svg", metadata={"Date": None})
    head, defs, rest = content.getvalue().partition("<defs>")
    return f"{head}{_STYLE}{defs}{rest}".encode()


def of_training(config: Config, learned: Learned) -> Pictures:
    """The plots of a training."""
    belief = learned.results["belief"]
    figures = {
        "latent_space": latent_plots.latent_space(config, learned.posteriors),
        "scanlines": result_plots.scanlines(config, learned.windows),
        "calibration": result_plots.calibration(config, learned.reliability, belief),
        "reward": result_plots.rewards(learned.rewards, learned.results["dqn"]),
    }
    return {f"{name}.svg": svg(figure) for name, figure in figures.items()}


def of_missions(config: Config, learned: Learned, played: Played) -> Pictures:
    """The plot of missions and the film of one, also under naive exploration."""
    films = {f"{config.mission.policies[0]} policy": played.recording}
    if played.naive is not None:
        films["naive policy"] = played.naive
    lasts = max(film.duration_of(config, each.end) for each in films.values())
    fusion, fields = learned.models.fusion, learned.fields_of_view
    drawn = [
        film.draw(config, each.records, each.end, fusion, fields, title, lasts)
        for title, each in films.items()
    ]
    names = (f"{name}.svg" for name in page.OWN_FILMS)
    plot = svg(result_plots.policies(played.missions))
    return {"policies.svg": plot, **dict(zip(names, drawn, strict=False))}


def of_seeds(curves: result_plots.Curves, results: Results) -> Pictures:
    """The plots of several seeds together: `results` holds means and intervals."""
    return {
        "reward.svg": svg(result_plots.rewards(curves, results["dqn"])),
        "policies.svg": svg(result_plots.policies(results["mission"])),
    }


def write(run: Path, config: Config, pictures: Pictures, found: Summary) -> None:
    """Writes pictures of a run and the page that shows them, or raises `OSError`."""
    for name, content in pictures.items():
        files.write(run / name, content)
    files.write(run / "report.html", page.render(run, config, found))
