"""Verbs that need no bus run where Linux' own calls are missing (`elsewhere/sitecustomize.py` hides them)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from jointctl.tools.experiments.paper_experiments import synthetic_sweep
from tests.places import ROOT

HIDING = ROOT / "tests" / "unit" / "project" / "elsewhere"
LOG = ROOT / "tests" / "unit" / "recording" / "older_version.mcap"
FORMAT = ("--velocity-column", "velocity", "--torque-column", "torque", "--velocity-unit", "rad/s", "--side", "joint",
          "--torque-side", "motor", "--ratio", "121")  # fmt: skip


def python(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(HIDING), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, "JOINTCTL_TRACEBACK": "1"}
    command = [sys.executable, "-P", *words]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=540.0)


VERBS = [
    (["identify", "sweep.csv", *FORMAT, "--particles", "40", "--iterations", "40"], "sweep.friction.toml"),
    (["validate", "paper", "sweep.csv", *FORMAT], "sweep.validation.png"),
    (["check", "virtual", "--figure", "loop.png"], "loop.png"),
    (["report", str(LOG), "-o", "run.html"], "run.html"),
    (["log", "plot", str(LOG), "-o", "run.png"], "run.png"),
    (["log", "export", str(LOG), "--format", "csv", "-o", "run.csv"], "run.csv"),
    (["study", "--plants", "2", "--workers", "2", "--controller", "pid", "--csv", "study.csv"], "study.csv"),
]
# all of them in one process: most of the time of each is that of its imports
RUN = (
    "import json, sys; from typer.testing import CliRunner; from jointctl.tools.verbs.main import app\n"
    "for words in json.loads(sys.argv[1]):\n"
    "    done = CliRunner().invoke(app, words)\n"
    "    print(json.dumps([words, done.exit_code, repr(done.exception), done.output]), flush=True)"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("elsewhere")
    sweep = synthetic_sweep()
    rows = zip(sweep.velocity_radps, sweep.motor_torque_Nm, strict=True)
    (found / "sweep.csv").write_text("velocity,torque\n" + "".join(f"{speed},{torque}\n" for speed, torque in rows))
    return found


@pytest.fixture(scope="module")
def ended(folder: Path) -> dict[str, tuple[int, str, str]]:
    """How each verb has ended: exit code, error, what it printed; by its words."""
    done = python(folder, "-c", RUN, json.dumps([words for words, _ in VERBS]))
    assert done.returncode == 0, done.stderr
    return {str(words): (code, error, shown) for words, code, error, shown in map(json.loads, done.stdout.splitlines())}


@pytest.mark.parametrize(("words", "written"), VERBS)
def test_a_verb_without_a_bus_needs_nothing_of_linux(
    folder: Path, ended: dict[str, tuple[int, str, str]], words: list[str], written: str
) -> None:
    code, error, shown = ended[str(words)]
    assert code == 0, f"{error}\n{shown}"
    assert (folder / written).exists()


@pytest.mark.parametrize(
    "words",
    [
        ["log", "info", str(LOG)],
        pytest.param(["paper", "--no-identification"], marks=pytest.mark.slow("all experiments of the paper")),
    ],
)
def test_nor_does_the_program_that_begins_with_it(folder: Path, words: list[str]) -> None:
    done = python(folder, "-m", "jointctl.tools.verbs", *words)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "code",
    [
        "import fcntl", "import os; os.uname", "from os import memfd_create", "import signal; signal.SIGKILL",
        "import os; os.sched_getaffinity", "import socket; socket.AF_CAN", "from socket import AF_UNIX",
        "import time; time.clock_gettime_ns", "import ctypes; ctypes.CDLL(None)", "open('/proc/self/stat')",
        "import os; os.O_CLOEXEC",
    ],
)  # fmt: skip
def test_it_is_really_hidden_from_jointctl_and_from_nobody_else(tmp_path: Path, code: str) -> None:
    ours = f"import sys; exec({code!r}, {{'__name__': 'jointctl.tools.anything'}})"
    assert python(tmp_path, "-c", ours).returncode == 1
    if "/proc" not in code:
        assert python(tmp_path, "-c", code).returncode == 0
