"""The programs of examples/, and the blocks of docs/python.md that need no drive, run as they are."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.places import ROOT

BLOCKS = re.findall(r"\n\n((?:    .*\n|\n)+)", (ROOT / "docs" / "python.md").read_text())


def ran(folder: Path, *command: str) -> str:
    done = subprocess.run([sys.executable, "-P", *command], cwd=folder, capture_output=True, text=True, timeout=300.0)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_own_law(tmp_path: Path) -> None:
    lines = ran(tmp_path, str(ROOT / "examples" / "own_law.py")).splitlines()
    own, configured = (float(line.split()[-2]) for line in lines)
    assert configured < 0.5 * own < 5.0


def test_at_simulated_time(tmp_path: Path) -> None:
    blocks = [re.sub(r"^    ", "", block, flags=re.M) for block in BLOCKS]
    (first,) = (block for block in blocks if "lockstep=True" in block)
    (law,) = (block for block in blocks if "step_torque" in block)
    indented = re.sub(r"^(?=.)", "    ", law, flags=re.M)
    out = ran(tmp_path, "-c", f"import jointctl\n{first}\n{indented}\n    print(state.position_rad - target_rad)")
    error_rad, off_rad = (float(line) for line in out.splitlines())
    assert error_rad < 2e-3
    assert off_rad == pytest.approx(0.0, abs=5e-3)


@pytest.mark.realtime
def test_set_points_in_real_time(tmp_path: Path) -> None:
    out = ran(tmp_path, str(ROOT / "examples" / "stream.py"))
    assert "rad, tracking" in out
    assert len(list((tmp_path / "runs").glob("*.mcap"))) == 1
