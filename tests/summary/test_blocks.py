"""The one table of metrics: every key that it names exists, and every key is named."""

import json

import pytest
from summaries import CASE, EVALUATION, OF_A_TEAM, OF_SEEDS, ORIGIN, SUMMARY

from jaxsense.summary import blocks
from jaxsense.summary.blocks import BLOCKS

KEYS = {place + key for place, block in BLOCKS.items() for key in block}
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
