"""The MDPs of a training, made from the models trained so far."""

import dataclasses

from jaxsense.config import Config
from jaxsense.core.networks import Params
from jaxsense.core.types import Fusion
from jaxsense.dqn.map_mdp import Looks, MapMdp
from jaxsense.dqn.optimum import LookValues
from jaxsense.dqn.team_mdp import TeamMdp
from jaxsense.looks import Bank, make_mdp
from jaxsense.models import Models, make_models
from jaxsense.training.detections import Detections
from jaxsense.vae import novelty


def models_of(
    config: Config,
    fusion: Fusion,
    look_values: tuple[LookValues, ...] = (),
    q_networks: tuple[Params, ...] = (),
) -> Models:
    """Models trained so far; the others are empty.

    Args:
      config: all settings.
      fusion: how looks update the map.
      look_values: for each modality, the values of looks.
      q_networks: for each modality, parameters of the Q-network.
    """
    return make_models(
        config,
        detectors=(),
        jmvae={},
        fusion=fusion,
        novelty=novelty.independent(len(config.modalities)),
        look_values=look_values,
        q_networks=q_networks,
        tours=(),
    )


def mdp_of(config: Config, fusion: Fusion, looks: Looks) -> MapMdp | TeamMdp:
    """MDP in which agents learn.

    Args:
      config: all settings.
      fusion: how looks update the map.
      looks: how to look at PoIs.
    """
    return make_mdp(config, models_of(config, fusion), looks)


def held_out_mdp(
    config: Config, fusion: Fusion, detections: Detections, num_pois: int | None = None
) -> MapMdp:
    """Map MDP with held-out features, in which policies are measured.

    Args:
      config: all settings.
      fusion: how looks update the map.
      detections: of all sensors.
      num_pois: N; as in the arena by default.
    """
    mdp = mdp_of(config, fusion, Bank(detections.held_out)).map
    number = config.arena.num_pois if num_pois is None else num_pois
    return dataclasses.replace(mdp, num_pois=number)
