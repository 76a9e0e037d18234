"""[ripple] and [friction.angle]: what the laws feed forward, and where they do not belong."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.conversions import static_friction_Nm
from jointctl.tools.configuration.load import load_config
from jointctl.tools.configuration.records import axis_constants
from tests.configurations import written

RIPPLE = {
    "direction": 1, "zero_counts": 0, "torque_Nm": [0.5, 0.3], "per_motor_turn": [2.0, 10.0], "phase_rad": [0.0, 1.0],
}  # fmt: skip


def with_ripple(folder: Path, *, base: str = "precise", **values: Any) -> Path:
    own = {key: value for key, value in values.items() if "__" not in key}
    rest = {key: value for key, value in values.items() if "__" in key}
    return written(folder / "joint.toml", base, ripple={**RIPPLE, **own}, **rest)


def test_the_sines_reach_the_law_in_its_units(tmp_path: Path) -> None:
    config = load_config(with_ripple(tmp_path))
    series = axis_constants(config, np.zeros((1, 5)))[0].law.flexible.torque_ripple
    assert series.count == 2
    assert list(series.amplitude[:2]) == [0.5, 0.3]
    assert list(series.turns_prad[:2]) == pytest.approx([121.0 * order / math.tau for order in (2.0, 10.0)])
    assert list(series.phase_turns[:2]) == pytest.approx([0.0, 1.0 / math.tau])


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"zero_counts": 5}, r"ripple.zero_counts \(=5\) differs from encoder.zero_counts \(=0\)"),
        ({"direction": -1}, r"ripple.direction \(=-1\) differs from encoder.direction \(=1\)"),
        ({"phase_rad": [0.0]}, r"torque_Nm, per_motor_turn and phase_rad \(=2, 2, 1\) must be equally many numbers"),
        (
            {key: [1.0] * 5 for key in ("torque_Nm", "per_motor_turn", "phase_rad")},
            r"must be a list of up to 4 numbers",
        ),
        (
            {"torque_Nm": [500.0, -300.0]},
            r"ripple.torque_Nm \(=\[500.0, -300.0\]\) must be less than limits.torque_max_Nm",
        ),
        ({"base": "realistic"}, r'\[ripple\] is not for control.kind "flexible_joint"'),
    ],
)
def test_what_contradicts_itself_is_refused(tmp_path: Path, values: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        load_config(with_ripple(tmp_path, **values))


ANGLE = {"share": [0.1, 0.05], "per_motor_turn": [2.0, 1.0 / 121.0], "phase_rad": [0.0, 1.0]}


def with_angle(folder: Path, **values: Any) -> Path:
    return written(folder / "joint.toml", "precise", friction__angle={**ANGLE, **values})


def test_friction_of_the_angle_reaches_law_and_virtual_joint(tmp_path: Path) -> None:
    config = load_config(with_angle(tmp_path, direction=1, zero_counts=0))
    friction = axis_constants(config, np.zeros((1, 5)))[0].law.friction
    assert friction.conditioned == 1
    assert list(friction.of_angle.amplitude[:2]) == [0.1, 0.05]
    assert list(friction.of_angle.turns_prad[:2]) == pytest.approx([242.0 / math.tau, 1.0 / math.tau])
    static_Nm = 121.0 * 0.1575 * 1.15
    assert static_friction_Nm(config) == pytest.approx(static_Nm)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"zero_counts": 5}, r"friction.angle.zero_counts \(=5\) differs from encoder.zero_counts \(=0\)"),
        ({"phase_rad": [0.0]}, r"share, per_motor_turn and phase_rad \(=2, 2, 1\) must be equally many numbers"),
        ({"share": [0.5, -0.41]}, r"friction.angle.share \(=\[0.5, -0.41\]\) must add up to 0.9 at most, unsigned"),
    ],
)
def test_friction_of_the_angle_that_contradicts_itself_is_refused(
    tmp_path: Path, values: dict[str, Any], text: str
) -> None:
    with pytest.raises(ConfigurationError, match=text):
        load_config(with_angle(tmp_path, **values))


def test_shares_that_add_up_to_the_most_are_taken(tmp_path: Path) -> None:
    assert load_config(with_angle(tmp_path, share=[0.5, -0.4])).friction is not None
