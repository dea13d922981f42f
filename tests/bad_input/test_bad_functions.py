"""Arguments that public functions refuse, with the words of the commands."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import INF, NAN, SMOKE
from untrained import untrained

import jaxsense
from jaxsense import Belief, dqn, mission, recorded, sim, tasks, vae
from jaxsense.dqn import replay
from jaxsense.dqn.optimum import interpolate
from jaxsense.dqn.rewards import information
from jaxsense.interfaces import common as interfaces_common
from jaxsense.mission import begin
from jaxsense.mission.state import Faults, no_faults
from jaxsense.sim.light import random_light
from jaxsense.vae import fusion
from jaxsense.vae.readout import plausible_classes

# Settings whose models have other shapes.
OTHERS = dataclasses.replace(SMOKE, jmvae=dataclasses.replace(SMOKE.jmvae, latent_size=3))
WINDOWS = dataclasses.replace(SMOKE, camera=dataclasses.replace(SMOKE.camera, stride=2, window=40))


class World:
    """What the functions are called with, made once."""

    def __init__(self):
        self.key = jax.random.key(0)
        self.models = untrained(SMOKE)
        self.params, self.model = self.models.jmvae, jaxsense.make_jmvae(SMOKE)
        self.world = sim.make_world(SMOKE)
        self.camera, self.lidar = self.world.sensors
        self.mission = mission.make_mission(SMOKE, arenas=(self.world.arena,) * 2)
        self.classes = jnp.array([0, 1, 2])
        layout = sim.random_layout(self.key, SMOKE.arena, self.classes)
        light = random_light(self.key)
        self.scene = sim.Scene(layout, light, jnp.zeros((2, 3)))
        classes = Belief(jnp.eye(3)[:, :2], jnp.ones((3, 2)))
        prior = vae.prior(self.model, 20.0)
        self.filter = fusion.init_filter(self.key, self.model, classes, prior, (1,))
        self.in_place = self.models.fusion
        self.bank = tuple(jnp.full((3, 4, 2), 0.5) for _ in range(2))
        self.mdp = jaxsense.make_mdp(SMOKE, self.models, jaxsense.Bank(self.bank))
        self.environment = dqn.Environment(self.models.agent, self.mdp)
        seen = jnp.zeros((3, 2), bool)
        self.state = jax.jit(dqn.reset)(self.key, self.mdp, self.classes, seen)
        self.belief, self.means = Belief(jnp.zeros(2), jnp.ones(2)), jnp.zeros((3, 2))
        self.seen, self.x = jnp.zeros(2, bool), jnp.zeros(2)
        self.look = jnp.array([0.75, 0.25])

    def belief_of(self, **parts):
        return dataclasses.replace(self.belief, **parts)


@pytest.fixture(scope="module")
def given_world():
    return World()


def nop(key, observation):
    return jnp.int32(3)


def values(key, models, known):
    return jnp.zeros(len(known.looks) + 1)


def of_missions(w, config=SMOKE, models=None, policies=None, **options):
    """A score of missions, of a policy unless others are given."""
    models, policies = models or w.models, policies or {"mine": values}
    return jaxsense.score_missions(config, models, policies, **options)


def retrain(w, windows=None, labels=None):
    """A detector that is retrained on eight windows."""
    size = w.models.detectors[1].window_size
    if windows is not None and windows.shape[1] == 61:
        windows = np.resize(windows, (8, size))
    windows = np.zeros((8, size)) if windows is None else windows
    labels = np.zeros(8, int) if labels is None else labels
    looks = vae.Looks(windows, np.ones(len(windows)))
    return vae.retrain(w.key, w.models.detectors[1], looks, labels)


def value_iteration(w, **changed):
    """Values of looks that tell nothing, with some arguments changed."""
    given = {"likelihoods": jnp.zeros((2, 3, 2)), "reward": dqn.Nats(0.1), "config": SMOKE.mdp}
    return dqn.value_iteration(
        mixture=lambda p: w.belief, prior=w.belief, horizon=2, **{**given, **changed}
    )


IS_POLICY = "must be a function (key, observation) -> action, a Recurrent, or a list of them"
IS_TASK = "must be from make, or one of map-v0, many-v0, noisy-v0, team-v0"
BAD = jnp.array([0, 1, 7])


def changed(section, **values):
    """Settings of the smoke preset but for some of a section."""
    of_section = dataclasses.replace(getattr(SMOKE, section), **values)
    return dataclasses.replace(SMOKE, **{section: of_section})


FUNCTIONS = {
    "load": (
        lambda w: jaxsense.load(""),
        "run = '.': is not a run directory: it has no config.json",
    ),
    "score name": (lambda w: jaxsense.score("map-v0", "greedy"), f"policy = 'greedy': {IS_POLICY}"),
    "score swapped": (lambda w: jaxsense.score(nop, "map-v0"), f"task = nop: {IS_TASK}"),
    "score returns real": (
        lambda w: jaxsense.score("map-v0", lambda key, x: 0.5),
        "an integer of shape []; not float32[]",
    ),
    "recurrent arguments": (
        lambda w: jaxsense.score("map-v0", tasks.Recurrent(nop, 0)),
        "policy.act = nop: must be a function (key, memory, observation) -> (action, memory)",
    ),
    "score returns nothing": (
        lambda w: jaxsense.score("map-v0", lambda key, x: None),
        "policy: must return an integer of shape []; not NoneType",
    ),
    "recurrent returns an action": (
        lambda w: jaxsense.score("map-v0", tasks.Recurrent(lambda key, m, x: 0, 0)),
        "policy: must return an action and a memory",
    ),
    "recurrent memory grows": (
        lambda w: jaxsense.score("map-v0", tasks.Recurrent(lambda key, m, x: (0, (m, m)), 0)),
        "policy: must return a memory with the structure, shapes and dtypes of the first",
    ),
    "task step bool": (lambda w: jaxsense.make("map-v0").step(w.key, w.state, True), "dtype bool"),
    "task step observation": (
        lambda w: jaxsense.make("map-v0").step(w.key, w.x, 0),
        "must be State, as from reset",
    ),
    "mdp of": (
        lambda w: w.mdp.of(7),
        "modality = 7: must be a whole number from 0 to 1",
    ),
    "bayes label": (
        lambda w: w.models.bayes.update(w.models.bayes.prior, np.ones(1, np.float32), 0),
        "labels = 1: must be a whole number from 0 to 0",
    ),
    "team of a name": (
        lambda w: interfaces_common.robots_of("team-v0"),
        "mdp = 'team-v0': must be a task of a team alone, such as jaxsense.make('team-v0')",
    ),
    "Jmvae size": (lambda w: vae.Jmvae(("a",), (2,), None, (8,)), "latent_size = None"),
    "missions function": (
        lambda w: of_missions(w, policies=values),
        "policies = values: must be a dictionary from names to policies",
    ),
    "missions swapped": (
        lambda w: of_missions(w, config=w.models, models=SMOKE),
        "config = Models: must be Config, of jaxsense.config",
    ),
    "missions fusion": (
        lambda w: of_missions(w, models=dataclasses.replace(w.models, fusion=3)),
        "models.fusion = int: must be a Fusion; it lacks accumulates, classes, prior, update",
    ),
    "mean_return episodes": (
        lambda w: tasks.mean_return(w.key, "map-v0", nop, 0),
        "episodes = 0: must be a whole number greater than 0",
    ),
    "task step team": (
        lambda w: jaxsense.make("team-v0").step(w.key, w.state, 0),
        "state.seen has the shape (3, 2): must be (8, 2)",
    ),
    "make_mdp few": (
        lambda w: jaxsense.make_mdp(SMOKE, w.models, jaxsense.Bank(w.bank[:1])),
        "looks has 1 entries: must be 2",
    ),
    "make_mdp nan": (
        lambda w: jaxsense.make_mdp(SMOKE, w.models, jaxsense.Bank((w.bank[0] * NAN,) * 2)),
        "looks = nan: must be finite",
    ),
    "make_mdp live far": (
        lambda w: jaxsense.make_mdp(changed("viewpoint", max_distance=1.3), w.models),
        "distance of looks by the camera = 1.2999999523162842: must be from 0.3 to 1.2, as",
    ),
    "make_layout classes": (
        lambda w: sim.make_layout(SMOKE.arena, jnp.zeros((3, 2)), jnp.zeros(3), BAD),
        "classes = 7: must be a whole number from 0 to 2",
    ),
    "look poi": (
        lambda w: sim.look(w.key, w.world, w.scene, 0, jnp.int32(3)),
        "poi = 3: must be a whole number from 0 to 2",
    ),
    "replay empty": (
        lambda w: replay.sample(jnp.zeros((1, 2)), replay.init(1, 2, 1, 2)),
        "rounds in replay = 0: must be 1 or more; add some",
    ),
    "value_iteration sum": (
        lambda w: value_iteration(w, start=jnp.array([0.75, 0.5])),
        "sum of start = 1.25: must be 1",
    ),
    "models.detect length": (
        lambda w: w.models.detect(1, w.lidar, np.ones(720), 0.0, 1.0),
        "readings of lidar has the shape (720,): must be (683,)",
    ),
    "fit_noise scan": (
        lambda w: recorded.fit_noise(SMOKE.lidar, np.zeros(20), np.ones(20)),
        "ranges has the shape (20,): must be (any, 20)",
    ),
    "retrain nan": (
        lambda w: retrain(w, np.full((8, 61), NAN)),
        "windows = nan: must be finite; leave out what was not recorded",
    ),
    "retrain label": (
        lambda w: retrain(w, labels=np.arange(1, 9) % 2 + 1),
        "labels = 2: must be a whole number from 0 to 1",
    ),
    "cut_out dtype": (
        lambda w: sim.cut_out(w.camera, np.full((640, 3), 255, np.uint8), 0.0),
        "readings of dtype uint8: must be real numbers",
    ),
    "Sensor stride": (lambda w: dataclasses.replace(w.lidar, stride=0), "stride = 0"),
    "Jmvae twice": (lambda w: vae.Jmvae(("a", "a"), (2, 2), 2, (8,)), "none twice"),
    "Jmvae plus": (
        lambda w: vae.Jmvae(("a", "b", "a+b"), (2, 2, 2), 2, (8,)),
        "modalities = ('a', 'b', 'a+b'): must be one name or more, none twice, and none with a +",
    ),
    "posterior batch": (
        lambda w: vae.posterior(w.params, w.model, (w.x[None], w.x[None])),
        "features of camera has the shape (1, 2): must be (2,); use jax.vmap for a batch",
    ),
    "update weight": (
        lambda w: w.filter.update(w.belief, w.seen, w.look, 0, NAN),
        "weight = nan: must be from 0 to 1",
    ),
    "fuse std": (
        lambda w: vae.fuse(w.params, w.model, w.belief_of(std=-w.belief.std), w.seen, (w.x, None)),
        "belief.std = -1.0: must be greater than 0",
    ),
    "fuse sum": (
        lambda w: vae.fuse(w.params, w.model, w.belief, w.seen, (w.look, w.x)),
        "sum of features of lidar = 0.0: must be 1",
    ),
    "posterior nan": (
        lambda w: vae.posterior(w.params, w.model, (None, w.x * NAN)),
        "features of lidar = nan: must be finite",
    ),
    "in place modality": (
        lambda w: w.in_place.update(w.belief, w.seen, w.x, 2),
        "modality = 2: must be 0 (camera) or 1 (lidar)",
    ),
    "bayes none": (
        lambda w: w.models.bayes.update(jnp.full(3, -INF), w.look, 0),
        "largest of log_posterior = -inf: must be finite",
    ),
    "interpolate": (
        lambda w: interpolate(jnp.zeros(7), jnp.full(3, 1 / 3)),
        "length of table = 7: must be 6 or another size of a grid",
    ),
    "prior": (lambda w: vae.prior(w.model, -1.0), "variance = -1.0: must be greater than 0"),
    "plausible_classes": (
        lambda w: plausible_classes(w.belief_of(mean=w.x * NAN), w.means),
        "belief.mean = nan: must be finite",
    ),
    "information zero": (lambda w: information(w.x), "std = 0.0: must be greater than 0"),
    "reset classes": (lambda w: dqn.reset(w.key, w.mdp, BAD), "classes = 7"),
    "step action": (
        lambda w: dqn.step(w.key, w.mdp, w.state, jnp.int32(4)),
        "action = 4: must be a whole number from 0 to 3",
    ),
    "mission.rollout": (lambda w: mission.rollout(w.key, None, None, None, 0), "steps = 0"),
    "make_mdp of others": (
        lambda w: jaxsense.make_mdp(OTHERS, w.models),
        "models.fusion holds 3 classes in 2 dimensions: must be 3 in 3, as in config",
    ),
    "make_mdp of other windows": (
        lambda w: jaxsense.make_mdp(WINDOWS, w.models),
        "models.detectors of camera: reads windows of 240 numbers; must be of 120, as config's are",
    ),
    "detections": (lambda w: jaxsense.detections(w.key, SMOKE, w.models, 0), "samples = 0"),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_refuse(given_world, name):
    call, expected = FUNCTIONS[name]
    with pytest.raises(ValueError, match=re.escape(expected)):
        call(given_world)


@pytest.mark.parametrize(
    ("inputs", "expected"),
    [
        ({"policy": 12}, "policy = 12: must be a whole number from 0 to 11"),
        ({"policy": -1}, "policy = -1"),
        ({"classes": BAD}, "classes = 7"),
        ({"faults": Faults(jnp.full(2, NAN), jnp.zeros(2))}, "faults.stops_at = nan"),
        ({"faults": Faults(jnp.zeros(2), -jnp.ones(2))}, "faults.blind_at = -1.0"),
    ],
)
def test_a_mission_refuses(given_world, inputs, expected):
    team, models = given_world.mission, given_world.models
    base = {"classes": given_world.classes, "policy": 0, "faults": no_faults(SMOKE)}
    with pytest.raises(ValueError, match=re.escape(expected)):
        begin.start(team, models, given_world.scene, **{**base, **inputs})


def test_environments_refuse(given_world):
    from jaxsense.interfaces import gymnasium, gymnax

    mdp = given_world.mdp
    for number in (0, -1, 1.5, True, "2"):
        with pytest.raises(ValueError, match=r"num_envs = .*: must be a whole number greater"):
            gymnasium.MapVectorEnv(mdp, 0, number)
    for modality in (2, -1):
        with pytest.raises(ValueError, match=r"modality = .*: must be a whole number from 0 to 1"):
            gymnasium.MapVectorEnv(mdp, modality, 2)
        with pytest.raises(ValueError, match=r"modality = .*: must be a whole number from 0 to 1"):
            gymnax.MapEnv(mdp, modality)
    with pytest.raises(ValueError, match="Later"):
        gymnasium.MapVectorEnv(mdp, 0, 2, autoreset_mode="Later")
    env = gymnasium.MapVectorEnv(mdp, 0, 2)
    for mask in ([True], [1, 0], "x", np.ones(3, bool)):
        with pytest.raises(ValueError, match=r"reset_mask = .*: must hold 2 booleans"):
            env.reset(options={"reset_mask": mask})
    env._states = given_world.state  # as after a reset, which takes long to compile
    for actions in ([0, 4], [-1, 0], [0.5, 1.0], [0], [[0, 1]], "x"):
        with pytest.raises(ValueError, match=r"actions = .*: must be in"):
            env.step(actions)
    start = gymnax.MapEnvState(time=0, map=given_world.state, terminated=jnp.bool_(False))
    with pytest.raises(ValueError, match="action = 4: must be a whole number from 0 to 3"):
        gymnax.MapEnv(mdp, 0).step_env(given_world.key, start, 4, gymnax.MapEnvParams())
