"""`doctor --motion` as its user starts it: a joint that is right, one with a wrong sign, and every way to end it."""

from __future__ import annotations

import os
import signal
from typing import Any

from tests.python_process import eventually


def test_a_joint_that_is_right_and_one_whose_file_is_wrong_about_its_torque(bench: Any) -> None:
    right = bench.with_joint()
    done = bench.run("doctor", right, "--motion", "-y", env={**os.environ, "COLUMNS": "200"})
    assert done.code == 0, done.err + done.out
    assert "the joint moved with the torque" in done.out
    assert bench.disabled()
    wrong = bench.config("wrong.toml", drive__torque_direction=-1)
    done = bench.start("doctor", wrong, "--motion", "-y", "--json").finished()
    assert done.code == 1, done.err
    assert "moved against the torque" in done.out
    assert "else drive.torque_direction" in done.out
    assert bench.disabled()


def test_it_asks_and_ctrl_c_and_the_loss_of_the_watcher_end_it_safely(bench: Any) -> None:
    config = bench.with_joint()
    bench.start("doctor", config, "--motion").finished().refused(2, "there is no terminal to ask on")
    check = bench.start("doctor", config, "--motion", "-y").saw("  tracking")
    check.signal(signal.SIGINT, group=True)
    done = check.finished(20.0)
    assert (done.code, "nothing was judged" in done.err) == (130, True), done.err
    assert bench.disabled()
    check = bench.start("doctor", config, "--motion", "-y").saw("  tracking")
    loop = check.child("loop_process")
    os.kill(check.process.pid, signal.SIGKILL)
    eventually(lambda: not os.path.exists(f"/proc/{loop}"), 20.0)
    assert bench.disabled()
