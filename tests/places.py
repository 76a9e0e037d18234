"""Where the tree is whose tests these are."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONFIGS = ROOT / "configs"
EDS = CONFIGS / "virtual_joint.eds"
# real data of others, which a clone does not hold: tests that need them say so and are skipped where they are missing
PUBLIC_DATA = Path(os.environ.get("JOINTCTL_PUBLIC_DATA", ROOT.parent / "shared" / "data"))
