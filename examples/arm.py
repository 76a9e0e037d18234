"""Three joints at once, at simulated time: a straight way in the joints' space, then a circle of set-points.

    python examples/arm.py [ARM]

Without a file it is the shipped arm.  `lockstep=True` is left out for an arm in real time, and `step` is `time.sleep`.
"""

from __future__ import annotations

import sys

import numpy as np

import jointctl

RATE_Hz, SECONDS = 100.0, 4.0


def main() -> None:
    """A move, the set-points, and how well they were followed."""
    with jointctl.Arm(*sys.argv[1:], lockstep=True) as arm:
        arm.enable()
        arm.move_to(arm.state.desired_position_rad + 0.2, duration_s=2.0)
        middle_rad, first = arm.state.desired_position_rad, len(arm.records)
        phases_rad = 0.5 * np.pi * np.arange(len(arm.names))
        for k in range(1, round(SECONDS * RATE_Hz) + 1):
            now_s = k / RATE_Hz
            share = min(now_s, SECONDS - now_s, 1.0) ** 2  # from rest to rest
            arm.command(middle_rad + 0.05 * share * np.sin(np.pi * now_s + phases_rad), time_s=now_s)
            arm.step(1.0 / RATE_Hz)
        arm.step(0.3)
        errors_mrad = 1e3 * np.sqrt(np.mean(arm.records[first:]["error_rad"] ** 2, axis=0))
    for name, error_mrad in zip(arm.names, errors_mrad, strict=True):
        print(f"{name:12} {error_mrad:.3f} mrad RMSE")
    print(arm.state.phase)


if __name__ == "__main__":
    main()
