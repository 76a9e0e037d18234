"""Configurations that a campaign is run with beside the shipped ones: one line changed each, or two.

`python -m tests.faults.campaign_variants FOLDER` writes them, for `jointctl fault-campaign FOLDER/NAME.toml`, and an
arm without brakes, for `jointctl fault-campaign FOLDER/brakeless/arm.toml`.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from jointctl.tools.configuration.arm import SHIPPED_ARM
from tests.places import CONFIGS

OWN_LOOP = (  # the drive closes its own loops
    (r'^mode = "cst"', 'mode = "csp"'),
    (r'^kind = "computed_torque_rbf"', 'kind = "computed_torque"'),
    (r"^\[encoder\]", "[drive.cascade]\nposition_gain_ps = 30.0\n\n[encoder]"),
)
VARIANTS: dict[str, tuple[tuple[str, str], ...]] = {
    "gravity": (  # known to the law; about half of what friction holds
        (r"^torque_constant_NmpA", "gravity_Nm = 6.0\ntorque_constant_NmpA"),
        (r"^initial_position_rad", "gravity_Nm = 6.0\ninitial_position_rad"),
    ),
    "counts_4096": (  # on the motor: at the joint the count would be 1.5 mrad, 1.5 rad/s in one period
        (r"^counts_per_turn = \d+", "counts_per_turn = 4096"),
        (r'^side = "joint"', 'side = "motor"'),
    ),
    "csp": OWN_LOOP,
    "csv": (*OWN_LOOP[1:], (r'^mode = "cst"', 'mode = "csv"')),
    "rate_500_Hz": ((r"^rate_Hz = [\d.]+", "rate_Hz = 500.0"),),
    "rate_2_kHz": ((r"^rate_Hz = [\d.]+", "rate_Hz = 2000.0"),),
}


def write_variant(name: str, folder: Path) -> Path:
    """configs/virtual.toml with the changes of `name`, as a file of its own."""
    text = (CONFIGS / "virtual.toml").read_text()
    for pattern, changed in VARIANTS[name]:
        text, count = re.subn(pattern, changed, text, count=1, flags=re.MULTILINE)
        assert count == 1, pattern
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


def write_brakeless_arm(folder: Path) -> Path:
    """The shipped arm on its side, no joint with a brake: its friction alone holds it."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in SHIPPED_ARM.parent.iterdir():
        text = path.read_text()
        text = text.replace("gravity_mps2 = [0.0, 0.0, -9.81]", "gravity_mps2 = [0.0, -9.81, 0.0]")
        text = re.sub(r"(?m)^\[virtual\].*$", "[virtual]\nbrake = false", text)
        (folder / path.name).write_text(text)
    return folder / SHIPPED_ARM.name


if __name__ == "__main__":
    print(write_brakeless_arm(Path(sys.argv[1]) / "brakeless"))
    for name in VARIANTS:
        print(write_variant(name, Path(sys.argv[1])))
