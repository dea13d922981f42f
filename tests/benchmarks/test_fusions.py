"""The ways of fusing that only the benchmark knows, its table, and all of it at tiny size."""

import json
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.fusions import __main__, kinds, study, table
from jaxsense import Bank, vae
from jaxsense.config import MdpConfig
from jaxsense.core.types import Belief
from jaxsense.dqn import map_mdp
from jaxsense.vae import fusion, jmvae, readout
from jaxsense.vae.bayes import Bayes
from jaxsense.vae.jmvae import Jmvae

# Red or green, cylinder or cube: classes are green cylinder, red cylinder, red cube.
MODEL = Jmvae(("camera", "lidar"), (2, 2), 2, (4,))
BAYES = Bayes(jnp.array([[1, 0, 0], [0, 0, 1]]))
CLASSES = Belief(jnp.array([[1.2, 0.9], [-0.8, 0.9], [-0.8, -1.3]]), jnp.full((3, 2), 0.4))
NOBODY = np.zeros(2, bool)
GREEN, CUBE = (0, jnp.array([0.2, 0.8])), (1, jnp.array([0.4, 0.6]))
"""Two looks: modality and features."""


def experts(of=vae.InPlace):
    params = jmvae.init(jax.random.key(0), MODEL)
    return of(params, CLASSES, fusion.prior(MODEL, 20.0), readout.make(CLASSES), MODEL)


def after(found, *looks):
    belief = found.prior
    for modality, features in looks:
        belief = found.update(belief, NOBODY, features, modality)
    return belief


def alone(look):
    modality, features = look
    return experts().together({modality: features})


def test_log_odds_by_hand():
    found = kinds.LogOdds(BAYES)
    chex.assert_trees_all_close(found.class_probabilities(found.prior), jnp.full(3, 1 / 3))
    # A green look: .8 / (1/3) against .2 / (2/3), a ratio of 8, for both red classes.
    belief = after(found, GREEN)
    np.testing.assert_allclose(belief.mean, [math.log(8), 0.0], atol=1e-6)
    np.testing.assert_allclose(found.class_probabilities(belief), [0.8, 0.1, 0.1], rtol=1e-5)
    # A cube: .6 / (1/3) against .4 / (2/3), a ratio of 3: weights 8, 1 and 3.
    belief = after(found, GREEN, CUBE)
    np.testing.assert_allclose(belief.mean, [math.log(8 / 3), math.log(1 / 3)], atol=1e-6)
    np.testing.assert_allclose(
        found.class_probabilities(belief), [8 / 12, 1 / 12, 3 / 12], rtol=1e-5
    )
    assert found.most_likely_class(belief) == 0
    chex.assert_trees_all_close(found.together(dict([GREEN, CUBE])), belief)


def test_known_classes_are_read_from_log_odds():
    found = kinds.LogOdds(BAYES)
    read = jax.vmap(found.class_probabilities)(found.classes)
    np.testing.assert_allclose(read, np.eye(3), atol=1e-5)


def test_probabilities_from_log_odds_are_positive():
    found = kinds.LogOdds(BAYES)
    read = found.class_probabilities(Belief(jnp.array([300.0, 0.0]), jnp.ones(2)))
    np.testing.assert_allclose(read, [1.0, 1e-6, 1e-6], rtol=1e-5)


@pytest.mark.parametrize("looks", [(GREEN,), (GREEN, CUBE), (GREEN, CUBE, GREEN)])
def test_a_mixture_has_the_moments_of_all_looks(looks):
    found = kinds.Mixture(experts())
    belief = after(found, *looks)
    parts = [alone(look) for look in looks]
    mean, std = vae.moment_match(
        jnp.stack([x.mean for x in parts]), jnp.stack([x.std for x in parts])
    )
    np.testing.assert_allclose(belief.mean, [*mean, len(looks)], rtol=1e-5)
    np.testing.assert_allclose(belief.std, [*std, 1.0], rtol=1e-5)
    expected = experts().class_probabilities(Belief(mean, std))
    np.testing.assert_allclose(found.class_probabilities(belief), expected, rtol=1e-4)


def test_a_mixture_knows_its_classes_and_prior():
    found = kinds.Mixture(experts())
    np.testing.assert_allclose(found.class_probabilities(found.prior), np.full(3, 1 / 3))
    shown = jax.vmap(found.most_likely_class)(found.classes)
    np.testing.assert_array_equal(shown, np.arange(3))


def test_a_product_adds_precisions_and_counts_the_prior_once():
    found = experts(kinds.Product)
    chex.assert_trees_all_close(after(found, GREEN), alone(GREEN), rtol=1e-4)
    both, parts = after(found, GREEN, CUBE), [alone(GREEN), alone(CUBE)]
    precision = sum(x.std**-2 for x in parts) - 1 / 20
    np.testing.assert_allclose(both.std**-2, precision, rtol=1e-4)
    mean = sum(x.mean * x.std**-2 for x in parts) / precision
    np.testing.assert_allclose(both.mean, mean, rtol=1e-3)


def test_an_audited_map_holds_what_it_reads_and_the_exact_posterior():
    inner = kinds.Mixture(experts())
    found = kinds.Audited(inner, BAYES)
    belief = after(found, GREEN, CUBE)
    chex.assert_trees_all_close(
        found.class_probabilities(belief),
        inner.class_probabilities(after(inner, GREEN, CUBE)),
        rtol=1e-4,
    )
    weights = np.array([8, 1, 3]) / 12
    np.testing.assert_allclose(jnp.exp(found.log_posterior(belief)), weights, rtol=1e-5)
    information = kinds.ExactNats(0.1).information(belief, found.class_probabilities(belief))
    np.testing.assert_allclose(information, np.sum(weights * np.log(weights)), rtol=1e-5)


