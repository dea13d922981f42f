"""A summary that cannot be used is refused in one line."""

import copy
import json

import pytest
from summaries import SUMMARY

from jaxsense.config import ConfigError
from jaxsense.summary.read import read_summary


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
