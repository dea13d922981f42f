"""Time from nothing compiled to a policy within a hundredth of the optimal return."""

import concurrent.futures
import dataclasses
import functools
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from benchmarks import peers
from benchmarks.dqn import Task
from benchmarks.measure import Options, Row
from jaxsense import PRESETS, init, learn
from jaxsense.config import DetectorConfig, DqnConfig, JmvaeConfig
from jaxsense.dqn import episodes, policies, training
from jaxsense.dqn.episodes import Start, reference
from jaxsense.dqn.policies import Known
from jaxsense.run import devices

_LONGEST = 60.0  # s that we may take
_MOST_TIMES = 20  # our time, after which a peer is stopped
_SHARE = 0.99  # of the optimal return, which counts as optimal
_CONFIG = dataclasses.replace(
    PRESETS["default"],
    detector=DetectorConfig(num_scans=24576, num_held_out=3 * 4096, steps=1500, batch=256),
    jmvae=JmvaeConfig(samples_per_class=4096, steps=2000),
    dqn=DqnConfig(
        observe="bank",
        epochs=420,  # in chunks of 20, after each of which the policy is examined
        updates=8,
        batch=256,
        replay_capacity=65536,
        epsilon_decay=0.98,
        target_period=10,
    ),
)
_QUICK = dataclasses.replace(
    PRESETS["smoke"],
    detector=DetectorConfig(num_scans=384, num_held_out=3 * 64, steps=20, batch=32),
    jmvae=JmvaeConfig(restarts=1, samples_per_class=64, steps=20, batch=32),
)


@dataclasses.dataclass(frozen=True)
class Learner:
    """One that trains, a chunk at a time, and compiles what it needs when first called.

    Attributes:
      start: `() -> state`.
      go_on: `(state) -> state` after a chunk.
      as_params: `(state) -> params` of a Q-network of ours.
    """

    start: Callable[[], Any]
    go_on: Callable[[Any], Any]
    as_params: Callable[[Any], optax.Params]


class Examiner:
    """Tells whether a Q-network is near the optimum, from whole episodes from fixed starts.

    Attributes:
      target: mean return to reach.
    """

    def __init__(self, task: Task, num_starts: int):
        """Compiles everything, and plays the optimal policy, on the task's bank."""
        mdp, exact, agent = task.mdp, task.models.bayes, task.models.agent
        reset_key, play_key = jax.random.split(jax.random.key(5))
        reset = jax.jit(jax.vmap(lambda key: episodes.reset(key, mdp, exact)))
        self._starts = reset(jax.random.split(reset_key, num_starts))
        optimal = reference(jax.random.key(0), mdp, task.models, exact.labels)

        def learned(params: optax.Params, known: Known, classes: jax.Array) -> jax.Array:
            del classes
            observed = agent.observe(known.belief, known.team, known.times, known.robot)
            return agent.values(params, observed)

        def mean_return(
            values: Callable[[Known, jax.Array], jax.Array], starts: Start
        ) -> jax.Array:
            def play(key: jax.Array, start: Start) -> jax.Array:
                def act(key: jax.Array, known: Known, memory: tuple[()]):
                    del key
                    return policies.best(values(known, start.state.classes)), memory

                return episodes.run_episode(key, mdp, exact, act, start)[0]

            return jnp.mean(jax.vmap(play)(jax.random.split(play_key, num_starts), starts))

        def learned_return(params: optax.Params, starts: Start) -> jax.Array:
            return mean_return(functools.partial(learned, params), starts)

        self.target = _SHARE * float(jax.jit(lambda x: mean_return(optimal, x))(self._starts))
        example = agent.init(jax.random.key(0))
        self._learned_return = jax.jit(learned_return).lower(example, self._starts).compile()

    def passes(self, params: optax.Params) -> bool:
        """Whether the policy of a Q-network reaches the target."""
        return float(self._learned_return(params, self._starts)) >= self.target


def time_to_optimal_rejax(options: Options) -> Row:
    """Against rejax, the best of several settings."""
    peer = peers.load("rejax", options.peers)

    def measure_peer(task: Task, examiner: Examiner, limit: float) -> tuple[float, bool]:
        def once(settings: Any) -> tuple[bool, float]:
            spent, is_stopped = _time_to(lambda: peer.learner(task, settings), examiner, limit)
            return is_stopped, spent  # one that was stopped comes after all that were not

        best = peer.FAST[0] if options.quick else min(peer.FAST, key=once)
        return _median_time(lambda: peer.learner(task, best), examiner, limit, options)

    theirs = measure_peer if peer else None
    return _row("rejax", options, theirs, "rejax DQN", ("rejax",))


