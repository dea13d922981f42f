"""Variants of the JMVAE of scans: two are the library's, and each changes what its name says."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.raw import __main__, report, training
from benchmarks.raw.looks import (
    Looks,
    as_they_are,
    in_frames,
    regrouped,
    simulate,
    standardised,
)
from benchmarks.raw.model import Model, hidden
from benchmarks.raw.training import PARTS
from benchmarks.raw.variants import ABLATION, OURS, PAPER, TABLES
from jaxsense import PRESETS
from jaxsense.core import networks
from jaxsense.core.networks import MLP
from jaxsense.vae import gaussian, leave_one_out
from jaxsense.vae.frames import Chromaticity
from jaxsense.vae.leave_one_out import Shape

KEY = jax.random.key(0)
SIZES, NUMBER, POIS = (3, 5), 4, 6


def columns(number):
    rng = np.random.default_rng(0)
    return tuple(rng.normal(size=(n, POIS, number)).astype(np.float32) for n in SIZES)


LOOKS = columns(NUMBER)
OURS_MODEL = Model(OURS, SIZES)


@functools.cache
def random_params(model):
    return jax.jit(model.init)(KEY)


@functools.cache
def loss_function(model):
    return jax.jit(model.loss)


def loss_of(model, params, looks, beta=1.0, has_begun=1.0):
    return loss_function(model)(KEY, params, looks, jnp.float32(beta), jnp.float32(has_begun))


@pytest.mark.slow
def test_the_variant_ours_has_the_loss_of_the_library():
    model, params = OURS_MODEL, random_params(OURS_MODEL)
    shape = Shape(("camera", "lidar"), SIZES, 2, OURS.jmvae.hidden)
    named = {
        part: dict(zip(shape.modalities, params[ours], strict=True))
        for part, ours in (("encoders", "alone"), ("embeddings", "embedding"),
                           ("decoders", "decoders"))
    }  # fmt: skip

    @jax.jit
    def losses(params, looks):
        noise = jnp.stack([
            jax.random.normal(keys[0], (2, POIS, NUMBER)) for keys in jax.random.split(KEY, (2, 2))
        ])  # fmt: skip
        return leave_one_out.losses(
            noise, params, shape,
            tuple(jnp.moveaxis(x, 0, -1) for x in looks),
            alpha=OURS.jmvae.alpha, beta=0.7, has_begun=0.6,
            reconstruction_weights=OURS.jmvae.reconstruction_weights,
        )  # fmt: skip

    expected = losses({**named, "joint": params["joint"][0]}, LOOKS)
    found = loss_of(model, params, LOOKS, 0.7, 0.6)
    np.testing.assert_allclose(found, jnp.mean(expected), rtol=1e-4)


def test_the_paper_has_the_objective_of_a_jmvae():
    model, looks = Model(PAPER, SIZES), columns(1)
    params = random_params(model)

    @jax.jit
    def objective(params, looks):
        joint = model.posterior(params, looks)
        noise = jax.random.normal(jax.random.split(KEY, (2, 2))[0, 0], (2, POIS, 1))[..., 0]
        z = gaussian.sample(noise, *joint)
        total = 0.1 * jax.vmap(gaussian.kl_to_standard_normal, in_axes=-1)(*joint)
        for m, x in enumerate(looks):
            mean = networks.apply(model.decoders[m], params["decoders"][m], z)
            total += 0.5 * jnp.sum((x[..., 0] - mean) ** 2, axis=0)
            alone = [y[..., 0] for y in model.of_single(params, looks, m)]
            total += jax.vmap(gaussian.kl_divergence, in_axes=-1)(*joint, *alone)
        return jnp.mean(total)

    assert (PAPER.jmvae.alpha, PAPER.jmvae.beta) == (1.0, 0.1)
    found = loss_of(model, params, looks, 0.1)
    np.testing.assert_allclose(found, objective(params, looks), rtol=1e-5)


@pytest.mark.slow
def test_all_that_is_known_of_a_look_is_in_its_row():
    looks = simulate(KEY, 288)
    assert {len(x) for x in (*looks.windows, *looks.frames, looks.classes)} == {36}
    of_windows = jax.vmap(jax.vmap(Chromaticity()))(looks.windows[0])
    centred = of_windows - of_windows.mean(axis=(0, 1), keepdims=True)
    np.testing.assert_allclose(
        jnp.corrcoef(centred.ravel(), looks.frames[0].ravel())[0, 1], 1, atol=1e-3
    )


def test_names_are_unique():
    for table in TABLES.values():
        assert len({variant.name for variant in table}) == len(table)


# The others differ in the looks that they are given, or in the schedules.
IN_LOSS = [
    variant
    for variant in ABLATION
    if variant.looks == NUMBER
    and variant.leaves_out
    and variant.name not in (OURS.name, "ours, beta constant", "ours, alpha from the start")
    and (variant.view == in_frames or variant.jmvae != OURS.jmvae)
]


@pytest.mark.parametrize("variant", IN_LOSS, ids=lambda v: v.name)
def test_each_variant_has_another_loss(variant):
    changed = Model(variant, SIZES)
    # Without private latents, the networks are the same.
    params = random_params(changed if variant.private else OURS_MODEL)
    found = loss_of(changed, params, LOOKS)
    assert np.isfinite(found)
    if not variant.private:
        assert abs(found - loss_of(OURS_MODEL, params, LOOKS)) > 1e-3


def test_looks_decoded_from_all_share_one_posterior():
    params = random_params(OURS_MODEL)
    one, others = (
        Model(dataclasses.replace(OURS, leaves_out=leaves_out), SIZES)
        for leaves_out in (False, True)
    )
    whole = np.asarray(jax.jit(one.posterior)(params, LOOKS)[0])[..., None]
    for mean, _ in jax.jit(one.sources)(params, LOOKS):
        np.testing.assert_allclose(mean, np.broadcast_to(whole, mean.shape), rtol=1e-5)
    # What a look shows does not reach the posterior that it is decoded from.
    changed, sources = np.array(LOOKS[0]), jax.jit(others.sources)
    changed[:, :, 1] += 5.0
    before, after = (
        np.asarray(sources(params, looks)[0][0]) for looks in (LOOKS, (changed, LOOKS[1]))
    )
    np.testing.assert_allclose(after[..., 1], before[..., 1], rtol=1e-4, atol=1e-5)
    assert (np.abs(after - before).max(axis=(0, 1))[[0, 2, 3]] > 1e-3).all()


def test_sums_and_means_of_squares_differ_by_the_number_of_numbers():
    decoded = jnp.zeros_like(LOOKS[1])
    of = {
        is_mean: Model(
            dataclasses.replace(OURS, is_mean=is_mean, learns_variance=False), SIZES
        )._errors(LOOKS[1], decoded)
        for is_mean in (False, True)
    }
    np.testing.assert_allclose(of[False], 5 * of[True], rtol=1e-6)


@pytest.mark.parametrize(
    ("repeats", "sizes"), [((1, 1), (5, 5)), ((4, 1), (20, 5)), ((1, 2), (5, 10))]
)
def test_ratios_are_those_of_numbers(repeats, sizes):
    model = Model(OURS.but("", repeats=repeats), SIZES)
    assert model.inputs == sizes
    seen = tuple(jnp.moveaxis(x, 0, -1) for x in LOOKS)
    for x, repeated, size in zip(seen, model.columns(seen), SIZES, strict=True):
        counts = (repeated[None] == jnp.moveaxis(x, -1, 0)[:, None]).sum(axis=1)[:, 0, 0]
        assert counts.sum() == len(repeated)
        assert counts.max() - counts.min() <= 1  # 5 of 3 numbers: two of them twice
        assert len(counts) == size


def of_easy(number=96):
    """Looks of three classes that anyone can tell apart."""
    classes = np.arange(number) % 3
    x = jnp.asarray(np.eye(3)[classes][:, None] * np.ones((1, 8, 1)), jnp.float32)
    noise = 0.1 * jax.random.normal(KEY, (2, *x.shape))
    seen = (x + noise[0], x + noise[1])
    return Looks(seen, seen, jax.random.normal(KEY, (number, 8, 7)), classes)


@pytest.mark.slow
def test_variants_learn_what_is_easy():
    variant = OURS.but("", hidden=(128,), steps=300)
    looks = of_easy()
    data = training.split(looks, variant.view)
    assert [len(x) for x in data.classes] == [72, 24]
    keys = jax.random.split(KEY, 2)
    found = training.compiled(variant, data, keys)()
    assert (found["right"] == 1).all()
    assert (found["pair"] == 1).all()
    assert (found["of_classes"] == 1).all()
    assert (found["units"] == 2).all()
    assert (found["by_class"] > 0.9).all()
    assert found["gradient"].shape == (2, PARTS, 3)
    assert (found["gradient"] > 0).all()
    assert found["posteriors"]["joint"].shape == (2, 3, training.SHOWN, 2, 2)
    assert (found["posteriors"]["lidar"][..., 1, :] > 0).all()


def test_explained_shares_are_those_of_a_regression():
    given, noise = np.split(np.random.default_rng(0).normal(size=(500, 3)), [2], axis=1)
    half = given[:, :1] + noise  # variances 1 and 1
    assert training.explained(given[:, :1] * 3 + 2, given) == pytest.approx(1)
    # Numbers that follow from the others, as squares of a direction do, add nothing.
    repeated = np.concatenate([given, 1 - given.sum(axis=1, keepdims=True)], axis=1)
    assert training.explained(half, repeated) == pytest.approx(training.explained(half, given))
    assert training.explained(half, given) == pytest.approx(0.5, abs=0.08)
    assert training.explained(noise, given) == pytest.approx(0, abs=0.02)
    assert training.explained(np.ones((500, 2)), given) == 0


def test_latents_are_explained_by_the_class_or_by_distances_and_light():
    data = training.split(of_easy(), in_frames)
    of_class = np.eye(3)[np.asarray(data.classes[1])][:, 1:]
    around = np.asarray(data.circumstances[:, 0])
    found = training.shares(np.stack([of_class, around[:, :2], around[:, 5:] ** 2]), data)
    np.testing.assert_allclose(found["by_class"][0], 1, atol=1e-9)
    np.testing.assert_allclose(found["by_view"][1:], 1, atol=1e-9)
    assert (found["by_class"][1:] < 0.5).all()
    assert found["by_view"][0] < 0.9


def test_beta_weighs_as_much_where_looks_share_one_posterior():
    # Three posteriors, the whole and one for each sensor, and three times the weight for one.
    for variant in ABLATION:
        number = 3 if variant.leaves_out else 1
        usual = PAPER.jmvae.beta if variant.name.startswith("paper") else 3 * OURS.jmvae.beta
        assert number * variant.jmvae.beta == pytest.approx(usual), variant.name


def test_hidden_layers_are_those_of_the_network():
    network = MLP((4, 3), 2)
    params = networks.init(KEY, network, 5)
    x = jax.random.normal(KEY, (5, 7))
    *_, last = hidden(params, x)
    layer = params["params"]["Dense_2"]
    expected = networks.apply(network, params, x)
    found = layer["kernel"].T @ last + layer["bias"][:, None]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_dead_units_are_those_that_nothing_switches_on():
    looks = of_easy()
    data = training.split(looks, in_frames)
    model = Model(OURS, (3, 3))
    params = random_params(model)
    dead = jax.jit(lambda params: training.dead(KEY, model, params, data))
    before = dead(params)
    assert len(before) == 6  # one layer for each sensor, and two in each decoder
    layers = params["decoders"][1]["params"]
    bias = np.repeat(np.float32([-1e3, 1e3]), 64)
    layers["Dense_1"] = {**layers["Dense_1"], "bias": bias}
    after = dead(params)
    assert after[-1] == 0.5
    np.testing.assert_array_equal(after[:-1], before[:-1])


def test_least_weights_are_of_the_layer_that_shrinks_most():
    first = random_params(OURS_MODEL)
    last = jax.tree.map(lambda x: 2 * x, first)
    layers = last["decoders"][1]["params"]
    layers["Dense_1"] = {**layers["Dense_1"], "kernel": layers["Dense_1"]["kernel"] / 8}
    assert training.of_layers(first, last) == pytest.approx(0.25)


def test_views_and_groups():
    looks = of_easy(12)
    assert as_they_are(looks) is looks.windows
    for x in standardised(looks):
        np.testing.assert_allclose(x.mean(axis=(0, 1)), 0, atol=1e-5)
        np.testing.assert_allclose(x.std(), 1, rtol=1e-4)
    groups = regrouped(looks.windows, 2)[0]
    np.testing.assert_array_equal(groups[5], looks.windows[0][1, 2:4])


def figures(pair):
    """Figures of two seeds, as the program writes them."""
    posterior = np.ones((3, 4, 2, 2)).tolist()
    names = ("by_class", "by_view", "dead", "dead_at_start", "least_weights")
    lists = {name: [0.25, 0.75] for name in names} | {"right": pair, "pair": pair}
    return lists | {
        "units": [1, 2],
        "of_classes": [[1.0, 0.5, 0.25]] * 2,
        "gradient_at_start": [[1.0, 2.0, 3.0]] * 2,
        "gradient": [[[1.0, 2.0, 3.0]] * PARTS] * 2,
        "posteriors": {name: posterior for name in ("joint", "camera", "lidar")},
    }


def test_the_report_reads_files_of_several_programs(tmp_path, capsys):
    given = {"seeds": [100, 101], "steps": 10, "scans": 100}
    for table, variants in TABLES.items():
        rows = [{"table": table, "name": v.name, **figures([0.4, 0.5])} for v in variants]
        (tmp_path / f"{table}.json").write_text(json.dumps({**given, "variants": rows}))
    files = [str(tmp_path / f"{table}.json") for table in TABLES]
    pictures = [tmp_path / "a.png", tmp_path / "b.png"]
    report.main([*files, "--plot", str(pictures[0]), "--posteriors", str(pictures[1])])
    printed = capsys.readouterr().out
    # t of 1 degree of freedom, 12.706, times the standard error, 0.05
    assert "| paper | 0.450 ± 0.635 (0.400 to 0.500) |  | 1.5 (1.0 to 2.0) | 0.50 (0.25" in printed
    assert "| 16:1 | 0.450 ± 0.635 (0.400 to 0.500) |" in printed
    gradients = " | ".join(f"{x}.00" for x in (1, 1, 3, 3))  # alike in all seeds
    accuracy = "0.450 ± 0.635 (0.400 to 0.500) | 1.5 (1.0 to 2.0)"
    assert f"| ours | 8 | {accuracy} | {gradients} | 0.50 (0.25 to 0.75) |" in printed
    assert "| 101 | 0.500 | 1.00, 0.50, 0.25 | 2 | 0.75 |" in printed
    assert all(path.stat().st_size > 1000 for path in pictures)


def test_files_of_different_runs_are_refused(tmp_path, capsys):
    for name, steps in (("a", 10), ("b", 20)):
        text = json.dumps({"seeds": [1], "steps": steps, "scans": 100, "variants": []})
        (tmp_path / name).write_text(text)
    with pytest.raises(SystemExit):
        report.main([str(tmp_path / "a"), str(tmp_path / "b")])
    assert "steps = [10, 20]: must be the same in all" in capsys.readouterr().err


def test_what_a_table_lacks_is_named(tmp_path, capsys):
    row = {"table": "depth", "name": "ours, depth 1", **figures([0.4, 0.5])}
    whole = {"seeds": [100, 101], "steps": 10, "scans": 100, "variants": [row]}
    (tmp_path / "a").write_text(json.dumps(whole))
    with pytest.raises(SystemExit):
        report.main([str(tmp_path / "a")])
    assert "files: table depth: lacks paper, depth 1, paper, depth 2" in capsys.readouterr().err
    rows = [{**row, "name": variant.name} for variant in TABLES["depth"]]
    (tmp_path / "a").write_text(json.dumps({**whole, "variants": rows}))
    with pytest.raises(SystemExit):
        report.main([str(tmp_path / "a"), "--plot", str(tmp_path / "p.png")])
    assert "plot: needs the tables ablation, ratio" in capsys.readouterr().err


def test_wrong_numbers_of_steps_are_refused(capsys):
    with pytest.raises(SystemExit):
        __main__.main(["--steps", "15"])
    assert "steps = 15: must be a multiple of 10" in capsys.readouterr().err


@pytest.mark.slow
def test_the_program_writes_what_the_report_reads(tmp_path, monkeypatch, capsys):
    raw = PRESETS["raw"].jmvae.looks
    assert OURS.looks == raw
    monkeypatch.setitem(TABLES, "ablation", (PAPER, OURS))
    monkeypatch.setattr(report, "ABLATION", (PAPER, OURS))
    path = tmp_path / "raw.json"
    options = ["--tables", "ablation", "--seeds", "2", "--steps", "20", "--scans", "600"]
    __main__.main([*options, "--json", str(path)])
    report.main([str(path), "--posteriors", str(tmp_path / "p.png")])
    assert "| paper | 0." in capsys.readouterr().out
    # What pages say of a table.
    content = json.loads(path.read_text())
    written = report.written(content, report.of_ablation)
    command = "python -m benchmarks.raw --tables ablation --seeds 2 --steps 20 --scans 600"
    assert f"`{command}`: {content['device']}" in written
