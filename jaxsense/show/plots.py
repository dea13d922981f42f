"""The plots of a run as files, which follow the colours of the page that shows them."""

from collections.abc import Mapping

from jaxsense.config import Config
from jaxsense.core.types import Belief, Reliability
from jaxsense.show import drawing, latent_plots, learning_plots, mission_plots, scan_plots
from jaxsense.show.learning_plots import Arrays, Curves
from jaxsense.summary.blocks import Learned, Missions


def of_run(
    config: Config,
    results: Learned,
    posteriors: dict[str, Belief],
    windows: Arrays,
    reliability: Mapping[str, Reliability],
) -> dict[str, bytes]:
    """Draws the plots that only a run of one seed has, as SVG files by name.

    Args:
      config: all settings.
      results: the blocks of the summary.
      posteriors: see `latent_plots.latent_space`.
      windows: see `scan_plots.scanlines`.
      reliability: see `learning_plots.calibration`.
    """
    calibration = learning_plots.calibration(config, reliability, results["belief"])
    return {
        "latent_space.svg": drawing.svg(latent_plots.latent_space(config, posteriors)),
        "scanlines.svg": drawing.svg(scan_plots.scanlines(config, windows)),
        "calibration.svg": drawing.svg(calibration),
    }


def of_learning(curves: Curves, results: Learned) -> dict[str, bytes]:
    """Draws the plots of a training that a run and several seeds share, as SVG files by name.

    Args:
      curves: see `learning_plots.rewards`.
      results: the blocks of the summary.
    """
    return {"reward.svg": drawing.svg(learning_plots.rewards(curves, results["dqn"]))}


def of_missions(missions: Missions, num_pois: int) -> dict[str, bytes]:
    """Draws the plots of missions that a run and several seeds share, as SVG files by name.

    Args:
      missions: the block `mission` of the summary.
      num_pois: points of interest of a mission.
    """
    return {"policies.svg": drawing.svg(mission_plots.policies(missions, num_pois))}