def time_to_optimal_sb3(options: Options) -> Row:
    """Against Stable-Baselines3."""
    peer = peers.load("sb3", options.peers)

    def measure_peer(task: Task, examiner: Examiner, limit: float) -> tuple[float, bool]:
        return peer.time_to(task, examiner.passes, limit)

    theirs = measure_peer if peer else None
    packages = ("stable-baselines3", "torch")
    return _row("sb3", options, theirs, "Stable-Baselines3 DQN", packages)


def _row(
    against: str,
    options: Options,
    theirs: Callable[[Task, Examiner, float], tuple[float, bool]] | None,
    peer: str,
    packages: tuple[str, ...],
) -> Row:
    """Ours, and with `theirs(task, examiner, limit) -> (seconds, was stopped)` the peer's."""
    task, examiner = _trained_task(options.quick)
    longest = 0.0 if options.quick else _LONGEST
    ours, is_stopped = _median_time(lambda: _learner(task), examiner, longest, options)
    if is_stopped and not options.quick:
        raise RuntimeError(f"no policy within a hundredth of the optimum after {ours:.0f} s")
    their_time, is_bound = None, False
    if theirs is not None:
        their_time, is_bound = theirs(task, examiner, 0.0 if options.quick else _MOST_TIMES * ours)
    return Row(
        f"time_to_optimal_{against}",
        "s",
        ours,
        _compile_s(task),
        task.config.dqn.num_envs,
        peer=peer,
        theirs=their_time,
        packages=packages,
        is_bound=is_bound,
    )


@functools.cache
def _trained_task(quick: bool) -> tuple[Task, Examiner]:
    """The map MDP on detections of trained detectors, and its examination on detections apart."""
    config = _QUICK if quick else _CONFIG
    train = jax.jit(lambda key: learn(key, config, until="look_values").outputs)
    outputs = train(jax.random.key(6))
    trained = dataclasses.replace(
        init(jax.random.key(6), config),
        fusion=outputs["fusion"],
        jmvae=outputs["best_jmvae"],
        look_values=outputs["look_values"],
    )
    found = outputs["detections"]
    examiner = Examiner(Task(config, trained, found.held_out), 32 if quick else 4096)
    return Task(config, trained, found.bank), examiner


def _learner(task: Task) -> Learner:
    """Our own training, compiled as in a run: side by side."""
    settings = task.config.dqn
    learning = task.environment

    def start(key: jax.Array):
        init_key, start_key, key = jax.random.split(key, 3)
        prepared = training.starts(start_key, learning, settings)
        return key, training.init(init_key, learning, settings, prepared), prepared

    def go_on(carry):
        key, state, prepared = carry
        key, chunk_key = jax.random.split(key)
        state, _ = training.train_chunk(chunk_key, learning, settings, state, prepared)
        return key, state, prepared

    key = jax.random.key(7)
    carry = jax.eval_shape(start, key)
    lowered = jax.jit(start).lower(key), jax.jit(go_on, donate_argnums=0).lower(carry)
    with concurrent.futures.ThreadPoolExecutor(len(lowered)) as pool:
        options = devices.compiler_options()
        begin, train = pool.map(lambda program: program.compile(options), lowered)
    return Learner(start=lambda: begin(key), go_on=train, as_params=lambda carry: carry[1].params)


def _median_time(
    make: Callable[[], Learner], examiner: Examiner, limit: float, options: Options
) -> tuple[float, bool]:
    """Seconds to pass, the median of three, or of one that was stopped; and whether it was."""
    times = []
    for _ in range(1 if options.quick else 3):
        spent, is_stopped = _time_to(make, examiner, limit)
        if is_stopped:
            return spent, True
        times.append(spent)
    return statistics.median(times), False


def _time_to(make: Callable[[], Learner], examiner: Examiner, limit: float) -> tuple[float, bool]:
    """Seconds of compiling and training until the examination is passed, without examinations."""
    jax.clear_caches()
    begin = time.perf_counter()
    learner = make()
    state = learner.start()
    spent = 0.0
    while True:
        state = jax.block_until_ready(learner.go_on(state))
        spent += time.perf_counter() - begin
        if examiner.passes(learner.as_params(state)):
            return spent, False
        if spent > limit:
            return spent, True
        begin = time.perf_counter()


def _compile_s(task: Task) -> float:
    """What of our time is the first chunk's compilation and that of the start."""
    jax.clear_caches()
    begin = time.perf_counter()
    learner = _learner(task)
    state = jax.block_until_ready(learner.go_on(learner.start()))
    first = time.perf_counter() - begin
    begin = time.perf_counter()
    jax.block_until_ready(learner.go_on(state))
    return first - (time.perf_counter() - begin)
