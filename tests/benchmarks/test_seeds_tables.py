"""Tables over seeds."""

import json

import pytest
from summaries import BYTES, CASE, EVALUATION, GROUPED, OF_SCANS, SUMMARY

from benchmarks.seeds import __main__ as program
from benchmarks.seeds import rows, tables
from benchmarks.seeds.runs import gather
from jaxsense.config import ConfigError


@pytest.fixture
def runs(tmp_path):
    """Makes the directory of a run with a preset, a seed, a summary and evaluations."""

    def make(preset, seed, summary=SUMMARY, **evaluations):
        run = tmp_path / f"{preset}-{seed}"
        (run / "evaluations").mkdir(parents=True)
        written = {"preset": preset, "seed": seed, "commit": "0123456789abcdef"}
        (run / "config.json").write_text(json.dumps(written))
        versions = {"python": "3.11.7", "jax": "0.10.2", "mujoco": "3.17.0"}
        summary = {**summary, "devices": ["cpu"], "versions": versions}
        (run / "summary.json").write_text(json.dumps(summary))
        for name, each in evaluations.items():
            (run / "evaluations" / f"{name}.json").write_text(json.dumps(each))
        return run

    return make


def with_jmvae(**values):
    return {**SUMMARY, "jmvae": {**SUMMARY["jmvae"], **values}}


def cells(table, label):
    (line,) = [line for line in table.splitlines() if line.startswith(f"| {label}")]
    return [cell.strip() for cell in line.split("|")[2:-1]]


def test_cells_go_from_the_minimum_to_the_maximum_of_the_seeds(runs):
    low = with_jmvae(sigma_norm={name: [0.4, 1.1, 1.6] for name in ("joint", "camera", "lidar")})
    agent = {**SUMMARY["dqn"]["lidar"], "optimal_states": 1600}
    low["dqn"] = {"camera": SUMMARY["dqn"]["camera"], "lidar": agent}
    found = gather([runs("paper", 100), runs("paper", 101, low), runs("default", 100)])
    table = tables.of_presets(found, rows.OF_README, ("paper", "default"))
    # The LiDAR of the summary tells the second class apart, and not the first.
    assert cells(table, "what each sensor") == ["9 cells", "8 of 9", "8 of 9"]
    assert cells(table, "sigma norm, unambiguous") == [
        "from 1.05", "0.40 to 1.60 (fitted)", "0.50 to 1.50",
    ]  # fmt: skip
    assert cells(table, "start states") == ["", "1,700; 1,600 to 1,700", "1,700; 1,700"]
    assert table.splitlines()[-1] == (
        "`python -m jaxsense.train --preset PRESET --seed S`, seeds 100 to 101: cpu with 2 cores; "
        "commit 0123456789 on 2026-11-26; python 3.11.7, jax 0.10.2, mujoco 3.17.0."
    )


def test_table_one_says_what_the_paper_says_and_how_many_cells_are_the_same(runs):
    found = gather([runs("paper", 100), runs("paper", 101)])
    table = tables.table_one(found, ("paper",))
    assert cells(table, "green cylinder (1)") == ["true", "false", "true"]
    assert cells(table, "red cylinder (2)") == ["false", "false", "true"]
    assert cells(table, "red cube (3)") == ["false", "true", "true"]
    assert "- `paper`, seeds 100 to 101: 8" in table.splitlines()


def test_cores_and_dates_stand_below_the_table_for_runs_that_note_them(runs):
    noted = {**SUMMARY, "cores": 16, "date": "2026-11-28"}
    later = {**noted, "date": "2026-11-29"}
    before = {name: x for name, x in SUMMARY.items() if name not in ("cores", "date")}
    of_each = enumerate((noted, later, before), 100)
    found = gather([runs("paper", seed, summary) for seed, summary in of_each])
    assert found["paper"]["100"]["cores"] == 16
    assert "date" not in found["paper"]["102"]
    last = tables.of_presets(found, rows.OF_README, ("paper",)).splitlines()[-1]
    assert ": cpu with 16 cores; commit 0123456789 on 2026-11-28 and 2026-11-29; python" in last


