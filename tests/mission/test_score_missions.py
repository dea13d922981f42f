"""Scores of custom policies in missions."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from teams import CONFIG

import jaxsense
from jaxsense.run import score


def last_first(key, models, known):
    """Looks at the last PoI first."""
    return jnp.append(jnp.arange(1.0, len(known.looks) + 1), 0.0)


def measured(right, looks, time):
    """Metrics of four missions with two PoIs, as `measure` has them."""
    one = np.ones(4)
    return {
        "is_right": np.array(right, bool),
        "observations_per_poi": np.array(looks),
        "time_s": np.array(time),
        "seen": np.ones((4, 2), bool),
        "confidence": np.ones((4, 2)),
        "nll": np.zeros((4, 2)),
        "collisions": 0 * one,
        "goals": one,
        "goals_reached": one,
        "information": one,
        "reason": one.astype(int),
    }


FOUND = {
    "mine": measured([[1, 1], [1, 0], [1, 1], [1, 0]], [2.0, 2.0, 3.0, 3.0], [11, 13, 15, 21]),
    "naive": measured(np.ones((4, 2)), [2.0] * 4, [10, 11, 14, 17]),
}


@pytest.fixture
def play(team, models, monkeypatch):
    """Scores policies with a fake player, which keeps what it was asked to play."""
    asked = {}

    class Player:
        def __init__(self, team, compiler, total, workers, models):
            asked["team"] = team

        def play(self, key, models, played, episodes):
            asked["played"] = {name: case.policy for name, case in played.items()}
            return SimpleNamespace(metrics={name: FOUND[name] for name in played})

    monkeypatch.setattr(score.missions, "Player", Player)

    def run(policies, **options):
        return jaxsense.score_missions(CONFIG, models, policies, **options), asked

    return run


def test_differences_are_of_the_same_arenas(play):
    found, asked = play({"mine": last_first}, against=["naive"], episodes=4)
    assert asked["played"] == {"mine": "mine", "naive": "naive"}
    assert [*asked["team"].policies] == ["naive", "mine"]
    mine = found.policies["mine"]
    # 6 of 8 PoIs; (2 + 2 + 3 + 3) / 4 looks; (11 + 13 + 15 + 21) / 4 s.
    assert (mine["accuracy"], mine["observations_per_poi"], mine["mean_time_s"]) == (0.75, 2.5, 15)
    # Differences 1, 2, 1 and 4 s: mean 2, deviation sqrt(2), and t = 3.182 with 3 degrees.
    assert mine["intervals"]["time_s"]["mean"] == 2
    assert mine["intervals"]["time_s"]["high"] == pytest.approx(2 + 3.182 * 2**0.5 / 2, abs=1e-3)
    assert "intervals" not in found.policies["naive"]
    assert str(found).splitlines() == [
        "4 missions of each policy; differences from naive",
        "       right  looks per PoI  mean time [s]  mean time, difference [s]",
        "mine   0.750           2.50           15.0          2.0 (-0.3\u00a0to\u00a04.3)",
        "naive  1.000           2.00           13.0                          -",
    ]


@pytest.mark.parametrize("values", [jnp.zeros(3), jnp.zeros(4, int), 0.0])
def test_a_policy_without_a_value_for_each_action_is_named(values):
    checked = score._checked("mine", lambda key, models, known: values)
    with pytest.raises(
        ValueError, match=r"^policies\['mine'\] = <lambda>: must return floats of shape \[4\]"
    ):
        checked(None, None, SimpleNamespace(looks=np.zeros((3, 2))))


def test_missions_that_the_network_did_not_learn_for_are_told(play, monkeypatch):
    monkeypatch.setattr(score, "beyond_training", lambda config: ["9 PoIs: too many"])
    monkeypatch.setitem(FOUND, "latent", FOUND["naive"])
    with pytest.warns(UserWarning, match="^9 PoIs: too many$") as told:
        play({}, against=["latent"], episodes=4)
    play({}, against=["naive"], episodes=4)
    assert [each.filename for each in told] == [__file__]
