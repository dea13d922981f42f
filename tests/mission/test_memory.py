"""Maps by each robot: what messages leave known, and that without losses nothing changes."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from teams import CONFIG, LATENT, POSES, POSITIONS, with_config, with_eyes

import jaxsense
from jaxsense import mission
from jaxsense.config.mission import CommunicationConfig
from jaxsense.core import networks
from jaxsense.core.networks import MLP
from jaxsense.core.types import Belief
from jaxsense.mission import act, maps
from jaxsense.mission.begin import start
from jaxsense.mission.maps import MOST_LOOKS, Evidence, OwnMap
from jaxsense.mission.rollout import _repeat_messages, rollout_batch
from jaxsense.mission.state import FAILED
from jaxsense.vae import readout
from jaxsense.vae.fusion import Filter

MODALITY = jnp.array([0, 1, 1])
NOTHING = Evidence(jnp.zeros(3), jnp.zeros(3))


def communicating(config, **settings):
    """Settings with maps by each robot, and the filter, which they need."""
    own = replace(config.mission, communication=CommunicationConfig(own_maps=True, **settings))
    return replace(config, mission=own, jmvae=replace(config.jmvae, fusion="filter"))


@pytest.fixture(scope="module")
def own_models():
    """Models with a filter that says different things of different features."""
    models = with_eyes(jaxsense.init(jax.random.key(0), communicating(CONFIG)))
    classes = Belief(jnp.array([[1.5, 0.0], [-1.0, 1.2], [-0.8, -1.4]]), jnp.full((3, 2), 0.3))
    fusion = models.fusion
    assert isinstance(fusion, Filter)
    read = readout.make(classes, fusion.model.feature_sizes)
    network = MLP(fusion.hidden, read.of_classes.shape[1])
    params = {
        name: networks.scale_last(network, networks.init(jax.random.key(i), network, size), 0.3)
        for i, (name, size) in enumerate(
            zip(fusion.model.modalities, fusion.model.feature_sizes, strict=True)
        )
    }
    fusion = replace(fusion, classes=classes, readout=read, networks=params)
    return replace(models, fusion=fusion)


@pytest.fixture(scope="module")
def own_team(team):
    return with_config(team, communicating(CONFIG))


@pytest.fixture(scope="module")
def own_arena(own_team, own_models, arena_of):
    """A mission with maps by each robot in a chosen arena."""

    def make(positions, poses, policy=LATENT):
        state = arena_of(positions, poses, classes=(2, 0, 1), policy=policy)
        given = state.scene, state.classes, state.policy, state.faults
        return start(own_team, own_models, *given, state.roadmap, state.pose_error)

    return make


@jax.jit
def with_look(held, robot, poi, place, evidence, seconds):
    return held.with_look(robot, poi, place, evidence, seconds, jnp.bool_(True))


def looked(held, robot, poi=0, seconds=0.0, evidence=NOTHING, place=(0.0, 0.0)):
    return with_look(
        held, np.int32(robot), np.int32(poi), np.float32(place), evidence, np.float32(seconds)
    )


tell = jax.jit(lambda held, key, *given: held.after_messages(key, *given))


def test_messages_leave_known_what_a_protocol_with_counters_does():
    """A receiver keeps, of the messages that have come, the one of most looks."""
    settings = CommunicationConfig(own_maps=True, loss=0.4, delay=2.0)
    draw = jax.jit(lambda key: jax.random.bernoulli(key, 0.4, (3, 3)))
    draw_delay = jax.jit(lambda key: 2.0 * jax.random.uniform(key, (3, 3), maxval=2.0))
    heard_by = jax.jit(lambda held, robot, time: held.known_to(robot, time))
    rng, held = np.random.default_rng(0), maps.empty(MODALITY, 3)
    numbers, messages, known, overtaken = [0, 0, 0], [], np.zeros((3, 3), int), 0
    for step in range(60):
        time = 0.5 * step
        for robot in np.flatnonzero(rng.random(3) < 0.3):
            held = looked(held, robot, seconds=time)
            numbers[robot] += 1
            known[robot, robot] += 1
        sends, key = rng.random(3) < 0.4, jax.random.key(step)
        for _ in range(2):  # every message comes twice
            held = tell(held, key, settings, jnp.float32(time), jnp.asarray(sends))
        lost_key, delay_key = jax.random.split(key)
        is_lost, delay = np.asarray(draw(lost_key)), np.asarray(draw_delay(delay_key))
        messages += [
            (np.float32(time) + delay[to, of], to, of, numbers[of])
            for of in np.flatnonzero(sends)
            for to in range(3)
            if to != of and not is_lost[to, of]
        ]
        for message in sorted(m for m in messages if m[0] <= time):
            _, to, of, count = message
            overtaken += count < known[to, of]
            known[to, of] = max(known[to, of], count)
        messages = [m for m in messages if m[0] > time]
        for robot in range(3):
            heard = np.asarray(heard_by(held, robot, jnp.float32(time)))
            np.testing.assert_array_equal(heard.sum(axis=1), known[robot])
            # The first ones, which is what a sum and a counter stand for.
            assert all(row[: row.sum()].all() for row in heard)
    assert min(numbers) > 5
    assert overtaken > 5


def test_sums_are_of_the_looks_that_are_known():
    says = lambda *values: Evidence(jnp.array(values), 10 * jnp.array(values))  # noqa: E731
    held = maps.empty(MODALITY, 3)
    held = looked(held, 0, poi=1, evidence=says(1.0, 0.0, 0.0), place=(1.0, 0.0))
    held = looked(held, 0, poi=0, evidence=says(0.0, 2.0, 0.0))
    held = looked(held, 1, poi=1, evidence=says(0.0, 0.0, 4.0), place=(0.0, 3.0))
    own, every = held.known_to(0, jnp.float32(0)), held.taken()
    np.testing.assert_array_equal(held.total(own, 2).log_likelihood, [[0, 2, 0], [1, 0, 0]])
    np.testing.assert_array_equal(held.total(every, 2).exact, [[0, 20, 0], [10, 0, 40]])
    # Of PoI 1, the LiDAR has looked from (0, 3) only, as far as all know.
    apart = OwnMap(held, every, 2).apart(jnp.array([[4.0, 0.0]]), jnp.int32(1), 1)
    np.testing.assert_allclose(np.sort(apart[0])[:2], [5.0, np.inf])
    assert np.isinf(OwnMap(held, own, 2).apart(jnp.array([[4.0, 0.0]]), jnp.int32(1), 1)).all()


def test_a_full_memory_takes_nothing_more():
    held = maps.empty(MODALITY, 3)
    full = replace(held, number=held.number.at[0].set(MOST_LOOKS))
    after = looked(full, 0, evidence=Evidence(jnp.ones(3), jnp.ones(3)))
    jax.tree.map(np.testing.assert_array_equal, replace(after, number=full.number), full)


def test_looks_one_by_one_come_to_the_shared_map(own_models):
    """To rounding: the least probability is far below these."""
    fusion, held = own_models.fusion, maps.empty(MODALITY, 3)
    shared = jax.tree.map(lambda x: jnp.tile(x, (2, 1)), (fusion.prior, own_models.bayes.prior))
    nobody, rng = jnp.zeros(2, bool), np.random.default_rng(0)

    @functools.partial(jax.jit, static_argnums=2)
    def learn(shared, features, modality, weight):
        """What one more look at PoI 1 changes in the shared map, and its evidence."""
        look = features, modality, weight
        belief, log_posterior = jax.tree.map(lambda x: x[1], shared)
        new = fusion.update(belief, nobody, *look), own_models.bayes.update(log_posterior, *look)
        after = jax.tree.map(lambda x, new: x.at[1].set(new), shared, new)
        return after, maps.evidence_of(own_models, *look)

    read = jax.jit(lambda held: OwnMap(held, held.taken(), 2).read(own_models))
    for look in range(6):
        modality, weight = look % 2, np.float32(rng.uniform(0.3, 1.0))
        features = np.float32(rng.dirichlet([1.0, 1.0]))
        shared, evidence = learn(shared, features, modality, weight)
        belief, log_posterior = shared
        held = looked(held, modality, poi=1, evidence=evidence)
        # The map of a robot that knows all looks is the same; PoI 0 has not been looked at.
        own = read(held)
        np.testing.assert_allclose(own.belief.mean, belief.mean, atol=2e-4)
        np.testing.assert_allclose(own.belief.std, belief.std, atol=2e-4)
        np.testing.assert_array_equal(own.belief.std[0], fusion.prior.std)
        np.testing.assert_allclose(own.log_posterior, log_posterior, atol=1e-5)
    assert np.abs(shared[0].mean).max() > 0.3
    np.testing.assert_array_equal(read(held).times_seen, [[0, 0], [3, 3]])


def test_robots_that_work_repeat_their_messages(own_team, own_arena, set_robot):
    state = own_arena(POSITIONS, POSES)
    state = replace(state, memory=looked(state.memory, 0))
    repeat = jax.jit(lambda state: _repeat_messages(jax.random.key(0), own_team, state))
    # Once a second, every ten control periods.
    for steps, version in ((9, 0), (10, 1), (11, 0), (20, 1)):
        after = repeat(replace(state, steps=jnp.int32(steps)))
        assert own_team.map_of(after, 1).version == version
    failed = set_robot(replace(state, steps=jnp.int32(10)), 0, phase=FAILED)
    assert own_team.map_of(repeat(failed), 1).version == 0


def test_a_robot_remembers_and_tells_what_it_has_detected(own_team, own_arena, set_robot):
    state = set_robot(own_arena(POSITIONS, POSES), 1, target=2)
    learned = (Belief(*jnp.ones((2, 2))), jnp.zeros(3)), NOTHING
    write = jax.jit(lambda state, *found: act._write(own_team, 1, jax.random.key(0), state, *found))
    after = write(replace(state, steps=jnp.int32(4)), jnp.bool_(True), *learned).memory
    np.testing.assert_array_equal(after.number, [0, 1])
    assert after.poi[1, 0] == 2
    np.testing.assert_allclose(after.place[1, 0], POSES[1][:2])
    # Both at once; of the other robot nobody has heard anything.
    np.testing.assert_allclose(after.heard_at[:, :, 0], [[np.inf, 0.4]] * 2, rtol=1e-6)
    missed = write(state, jnp.bool_(False), *learned).memory
    jax.tree.map(np.testing.assert_array_equal, missed, state.memory)


@pytest.mark.slow  # compiles a mission twice
def test_without_losses_and_delay_missions_are_those_of_a_shared_map(team, own_models, as_numpy):
    whole = communicating(CONFIG)
    shared = replace(whole, mission=replace(whole.mission, communication=CommunicationConfig()))

    def play(config):
        changed = with_config(team, config)

        @jax.jit
        def run(keys):
            begin = lambda key: mission.reset(key, changed, own_models, LATENT)  # noqa: E731
            return rollout_batch(keys, changed, own_models, jax.vmap(begin)(keys), 150)

        return as_numpy(run(jax.random.split(jax.random.key(1), 6)))

    (end, records), (own_end, own_records) = play(shared), play(whole)
    assert records.detected.sum() > 20
    for name in ("phase", "target", "scanned", "detected", "seen"):
        np.testing.assert_array_equal(getattr(own_records, name), getattr(records, name))
    np.testing.assert_allclose(own_records.poses, records.poses, atol=1e-4)
    np.testing.assert_allclose(own_records.belief.mean, records.belief.mean, atol=1e-3)
    assert own_end.memory is not None
    np.testing.assert_array_equal(
        own_end.memory.number.sum(axis=1), end.times_seen.sum(axis=(1, 2))
    )
