"""Processes that share a run give what one process gives."""

import os
import re
import signal
import socket
import subprocess
import sys
import time

import jax
import pytest
from same_figures import different_across_compilers
from smoke import without_times

from jaxsense import train
from jaxsense.config import ConfigError
from jaxsense.run import devices

TRAIN = [sys.executable, "-m", "jaxsense.train", "--quiet", "--cache", "None"]


def free_port():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return free.getsockname()[1]


def two_processes(options):
    """Two processes that share a run."""
    address = f"localhost:{free_port()}"
    shared = [*TRAIN, *options, "--coordinator", address, "--num-processes", "2"]
    return [
        subprocess.Popen(
            [*shared, "--process-index", str(i)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # Both write what these tests compile to one cache, and JAX warns where they meet.
            env={**os.environ, "PYTHONWARNINGS": "ignore::UserWarning"},
        )
        for i in range(2)
    ]


@pytest.mark.slow  # two processes compile a whole run
def test_two_processes_share_a_run(tmp_path):
    alone, smoke = tmp_path / "alone", ["--preset", "smoke"]
    subprocess.run([*TRAIN, *smoke, "--out", str(alone)], check=True, stdout=subprocess.DEVNULL)
    processes = two_processes([*smoke, "--out", str(tmp_path / "shared")])
    ended = [process.communicate(timeout=600) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], ended
    assert "Results are in" in ended[0][0]
    assert "Results are in" not in ended[1][0]
    found, expected = (without_times(tmp_path / name) for name in ("shared", "alone"))
    assert not different_across_compilers(found, expected)
    assert found["mission"]["naive"]["episodes"] == 4


@pytest.mark.slow
def test_a_process_without_a_device_is_refused_in_all_processes(tmp_path):
    out = tmp_path / "run"
    processes = two_processes(["--preset", "smoke", "--devices", "1", "--out", str(out)])
    ended = [process.communicate(timeout=100) for process in processes]
    assert [process.returncode for process in processes] == [2, 2], ended
    assert all("devices = 1: must be from 2 to 2" in errors for _, errors in ended)
    assert not out.exists()


@pytest.mark.slow  # two processes compile three runs
def test_two_processes_stop_and_resume_several_seeds(tmp_path):
    seeds = tmp_path / "seeds"
    processes = two_processes(["--preset", "smoke", "--num-seeds", "2", "--out", str(seeds)])
    # The first seed is finished, the second one not, when both are asked to stop.
    metrics = seeds / "seed-1" / "metrics.jsonl"
    while not (metrics.exists() and "dqn" in metrics.read_text()):
        assert [process.poll() for process in processes] == [None, None]
        time.sleep(0.05)
    for process in processes:
        process.send_signal(signal.SIGTERM)
    ended = [process.communicate(timeout=100) for process in processes]
    assert [process.returncode for process in processes] == [130, 130], ended
    assert ended[0][1].startswith("Stopped; all training so far is saved.")
    assert ended[1][1] == ""
    assert (seeds / "seed-0" / "summary.json").exists()
    processes = two_processes(["--resume", str(seeds)])
    ended = [process.communicate(timeout=600) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], ended
    alone = tmp_path / "alone"
    smoke = ["--preset", "smoke", "--seed", "1", "--out", str(alone)]
    subprocess.run([*TRAIN, *smoke], check=True, stdout=subprocess.DEVNULL)
    assert not different_across_compilers(without_times(seeds / "seed-1"), without_times(alone))


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (("localhost:1", None, 0), "coordinator = 'localhost:1': also needs --num-processes"),
        ((None, 2, 0), "num_processes = 2: also needs --coordinator"),
        (("localhost", 2, 0), "coordinator = 'localhost': must be HOST:PORT"),
        (("localhost:99999", 2, 0), "must be HOST:PORT, with a port from 1 to 65535"),
        (("no.host.invalid:1", 2, 1), "coordinator = 'no.host.invalid:1': cannot be found"),
        (("localhost:1", 2, 2), "process_index = 2: must be from 0 to 1"),
    ],
)
def test_processes_that_cannot_be_are_named(given, expected, capsys):
    with pytest.raises(ConfigError, match=re.escape(expected)):
        devices.join(*given)
    assert capsys.readouterr().out == ""


def test_who_waits_says_so_and_gives_up(monkeypatch, capsys):
    monkeypatch.setattr(devices, "_JOIN_TIMEOUT", 0.5)
    monkeypatch.setattr(jax.distributed, "initialize", lambda *_, **__: time.sleep(9))
    with pytest.raises(ConfigError, match="not all 2 processes have joined within"):
        devices.join("localhost:1", 2, 0)
    assert capsys.readouterr().out == "Waiting for the other processes at localhost:1.\n"


def test_the_first_process_listens_and_who_cannot_join_says_why(monkeypatch, capsys):
    asked = []
    note = lambda *given, **more: asked.append((*given, *more.values()))  # noqa: E731
    monkeypatch.setattr(jax.distributed, "initialize", note)
    devices.join("localhost:1", 1, 0, quiet=True)
    devices.join("localhost:1", 2, 1)
    timeout = 2 * devices._JOIN_TIMEOUT
    assert asked[0] == ("localhost:1", 1, 0, "localhost:1", timeout)
    assert asked[1] == ("localhost:1", 2, 1, None, timeout)
    assert capsys.readouterr().out.count("Waiting") == 1

    def fail(*_, **__):
        raise RuntimeError("no such host\nat all")

    monkeypatch.setattr(jax.distributed, "initialize", fail)
    with pytest.raises(ConfigError, match=r"cannot be joined \(no such host\)$"):
        devices.join("localhost:1", 2, 1, quiet=True)


LISTENS = """
import socket, sys
from jaxsense.run import devices
port = int(sys.argv[1])
devices.join(f"127.0.0.1:{port}", 1, 0, quiet=True)
socket.create_connection(("127.0.0.1", port), timeout=5).close()
try:
    socket.create_connection(("127.0.0.2", port), timeout=5)
except ConnectionRefusedError:
    print("refused")
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="has one loopback address")
def test_the_first_process_listens_at_its_address_alone():
    command = [sys.executable, "-c", LISTENS, str(free_port())]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (0, "refused\n"), ended.stderr


@pytest.mark.slow
def test_ctrl_c_ends_a_process_that_waits_for_the_others(tmp_path):
    shared = ["--coordinator", f"localhost:{free_port()}", "--num-processes", "2"]
    command = [sys.executable, "-m", "jaxsense.train", "--cache", "None", "--preset", "smoke"]
    out = tmp_path / "run"
    process = subprocess.Popen(
        [*command, *shared, "--process-index", "0", "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline().startswith("Waiting for the other processes at localhost:")
    time.sleep(1)
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=20) == ("", "Interrupted.\n")
    assert process.returncode == 130
    assert not out.exists()


def test_the_first_process_checks_its_options_before_others_join(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(devices, "join", lambda *_, **__: pytest.fail("joined"))
    (tmp_path / "file").write_text("precious")
    shared = ["--coordinator", "localhost:1", "--num-processes", "2", "--process-index", "0"]
    for options, expected in (
        (["--out", str(tmp_path)], "is not empty"),
        (["--devices", "999"], "devices = 999: must be a whole number, from 1 to 256"),
        (["--resume", str(tmp_path)], "is not a run directory"),
    ):
        with pytest.raises(SystemExit):
            train.main([*shared, *options])
        assert expected in capsys.readouterr().err
