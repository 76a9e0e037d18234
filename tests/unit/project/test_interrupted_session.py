"""A session of tests that was started with `nohup` or `&` can still interrupt what it starts."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.places import ROOT

ASK = "import signal; raise SystemExit(signal.getsignal(signal.SIGINT) is not signal.default_int_handler)"
IGNORED = ("sh", "-c", 'trap "" INT; exec "$@"', "sh")


def test_a_process_of_the_tests_can_be_interrupted() -> None:
    assert subprocess.run([sys.executable, "-c", ASK], check=False).returncode == 0


def test_sigint_ignored_is_passed_on_otherwise() -> None:
    assert subprocess.run([*IGNORED, sys.executable, "-c", ASK], check=False).returncode == 1


def test_the_first_holds_in_a_session_that_was_started_with_sigint_ignored() -> None:
    chosen = f"{Path(__file__).resolve()}::{test_a_process_of_the_tests_can_be_interrupted.__name__}"
    command = [*IGNORED, sys.executable, "-m", "pytest", "-n0", "-p", "no:cacheprovider", chosen]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout
