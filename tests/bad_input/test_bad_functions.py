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
from jaxsense import dqn, mission, recorded, sim, tasks, vae
from jaxsense.config import ConfigError, DetectorConfig
from jaxsense.core.types import Belief, Transition
from jaxsense.dqn import replay
from jaxsense.dqn.optimum import interpolate
from jaxsense.dqn.rewards import information
from jaxsense.interfaces import common as interfaces_common
from jaxsense.looks import Bank, make_mdp
from jaxsense.mission import begin, roadmap
from jaxsense.mission.outcome import is_fault
from jaxsense.mission.state import Faults, no_faults
from jaxsense.models import Models
from jaxsense.sim.light import Light, random_conditions, random_light
from jaxsense.sim.world import survey
from jaxsense.tasks import registry
from jaxsense.tasks.score import estimate
from jaxsense.vae import detectors, fusion, readout

# Settings whose models have other shapes.
OTHERS = dataclasses.replace(SMOKE, jmvae=dataclasses.replace(SMOKE.jmvae, latent_size=3))
WINDOWS = dataclasses.replace(SMOKE, camera=dataclasses.replace(SMOKE.camera, stride=2, window=40))
FEWER = dataclasses.replace(SMOKE, arena=dataclasses.replace(SMOKE.arena, num_pois=2))
FARTHER = dataclasses.replace(
    SMOKE, viewpoint=dataclasses.replace(SMOKE.viewpoint, max_distance=1.3)
)


class World:
    """What the functions are called with, made once."""

    def __init__(self):
        self.key = jax.random.key(0)
        self.models: Models = untrained(SMOKE)
        self.params, self.model = self.models.jmvae, jaxsense.make_jmvae(SMOKE)
        self.world = sim.make_world(SMOKE)
        self.camera, self.lidar = self.world.sensors
        self.mission = mission.make_mission(SMOKE)
        self.classes = jnp.array([0, 1, 2])
        layout = jax.jit(sim.random_layout)(self.key, SMOKE.arena, self.classes)
        light = jax.jit(random_light)(self.key)
        self.scene = sim.Scene(layout, light, jnp.zeros((2, 3)))
        classes = Belief(jnp.eye(3)[:, :2], jnp.ones((3, 2)))
        prior = vae.prior(self.model, 20.0)
        self.filter = fusion.init_filter(self.key, self.model, classes, prior, (1,))
        self.in_place = self.models.fusion
        self.bank = tuple(jnp.full((3, 4, 2), 0.5) for _ in range(2))
        self.mdp = make_mdp(SMOKE, self.models, Bank(self.bank))
        self.environment = dqn.Environment(self.models.agent, self.mdp)
        seen = jnp.zeros((3, 2), bool)
        self.state = jax.jit(dqn.reset)(self.key, self.mdp, self.classes, seen)
        self.belief, self.means = Belief(jnp.zeros(2), jnp.ones(2)), jnp.zeros((3, 2))
        self.seen, self.x = jnp.zeros(2, bool), jnp.zeros(2)
        self.look = jnp.array([0.75, 0.25])

    def look_of(self, size):
        return self.models.detectors[0], jnp.ones(size), jnp.float32(1)

    def belief_of(self, **numbers):
        filled = {name: jnp.full(2, float(x)) for name, x in numbers.items()}
        return dataclasses.replace(self.belief, **filled)

    def fused(self, fusion):
        return dataclasses.replace(self.models, fusion=fusion)


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


def retrain(w, number=0.0, size=None, labels=(0,) * 8, detector=None, **settings):
    """A detector that is retrained on eight windows, all of whose readings are a number."""
    detector = detector or w.models.detectors[1]
    windows = np.full((8, size or w.models.detectors[1].window_size), number, np.float32)
    config = DetectorConfig(**{"steps": 2, "batch": 4, "calibration": 0.25, **settings})
    looks = vae.Looks(windows, np.ones(8, np.float32))
    return vae.retrain(w.key, detector, looks, np.array(labels), config)