def test_columns_that_were_made_otherwise_tell_how_each_was(runs):
    later = {**SUMMARY, "date": "2026-11-29"}
    found = gather([runs("paper", 100), runs("paper", 101), runs("default", 100, later)])
    table = tables.of_presets(found, rows.OF_README, ("paper", "default"))
    where = "python 3.11.7, jax 0.10.2, mujoco 3.17.0."
    assert table.split("\n\n")[1:] == [
        "`python -m jaxsense.train --preset PRESET --seed S`:",
        "- `paper` preset, seeds 100 to 101: cpu with 2 cores; commit 0123456789 on 2026-11-26; "
        f"{where}\n"
        "- `default` preset, seed 100: cpu with 2 cores; commit 0123456789 on 2026-11-29; "
        f"{where}",
    ]


def test_columns_may_have_other_names_than_presets(runs):
    found = gather([runs("paper", 100)], "wider") | gather([runs("paper", 101)])
    heads = ("wider", "as it is")
    table = tables.of_presets(found, rows.OF_FIGURES[:2], ("wider", "paper"), heads)
    assert table.splitlines()[0] == "|  | paper | wider, seed 100 | as it is, seed 101 |"


def test_what_a_run_does_not_have_stays_empty(runs):
    scans = {**OF_SCANS, "belief": {**OF_SCANS["belief"], "nll": [0.5, 0.25]}}
    scans["mission"] = {**scans["mission"], "naive": CASE}
    labelled = {**SUMMARY, "mission": scans["mission"]}
    found = gather([runs("raw", 100, scans), runs("default", 100, labelled)])
    table = tables.of_presets(found, rows.OF_RAW, ("raw", "default"))
    assert cells(table, "right at held-out") == ["", f"{GROUPED['pair']:.4f}", ""]
    assert cells(table, "minimum share") == ["", "0.500", "0.500"]
    assert cells(table, "NLL after six")[1] == "-1.7500"
    assert cells(table, "time, median") == ["", "13.8 s, 13.8 s", "13.8 s, 13.8 s"]


def test_policies_stand_by_the_learned_one_with_all_seeds(runs):
    def evaluation(number, **times):
        gap = {"mean": 0.51, "low": -0.2, "high": 1.4}
        longer = dict.fromkeys(("accuracy", "observations_per_poi", "time_s"), gap)
        played = {
            name: {**CASE, "seed": 0, "mean_time_s": time}
            | ({"intervals": longer} if name == "auction" else {})
            for name, time in times.items()
        }
        return {**EVALUATION, "num_pois": number, "mission": {**EVALUATION["mission"], **played}}

    first = runs("many", 100, a=evaluation(8, latent=20.0, auction=19.0))
    second = runs("many", 101, a=evaluation(8, latent=10.0, auction=11.0, naive=8.0))
    # Another number of PoIs is another column; this one comes in two files.
    team = runs("team", 100, a=evaluation(16, latent=4.0), b=evaluation(16, latent=4.0, naive=6.0))
    found = gather([first, second, team])
    table = tables.worth(found, {("many", 8, 3): "`many`", ("team", 16, 3): "`team`"})
    assert cells(table, "policy") == ["`many`, seeds 100 to 101", "`team`, seed 100"]
    assert cells(table, "`latent`") == ["1.00; 1.7; 0.2 %", "1.00; 1.7; 0.2 %"]
    assert cells(table, "`auction`") == ["0.95 to 1.10; 1.7; 0.2 %", "not played"]
    assert cells(table, "`naive`") == ["0.80; 1.7; 0.2 %", "1.50; 1.7; 0.2 %"]
    assert "`random`" not in table
    shown = tables.missions(found, "many", 8, 3)
    assert cells(shown, "`latent`") == [
        "0.998", "1.68", "13.8 s", "10.0 to 20.0 s", "-0.001", "0.013", "",
    ]  # fmt: skip
    assert cells(shown, "`auction`")[-1] == "0.5 (-0.2 to 1.4); 0.5 (-0.2 to 1.4)"
    assert "--preset many" in shown.splitlines()[-1]
    # Evaluations tell how they were made; those that do not were made with their runs.
    assert "NVIDIA H200 with 16 cores; commit fedcba9876 on 2026-11-30" in shown.splitlines()[-1]
    for run in found["many"].values():
        del run["evaluations"]["a"]["origin"]
    shown = tables.missions(found, "many", 8, 3)
    assert "cpu with 2 cores; commit 0123456789 on 2026-11-26" in shown.splitlines()[-1]


