"""The best JMVAE, and figures of its latent space and beliefs, on weights that are set by hand."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from by_hand import (
    BANK,
    CAMERA,
    CLASS_MEANS,
    CONFIG,
    EXACT,
    KEY,
    LIDAR,
    PARAMS,
    detections,
    in_place,
)
from tiny import TINY, stage_of

from jaxsense.core.types import Belief, pytree
from jaxsense.training import jmvaes, measures


@jax.jit
def latent_space(fusion, bank):
    given = detections(held_out=bank)
    return measures.latent_space(jax.random.key(0), CONFIG, fusion=fusion, detections=given)


@pytest.fixture(scope="module")
def found():
    return jax.tree.map(np.asarray, latent_space(in_place(), BANK))


def test_figures_of_the_latent_space_as_worked_by_hand(found):
    _, figures = found
    assert figures["active_units"] == 2
    norms = {
        "joint": [3**0.5, 3**0.5, 3],  # 1 + 1 + 1; 4 + 4 + 1
        "camera": [3**0.5, 27**0.5, 27**0.5],  # 1 + 25 + 1
        # 26 + 1 + 1, and sqrt(26) + 1 + 1 at the second look; 1 + 4 + 1.
        "lidar": [(28**0.5 + (26**0.5 + 2) ** 0.5) / 2, 28**0.5, 6**0.5],
    }
    for name, expected in norms.items():
        np.testing.assert_allclose(figures["sigma_norm"][name], expected, rtol=1e-5)
    # At most 2 deviations away. At the second look at class 0, (2.5, 0) is 7.5 / 2.26 deviations
    # from class 0 and 2.5 / 2.26 from class 1, the only one that it leaves open.
    shares = {"joint": [1, 1, 1], "camera": [1, 0, 0], "lidar": [0, 0, 1]}
    for name, expected in shares.items():
        np.testing.assert_array_equal(figures["unambiguous"][name], expected)
    # Red leaves the classes 1 and 2 open, each 5 / 5 deviations off, a cylinder 0 and 1, each
    # 5 / sqrt(26); only the second look at class 0 leaves too few.
    shares = {"joint": [1, 1, 1], "camera": [1, 1, 1], "lidar": [0.5, 1, 1]}
    for name, expected in shares.items():
        np.testing.assert_array_equal(figures["consistent"][name], expected)


def test_beliefs_of_classes_are_means_over_the_bank_that_is_given():
    @jax.jit
    def beliefs(bank):
        given = detections(bank)
        return jmvaes.class_beliefs(KEY, CONFIG, params=PARAMS, detections=given)

    found = beliefs(BANK)
    np.testing.assert_allclose(found.mean, CLASS_MEANS, atol=1e-5)
    np.testing.assert_allclose(found.std, [[1, 1, 1], [1, 1, 1], [2, 2, 1]], rtol=1e-5)
    # One of two looks at class 1 is green, and one at class 2 a cylinder: (10 + 0) / 2 each, and
    # deviations of (1 + 2) / 2.
    other = CAMERA.at[1, 1].set(jnp.array([0.0, 1.0])), LIDAR.at[2, 1].set(jnp.array([1.0, 0.0]))
    found = beliefs(other)
    np.testing.assert_allclose(found.mean, [[10, 0, 0], [5, 0, 0], [0, 5, 0]], atol=1e-5)
    np.testing.assert_allclose(found.std, [[1, 1, 1], [1, 1, 1], [1.5, 1.5, 1]], rtol=1e-5)


def test_fusion_as_worked_by_hand(found):
    # The LiDAR's look after the camera's is exact. The camera's after the LiDAR's is encoded with a
    # cube of .6 more, and so lies 6 further along the second dimension: class 1 at (0, 6) is nearer
    # to class 2 at (0, 10), class 2 lies 6 / 2 deviations off.
    np.testing.assert_allclose(found[1]["fusion"]["accuracy"], 5 / 6, rtol=1e-6)
    np.testing.assert_allclose(found[1]["fusion"]["mean_error"], (6 + 6 + 3) / 6, rtol=1e-4)
    # A cube of .6 more also widens two of three dimensions, by 4^(.6 / 2), after one of two orders.
    widening = 0.6 * np.log(2.0) * 2 / 3
    np.testing.assert_allclose(found[1]["fusion"]["std_error"], widening / 2, rtol=1e-4)


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
    # Where two classes are left, the belief is wider.
    assert found["doubt_correlation"] > 0.5


def test_moment_matching_error_as_worked_by_hand():
    # The components match N(2, 3^2), with the variance (1 + 9) / 2 + (4 + 4) / 2, and N(1, .5^2).
    # Dimension 1: |3.5 - 2| / 3 + |ln(6/3)| = .5 + .693147; dimension 2: |.9 - 1| / .5 + 0 = .2.
    components = _belief(((0.0, 1.0), (4.0, 1.0)), ((1.0, 0.5), (3.0, 0.5)))
    error = measures.moment_matching_error(_belief((3.5, 0.9), (6.0, 0.5)), components)
    np.testing.assert_allclose(error, (0.5 + 0.693147 + 0.2) / 2, rtol=1e-5)
    # Too narrow counts as much as too wide.
    narrow = measures.moment_matching_error(_belief((0.5, 1.1), (1.5, 0.5)), components)
    np.testing.assert_allclose(narrow, error, rtol=1e-5)


def _belief(mean, std):
    return Belief(jnp.array(mean), jnp.array(std))


def test_calibration_error_and_likelihood_by_hand():
    # In the bin above 14/15: .95 and 1.0, of which one is right; in that above .6: .65, right.
    probabilities = jnp.array([[0.95, 0.05], [0.0, 1.0], [0.65, 0.35]])
    labels = jnp.array([0, 0, 0])
    expected = (abs(0.95 + 1.0 - 1) + abs(0.65 - 1)) / 3
    error = measures.calibration_error(measures.diagram(probabilities, labels))
    assert error == pytest.approx(expected, abs=1e-6)
    found = measures.negative_log_likelihood(probabilities[::2], labels[::2])
    assert found == pytest.approx(-(np.log(0.95) + np.log(0.65)) / 2, rel=1e-5)
    # A label of probability zero costs no more than a finite number.
    assert np.isfinite(measures.negative_log_likelihood(probabilities, labels))


# The camera tells class 0 from the others, the LiDAR class 2. Classes in the same place cannot be
# read from a belief.
CORNER = Belief(jnp.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]]), jnp.full((3, 2), 0.3))
PLACE = Belief(jnp.ones((3, 2)), jnp.full((3, 2), 0.3))


@jax.jit
def kept(losses, classes):
    """The restart that is kept, by losses and beliefs of the classes."""
    restarts = tuple((jnp.int32(i), losses[i]) for i in range(len(losses)))
    of_restart = lambda *_, params, detections: jax.tree.map(lambda x: x[params], classes)  # noqa: E731
    camera = np.float32([[0.1, 0.9], [0.9, 0.1], [0.9, 0.1]])[:, None]
    given = {
        "restarts": restarts,
        "detections": detections((jnp.asarray(camera), jnp.asarray(camera[::-1]))),
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jmvaes, "class_beliefs", of_restart)
        return stage_of("best_jmvae").begin(KEY, TINY, **given)


def best_of(losses, classes):
    stacked = jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *classes)
    return int(kept(np.float32(losses), stacked))


def test_the_exact_restart_with_the_lowest_loss_is_kept_or_the_most_exact():
    nan = jnp.nan
    assert best_of((1, nan, 0.9), [CORNER] * 3) == 2
    # From equal places no class can be read, whatever the loss.
    assert best_of((1, 0.5, 0.9), [CORNER, PLACE, CORNER]) == 2
    assert best_of((nan, 0.5, 0.9), [CORNER, PLACE, PLACE]) == 1
    line = Belief(jnp.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0]]), jnp.full((3, 2), 0.3))
    assert best_of((0.5, 0.9, 0.5), [PLACE, line, PLACE]) == 1
