"""No test is left out because a file or folder has another name now."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.places import ROOT
from tests.tiers import FOLDERS, LOCKSTEP, tier_of


def test_what_the_tiers_name_exists() -> None:
    assert [name for name in FOLDERS if not (ROOT / "tests" / name).is_dir()] == []
    assert [name for name in LOCKSTEP if not (ROOT / "tests" / name).is_file()] == []


@pytest.mark.parametrize(
    ("path", "tier"),
    [
        ("hil/test_demo.py", "realtime"), ("hil/test_study.py", None), ("parties/test_tshark.py", "parties"),
        ("unit/hil/test_lockstep.py", None), ("socketcan/test_vcan.py", "realtime"), ("bench/test_benchmarks.py", None),
    ],
)  # fmt: skip
def test_the_folder_gives_the_tier(path: str, tier: str | None) -> None:
    assert tier_of(Path(path)) == tier