def test_evaluations_of_one_run_are_by_one_commit(runs):
    mission = {"latent": CASE, "bytes_per_detection": BYTES}
    other = {
        **EVALUATION,
        "mission": mission,
        "origin": {**EVALUATION["origin"], "commit": "b" * 16},
    }
    found = gather([runs("many", 100, a={**EVALUATION, "mission": mission}, b=other)])
    with pytest.raises(ValueError, match=r"run 100 of many: evaluated by b+ and fedc.*one commit"):
        tables.missions(found, "many", 16, 3)


def test_teams_of_other_sizes_are_other_columns(runs):
    def evaluation(robots, accuracy):
        mission = {"latent": {**CASE, "accuracy": accuracy}, "bytes_per_detection": BYTES}
        return {**EVALUATION, "num_pois": 8, "robots": robots, "mission": mission}

    two, three = ["camera", "lidar"], ["camera", "camera", "lidar"]
    run = runs("team", 100, a=evaluation(two, 0.9), b=evaluation(three, 0.8))
    found = gather([run], "sizes")
    names = {("sizes", 8, 3): "three", ("sizes", 8, 2): "two"}
    assert cells(tables.worth(found, names), "`latent`") == [
        "1.00; 1.7; 20.0 %",
        "1.00; 1.7; 10.0 %",
    ]


def test_robots_that_fail_stand_below_those_that_work(runs):
    cases = {"latent": CASE, "auction": CASE, "camera_alone": {**CASE, "accuracy": 0.7}}
    cases["bytes_per_detection"] = BYTES
    run = runs("default", 100, a={**EVALUATION, "num_pois": 3, "mission": cases})
    table = tables.failures(gather([run]), "default", 3, 3)
    assert cells(table, "all work") == ["0.998", "1.68", "13.8 s", "14.5 s", "0"]
    assert cells(table, "camera alone")[0] == "0.700"
    assert "auction" not in table


def test_missions_of_trainings_stand_side_by_side(runs):
    table = tables.of_missions(gather([runs("default", 100)]), "default")
    assert cells(table, "time, mean") == ["14.5 s"]
    assert "--mission.episodes 128`" in table


def test_two_runs_of_a_seed_are_refused(runs, tmp_path):
    run = runs("paper", 100)
    with pytest.raises(ConfigError, match="is a second run of its group and seed"):
        gather([run, run])


def test_the_program_writes_what_it_gathers(runs, tmp_path):
    run, out = runs("paper", 100), tmp_path / "seeds.json"
    program.main([str(run), "--out", str(out)])
    assert json.loads(out.read_text()) == json.loads(json.dumps(gather([run])))


def test_runs_with_other_settings_are_a_group_of_their_own(runs, tmp_path):
    out = tmp_path / "seeds.json"
    program.main([str(runs("paper", 100)), "--out", str(out)])
    program.main([str(runs("paper", 101)), "--group", "wider", "--out", str(out)])
    found = json.loads(out.read_text())
    assert {name: [*of_seeds] for name, of_seeds in found.items()} == {
        "paper": ["100"], "wider": ["101"],
    }  # fmt: skip


def test_the_program_replaces_runs_and_keeps_others(runs, tmp_path):
    out = tmp_path / "seeds.json"
    old = {"many": {"100": "old"}, "paper": {"100": "old", "101": "old"}}
    out.write_text(json.dumps(old))
    program.main([str(runs("paper", 101)), str(runs("default", 100)), "--out", str(out)])
    found = json.loads(out.read_text())
    assert [*found] == ["default", "many", "paper"]
    assert found["many"] == old["many"]
    assert found["paper"]["100"] == "old"
    assert (
        found["paper"]["101"]["commit"] == found["default"]["100"]["commit"] == "0123456789abcdef"
    )


def test_a_zero_has_no_sign():
    assert tables._range("{:.3f}", [-0.0001, 0.002]) == "0.000 to 0.002"
    assert tables._range("{:.1f} s", [-0.01]) == "0.0 s"
    assert tables._range("{:.1f}", [-0.06]) == "-0.1"
