"""What the parser of the command line does not understand: one line and a hint, exit code 2."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


def run(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "jointctl.tools.cli", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60.0, env={**os.environ, "COLUMNS": "40"})


@pytest.mark.parametrize(
    ("words", "parts", "verb"),
    [
        (["rum", "virtual"], ["rum"], ""),
        (["run"], ["CONFIG"], "run "),
        (["run", "virtual", "-t", "200"], ["--target", "127"], "run "),
        (["run", "virtual", "--frobnicate"], ["--frobnicate"], "run "),
        (["run", "virtual", "extra"], ["extra"], "run "),
        (["demo", "--duration", "x"], ["--duration"], "demo "),
        (["log", "foo"], ["foo"], "log "),
        (["fault-campaign", "--scenario", "-1"], ["--scenario", "0"], "fault-campaign "),
        (["fault-campaign", "--scenario", str(2**31)], ["--scenario", str(2**31 - 1)], "fault-campaign "),
        (["fault-campaign", "--seed", "-1"], ["--seed", "0"], "fault-campaign "),
    ],
)
def test_it_is_one_line_and_a_hint(words: list[str], parts: list[str], verb: str) -> None:
    done = run(*words)
    assert done.returncode == 2
    error, hint = done.stderr.splitlines()
    assert error.startswith("error: ")
    assert all(part in error for part in parts), error
    assert hint.startswith("hint: `")
    assert f"{verb}--help` shows what there is" in hint


@pytest.mark.parametrize("words", [[], ["log"], ["params"]])
def test_without_a_verb_the_help_is_shown(words: list[str]) -> None:
    done = run(*words)
    assert done.returncode == 2
    assert "Usage:" in done.stdout
    assert done.stderr == ""


def test_help_is_no_error() -> None:
    assert run("run", "--help").returncode == 0
