"""The programs of examples/, the notebook, and the blocks of docs/python.md that are its cells."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.places import ROOT

PAGE = (ROOT / "docs" / "python.md").read_text()
BLOCKS = re.findall(r"^```python\n(.*?)\n```$", PAGE, re.MULTILINE | re.DOTALL)
LARGEST_PICTURE_BYTES = 60_000


def ran(folder: Path, *command: str) -> str:
    done = subprocess.run([sys.executable, "-P", *command], cwd=folder, capture_output=True, text=True, timeout=300.0)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_own_law(tmp_path: Path) -> None:
    lines = ran(tmp_path, str(ROOT / "examples" / "own_law.py")).splitlines()
    own, configured = (float(line.split()[-2]) for line in lines)
    assert configured < 0.5 * own < 5.0


@pytest.fixture(scope="module")
def notebook() -> Any:
    nbformat = pytest.importorskip("nbformat")
    return nbformat.read(ROOT / "examples" / "joint.ipynb", as_version=4)


def test_the_notebook_holds_no_outputs(notebook: Any) -> None:
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert len(code) > 8
    assert [cell.outputs for cell in code if cell.outputs or cell.execution_count] == []


def test_the_tutorial_is_made_of_cells_of_the_notebook(notebook: Any) -> None:
    """Those with a joint at simulated time; what the page shows is what runs there."""
    cells = [cell.source for cell in notebook.cells]
    shown = [block for block in BLOCKS if "lockstep=True) as" in block]
    assert len(shown) == 4
    assert [block for block in shown if block not in cells] == []


def test_the_notebook_runs_and_draws_the_pictures_of_the_page(tmp_path: Path) -> None:
    pytest.importorskip("nbclient")
    pictures = runpy.run_path(str(ROOT / "docs" / "pictures.py"))["pictures"]
    drawn: Iterator[tuple[str, bytes]] = pictures(tmp_path)
    sizes = {name: len(png) for name, png in drawn}
    assert set(sizes) == set(re.findall(r"\((python-[a-z-]+\.png)\)", PAGE))
    kept = {name: (ROOT / "docs" / name).stat().st_size for name in sizes}
    assert max(kept.values()) < LARGEST_PICTURE_BYTES
    assert all(0.5 < kept[name] / size < 2.0 for name, size in sizes.items())


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
