"""Time from nothing compiled to a policy within a hundredth of the optimal return."""

import concurrent.futures
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax

from benchmarks import measure, peers
from benchmarks.maps import MODALITY, Examiner, Learner, Task
from benchmarks.measure import Options, Row
from benchmarks.trained import trained_task
from jaxsense.dqn import training
from jaxsense.run import devices

_LONGEST = 60.0  # s that we may take
_MOST_TIMES = 20  # our time, after which a peer is stopped


def time_to_optimal_rejax(options: Options) -> Row:
    """Against rejax, the best of several settings."""
    peer = peers.load("rejax", options)

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
    peer = peers.load("sb3", options)

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
    task, examiner = trained_task(options.quick)
    longest = 0.0 if options.quick else _LONGEST
    ours, is_stopped = _median_time(lambda: _learner(task), examiner, longest, options)
    if is_stopped and not options.quick:
        raise RuntimeError(f"no policy within a hundredth of the optimum after {ours:.0f} s")
    limit = 0.0 if options.quick else _MOST_TIMES * ours
    their_time, is_bound = theirs(task, examiner, limit) if theirs else (None, False)
    return measure.make_row(
        f"time_to_optimal_{against}",
        "s",
        ours,
        theirs=their_time,
        peer=peer,
        packages=packages,
        compile_s=_compile_s(task),
        batch=task.config.dqn.num_envs,
        is_bound=is_bound,
    )


def _learner(task: Task) -> Learner:
    """Our own training, compiled as in a run: side by side."""
    settings = task.config.dqn
    learning = task.models.agent.environment(task.mdp, MODALITY)

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