@pytest.mark.slow
def test_rewards_are_nats_of_the_exact_posterior_whatever_the_map_says():
    bank = tuple(jnp.tile(features, (3, 1, 1)) for _, features in (GREEN, CUBE))
    config = MdpConfig(reward="nats", look_cost=0.1)
    found = kinds.Audited(experts(kinds.Product), BAYES)
    mdp = map_mdp.MapMdp(Bank(bank), found, kinds.ExactNats(0.1), config, 1)
    state = map_mdp.reset(jax.random.key(0), mdp, seen=jnp.zeros((1, 2), bool))
    total = 0.0
    for modality in (0, 1):
        state, outcome = map_mdp.step(jax.random.key(1), mdp, state, jnp.int32(0), modality)
        total += float(outcome.reward)
    weights = np.array([8, 1, 3]) / 12
    entropy = -np.sum(weights * np.log(weights))
    assert total == pytest.approx(math.log(3) - entropy - 0.2, abs=1e-4)


def test_the_network_reads_class_probabilities():
    found = kinds.LogOdds(BAYES)
    agent = kinds.ProbabilityAgent(0.5, 2, 2, (8,), found)
    beliefs = jax.tree.map(lambda *x: jnp.stack(x), found.prior, after(found, GREEN))
    observed = agent.observe(beliefs, None, jnp.int32(0))
    np.testing.assert_allclose(observed, [1 / 3, 1 / 3, 1 / 3, 0.8, 0.1, 0.1], rtol=1e-5)
    assert agent.values(agent.init(jax.random.key(0)), observed).shape == (3,)


FOUND = {
    100: {"a": {"nll 1": 0.3, "looks": 2.0}, "filter": {"nll 1": 0.1, "looks": 1.0}},
    101: {"a": {"nll 1": 0.7, "looks": 2.5}, "filter": {"nll 1": 0.3, "looks": 1.0}},
}


def test_differences_are_paired_by_seed():
    found = table.summarise(FOUND, {"a": 8, "filter": 16})["a"]
    assert found["bytes"] == 8
    assert found["mean"]["nll 1"]["mean"] == pytest.approx(0.5)
    # Differences of .2 and .4: mean .3, standard error .1, and t = 12.706 for 1 degree of freedom.
    less = found["less_filter"]["nll 1"]
    assert less["mean"] == pytest.approx(0.3)
    assert less["high"] == pytest.approx(0.3 + 1.2706, abs=1e-4)


def test_the_table_shows_means_and_differences_from_the_filter():
    lines = table.as_markdown(table.summarise(FOUND, {"a": 8, "filter": 16})).splitlines()
    assert lines == [
        "|  | a | filter |",
        "| --- | --- | --- |",
        "| bytes | 8 | 16 |",
        "| nll 1 | 0.500, +0.300 ± 1.271 | 0.200 |",
        "| looks | 2.25, +1.25 ± 3.18 | 1.00 |",
    ]


def test_one_seed_has_no_intervals():
    text = table.as_markdown(table.summarise({100: FOUND[100]}, {"a": 8, "filter": 16}))
    assert "| nll 1 | 0.300, +0.200 | 0.100 |" in text


def test_bytes_of_beliefs():
    assert study.sizes(study.settings("noisy")) == {
        "class log-odds": 8,
        "in place": 16,
        "filter": 16,
        "product of experts": 16,
        "mixture of experts": 20,
    }


@pytest.mark.parametrize(("text", "seeds"), [("100-109", range(100, 110)), ("7", range(7, 8))])
def test_seeds(text, seeds):
    assert __main__.Arguments(seeds=text).range == seeds


@pytest.mark.parametrize("text", ["", "9-1", "1-", "x", "1-2-3", "-1"])
def test_wrong_seeds_are_one_line(text, capsys):
    with pytest.raises(SystemExit) as stop:
        __main__.main([f"--seeds={text}"])
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "must be as 100-109, or one seed" in message


def test_an_existing_file_is_not_overwritten(tmp_path, capsys):
    path = tmp_path / "out.json"
    path.write_text("precious")
    with pytest.raises(SystemExit):
        __main__.main(["--json", str(path)])
    assert path.read_text() == "precious"
    assert "already exists; must be new" in capsys.readouterr().err


@pytest.mark.slow  # compiles trainings and missions of five fusions
def test_the_whole_benchmark_at_tiny_size(tmp_path, capsys):
    path = tmp_path / "out.json"
    __main__.main(f"--preset smoke --seeds 0-1 --missions 2 --json {path}".split())
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"|  | {' | '.join(study.KINDS)} |"
    figures = {
        *(f"nll {k}" for k in range(1, 7)),
        *("return camera", "return lidar", "accuracy", "looks", "seconds", "late"),
    }
    found = json.loads(path.read_text())
    assert set(found["seeds"]) == {"0", "1"}
    assert set(found["optimal"]) == {"return camera", "return lidar"}
    for of_fusion in found["fusions"].values():
        assert set(of_fusion["mean"]) == figures
        for interval in of_fusion["mean"].values():
            assert all(map(math.isfinite, interval.values()))
    # Exact Bayes and the filter that learned it agree better than a mixture that never adds up.
    nll = {name: x["mean"]["nll 6"]["mean"] for name, x in found["fusions"].items()}
    assert nll["class log-odds"] < nll["mixture of experts"]
