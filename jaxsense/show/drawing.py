"""Figures as files, and the plots and films of a finished run."""

import io
from pathlib import Path
from typing import TypeAlias

import matplotlib as mpl
from matplotlib.figure import Figure

from jaxsense.config import Config
from jaxsense.run import files
from jaxsense.run.missions import Played
from jaxsense.run.pipeline import TrainingResults
from jaxsense.show import film, page, plots
from jaxsense.summary.blocks import Missions, Results, Summary

Pictures: TypeAlias = dict[str, bytes | str]
"""The content of plots and films, by the names of their files."""
# On a dark page lightness is inverted and hues stay, except in images, which are inverted twice.
_STYLE = """<style>text{font-family:system-ui,-apple-system,"Segoe UI",Roboto,sans-serif!important}
@media (prefers-color-scheme:dark){svg,image{filter:invert(.91) hue-rotate(180deg)}}</style>"""


def svg(figure: Figure) -> bytes:
    """A figure as an SVG file, the same for the same figure, that is dark on a dark page."""
    content = io.StringIO()
    # Texts remain texts, and names of parts do not depend on chance.
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "jaxsense"}):
        figure.savefig(content, format="svg", metadata={"Date": None})
    head, defs, rest = content.getvalue().partition("<defs>")
    return f"{head}{_STYLE}{defs}{rest}".encode()


def of_training(config: Config, learned: TrainingResults) -> Pictures:
    """The plots of a training."""
    belief = learned.results["belief"]
    figures = {
        "latent_space": plots.latent_space(config, learned.posteriors),
        "scanlines": plots.scanlines(config, learned.windows),
        "calibration": plots.calibration(config, learned.reliability, belief),
        "reward": plots.rewards(learned.rewards, learned.results["dqn"]),
    }
    return {f"{name}.svg": svg(figure) for name, figure in figures.items()}


def of_missions(
    config: Config, learned: TrainingResults, played: Played, block: Missions
) -> Pictures:
    """The plot of missions and the film of one, also under naive exploration."""
    missions = {f"{name} policy": each for name, each in played.recordings.items()}
    films = film.draw(config, missions, learned.models.fusion)
    names = (f"{name}.svg" for name in page.OWN_FILMS)
    return {
        "policies.svg": svg(plots.policies(block)),
        **dict(zip(names, films, strict=False)),
    }


def of_seeds(curves: plots.Curves, results: Results) -> Pictures:
    """The plots of several seeds together: `results` holds means and intervals."""
    return {
        "reward.svg": svg(plots.rewards(curves, results["dqn"])),
        "policies.svg": svg(plots.policies(results["mission"])),
    }


def write(run: Path, config: Config, pictures: Pictures, found: Summary) -> None:
    """Writes pictures of a run and the page that shows them, or raises `OSError`."""
    for name, content in pictures.items():
        files.write(run / name, content)
    files.write(run / "report.html", page.render(run, config, found))