def train(w, *shapes, number=0.5, scale=1.0):
    """A JMVAE, its parameters scaled, that is trained for a step on banks of a number."""
    bank, params = (
        tuple(jnp.full(x, number) for x in shapes),
        jax.tree.map(lambda x: x * scale, w.params),
    )
    config = dataclasses.replace(SMOKE.jmvae, steps=1, batch=2)
    return vae.train(w.key, params, w.model, bank, config)


def mdp_of(w, features):
    """An MDP whose looks by each sensor are the same."""
    return make_mdp(SMOKE, w.models, Bank((features, features)))


def remembering(act):
    """The score of a policy with a memory."""
    return jaxsense.score("map-v0", tasks.Recurrent(act, 0))


def log_likelihood(w, weights=(1.0, 1.0), samples=2):
    return vae.log_likelihood(w.key, w.params, w.model, (w.x, w.x), weights, samples)


class Plain:
    """All members of a fusion, but no pytree."""

    accumulates = classes = prior = update = together = class_probabilities = None


def walls(*distances):
    """Angles, and scans of a wall at each distance, without edges."""
    angles = np.linspace(-0.1, 0.1, 15)
    return angles, np.repeat(distances, 20)[:, None] / np.cos(angles)[None]


def start(w, **inputs):
    """A mission that begins with some inputs changed."""
    given = {"classes": w.classes, "policy": 0, "faults": no_faults(SMOKE), **inputs}
    paths, no_error = roadmap.build(SMOKE, w.scene.layout), jnp.zeros_like(w.scene.poses)
    return begin.start(w.mission, w.models, w.scene, **given, paths=paths, pose_error=no_error)


def value_iteration(w, **changed):
    """Values of looks that tell nothing, with some arguments changed."""
    given = {"likelihoods": jnp.zeros((2, 3, 2)), "reward": dqn.Nats(0.1), "config": SMOKE.mdp}
    given |= {"mixture": lambda p: w.belief, "prior": w.belief, "horizon": 2}
    return dqn.value_iteration(**{**given, **changed})


def seen_by(number):
    """Transitions of a number of environments."""
    states, scalars = jnp.ones((3, number)), jnp.zeros(number)
    return Transition(states, scalars, scalars, scalars, states)


IS_POLICY = "must be a function (key, observation) -> action, a Recurrent, or a list of them"
IS_TASK = "must be from make, or one of map-v0, many-v0, noisy-v0, team-v0"
BAD, THIRDS = jnp.array([0, 1, 7]), jnp.full(3, 1 / 3)


