"""Tables of a run: which values are the best, and what is compared with the paper."""

from summaries import BYTES, CASE, SUMMARY

from jaxsense.show import tables


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
