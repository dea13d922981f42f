"""Tables of a run: which values are the best, and what is compared with the paper."""

import pytest
from summaries import BYTES, CASE, SUMMARY

from jaxsense.show import tables
from jaxsense.summary.blocks import MISSIONS


def played(**cases):
    return {**cases, "bytes_per_detection": BYTES}


def test_the_best_values_are_those_of_policies_about_as_accurate_as_the_best():
    # .994 is within .005 of .998, and .99 is not, however few its looks.
    quick = {**CASE, "accuracy": 0.994, "time_s": 9.0}
    wrong = {**CASE, "accuracy": 0.99, "observations_per_poi": 0.5, "time_s": 5.0}
    table = tables.missions(played(latent=CASE, nearest=quick, random=wrong), "")
    # The accuracy of the first, the looks of both, and the time of the second.
    assert table.best == {(0, 0), (0, 1), (1, 1), (1, 2)}


def test_a_single_policy_is_not_the_best():
    assert tables.missions(played(latent=CASE), "").best == frozenset()


def test_every_agent_must_have_the_papers_task():
    camera = SUMMARY["dqn"]["camera"]
    assert tables.paper(SUMMARY) is not None
    other = {"camera": camera, "lidar": {**camera, "num_permutations": 200}}
    assert tables.paper({**SUMMARY, "dqn": other}) is None


def test_where_one_alone_is_as_accurate_as_the_best_only_its_accuracy_is_marked():
    worse = {**CASE, "accuracy": CASE["accuracy"] - 0.1}
    table = tables.missions(played(latent=CASE, naive=worse), "")
    assert table.best == {(0, 0)}
    assert {"against naive", "unfinished", "in bold"} <= set(table.meanings)
    assert "against naive" not in tables.missions(played(latent=CASE), "").meanings


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, ""),  # optimal 1.25, greedy 1.24
        ({"greedy": 1.2504}, ""),  # shown as 1.250, like the optimal one
        ({"greedy": 1.2506}, "For lidar, greedy gets more than optimal."),
        ({"greedy": 1.3, "return": 1.26}, "For lidar, Q-network and greedy get more than optimal."),
        ({"greedy": 1.3, "optimal": None, "fraction_of_optimal": None}, ""),
    ],
)
def test_only_where_a_policy_is_above_optimal_a_note_says_why(changes, expected):
    camera = SUMMARY["dqn"]["camera"]
    note = tables.agents(
        {**SUMMARY, "dqn": {"camera": camera, "lidar": {**camera, **changes}}}
    ).note
    assert note.startswith(expected)
    assert ("another policy can score higher" in note) == bool(expected)


def test_policies_have_the_names_that_users_type():
    block = played(latent=CASE, naive_2=CASE, camera_alone=CASE)
    assert [name for name, _ in tables.missions(block, "").rows] == ["latent", "naive_2"]
    assert [name for name, _ in tables.failures(block).rows] == ["camera_alone"]


def test_every_metric_of_missions_stands_in_one_table():
    shown = [key for keys in tables.ALL_OF_MISSIONS.values() for key in keys]
    # The seed stands above, and how missions ended in the main table.
    assert sorted([*shown, "seed", "ended"]) == sorted(MISSIONS)
    assert max(map(len, tables.ALL_OF_MISSIONS.values())) <= 6  # columns that fit a narrow page


def test_a_table_of_metrics_leaves_out_who_has_none_of_them():
    alone = {**CASE, "told": 0.75, "ambiguous_reported": None}
    found = {t.caption: t for t in tables.all_of_missions(played(latent=CASE, camera_alone=alone))}
    assert set(found) == {"Maps at the end", "Looks and time", "A robot alone"}
    assert found["A robot alone"].rows == [("camera_alone", ["0.750"])]
    assert [name for name, _ in found["Looks and time"].rows] == ["latent", "camera_alone"]


def test_an_end_of_missions_is_not_broken_between_lines():
    table = tables.missions(
        played(latent={**CASE, "ended": {"time limit": 1, "undetected": 2}}), ""
    )
    assert table.rows[0][1][-1] == "1\u00a0time\u00a0limit, 2\u00a0undetected"
