"""No test is left out because a file or folder has another name now."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.places import ROOT
from tests.tiers import FOLDERS, LOCKSTEP, tier_of


def test_what_the_tiers_name_exists() -> None:
    assert [name for name in FOLDERS if not (ROOT / "tests" / name).is_dir()] == []
    assert [name for name in LOCKSTEP if not (ROOT / "tests" / name).is_file()] == []


def test_the_script_collects_all_that_needs_real_time() -> None:
    collected = re.search(r"IN_REAL_TIME=\((.+)\)", (ROOT / "check").read_text())
    assert collected is not None
    needed = {f"tests/{name}" for name in FOLDERS}
    for file in (ROOT / "tests").rglob("test_*.py"):
        if file.relative_to(ROOT / "tests").parts[0] not in FOLDERS and "@pytest.mark.realtime" in file.read_text():
            needed.add(str(file.relative_to(ROOT)))
    assert needed - {str(Path(__file__).relative_to(ROOT))} == set(collected[1].split())


@pytest.mark.parametrize(
    ("path", "tier"),
    [
        ("hil/test_demo.py", "realtime"), ("hil/test_study.py", None), ("parties/test_tshark.py", "parties"),
        ("unit/hil/test_lockstep.py", None), ("socketcan/test_vcan.py", "realtime"), ("bench/test_benchmarks.py", None),
    ],
)  # fmt: skip
def test_the_folder_gives_the_tier(path: str, tier: str | None) -> None:
    assert tier_of(Path(path)) == tier
