"""Set-points as they come, at 100 Hz, to a virtual joint in real time: a slow sine from a program's own clock.

    python examples/stream.py [CONFIG]

With a configuration of your own it moves your joint: it shows the motion envelope and asks first.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence

import jointctl

SECONDS, RATE_Hz = 4.0, 100.0


def approved(lines: Sequence[str]) -> bool:
    """The user at the terminal."""
    print(*lines, sep="\n")
    return input("Move the joint? [y/N] ").strip().lower() in ("y", "yes")


def main() -> None:
    """Follow 0.05 rad to each side, from rest to rest."""
    own = sys.argv[1:]
    with jointctl.Joint(*own) as joint:
        joint.enable(approved if own else None)
        middle_rad, begun_s = joint.state.desired_position_rad, time.monotonic()
        while (now_s := time.monotonic() - begun_s) < SECONDS:
            share = min(now_s, SECONDS - now_s, 1.0) ** 2
            position_rad = middle_rad + 0.05 * share * math.sin(math.pi * now_s)
            try:
                joint.command(position_rad, time_s=now_s)
            except jointctl.SetPointError as error:  # the computer stood still for longer than stream.delay_s, say
                print(error, file=sys.stderr)
                joint.move_to(position_rad)  # the joint rests on the way: go on from there
                begun_s = time.monotonic() - now_s
            time.sleep(1.0 / RATE_Hz)
        joint.wait(0.3)
        print(f"at {joint.state.position_rad:+.4f} rad, {joint.state.phase}")
    print(f"log: {joint.log_path}")


if __name__ == "__main__":
    main()
