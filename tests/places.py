"""Where the tree is whose tests these are."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONFIGS = ROOT / "configs"
EDS = CONFIGS / "virtual_joint.eds"
