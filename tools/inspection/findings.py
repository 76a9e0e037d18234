"""What `jointctl doctor` reports: findings, each with a cure where something is amiss."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

OK, NOTE, PROBLEM = "ok", "note", "problem"


@dataclass(frozen=True)
class Finding:
    """One line of the report; `cure` tells what to do about it, `numbers` has figures for --json."""

    topic: str
    status: str  # ok, note (works, could be better), problem (a run will fail or be unsafe)
    text: str
    cure: str = ""
    numbers: dict[str, Any] = field(default_factory=dict)


def file_text(path: Path) -> str | None:
    """What a file of /sys or /proc says; None if it cannot be read."""
    try:
        return path.read_text().strip()
    except OSError:
        return None
