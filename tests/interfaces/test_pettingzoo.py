"""PettingZoo: its own tests, turns and both forms; `test_parity` has the steps."""

import warnings

import numpy as np
import pytest
import small

pytest.importorskip("pettingzoo", reason="needs the extra jaxsense[pettingzoo]")

from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test
from pettingzoo.utils import turn_based_aec_to_parallel as parallel

from jaxsense.interfaces.pettingzoo import TeamAECEnv, make

AGENTS, NOP = [*small.AGENTS], small.TEAM_NOP


def own():
    return TeamAECEnv(small.team(), small.TEAM)


@pytest.mark.slow
@pytest.mark.parametrize("turns", [own, lambda: make("team-v0")])
def test_pettingzoos_own_tests_pass(turns):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        # A mean of one's own MDP has no bounds, and the only LiDAR no number.
        for known in ("Agent's .* observation space", "We recommend agents"):
            warnings.filterwarnings("ignore", known)
        api_test(turns(), num_cycles=40)
        seed_test(turns, num_cycles=40)
        parallel_api_test(parallel(turns()), num_cycles=40)
        parallel_seed_test(lambda: parallel(turns()), num_cycles=40)


def test_robots_take_turns_and_leave():
    env = own()
    env.reset(seed=0)
    totals, earned, left = dict.fromkeys(AGENTS, 0.0), dict.fromkeys(AGENTS, 0.0), {}
    rng = np.random.default_rng(0)
    for agent in env.agent_iter():
        seen, reward, terminated, truncated, info = env.last()
        earned[agent] += reward
        if terminated or truncated:
            env.step(None)
            assert agent not in env.agents
            left[agent] = seen
            continue
        assert info["action_mask"].dtype == np.int8
        for other in set(env.agents) - {agent}:
            assert env.infos[other]["action_mask"].tolist() == [0] * NOP + [1]
        env.step(int(rng.choice(np.flatnonzero(info["action_mask"]))))
        for name, last in left.items():  # wrappers ask robots that have left, too
            np.testing.assert_array_equal(env.observe(name), last)
        assert {type(x) for x in env.rewards.values()} == {float}
        totals = {name: total + env.rewards.get(name, 0.0) for name, total in totals.items()}
    assert env.agents == []
    # Whoever is asked gets all that it has earned since its last turn.
    assert earned == pytest.approx(totals)


def test_seeds_repeat_and_differ():
    together = parallel(own())
    first, again, other, later = (together.reset(s)[0]["lidar"] for s in (1, 1, 2, None))
    np.testing.assert_array_equal(first, again)
    # Without any seed, two environments differ; what they give is the caller's to change.
    fresh = parallel(own()).reset()[0]["lidar"]
    for one, two in ((first, other), (other, later), (fresh, later)):
        assert (one != two).any()
    fresh += 1.0
