"""What travels with the package is read as it was written."""

import chex
import jax
import jax.numpy as jnp
import pytest

from jaxsense.core.types import Belief
from jaxsense.tasks import archive

TREE = {"beliefs": (Belief(jnp.arange(3.0), jnp.ones(3)), [jnp.int32(7)]), "none": ()}
ABOUT = {"names": {"red": 1.5, "blue": [1, 2]}, "who": "test"}


def test_trees_and_words_come_back(tmp_path):
    archive.write(tmp_path / "a.npz", {"tree": TREE, "other": jnp.zeros((2, 2))}, ABOUT)
    arrays, about = archive.read(tmp_path / "a.npz")
    chex.assert_trees_all_equal(archive.fill(arrays, "tree", TREE), TREE)
    assert set(arrays) == {"tree/beliefs/0/mean", "tree/beliefs/0/std", "tree/beliefs/1/0", "other"}
    # The order of names is kept: that of colours numbers the labels.
    assert list(about) == ["names", "who"]
    assert list(about["names"]) == ["red", "blue"]
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        ({"x": jnp.zeros(2)}, r"tree/x has shape \(3,\): must have shape \(2,\)"),
        ({"x": jnp.zeros(3), "y": jnp.zeros(1)}, r"tree/y is missing: must have shape \(1,\)"),
    ],
)
def test_a_tree_of_other_shapes_is_refused(tmp_path, shapes, message):
    archive.write(tmp_path / "a.npz", {"tree": {"x": jnp.zeros(3)}}, {})
    arrays, _ = archive.read(tmp_path / "a.npz")
    with pytest.raises(ValueError, match=message):
        archive.fill(arrays, "tree", jax.eval_shape(lambda: shapes))
