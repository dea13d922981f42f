"""The package as a whole: the examples of the README and of the documentation."""

import re
from pathlib import Path

import chex
import flax
import numpy as np
import pytest

ROOT = Path(__file__).parent.parent


def run_example(path: Path, which: int = -1) -> dict:
    """Runs a Python example of a page, by default the last; gives the names that it leaves."""
    names: dict = {}
    examples = re.findall(r"```python\n(.*?)```", path.read_text(), re.DOTALL)
    exec(compile(examples[which], path.name, "exec"), names)
    return names


def test_example_of_the_readme_runs(capsys):
    names = run_example(ROOT / "README.md")
    assert capsys.readouterr().out == f"(12,) {names['seen'].reward!s}\n"
    # A look costs 0.1 nats, and tells at most which of three classes it is: log 3 = 1.10.
    assert -0.1 <= float(names["seen"].reward) < 1.0


@pytest.mark.slow
def test_example_of_the_first_steps_runs(capsys):
    belief = run_example(ROOT / "docs" / "getting-started.md")["belief"]
    assert capsys.readouterr().out == "(64, 2) (64, 2)\n"
    assert np.isfinite(belief.mean).all()
    assert (np.asarray(belief.std) > 0).all()


@pytest.mark.slow  # trains as far as the latent space
def test_example_of_several_settings_runs(capsys):
    names = run_example(ROOT / "docs" / "getting-started.md", 0)
    assert capsys.readouterr().out == f"{names['metrics'].active_units}\n"
    assert names["metrics"].active_units.shape == (3,)


SINGLE = ROOT / "docs" / "functions.md"


@pytest.mark.slow
def test_examples_of_single_functions_run(capsys):
    rays, fusion, values, paths, memory = (run_example(SINGLE, i) for i in range(5))
    np.testing.assert_allclose(rays["hit"].distance, [1.5, np.inf, 2.5], rtol=1e-6)
    assert "[-1.  0.]" in capsys.readouterr().out.replace("[-1. 0.]", "[-1.  0.]")
    models, belief = fusion["models"], fusion["belief"]
    assert np.isclose(models.fusion.class_probabilities(belief).sum(), 1)
    of_all = [values["values"].of_all(np.array([p, 1 - p]), True) for p in (0.5, 0.8, 0.99)]
    # The first look gains log 2 less the entropy of a coin that is right four times in five, .193.
    assert of_all[0] > 0.193 - 0.1
    assert of_all[2] < 0
    assert 0.5 < paths["lengths"].min() < 4
    assert memory["batch"].s_t.shape == (3, 128)


@pytest.mark.slow
def test_example_of_the_jmvae_on_own_data_runs(capsys):
    names = run_example(ROOT / "docs" / "jmvae.md")
    # A float64 column at 1e6 +- 1 and one at 2,000 +- 3 have a deviation of 1 afterwards.
    far = np.random.default_rng(0).normal([1e6, 2e3], [1.0, 3.0], (5000, 2))
    scaled = names["standardize"](far)
    np.testing.assert_allclose(scaled.mean(axis=0), 0.0, atol=1e-5)
    np.testing.assert_allclose(scaled.std(axis=0), 1.0, rtol=1e-5)
    assert scaled.dtype == np.float32
    assert names["losses"][-50:].mean() < 0.5 * names["losses"][:50].mean()
    shapes, share, likelihood = capsys.readouterr().out.splitlines()
    assert shapes == "(200, 2) (200, 2)"
    assert float(share.split()[-1]) > 0.99
    # Between that of sixteen independent features, which are scaled, and the density of the
    # decoders, of variance .1, at their means.
    independent, at_means = 8 * np.log(1 / (2 * np.pi)) - 8, 8 * np.log(10 / (2 * np.pi))
    assert independent < float(likelihood.split()[-1]) < at_means
    saved = flax.serialization.to_bytes(names["params"])
    empty = names["vae"].init(names["init_key"], names["model"])
    restored = flax.serialization.from_bytes(empty, saved)
    chex.assert_trees_all_equal(names["params"], restored)


@pytest.mark.slow
def test_examples_of_the_tasks_run(capsys):
    page = ROOT / "docs" / "tasks.md"
    assert np.isfinite(run_example(page, 0)["seen"].reward)
    played = run_example(page, 1)
    assert played["rewards"].shape == (64, 20)
    assert np.all(played["is_live"][:, 0])
    assert np.all(played["is_live"][:, :-1] >= played["is_live"][:, 1:])
    capsys.readouterr()
    run_example(page, 2)
    from_observation, of_state = capsys.readouterr().out.splitlines()
    assert from_observation == of_state
    assert "False" in of_state
    run_example(page, 3)
    assert "noisy-v0, camera, 10 seeds: return" in capsys.readouterr().out
    on_host = run_example(page, 4)["found"]
    assert capsys.readouterr().out.endswith("(10,)\n")
    assert 0 < on_host.fraction_of_optimal.low <= on_host.fraction_of_optimal.value <= 1
    run_example(page, 5)
    assert "noisy-v0, camera, 10 seeds: return" in capsys.readouterr().out
    run_example(page, 6)
    assert "mine" in capsys.readouterr().out
    run_example(page, 7)
    printed = capsys.readouterr().out
    learned, random = (
        float(re.search(rf"{name}:?(?: return)? (-?[\d.]+)", printed)[1])
        for name in (r"map-v0, camera, \d+ seeds?", "random")
    )
    assert learned > random
    assert run_example(page, 8)["models"].tours
    assert "--preset team --seed 0" in capsys.readouterr().out
