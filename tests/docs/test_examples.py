"""The programs of examples/ run as they are, and a log as docs/python.md reads it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.places import ROOT

PAGE = (ROOT / "docs" / "python.md").read_text()
BLOCKS = re.findall(r"^```python\n(.*?)\n```$", PAGE, re.MULTILINE | re.DOTALL)


def ran(folder: Path, *command: str) -> str:
    done = subprocess.run([sys.executable, "-P", *command], cwd=folder, capture_output=True, text=True, timeout=300.0)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_own_law(tmp_path: Path) -> None:
    lines = ran(tmp_path, str(ROOT / "examples" / "own_law.py")).splitlines()
    own, configured = (float(line.split()[-2]) for line in lines)
    assert configured < 0.5 * own < 5.0


def test_an_arm(tmp_path: Path) -> None:
    *joints, phase = ran(tmp_path, str(ROOT / "examples" / "arm.py")).splitlines()
    assert [line.split()[0] for line in joints] == ["shoulder", "elbow", "wrist"]
    assert all(float(line.split()[1]) < 0.5 for line in joints)
    assert phase == "finished"


def test_an_arm_as_the_page_shows_it(tmp_path: Path) -> None:
    (block,) = (block for block in BLOCKS if "jointctl.Arm(" in block)
    out = ran(tmp_path, "-c", f"import jointctl\n{block}\nprint(moved.shape[1], arm.state.phase)")
    assert out.splitlines()[-1] == "3 finished"


@pytest.mark.realtime
def test_set_points_in_real_time(tmp_path: Path) -> None:
    out = ran(tmp_path, str(ROOT / "examples" / "stream.py"))
    assert "rad, tracking" in out
    assert len(list((tmp_path / "runs").glob("*.mcap"))) == 1


@pytest.mark.realtime
def test_a_log_in_pandas(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    (block,) = (block for block in BLOCKS if "to_pandas" in block)
    program = f"""import jointctl, pandas as pd
with jointctl.Joint("virtual") as joint:
    joint.enable()
    joint.move_to(0.2, duration_s=1.0)
{block.replace('"runs/x.mcap"', "joint.log_path")}
assert len(table) == len(log.records) > 1000
assert abs(table.position_rad.iloc[-1] - 0.2) < 1e-2
"""
    assert "position_rad" in ran(tmp_path, "-c", program)
