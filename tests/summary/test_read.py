"""A summary: the one table of its metrics, and what cannot be used is refused in one line."""

import copy
import json

import pytest
from summaries import CASE, EVALUATION, OF_A_TEAM, OF_SEEDS, ORIGIN, RESULTS, SUMMARY

from jaxsense.config import ConfigError
from jaxsense.summary import blocks, compare
from jaxsense.summary.blocks import BLOCKS
from jaxsense.summary.read import read_evaluations, read_origins, read_summary


def written(path, content, name="summary.json"):
    (path / name).parent.mkdir(exist_ok=True)
    (path / name).write_text(json.dumps(content))
    return path


def test_a_summary_is_read_with_keys_of_later_versions(tmp_path):
    content = {**SUMMARY, "later": 1}
    assert read_summary(written(tmp_path, content)) == content


@pytest.mark.parametrize(
    ("place", "value", "reason"),
    [
        ("dqn.camera.return", None, "summary.dqn.camera.return is missing"),
        ("timing", None, "summary.timing is missing"),
        ("mission.latent.time_s", "x", "summary.mission.latent.time_s has the wrong type"),
        ("mission.latent.time_s", {}, "summary.mission.latent.time_s has the wrong type"),
        ("mission.latent.accuracy", True, "accuracy has the wrong type"),
        ("mission.latent", 3, "summary.mission.latent has the wrong type"),
        ("jmvae.unambiguous.joint", [1], "summary.jmvae.unambiguous.joint.0 has the wrong type"),
        ("jmvae.active_units", True, "active_units has the wrong type"),
        ("jmvae.readout_error", 1e31, "readout_error has the wrong type"),
        ("seed", 1.5, "summary.seed has the wrong type"),
        ("cores", "two", "summary.cores has the wrong type"),
        ("mission", {}, "summary.mission must hold 1 to 1,000 cases"),
        ("mission", 3, "summary.mission must hold 1 to 1,000 cases"),
        ("belief", [], "summary.belief has the wrong type"),
        ("seeds", {"3": {}}, "summary.seeds.3.belief is missing"),
    ],
)
def test_what_is_missing_or_wrong_is_named(tmp_path, place, value, reason):
    content = copy.deepcopy(SUMMARY)
    *blocks, key = place.split(".")
    block = content
    for name in blocks:
        block = block[name]
    block.pop(key, None)
    if value is not None:
        block[key] = value
    with pytest.raises(ConfigError) as error:
        read_summary(written(tmp_path, content))
    assert "must hold the summary.json of a finished run" in str(error.value)
    assert reason in str(error.value)
    assert "\n" not in str(error.value)


def test_a_summary_of_several_seeds_holds_intervals(tmp_path):
    of_seed = {name: SUMMARY[name] for name in RESULTS}
    means = compare.statistics([of_seed, of_seed])
    content = {**SUMMARY, **means, "seeds": {"3": of_seed, "4": of_seed}}
    assert read_summary(written(tmp_path, content)) == content
    means["belief"]["doubt_correlation"] = 0.5
    with pytest.raises(ConfigError, match=r"doubt_correlation has the wrong type"):
        read_summary(written(tmp_path, content))


def test_a_run_that_is_not_finished_has_no_summary(tmp_path):
    with pytest.raises(ConfigError, match=r"is not finished: it has no summary\.json; continue it"):
        read_summary(tmp_path)
    assert read_origins(tmp_path) == []
    assert read_evaluations(tmp_path) == {}
    written(tmp_path, EVALUATION, "evaluations/a.json")
    assert read_evaluations(tmp_path) == {"a": EVALUATION}
    made = [EVALUATION["origin"]]
    assert read_origins(written(tmp_path, made, "origins.json")) == made
    for read, name in ((read_origins, "origins.json"), (read_evaluations, "evaluations/a.json")):
        with pytest.raises(ConfigError, match=f"must hold the {name} of a finished run"):
            read(written(tmp_path, [{"stage": 1}], name))


# Every key that the table names exists, and every key is named.

KEYS = {place + key for place, block in BLOCKS.items() for key in block if place != "found.POLICY."}
# Only in some runs: of several seeds, of a team, from scans, or of one robot alone.
RARE = {"commit", "origins", "seeds", "failed", "dqn.MODALITY.other_numbers", "mission.POLICY.seed"}
RARE |= {f"mission.POLICY.{key}" for key in ("told", "ambiguous_reported")}
RARE |= {f"evaluations.NAME.{key}" for key in ("num_pois", "side", "robots")}
RARE |= {f"evaluations.NAME.origin.{key}" for key in ORIGIN}


def keys(value, key=""):
    """The keys of a summary up to those in the table, with MODALITY, POLICY and STAGE for names."""
    if not isinstance(value, dict) or {key, f"evaluations.NAME.{key}"} & KEYS:
        return {key}
    places = {"detectors": "MODALITY", "dqn": "MODALITY", "timing.stages": "STAGE"}
    place = {**places, "mission": "POLICY"}.get(key)
    names = {name: place or name for name in value}
    parts = [keys(value[name], f"{key}.{named}".lstrip(".")) for name, named in names.items()]
    return set().union(*parts)


def test_a_real_summary_has_every_documented_key_and_no_other(smoke_run):
    found = keys(json.loads((smoke_run / "summary.json").read_text()))
    found.discard("commit")  # known in a checkout
    assert found == KEYS - RARE
    # What tests of the page and the terminal show is a summary too.
    assert keys(SUMMARY) == {key for key in found if ".intervals." not in key}


def test_every_rare_key_is_somewhere():
    alone = {**CASE, "seed": 7, "told": 1.0, "ambiguous_reported": None}
    evaluation = {**EVALUATION, "mission": {"camera_alone": alone}}
    found = keys(OF_SEEDS) | keys(OF_A_TEAM)
    found |= {"commit", "origins"} | {
        key if key in KEYS else f"evaluations.NAME.{key}" for key in keys(evaluation)
    }
    assert RARE <= found <= KEYS


@pytest.mark.parametrize(
    ("value", "digits", "expected"),
    [
        (0.12345, 3, "0.123"),
        (-0.0001, 2, "0.00"),
        (1728, 1, "1,728"),
        (12345.6, 0, "12,346"),
        (None, 3, "-"),
        ({"mean": 1.0, "low": 0.0, "high": 2.0}, 1, "1.0 (0.0\u00a0to\u00a02.0)"),
        ({"mean": 1.0, "low": 1.0, "high": 1.0}, 2, "1.00 (1.00\u00a0to\u00a01.00)"),
        ({"mean": 1.0, "low": None, "high": None}, 2, "1.00"),
    ],
)
def test_numbers_as_text(value, digits, expected):
    assert blocks.text(value, digits) == expected
