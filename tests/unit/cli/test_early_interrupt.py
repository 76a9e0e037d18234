"""Ctrl-C before a verb has begun, and in the worker processes of one."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time

import pytest

from jointctl.tools.simulation.child_process import interrupts_left_to_the_parent

STUCK = (
    "import sys, time, types; sys.modules['typer'] = slow = types.ModuleType('typer');"
    "slow.__getattr__ = lambda name: (print('importing', flush=True), time.sleep(60));"
    "import jointctl.tools.cli.start as start; start.main()"
)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, -signal.SIGINT), (signal.SIGTERM, -signal.SIGTERM)])
def test_during_the_imports_it_ends_without_a_traceback(number: signal.Signals, code: int) -> None:
    started = subprocess.Popen([sys.executable, "-c", STUCK], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert started.stdout is not None
    assert started.stdout.readline() == "importing\n"
    started.send_signal(number)
    assert started.communicate(timeout=20.0)[1] == ""
    assert started.returncode == code


def test_where_it_is_ignored_it_stays_ignored() -> None:
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); import sys; sys.argv = ['jointctl', '--version'];"
        "import jointctl.tools.cli.start as start, atexit;"
        "atexit.register(lambda: print(signal.getsignal(signal.SIGINT).name)); start.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60.0)
    assert done.stdout.splitlines()[-1] == "SIG_IGN", done.stderr


def test_a_verb_has_the_handler_of_python_again() -> None:
    code = (
        "import sys, signal; sys.argv = ['jointctl', '--version'];"
        "import jointctl.tools.cli.start as start, atexit;"
        "atexit.register(lambda: print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)); start.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60.0)
    assert done.stdout.splitlines()[-1] == "True", done.stderr


def _held_back() -> bool:
    os.kill(os.getpid(), signal.SIGINT)
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def test_workers_hold_it_back_and_the_parent_gets_it() -> None:
    context = multiprocessing.get_context("spawn")
    with interrupts_left_to_the_parent():
        pool = context.Pool(1)
    with pool:
        assert pool.apply(_held_back)
    with pytest.raises(KeyboardInterrupt):  # noqa: PT012
        with interrupts_left_to_the_parent():
            os.kill(os.getpid(), signal.SIGINT)
            held = True
        assert held
        time.sleep(1.0)
