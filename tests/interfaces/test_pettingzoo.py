"""PettingZoo: its own tests, turns and both forms; `test_parity` has the steps."""

import warnings

import numpy as np
import pytest
import small

pytest.importorskip("pettingzoo", reason="needs the extra jaxsense[pettingzoo]")

from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test

from jaxsense.interfaces.pettingzoo import TeamAECEnv, TeamParallelEnv, make, make_parallel

AGENTS, NOP = [*small.AGENTS], small.TEAM_NOP
OWN = (
    lambda: TeamAECEnv(small.team(), small.TEAM),
    lambda: TeamParallelEnv(small.team(), small.TEAM),
)
TASK = lambda: make("team-v0"), lambda: make_parallel("team-v0")


@pytest.mark.slow
@pytest.mark.parametrize("both", [TASK, pytest.param(OWN, marks=pytest.mark.slow)])
def test_pettingzoos_own_tests_pass(both):
    turns, together = both
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        # A mean of one's own MDP has no bounds, and the only LiDAR no number.
        for known in ("Agent's .* observation space", "We recommend agents"):
            warnings.filterwarnings("ignore", known)
        api_test(turns(), num_cycles=40)
        seed_test(turns, num_cycles=40)
        parallel_api_test(together(), num_cycles=40)
        parallel_seed_test(together, num_cycles=40)


def test_turns_are_the_steps_of_the_parallel_environment():
    turns, together = (each() for each in OWN)
    turns.reset(seed=0)
    observations, infos = together.reset(seed=0)
    assert turns.agents == together.agents == AGENTS
    totals, earned, left = dict.fromkeys(AGENTS, 0.0), dict.fromkeys(AGENTS, 0.0), {}
    rng = np.random.default_rng(0)
    for agent in turns.agent_iter():
        seen, reward, terminated, truncated, info = turns.last()
        earned[agent] += reward
        if terminated or truncated:
            turns.step(None)
            assert agent not in turns.agents
            left[agent] = seen
            continue
        np.testing.assert_array_equal(seen, observations[agent])
        assert info["seconds"] == infos[agent]["seconds"]
        np.testing.assert_array_equal(info["action_mask"], infos[agent]["action_mask"])
        assert info["action_mask"].dtype == np.int8
        for other in set(together.agents) - {agent}:
            assert infos[other]["action_mask"].tolist() == [0] * NOP + [1]
        action = int(rng.choice(np.flatnonzero(info["action_mask"])))
        turns.step(action)
        for name, last in left.items():  # wrappers ask robots that have left, too
            np.testing.assert_array_equal(turns.observe(name), last)
        # Not all have to act.
        observations, rewards, *_, infos = together.step({agent: action})
        assert {type(x) for x in rewards.values()} == {float}
        assert turns.rewards == rewards
        totals = {name: total + rewards.get(name, 0.0) for name, total in totals.items()}
    assert turns.agents == together.agents == []
    # Whoever is asked gets all that it has earned since its last turn.
    assert earned == pytest.approx(totals)


def test_seeds_repeat_and_differ():
    env = OWN[1]()

    def play(env, **reset):
        seen = [env.reset(**reset)[0]["lidar"]]
        for _ in range(4):
            seen.append(env.step(dict.fromkeys(env.agents, 0))[0]["lidar"])
        return np.stack(seen)

    first, again, other, later = (play(env, seed=s) for s in (1, 1, 2, None))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert (other[0] != later[0]).any()
    # Without any seed, two environments differ; what they give is the caller's to change.
    fresh = OWN[1]().reset()[0]["lidar"]
    assert (fresh != later[0]).any()
    fresh += 1.0
