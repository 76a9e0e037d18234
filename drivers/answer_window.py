"""How long an answer of the drive belongs to the cycle that asked for it; the same on CAN and on a serial line."""

from __future__ import annotations

# A look so long after the window's end still counts: a wait may end a little late.
LOOK_LATE_NS = 200_000
