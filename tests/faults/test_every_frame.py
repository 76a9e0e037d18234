"""A stop, a death, another controller or a loss, or two, after a sample of the frames of a joint's or an arm's run.

The whole, after every frame: tests/bench/every_frame.py.
"""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from tests.places import ROOT

# every so many of the frames, and the seed of a second injection
SAMPLE = {
    ("run", "yes"): ("110", "0"), ("run", "no"): ("230", ""), ("program", "no"): ("110", "1"),
    ("arm", "yes"): ("700", "2"),
}  # fmt: skip


@pytest.mark.parametrize(("kind", "deadline"), SAMPLE)
def test_after_any_frame_the_joint_is_off_in_time_and_stays_off(kind: str, deadline: str) -> None:
    """`deadline`: whether the drive has 1400:5.  Of an arm every drive must be off."""
    command = [sys.executable, str(ROOT / "tests" / "bench" / "every_frame.py"), "--kind", kind]
    every, pairs = SAMPLE[kind, deadline]
    command += ["--deadline", deadline, "--every", every, "--workers", "1"]
    command += ["--pairs", pairs] if pairs else []
    done = subprocess.run(command, capture_output=True, text=True, timeout=600.0, check=False)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    found = re.search(r"^(\d+) injections", done.stdout, re.MULTILINE)
    assert found is not None
    assert int(found[1]) >= 17 * 5
    assert done.stdout.rstrip().endswith("0 violations")
