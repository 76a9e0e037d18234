"""The notebook of examples/ runs as it is; the tutorial of docs/python.md shows its cells and what they draw."""

from __future__ import annotations

import re
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.places import ROOT

PAGE = (ROOT / "docs" / "python.md").read_text()
BLOCKS = re.findall(r"^```python\n(.*?)\n```$", PAGE, re.MULTILINE | re.DOTALL)
LARGEST_PICTURE_BYTES = 60_000


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
    shown = [block for block in BLOCKS if "lockstep=True) as joint" in block]
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
    assert all(0.7 < kept[name] / size < 1.4 for name, size in sizes.items())
