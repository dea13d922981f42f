"""Scores of policies in missions, compared with built-in policies in the same arenas."""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.config import Config, ConfigError
from jaxsense.config.mission import MAX_EPISODES
from jaxsense.config.section import Checked, limited, require, require_function
from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.dqn.policies import POLICIES, Known, Trained, Values
from jaxsense.looks import beyond_training
from jaxsense.mission import cases, make_mission
from jaxsense.models import Models, require_fitting
from jaxsense.run import devices, missions
from jaxsense.run.compilation import Compiler
from jaxsense.run.devices import ALONE, Workers
from jaxsense.run.monitor import Listener, Monitor
from jaxsense.run.settings import MAX_SEED
from jaxsense.summary import make
from jaxsense.summary.blocks import MISSIONS, Case
from jaxsense.summary.compare import REFERENCE
from jaxsense.summary.tables import of_metrics

_IS_POLICY = "must be a function (key, models, known) -> values that JAX can trace"
AGAINST = (REFERENCE, "auction", "naive", "random")
"""Policies that `score_missions` compares with, unless told otherwise."""


class _Asked(Checked):
    """What is asked of `score_missions`, apart from the models and the policies themselves."""

    policies: Mapping[str, object]
    against: tuple[str, ...] = limited((), min_items=1)
    episodes: int = limited(1, at_least=1, at_most=MAX_EPISODES)
    seed: int = limited(0, at_least=0, at_most=MAX_SEED)

    def check(self) -> None:
        """Checks that there are policies of these names to compare with."""
        names = dict.fromkeys((*POLICIES, *self.policies))
        expected = f"must be among {', '.join(names)}"
        require(set(self.against) <= set(names), self, "against", expected)


@dataclasses.dataclass(frozen=True)
class MissionScore:
    """Result of `score_missions`; `print` shows a table.

    Attributes:
      policies: by name, the policies in the order of the table. `accuracy` is the share of PoIs
        whose most likely class is right, `observations_per_poi` the mean number of looks,
        `mean_time_s` the mean time until all robots are done, and `time_s` its median, in seconds.
        `intervals` holds the mean differences of accuracy, looks and time from the reference,
        arena by arena, each with a 95 % interval: `mean`, `low` and `high`. The reference has none.
      reference: name of the policy from which differences are taken.
      episodes: number of missions of each policy.
    """

    policies: dict[str, Case]
    reference: str
    episodes: int

    def __str__(self):
        keys = "accuracy", "observations_per_poi", "mean_time_s", "intervals.time_s"
        caption = f"{self.episodes:,} missions of each policy; differences from {self.reference}"
        return str(of_metrics(caption, self.policies, [MISSIONS[key] for key in keys]))


@checks.typed
def score_missions(
    config: Config,
    models: Models,
    policies: Mapping[str, Values],
    *,
    against: Sequence[str] = AGAINST,
    episodes: int = 256,
    seed: int = 0,
    listener: Listener = lambda stage, done, total, metrics: None,
) -> MissionScore:
    """Evaluates policies in missions, next to built-in policies in the same arenas.

    The arenas are those of `python -m jaxsense.evaluate` with the same seed. Compiling the missions
    takes most of the time of a few hundred; one call for several policies compiles once. On a CPU,
    the missions share one thread fewer than there are cores, at most 8; to use all cores, set the
    environment variable `NPROC` to a larger number, the size of XLA's thread pool, before JAX runs.

    Args:
      config: settings of the arena, the robots and their sensors.
      models: trained for them, for example both from `load_pretrained`.
      policies: custom policies by name, each a pure function `(key, models, known) -> [N + 1]`
        float values of looks at the N PoIs and of NOP.
      against: names of policies to compare with, from `dqn.POLICIES` or `policies`. Differences are
        taken from the first.
      episodes: missions of each policy.
      seed: of the arenas and of all noise, from 0 to 2^32 - 1.
      listener: called with the stage, how much of it is done, of how much, and metrics, while the
        missions are compiled and played; `print` shows them.

    Returns:
      The score.

    Raises:
      ConfigError: if an argument is of another type, a policy is unknown, has a name that is taken,
        takes other arguments, cannot be traced or returns values of another shape or dtype, or the
        models are for another number of PoIs.
      ValueError: if another argument is wrong, for example models of another run.
      RuntimeError: if the values of a policy, the models or the beliefs are not finite.
    """
    episodes, seed = (int(x) if isinstance(x, np.integer) else x for x in (episodes, seed))
    _Asked(policies, against, episodes, seed)  # pyright: ignore[reportArgumentType]
    if not models.agent.plays(number := config.arena.num_pois):
        expected = "must be the number of PoIs that the models were trained with"
        raise ConfigError("arena.num_pois", number, expected)
    require_fitting(config, models)
    for what in beyond_training(config) if "latent" in (*policies, *against) else ():
        warnings.warn(what, stacklevel=3)  # past the check of types
    own = {
        name: each if name in POLICIES else _checked(name, each) for name, each in policies.items()
    }
    # As the programs compute on an accelerator.
    with jax.default_matmul_precision("highest"), Compiler(Monitor(listener)) as compiler:
        scenario = make_mission(config, own)
        known = cases(config, scenario.policies)
        played = {name: known[name] for name in dict.fromkeys((*policies, *against))}
        scenario = scenario.playing(played)
        total = episodes * len(played)
        is_cpu = jax.default_backend() == "cpu"
        workers = Workers(threads=devices.threads()) if is_cpu else ALONE
        player = missions.Player(scenario, compiler, total, workers, models)
        found = player.play(jax.random.key(seed), models, played, episodes)
    blocks = make.missions(config, found.metrics, against[0])
    return MissionScore(blocks, against[0], episodes)


def _checked(name: str, policy: Values) -> Values:
    """The policy, which names itself if its values have another shape or dtype."""
    field = f"policies[{name!r}]"
    require_function(field, policy, 3, _IS_POLICY)

    def values(key: Key, models: Trained, known: Known) -> jax.Array:
        try:
            found = jnp.asarray(policy(key, models, known))
        except jax.errors.JAXTypeError as error:
            raise ConfigError(field, policy, _IS_POLICY) from error
        number = len(known.looks) + 1
        if found.shape != (number,) or not jnp.issubdtype(found.dtype, jnp.floating):
            expected = f"must return floats of shape [{number}], one for each PoI and NOP's last"
            expected = f"{expected}; not {found.dtype}{[*found.shape]}"
            raise ConfigError(field, policy, expected)
        return found

    return values
