"""Options and files that cannot be used: one line, status 2, and nothing is changed."""

import ast
import time
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import pytest
from refusals import NUMBERS, SMOKE, check_message
from smoke import contents, error_line, written_run
from untrained import blank

import jaxsense
from benchmarks import __main__ as benchmarks
from jaxsense import ConfigError, evaluate, export, train
from jaxsense.run import pipeline
from jaxsense.run.files import WriteError
from jaxsense.run.monitor import StageError

SECONDS = 10.0


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The directory of a run that trained nothing, without a summary."""
    return written_run(tmp_path_factory.mktemp("runs") / "run", SMOKE, blank(SMOKE))


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The working directory, with things in it that are not to be touched."""
    (tmp_path / "file").write_text("precious")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "kept").write_text("precious")
    texts = {
        "utf16": '{"seed": 1}'.encode("utf-16"),
        "deep": b"[" * 100_000,
        "twice": b'{"preset": "smoke", "seed": 1, "seed": 2}',
        "nan": b'{"config": {"jmvae": {"beta": NaN}}}',
        "float": b'{"seed": 1.0}',
        "field": b'{"config": {"dqn": {"epoch": 3}}}',
        "unknown": b'{"colour": 3}',
        "preset": b'{"preset": "x"}',
        "smoke": b'{"preset": "smoke"}',
        "sensor": b'{"config": {"sensors": {"x": {"make": "a:b"}}}}',
    }
    tables = {"deep": b"x = " + b"[" * 100_000, "twice": b"seed = 1\nseed = 2", "utf16": b"\xff"}
    tables |= {"date": b"seed = 2020-01-01", "field": b"[config.dqn]\nepoch = 3"}
    for ending, files in (("json", texts), ("toml", tables)):
        for name, text in files.items():
            (tmp_path / f"{name}.{ending}").write_bytes(text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refusal(program, argv, place, capsys) -> str:
    """What a command says that refuses its options: status 2, one line, and nothing changed."""
    before, begin = contents(place), time.perf_counter()
    line = error_line(argv, capsys, program)
    assert time.perf_counter() - begin < SECONDS
    assert contents(place) == before
    check_message(line)
    return line


TRAIN = [
    (["--seed"], "option = '--seed': expected one argument"),
    (["--seed", "-1"], "seed = -1: must be a whole number, from 0 to 4,294,967,295"),
    (["--num-seeds", "0"], "num_seeds = 0: must be a whole number, from 1 to 10,000"),
    (["--num-seeds", "2", "--seed", str(2**32 - 1)], "num_seeds = 2: leads beyond seed 2^32"),
    (["--cache", 300 * "x"], "cache = 'xxx"),
    (["--preset", ""], "preset = '': must be one of default, paper, noisy, many, raw, team"),
    (["--out", ""], "out = '': must be a path"),
    (["--out", "a\nb"], "out = 'a\\nb': must be a path of printable characters"),
    (["--cache", "file"], "cache = 'file': must be a directory"),
    (["--config", "full"], "config = 'full': full cannot be read (Is a directory)"),
    (["--config", "utf16.json"], "utf16.json is not JSON"),
    (["--config", "deep.json"], "deep.json is not JSON: nested too deeply"),
    (["--config", "twice.json"], "twice.json is not JSON: 'seed' appears twice"),
    (["--config", "nan.json"], "jmvae.beta = nan: must be a number"),
    (["--config", "float.json"], "seed = 1.0: must be a whole number"),
    (["--config", "field.json"], "dqn.epoch = 3: unknown setting; did you mean dqn.epochs?"),
    (["--config", "deep.toml"], "deep.toml is not TOML: nested too deeply"),
    (["--config", "twice.toml"], "twice.toml is not TOML: Cannot overwrite a value"),
    (["--config", "utf16.toml"], "utf16.toml is not TOML: 'utf-8' codec"),
    (["--config", "date.toml"], "seed = datetime.date(2020, 1, 1): must be a whole number"),
    (["--config", "field.toml"], "dqn.epoch = 3: unknown setting; did you mean dqn.epochs?"),
    (["--config", "preset.json"], "preset = 'x': must be one of default, paper"),
    (["--config", "smoke.json", "--preset", "paper"], "has a preset; omit --preset"),
    (["--config", "unknown.json"], "colour = 3: unknown field of a config.json"),
    (["--config", "sensor.json"], "sensors.x = {'make': 'a:b'}: missing setting attribute"),
    (["--resume", "full"], "resume = 'full': is not a run directory: it has no config.json"),
    (["--dqn.epochs", "1e3"], "dqn.epochs = '1e3': must be a whole number"),
    (["--team.second-cos", "1"], "; did you mean --team.second-cost?"),
    (["--mdp.no-partly-seen-starts"], "; did you mean --no-mdp.partly-seen-starts?"),
    (["--team.num-pois", "3"], "option = '--team.num-pois': expected 2 arguments"),
    (
        ["--mdp.partly-seen-starts", "maybe"],
        "option = 'maybe': unexpected argument: options start with --",
    ),
    (["--dqn.epoch", "3"], "option = '--dqn.epoch': is unknown; did you mean --dqn.epochs?"),
    (["-=\u202e"], "option = '-': is unknown; see"),
    (["-\u202e"], r"option = '-\u202e': is unknown; see"),
    (["smoke"], "option = 'smoke': unexpected argument"),
]


@pytest.mark.parametrize(("argv", "expected"), TRAIN, ids=count())
def test_train_refuses(argv, expected, place, capsys):
    base = [] if {"--config", "--resume", "--preset"} & set(argv) else ["--preset", "smoke"]
    out = [] if {"--out", "--resume"} & set(argv) else ["--out", "run"]
    assert expected in refusal(train, [*base, *out, *argv], place, capsys)


@pytest.mark.parametrize(("section", "name"), NUMBERS[::40])
@pytest.mark.parametrize("text", ["nan", "x"])
def test_train_refuses_numbers(section, name, text, place, capsys):
    option = f"--{section}.{name.replace('_', '-')}"
    line = refusal(train, ["--preset", "smoke", "--out", "run", option, text], place, capsys)
    assert line.startswith(f"jaxsense.train: {section}.{name} = ")


OTHERS = [
    (
        evaluate,
        [],
        "option = 'RUN': is missing: The directory of a finished run, e.g. runs/20261123-190025-d",
    ),
    (evaluate, ["pretrained:noisy"], "run = 'pretrained:noisy': only names models; must be a"),
    (export, ["noisy"], "run = 'noisy': is not a run directory: it has no config.json"),
    (evaluate, ["RUN"], "is not finished: it has no summary.json; continue it with python -m "),
    (
        evaluate,
        ["RUN", "--episodes", "0"],
        "episodes = 0: must be a whole number, from 1 to 100,000",
    ),
    (evaluate, ["RUN", "--policy", "sonar_alone"], "policy = 'sonar_alone': must be one of"),
    (
        evaluate,
        ["RUN", "--arena.num-pois", "4"],
        "arena.num_pois = 4: must be 3, as in training; others need dqn.task = team",
    ),
    (
        evaluate,
        ["RUN", "--robots", "camera", "camera", "--policy", "camera_alone"],
        "policy = 'camera_alone': must be one of all, policies, latent",
    ),
    (export, ["RUN", "--out", "full"], "out = 'full': already exists; must be a new file"),
    (export, ["RUN", "--out", "file/x"], "out = 'file/x': cannot be written (Not a directory)"),
    (benchmarks, ["--quick", "--json", "file"], "json = 'file': already exists; must be new"),
]


@pytest.mark.parametrize(("program", "argv", "expected"), OTHERS, ids=count())
def test_other_commands_refuse(program, argv, expected, run, place, capsys):
    argv = [str(run) if word == "RUN" else word for word in argv]
    before = contents(run)
    assert expected in refusal(program, argv, place, capsys)
    assert contents(run) == before


@pytest.mark.parametrize("summary", [b"{}", b"\xff"])
def test_evaluate_refuses_a_broken_summary(summary, run, capsys):
    (run / "summary.json").write_bytes(summary)
    told = refusal(evaluate, [str(run)], run, capsys)
    (run / "summary.json").unlink()
    assert "must hold the summary.json of a finished run" in told


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (StageError("jmvae: the loss of step 3 is not finite"), "jmvae: the loss of step 3 is not"),
        (WriteError(28, "No space left on device", "x"), "cannot write x: No space left on device"),
        (
            PermissionError(13, "Permission denied", "x"),
            "train: x: cannot be used (Perm",
        ),
        (OSError("Orbax, in\ntwo lines"), "train: Orbax, in two lines"),
        (ConfigError("checkpoint", "x", "is damaged"), "train: checkpoint = 'x': is damaged"),
    ],
)
def test_what_ends_a_run_is_told_without_advice(error, expected, tmp_path, capsys, monkeypatch):
    def fails(*_):
        raise error

    programs = lambda config, compiler, *_: SimpleNamespace(monitor=compiler.monitor)  # noqa: E731
    monkeypatch.setattr(train, "Programs", programs)
    monkeypatch.setattr(pipeline, "learn", fails)
    argv = ["--preset", "smoke", "--quiet", "--cache", "None", "--out", str(tmp_path / "run")]
    line = error_line(argv, capsys)
    assert expected in line
    assert "--help" not in line


def test_text_is_read_and_written_as_utf_8():
    """What a file holds must not depend on the locale."""
    for file in sorted(Path(jaxsense.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            if node.func.attr in ("read_text", "write_text", "open"):
                named = {keyword.arg for keyword in node.keywords}
                is_binary = any("b" in str(getattr(arg, "value", "")) for arg in node.args)
                is_of_zip = ast.unparse(node.func) == "files.open"  # always binary
                assert "encoding" in named or is_binary or is_of_zip, f"{file}:{node.lineno}"
