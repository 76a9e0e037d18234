"""A session of tests that was started with `nohup` or `&` can still interrupt what it starts."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from tests.conftest import pytest_configure

ASK = "import signal; raise SystemExit(signal.getsignal(signal.SIGINT) is not signal.default_int_handler)"


@pytest.mark.parametrize("configured", [False, True])
def test_sigint_ignored_is_passed_on_unless_the_session_was_configured(configured: bool) -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        if configured:
            pytest_configure()
        assert subprocess.run([sys.executable, "-c", ASK], check=False).returncode == (0 if configured else 1)
    finally:
        signal.signal(signal.SIGINT, before)