# Calls, and a part of what they say.
FUNCTIONS = [
    (lambda w: jaxsense.load(""), "run = '.': is not a run directory: it has no config.json"),
    (lambda w: jaxsense.score("map-v0", "greedy"), f"policy = 'greedy': {IS_POLICY}"),
    (lambda w: jaxsense.score(nop, "map-v0"), f"task = nop: {IS_TASK}"),
    (lambda w: jaxsense.score("map-v0", lambda key, x: 0.5), "not float32[]"),
    (lambda w: remembering(nop), "policy.act = nop"),
    (lambda w: jaxsense.score("map-v0", lambda key, x: None), "not NoneType"),
    (lambda w: remembering(lambda key, m, x: 0), "an action and a memory"),
    (lambda w: remembering(lambda key, m, x: (0, (m, m))), "policy: must return a memory with the"),
    (lambda w: jaxsense.make("map-v0").step(w.key, w.state, True), "dtype bool"),
    (lambda w: jaxsense.make("map-v0").step(w.key, w.x, 0), "must be State, as from reset"),
    (lambda w: w.mdp.of(7), "modality = 7: must be a whole number from 0 to 1"),
    (lambda w: w.models.bayes.update(w.models.bayes.prior, np.ones(1), 0), "labels = 1"),
    (lambda w: interfaces_common.robots_of("team-v0"), "mdp = 'team-v0'"),
    (lambda w: vae.Jmvae(("a",), (2,), None, (8,)), "latent_size = None"),
    (lambda w: of_missions(w, policies=values), "policies = values"),
    (lambda w: of_missions(w, config=w.models, models=SMOKE), "config = Models"),
    (lambda w: of_missions(w, models=w.fused(3)), "models.fusion = int: must be a Fusion; it lac"),
    (lambda w: of_missions(w, policies={3: values}), "policies = {3: <function values"),
    (lambda w: of_missions(w, policies={"mine": 3}), "policies['mine'] = 3: must be a function"),
    (lambda w: of_missions(w, policies={"mine": nop}), "policies['mine'] = nop"),
    (lambda w: of_missions(w, policies={"a_blind": values}), "policies = 'a_blind'"),
    (lambda w: of_missions(w, FEWER), "arena.num_pois = 2: must be the num"),
    (lambda w: of_missions(w, against=[]), "against = []: must be a list of 1 or more"),
    (lambda w: of_missions(w, against=["x"]), "against = ('x',): must be among latent"),
    (lambda w: of_missions(w, episodes=0), "episodes = 0"),
    (lambda w: of_missions(w, episodes=100_001), "episodes = 100001: must be a whole numb"),
    *(
        (lambda w, seed=seed: of_missions(w, seed=seed), f"seed = {seed}: must be a whole number")
        for seed in (-1, 2**32, True, 0.5)
    ),
    (lambda w: start(w, policy=11), "policy = 11: must be a whole number from 0 to 10"),
    (lambda w: start(w, policy=-1), "policy = -1"),
    (lambda w: start(w, classes=BAD), "classes = 7"),
    (lambda w: start(w, faults=Faults(jnp.full(2, NAN), jnp.zeros(2))), "faults.stops_at = nan"),
    (lambda w: start(w, faults=Faults(jnp.zeros(2), -jnp.ones(2))), "faults.blind_at = -1.0"),
    (lambda w: is_fault(3), "case = 3: must be str, as from cases"),
    (lambda w: tasks.mean_return(w.key, "map-v0", nop, 0), "episodes = 0"),
    (lambda w: jaxsense.make("team-v0").step(w.key, w.state, 0), "state.seen has the shape (3, 2)"),
    (lambda w: make_mdp(SMOKE, w.models, Bank(w.bank[:1])), "looks has 1 entries: must be 2"),
    (lambda w: mdp_of(w, w.bank[0] * NAN), "looks = nan"),
    (lambda w: make_mdp(FARTHER, w.models), "= 1.2999999523162842: must be from 0.3 to 1.2, as"),
    (lambda w: sim.make_layout(SMOKE.arena, jnp.zeros((3, 2)), jnp.zeros(3), BAD), "classes = 7"),
    (lambda w: sim.look(w.key, w.world, w.scene, 0, jnp.int32(3)), "poi = 3"),
    (lambda w: replay.sample(jnp.zeros((1, 2)), replay.init(1, 2, 1, 2)), "rounds in replay = 0"),
    (lambda w: value_iteration(w, start=jnp.array([0.75, 0.5])), "sum of start = 1.25: must be 1"),
    (lambda w: w.models.detect(1, w.lidar, np.ones(720), 0.0, 1.0), "lidar has the shape (720,)"),
    (lambda w: recorded.fit_noise(SMOKE.lidar, np.zeros(20), np.ones(20)), "ranges has the shape"),
    (lambda w: retrain(w, NAN), "windows = nan: must be finite; leave out what was not recorded"),
    (lambda w: retrain(w, labels=[1, 2] * 4), "labels = 2: must be a whole number from 0 to 1"),
    (lambda w: sim.cut_out(w.camera, np.ones((640, 3), np.uint8), 0.0), "readings of dtype uint8"),
    (lambda w: dataclasses.replace(w.lidar, stride=0), "stride = 0"),
    (lambda w: vae.Jmvae(("a", "a"), (2, 2), 2, (8,)), "none twice"),
    (lambda w: vae.Jmvae(("a", "b", "a+b"), (2, 2, 2), 2, (8,)), "modalities = ('a', 'b', 'a+b')"),
    (lambda w: vae.posterior(w.params, w.model, (w.x[None],) * 2), "camera has the shape (1, 2)"),
    (lambda w: w.filter.update(w.belief, w.seen, w.look, 0, NAN), "weight = nan"),
    (lambda w: w.in_place.update(w.belief_of(std=-1), w.seen, w.look, 0), "belief.std = -1.0"),
    (lambda w: w.in_place.update(w.belief, w.seen, w.x, 1), "sum of features of lidar = 0.0"),
    (lambda w: vae.posterior(w.params, w.model, (None, w.x * NAN)), "features of lidar = nan"),
    (lambda w: w.in_place.update(w.belief, w.seen, w.x, 2), "modality = 2"),
    (lambda w: w.models.bayes.update(jnp.full(3, -INF), w.look, 0), "largest of log_posterior"),
    (lambda w: interpolate(jnp.zeros(7), THIRDS), "length of table = 7"),
    (lambda w: interpolate(jnp.zeros(6), w.means), "probabilities has the shape (3, 2)"),
    (lambda w: value_iteration(w, likelihoods=jnp.full((2, 3, 2), NAN)), "likelihoods = nan"),
    (lambda w: value_iteration(w, horizon=0), "horizon = 0"),
    (lambda w: value_iteration(w, start=THIRDS), "start has the shape (3,)"),
    (lambda w: replay.init(0, 2, 1, 2), "state_size = 0"),
    (lambda w: replay.add(replay.init(3, 5, 2, 4), seen_by(7)), "transitions.s_tm1 has the shape"),
    (lambda w: replay.sample(jnp.zeros((1, 2), "bfloat16"), replay.init(1, 2, 1, 2)), "bfloat16"),
    (lambda w: w.models.agent.observe(Belief(w.means, w.means), 0, 0, 0), "belief.std = 0.0"),
    (lambda w: dqn.reset(w.key, w.mdp, w.classes, w.means), "seen of dtype float32: must be bool"),
    (lambda w: interfaces_common.prepared_starts(0, w.mdp, 2), "key = 0: must be one key"),
    (lambda w: interfaces_common.prepared_starts(w.key, w.mdp, 0), "number of starts = 0"),
    (lambda w: vae.prior(w.model, -1.0), "variance = -1.0: must be greater than 0"),
    (lambda w: readout.plausible_classes(w.belief_of(mean=NAN), w.means), "belief.mean = nan"),
    (lambda w: information(w.x), "std = 0.0: must be greater than 0"),
    (lambda w: dqn.reset(w.key, w.mdp, BAD), "classes = 7"),
    (lambda w: dqn.reset(w.key, dataclasses.replace(w.mdp, robots=())), "number of robots = 0"),
    (lambda w: dqn.step(w.key, w.mdp, w.state, jnp.int32(4)), "action = 4"),
    (lambda w: mission.rollout(w.key, None, None, None, 0), "steps = 0"),
    (lambda w: make_mdp(OTHERS, w.models), "models.fusion holds 3 classes in 2 dimensions: must"),
    (lambda w: make_mdp(WINDOWS, w.models), "models.detectors of camera: reads windows of 240"),
    (lambda w: jaxsense.detections(w.key, SMOKE, w.models, 0), "samples = 0"),
    (lambda w: vae.Jmvae(("a", "b"), (2,), 2, (8,)), "feature_sizes has 1 entries"),
    (lambda w: vae.Jmvae(["a"], (2,), 2, (8,)), "modalities = ['a']: must be tuple"),
    (lambda w: vae.Jmvae((), (), 2, (8,)), "modalities = (): must be one name"),
    (lambda w: vae.Jmvae(("a",), (2,), 2, (8,), 0), "max_subset = 0"),
    (lambda w: vae.init(w.key, w.model, scale=0.0), "scale = 0.0"),
    (lambda w: vae.encode(w.params, w.model, (w.x,)), "features has 1 entries"),
    (lambda w: vae.encode(w.params, w.model, (None, None)), "features = (None, None)"),
    (lambda w: vae.decode(w.params, w.model, jnp.zeros(3)), "z has the shape (3,): must be (2,)"),
    (lambda w: train(w, (3, 4, 2)), "bank has 1 entries: must be 2"),
    (lambda w: train(w, (3, 4, 2), (2, 4, 2)), "bank of lidar has the shape (2, 4, 2)"),
    (lambda w: train(w, *[(3, 4, 2)] * 2, number=NAN), "bank of camera = nan"),
    (lambda w: train(w, *[(3, 0, 2)] * 2), "rows in the bank of camera = 0"),
    (lambda w: train(w, *[(1, 4, 2)] * 2), "bank has one class with 4 looks: must be two or more"),
    (lambda w: train(w, *[(3, 4, 2)] * 2, scale=NAN), "losses = nan: must be finite; scale feat"),
    (lambda w: log_likelihood(w, samples=0), "samples = 0"),
    (lambda w: log_likelihood(w, (1.0,)), "reconstruction_weights has 1 entries"),
    (lambda w: log_likelihood(w, (0.0, 1.0)), "reconstruction_weights = 0.0"),
    (lambda w: detectors.features(*w.look_of(3)), "window has the shape (3,): must be (240,)"),
    (lambda w: detectors.detect(*w.look_of(3)), "window has the shape (3,): must be (240,)"),
    (lambda w: retrain(w, size=7), "windows has the shape (8, 7)"),
    (lambda w: retrain(w, calibration=0.0), "config.calibration = 0.0: must leave"),
    (lambda w: retrain(w, 1e38), "loss of retrained detectors = nan"),
    (lambda w: retrain(w, detector=3), "detector = 3: must be Classifier"),
    (lambda w: w.filter.update(w.belief, w.seen, w.look, 2), "modality = 2"),
    (lambda w: w.filter.update(w.belief, w.seen, THIRDS, 0), "features of camera has the shape"),
    (lambda w: w.filter.update(w.belief, w.seen, 2 * w.look, 0), "features = 1.5"),
    (lambda w: w.in_place.together({2: w.look}), "modality = 2: must be 0 (camera)"),
    (lambda w: readout.mixture(w.filter.classes, 1.5 * THIRDS), "sum of probabilities = 1.5"),
    (lambda w: readout.plausible_classes(w.belief, w.means * NAN), "class_means = nan"),
    (lambda w: w.filter.class_probabilities(Belief(THIRDS, THIRDS)), "belief.mean has the shape"),
    (lambda w: w.models.bayes.log_likelihoods(2 * w.look, 0), "features = 1.5"),
    (lambda w: w.models.detect(2, w.lidar, np.ones(683), 0.0, 1.0), "modality = 2"),
    (lambda w: make_mdp(SMOKE, w.fused(Plain())), "models.fusion = Plain"),
    (lambda w: mdp_of(w, jnp.zeros((3, 4, 3))), "looks of camera has the shape (3, 4, 3)"),
    (lambda w: mdp_of(w, jnp.zeros((3, 0, 2))), "looks at each class = 0"),
    (lambda w: jaxsense.detections(w.key, FARTHER, w.models, 1), "looks by the camera = 1.29"),
    (lambda w: sim.cut_out(w.lidar, np.ones(720), 0.0), "readings of lidar has the shape (720,)"),
    (lambda w: sim.cut_out(w.lidar, np.ones(683), 90.0), "bearing = 90.0"),
    (lambda w: sim.cut_out(w.lidar, -np.ones(683), 0.0), "readings of lidar = -1.0"),
    (lambda w: dataclasses.replace(w.lidar, height=0.0), "height = 0.0"),
    (lambda w: sim.look(w.key, w.world, w.scene, -1, 0), "robot = -1: must be a whole number"),
    (lambda w: sim.look(w.key, w.world, w.scene, 2, 0), "robot = 2: must be a whole number"),
    (lambda w: sim.cross_section(w.world.arena, None, 0.1, -2), "robot = -2: must be -1 or one of"),
    (lambda w: sim.cross_section(w.world.arena, None, 0.1, 2), "robot = 2: must be -1 or one of"),
    (lambda w: survey(0, w.world, w.classes, False), "key = 0: must be one key"),
    (lambda w: random_light(0), "key = 0: must be one key"),
    (lambda w: Light(w.x, 1.0, 1.0).changes(), "conditions = None"),
    (lambda w: Light(w.x, 1.0, 1.0, random_conditions(w.key)).changes(), "light.point = None"),
    (lambda w: recorded.fit_noise(SMOKE, *walls(1.0)), "config = Config"),
    (lambda w: recorded.fit_noise(SMOKE.lidar, np.zeros(14), np.ones((1, 14))), "angles = 14"),
    (lambda w: recorded.fit_noise(SMOKE.lidar, *walls(-1.0)), "ranges = -1.0"),
    (lambda w: recorded.fit_noise(SMOKE.lidar, *walls(1.2)), "20 pieces of walls"),
    (lambda w: recorded.fit_noise(SMOKE.lidar, *walls(1.2, 2.2)), "scans show no edges"),
    (lambda w: registry.agents("map"), "name = 'map': must be one of map-v0"),
    (lambda w: jaxsense.make("map-v0", "sonar"), "agent = 'sonar': must be one of camera, lidar"),
    (lambda w: jaxsense.score(jaxsense.make("map-v0"), nop, agent="lidar"), "agent = 'lidar'"),
    (lambda w: jaxsense.score("map-v0", []), "policy = []: must be one policy or"),
    (lambda w: jaxsense.score("map-v0", nop, episodes=0), "episodes = 0"),
    (lambda w: tasks.mean_return(w.key, "map-v0", lambda key, x: 4, 1), "actions from 0 to 3"),
    (lambda w: estimate(np.ones((2, 2))), "values has the shape (2, 2): must be (any,)"),
    (lambda w: jaxsense.make("map-v0").step(w.key, w.state, BAD[:2]), "action has the shape (2,)"),
    (lambda w: jaxsense.learn(w.key, SMOKE, until="x"), "until = 'x': must be one of scenes"),
]


@pytest.mark.parametrize(("call", "expected"), FUNCTIONS, ids=[told for _, told in FUNCTIONS])
def test_functions_refuse(given_world, call, expected):
    with pytest.raises((ValueError, TypeError), match=re.escape(expected)) as refused:
        call(given_world)
    assert "\n" not in str(refused.value)


def test_64_bits_are_refused_even_if_they_are_switched_on_later(given_world, tmp_path):
    w, task = given_world, jaxsense.make("team-v0")
    doors = (
        lambda: jaxsense.learn(w.key, SMOKE),
        lambda: sim.make_world(SMOKE),
        lambda: train(w, *[(3, 4, 2)] * 2),
        lambda: jaxsense.make("map-v0"),
        lambda: jaxsense.load_pretrained("default"),
        lambda: task.reset(w.key),
        lambda: tasks.mean_return(w.key, task, nop, 2),
        lambda: jaxsense.load(tmp_path),
    )
    with jax.enable_x64(True):
        for door in doors:
            with pytest.raises(ConfigError, match=r"^JAX_ENABLE_X64 = True: must be off, as jaxs"):
                door()


def test_environments_refuse(given_world):
    from jaxsense.interfaces import gymnasium, gymnax

    mdp = given_world.mdp
    for number in (0, -1, 1.5, True, "2"):
        with pytest.raises(ValueError, match=r"num_envs = .*: must be a whole number greater"):
            gymnasium.MapVectorEnv(mdp, num_envs=number)
    with pytest.raises(ValueError, match="render_mode = 'ansi': must be one of"):
        gymnasium.TaskEnv("map-v0", render_mode="ansi")
    with pytest.raises(ValueError, match="Later"):
        gymnasium.MapVectorEnv(mdp, num_envs=2, autoreset_mode="Later")
    env = gymnasium.MapVectorEnv(mdp, num_envs=2)
    for mask in ([True], [1, 0], "x", np.ones(3, bool)):
        with pytest.raises(ValueError, match=r"reset_mask = .*: must hold 2 booleans"):
            env.reset(options={"reset_mask": mask})
    env._states = given_world.state  # as after a reset, which takes long to compile
    for actions in ([0, 4], [-1, 0], [0.5, 1.0], [0], [[0, 1]], "x"):
        with pytest.raises(ValueError, match=r"actions = .*: must be in"):
            env.step(actions)
    start = gymnax.MapEnvState(time=0, map=given_world.state, terminated=jnp.bool_(False))
    with pytest.raises(ValueError, match="action = 4: must be a whole number from 0 to 3"):
        gymnax.MapEnv(mdp).step_env(given_world.key, start, 4, gymnax.MapEnvParams())
