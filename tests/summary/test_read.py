"""A summary that cannot be used is refused in one line."""

import copy
import json

import pytest
from summaries import EVALUATION, RESULTS, SUMMARY

from jaxsense.config import ConfigError
from jaxsense.summary import compare
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
