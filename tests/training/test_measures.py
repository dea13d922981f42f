"""The figures of a latent space and of policies, on networks whose weights are set by hand."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsense
from jaxsense.config import (
    ArenaConfig,
    Config,
    DqnConfig,
    EvaluationConfig,
    FilterConfig,
    JmvaeConfig,
    MdpConfig,
)
from jaxsense.core.types import Belief, pytree
from jaxsense.dqn import map_mdp, optimum, policies
from jaxsense.dqn.optimum import LookValues
from jaxsense.models import make_in_place, make_jmvae, make_prior
from jaxsense.training import comparison, measures, perception
from jaxsense.training.mdp import held_out_mdp, models_of
from jaxsense.training.perception import Detections
from jaxsense.vae import filter

# Classes: green cylinder, red cylinder, red cube. Three latent dimensions, of which one is unused.
CONFIG = Config(
    jmvae=JmvaeConfig(latent_size=3, hidden=(4,)),
    mdp=MdpConfig(min_increase=0.0, max_steps=8),
    dqn=DqnConfig(hidden=(2,)),
    evaluation=EvaluationConfig(num_starts=16, num_repeats=8),
)
KEY = jax.random.key(0)
GREEN, CUBE = 1, 1  # where features (red, green) and (cylinder, cube) hold them
LN4, LN25, LN26 = np.log([4.0, 25.0, 26.0])


def network(inputs, outputs, weights, bias=()):
    """A hidden layer that passes on what is not negative, then outputs by their weights.

    Args:
      inputs: number of inputs.
      outputs: number of outputs.
      weights: `{(input, output): weight}`.
      bias: `{output: bias}`.
    """
    kernel = np.zeros((4, outputs), np.float32)
    for place, weight in weights.items():
        kernel[place] = weight
    biases = np.zeros(outputs, np.float32)
    for output, each in dict(bias).items():
        biases[output] = each
    hidden = {"kernel": np.eye(inputs, 4, dtype=np.float32), "bias": np.zeros(4, np.float32)}
    last = {"kernel": kernel, "bias": biases}
    return {"params": {"Dense_0": hidden, "Dense_1": last}}


PARAMS = {
    "encoders": {
        # (10 green, 10 cube, 0), of deviation 1, but 2 in two dimensions for a cube.
        "camera+lidar": network(
            4, 6, {(GREEN, 0): 10, (2 + CUBE, 1): 10, (3, 3): LN4, (3, 4): LN4}
        ),
        # Green is class 0; red lies between the classes 1 and 2, in the second dimension.
        "camera": network(2, 6, {(GREEN, 0): 10, (0, 1): 5, (0, 4): LN25}),
        # A cube is class 2; a cylinder lies between the classes 0 and 1, in the first.
        "lidar": network(2, 6, {(CUBE, 1): 10, (0, 0): 5, (0, 3): LN26, (CUBE, 4): LN4}),
    },
    "decoders": {
        "camera": network(3, 2, {(0, GREEN): 0.1}),
        # Wrong by .6: too much of a cube.
        "lidar": network(3, 2, {(1, CUBE): 0.1}, {CUBE: 0.6}),
    },
}
# Two looks at each class. The second LiDAR look at class 0 tells half a cylinder.
CAMERA = jnp.array([[[0, 1], [0, 1]], [[1, 0], [1, 0]], [[1, 0], [1, 0]]], jnp.float32)
LIDAR = jnp.array([[[1, 0], [0.5, 0]], [[1, 0], [1, 0]], [[0, 1], [0, 1]]], jnp.float32)
BANK = (CAMERA, LIDAR)
CLASS_MEANS = jnp.array([[10.0, 0, 0], [0, 0, 0], [0, 10, 0]])


def detections(bank=(), held_out=()):
    """Detections that episodes do not start from."""
    nothing: Any = ()
    return Detections(bank, held_out, nothing, nothing)


def in_place(means=CLASS_MEANS):
    return make_in_place(CONFIG, PARAMS, Belief(means, jnp.ones((3, 3))))


@jax.jit
def latent_space(fusion, bank):
    given = detections(held_out=bank)
    return measures.latent_space(jax.random.key(0), CONFIG, fusion=fusion, detections=given)


@pytest.fixture(scope="module")
def found():
    return jax.tree.map(np.asarray, latent_space(in_place(), BANK))


def test_posteriors_are_of_both_sensors_and_of_each(found):
    posteriors, _ = found
    assert list(posteriors) == ["camera", "joint", "lidar"]
    expected = {
        "joint": ([[10, 0, 0], [0, 0, 0], [0, 10, 0]], [[1, 1, 1], [1, 1, 1], [2, 2, 1]]),
        "camera": ([[10, 0, 0], [0, 5, 0], [0, 5, 0]], [[1, 1, 1], [1, 5, 1], [1, 5, 1]]),
        "lidar": ([[5, 0, 0], [5, 0, 0], [0, 10, 0]], [[26**0.5, 1, 1]] * 2 + [[1, 2, 1]]),
    }
    for name, (mean, std) in expected.items():
        np.testing.assert_allclose(posteriors[name].mean[:, 0], mean, atol=1e-5)
        np.testing.assert_allclose(posteriors[name].std[:, 0], std, rtol=1e-5)
    np.testing.assert_allclose(posteriors["lidar"].mean[0, 1], [2.5, 0, 0], atol=1e-5)
    np.testing.assert_allclose(posteriors["lidar"].std[0, 1], [26**0.25, 1, 1], rtol=1e-5)


def test_figures_of_the_latent_space_as_worked_by_hand(found):
    _, figures = found
    assert figures.active_units == 2
    norms = {
        "joint": [3**0.5, 3**0.5, 3],  # 1 + 1 + 1; 4 + 4 + 1
        "camera": [3**0.5, 27**0.5, 27**0.5],  # 1 + 25 + 1
        # 26 + 1 + 1, and sqrt(26) + 1 + 1 at the second look; 1 + 4 + 1.
        "lidar": [(28**0.5 + (26**0.5 + 2) ** 0.5) / 2, 28**0.5, 6**0.5],
    }
    for name, expected in norms.items():
        np.testing.assert_allclose(figures.sigma_norm[name], expected, rtol=1e-5)
    # At most 2 deviations away. At the second look at class 0, (2.5, 0) is 7.5 / 2.26 deviations
    # from class 0 and 2.5 / 2.26 from class 1, the only one that it leaves open.
    shares = {"joint": [1, 1, 1], "camera": [1, 0, 0], "lidar": [0, 0, 1]}
    for name, expected in shares.items():
        np.testing.assert_array_equal(figures.unambiguous[name], expected)


def test_what_a_look_leaves_open_is_as_worked_by_hand(found):
    # Red leaves the classes 1 and 2 open, each 5 / 5 deviations off, a cylinder 0 and 1, each
    # 5 / sqrt(26); only the second look at class 0 leaves too few.
    shares = {"joint": [1, 1, 1], "camera": [1, 1, 1], "lidar": [0.5, 1, 1]}
    for name, expected in shares.items():
        np.testing.assert_array_equal(found[1].consistent[name], expected)


def test_classes_are_told_apart_by_the_means_that_are_given():
    # Class 1 where class 2 was, which lies far away: looks at class 2 leave class 1 open, and those
    # at class 1 also class 0, which is as far away as that.
    moved = jnp.array([[10.0, 0, 0], [0, 10, 0], [0, 100, 0]])
    _, figures = latent_space(in_place(moved), BANK)
    for name in ("joint", "lidar"):
        assert figures.unambiguous[name][2] == 0
    np.testing.assert_array_equal(figures.unambiguous["joint"], [1, 0, 0])


def test_beliefs_of_classes_are_means_over_the_bank_that_is_given():
    @jax.jit
    def beliefs(bank):
        given = detections(bank)
        return perception.class_beliefs(KEY, CONFIG, params=PARAMS, detections=given)

    found = beliefs(BANK)
    np.testing.assert_allclose(found.mean, CLASS_MEANS, atol=1e-5)
    np.testing.assert_allclose(found.std, [[1, 1, 1], [1, 1, 1], [2, 2, 1]], rtol=1e-5)
    # One of two looks at class 1 is green, and one at class 2 a cylinder: (10 + 0) / 2 each, and
    # deviations of (1 + 2) / 2.
    other = CAMERA.at[1, 1].set(jnp.array([0.0, 1.0])), LIDAR.at[2, 1].set(jnp.array([1.0, 0.0]))
    found = beliefs(other)
    np.testing.assert_allclose(found.mean, [[10, 0, 0], [5, 0, 0], [0, 5, 0]], atol=1e-5)
    np.testing.assert_allclose(found.std, [[1, 1, 1], [1, 1, 1], [1.5, 1.5, 1]], rtol=1e-5)


def test_moment_matching_as_worked_by_hand(found):
    # Mean over three dimensions, then looks, classes and sensors.
    # Camera, green: itself. Red: classes 1 and 2, mean 5, variances (1 + 4) / 2 = 2.5 and 2.5 + 25.
    red = (np.log(2.5) / 2 + np.log(27.5 / 25) / 2) / 3
    # LiDAR, cylinder: classes 0 and 1, mean 5, variances 1 + 25 and 1. A cube: class 2, of 4 and 4.
    cube = np.log(2) / 3
    # The second look at class 0: 2.5 / sqrt(26) off, and ln(26) / 4 too narrow.
    half = (2.5 / 26**0.5 + LN26 / 4) / 3
    camera, lidar = [0, red, red], [half / 2, 0, cube]
    error = found[1].moment_matching_error
    np.testing.assert_allclose(error, np.mean([*camera, *lidar]), rtol=1e-4)


def test_fusion_as_worked_by_hand(found):
    # The LiDAR's look after the camera's is exact. The camera's after the LiDAR's is encoded with a
    # cube of .6 more, and so lies 6 further along the second dimension: class 1 at (0, 6) is nearer
    # to class 2 at (0, 10), class 2 lies 6 / 2 deviations off.
    np.testing.assert_allclose(found[1].fusion["accuracy"], 5 / 6, rtol=1e-6)
    np.testing.assert_allclose(found[1].fusion["mean_error"], (6 + 6 + 3) / 6, rtol=1e-4)
    # A cube of .6 more also widens two of three dimensions, by 4^(.6 / 2), after one of two orders.
    widening = 0.6 * np.log(2.0) * 2 / 3
    np.testing.assert_allclose(found[1].fusion["std_error"], widening / 2, rtol=1e-4)


@pytest.mark.parametrize("modality", [0, 1])
def test_one_detection_that_is_not_a_number_shows_in_the_beliefs(modality):
    bank = tuple(x.at[2, 1, 0].set(jnp.nan) if m == modality else x for m, x in enumerate(BANK))
    posteriors, figures = latent_space(in_place(), bank)
    for name in ("joint", CONFIG.modalities[modality]):
        is_finite = np.isfinite(posteriors[name].std).all(axis=-1)
        np.testing.assert_array_equal(is_finite, [[True, True], [True, True], [True, False]])
        assert np.isnan(figures.sigma_norm[name][2])


# One look at each class, so that nothing is left to chance but the starts.
EXACT = tuple(x[:, :1] for x in BANK)
NUM_STATES = 1728  # 3^3 x 2^6


def with_bias(bias):
    """A Q-network whose values are the same for every map."""
    layers = {
        "Dense_0": {"kernel": jnp.zeros((2 * 3 * 3, 2)), "bias": jnp.zeros(2)},
        "Dense_1": {"kernel": jnp.zeros((2, 4)), "bias": bias},
    }
    return {"params": layers}


def constant(gain, total):
    """The same values of looks at every posterior."""
    points = len(optimum.lattice(3))
    tables = jnp.full(points, gain), jnp.full(points, total)
    return LookValues(*tables, jnp.float32(gain), jnp.float32(total))


def models_with(bias, values, fusion=None):
    """What policies read, with a Q-network of the same values for every map."""
    return models_of(
        CONFIG, in_place() if fusion is None else fusion, values, (with_bias(bias),) * 2
    )


@jax.jit
def play(modality, models, bank):
    mdp = held_out_mdp(CONFIG, models.fusion, detections(held_out=bank))
    return comparison.compare_policies(KEY, modality, models, mdp, CONFIG)


# Every look of the camera pays until it has looked, by `optimal`.
PAYS = constant(1.0, 1.0)


@pytest.mark.slow
def test_policies_are_played_from_every_state_and_from_random_starts():
    # Where a look replaces the one before, the values of looks do not matter.
    models = models_with(jnp.array([0.0, 0.0, 0.0, 1.0]), (PAYS, PAYS))
    found = jax.tree.map(np.asarray, play(jnp.int32(0), models, EXACT))
    of = {name: total for name, (total, _) in found.items()}
    assert {x.shape for pair in found.values() for x in pair} == {(NUM_STATES + 16,)}
    assert set(of) == {"latent", "optimal", "greedy", "naive", "random"}
    np.testing.assert_array_equal(of["latent"], 0.0)  # always NOP
    # The means over all states; a policy is at best as good.
    optimal, naive, uniform = (
        of[name][:NUM_STATES].mean() for name in ("optimal", "naive", "random")
    )
    assert optimal > naive > uniform
    # Naive exploration goes on where the camera has not seen all: bits 0, 2 and 4 of the number of
    # a state.
    goes_on = np.arange(NUM_STATES) % 64 & 0b010101 != 0b010101
    of_naive = found["naive"][1][:NUM_STATES]
    np.testing.assert_array_equal(of_naive != 0, goes_on)
    # The camera's own looks alone: no state pays more than three of the best, from a variance of
    # 20 in three dimensions to sqrt(3).
    most = 3 * (1 / 3**0.5 - 1 / 60**0.5)
    assert max(total.max() for total in of.values()) <= most + 1e-4


def test_values_that_are_not_numbers_give_totals_that_are_none():
    models = models_with(jnp.array([0.0, jnp.nan, 0.0, 1.0]), (PAYS, PAYS))
    found = jax.tree.map(np.asarray, play(jnp.int32(0), models, EXACT))
    assert all(np.isnan(x).all() for x in found.pop("latent"))
    assert all(np.isfinite(x).all() for pair in found.values() for x in pair)


@pytest.mark.slow
def test_where_looks_add_up_the_optimum_is_by_the_total_of_the_own_sensors_looks():
    model, prior, classes = make_jmvae(CONFIG), make_prior(CONFIG), in_place().classes
    fusion = filter.init(KEY, model, classes, prior, FilterConfig(hidden=(1,)))
    # No look of the camera pays by its total, and every look of the LiDAR does.
    models = models_with(jnp.zeros(4), (constant(1.0, -1.0), constant(-1.0, 1.0)), fusion)
    total, _ = play(jnp.int32(0), models, EXACT)["optimal"]
    np.testing.assert_array_equal(total, 0.0)
    _, first = play(jnp.int32(1), models, EXACT)["optimal"]
    assert np.all(first != 0)


@pytest.fixture(scope="module")
def same_policy():
    """Totals and first rewards of four times the same policy, by the number of repeats."""
    # Looks at a class are all different: what differs is their noise.
    always = policies.Policy(lambda key, models, known: jnp.array([1.0, 0.0, 0.0, 0.0]))
    bank = tuple(
        jax.nn.softmax(3 * jax.random.normal(k, (3, 64, 2)))
        for k in jax.random.split(jax.random.key(3))
    )
    models = models_with(jnp.zeros(4), (PAYS, PAYS))

    @jax.jit
    def compared(models, config):
        mdp = held_out_mdp(config, models.fusion, detections(held_out=bank))
        return comparison.compare_policies(
            KEY, jnp.int32(0), models, mdp, config, {"mine": lambda *_: always.values(*[0] * 3)}
        )

    def found(repeats):
        settings = EvaluationConfig(num_starts=4, num_repeats=repeats, num_states=8)
        return compared(models, replace(CONFIG, evaluation=settings))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(policies, "POLICIES", dict.fromkeys(comparison.COMPARED, always))
        patch.setattr(
            comparison, "reference", lambda *_: lambda known, classes: always.values(*[0] * 3)
        )
        names = *comparison.COMPARED, "mine"
        of_repeats = {n: found(n) for n in (1, 2, 9)}
        return {n: np.array([by_name[name] for name in names]) for n, by_name in of_repeats.items()}


def test_policies_are_compared_on_the_same_starts_and_the_same_looks(same_policy):
    found = same_policy[1]
    assert found.shape == (6, 2, 12)  # with one of our own
    assert len(np.unique(found[0, 0])) > 6  # of 12; without a gain a look is worth -1
    np.testing.assert_array_equal(found, found[[0] * 6])


def test_naive_and_random_policies_are_played_an_eighth_as_often(same_policy):
    # An eighth of nine, rounded up, is two.
    often, seldom = same_policy[9][0], same_policy[2][0]
    assert np.any(often != seldom)
    np.testing.assert_array_equal(same_policy[9], [often, often, *[seldom] * 4])


def test_the_learned_return_is_the_mean_over_random_starts():
    @jax.jit
    def returned(bias):
        mdp = held_out_mdp(CONFIG, in_place(), detections(held_out=EXACT))
        return comparison.learned_return(KEY, jnp.int32(0), with_bias(bias), mdp, CONFIG)

    assert returned(jnp.array([0.0, 0.0, 0.0, 1.0])) == 0.0
    # Eight looks at PoI 0, of which all but the first are in vain, and that one in some starts: it
    # pays at most what a class that is known for certain is worth.
    total = returned(jnp.array([1.0, 0.0, 0.0, 0.0]))
    assert -8 < total < -7 + 1 / 3**0.5
    assert np.isnan(returned(jnp.array([jnp.nan, 0.0, 0.0, 1.0])))


def test_other_numbers_of_pois_are_played_an_eighth_as_often_but_always_once(monkeypatch):
    played = []

    def play(key, config, *, num_pois, **inputs):
        assert inputs == {"modality": 0}
        played.append((num_pois, config.evaluation.num_repeats, config.evaluation.num_states))

    monkeypatch.setattr(comparison, "play_policies", play)
    team = jaxsense.PRESETS["team"]
    for repeats in (1, 96):
        settings = replace(team.evaluation, num_repeats=repeats, num_pois=(5, 20))
        comparison.play_numbers(KEY, replace(team, evaluation=settings), modality=0)
    assert played == [(5, 1, 1), (20, 1, 1), (5, 12, 1), (20, 12, 1)]


@pytest.mark.parametrize("num_pois", [None, 2, 5])
def test_policies_are_played_with_the_number_of_pois_that_is_asked_for(num_pois):
    mdp = held_out_mdp(CONFIG, in_place(), detections((), EXACT), num_pois)
    assert mdp.num_pois == (num_pois or 3)
    assert jax.eval_shape(map_mdp.reset, KEY, mdp).belief.mean.shape == (num_pois or 3, 3)
    np.testing.assert_array_equal(mdp.looks.features[1], EXACT[1])


@jax.jit
def beliefs(config, fusion):
    return measures.beliefs(KEY, config, fusion=fusion, detections=detections(held_out=EXACT))


@pytree
class Witness:
    """A fusion whose belief says which modalities had looked before."""

    classes: Belief
    prior: Belief

    def update(self, belief, seen, features, modality):
        del features, modality
        return replace(belief, mean=jnp.where(seen, 1.0, 0.0))

    def class_probabilities(self, belief):
        first = jnp.array([1 / 3, 1 / 2, 4 / 5])[jnp.sum(belief.mean).astype(int)]
        return jnp.array([first, (1 - first) / 2, (1 - first) / 2])


def test_histories_tell_fusion_which_modalities_have_looked_before():
    config = replace(CONFIG, evaluation=replace(CONFIG.evaluation, num_histories=600))
    fusion = Witness(Belief(jnp.zeros((3, 2)), jnp.ones((3, 2))), Belief(jnp.zeros(2), jnp.ones(2)))
    found = beliefs(config, fusion)
    # Each class is the true one of a third of the histories. Before the first look nobody has
    # looked, before the second one sensor; before the sixth two, unless all five were the same.
    none, one, two = (-(np.log(p) + 2 * np.log((1 - p) / 2)) / 3 for p in (1 / 3, 1 / 2, 4 / 5))
    np.testing.assert_allclose(found["nll"][:2], [none, one], rtol=1e-5)
    share = 2**-4
    error = 4 * np.sqrt(share * (1 - share) / 600) * (two - one)
    np.testing.assert_allclose(found["nll"][5], share * one + (1 - share) * two, atol=error)
    np.testing.assert_array_equal(found["looks"], [1, 2, 3, 4, 5, 6])
    np.testing.assert_allclose(found["accuracy"], 1 / 3, rtol=1e-6)


def test_exact_bayes_reads_the_same_looks():
    # The camera tells green from red, the LiDAR cubes from cylinders. Two of three classes are left
    # where all looks were by one sensor that cannot tell: by the LiDAR at class 0, the camera at
    # class 2, and either at class 1.
    config = replace(CONFIG, evaluation=replace(CONFIG.evaluation, num_histories=600))
    found = beliefs(config, in_place())
    share = 4 / 3 * 0.5 ** np.arange(1, 7)
    error = 4 * np.sqrt(share * (1 - share) / 600) * np.log(2)
    assert np.all(np.abs(found["bayes_nll"] - share * np.log(2)) < error)
    assert np.all(np.diff(found["bayes_nll"]) <= 1e-6)


# Two PoIs of two classes and one sensor: 2^2 x 2^2 states, of which half hold both classes.
SMALL = Config(
    modalities=("camera",),
    arena=ArenaConfig(num_pois=2, classes=("green cylinder", "red cylinder")),
    jmvae=JmvaeConfig(reconstruction_weights=(1.0,)),
    evaluation=EvaluationConfig(num_starts=3),
)
