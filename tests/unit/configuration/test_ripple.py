"""[ripple]: what the laws of a rigid joint feed forward, and where it does not belong."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.errors import ConfigurationError
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
        ({"base": "realistic"}, r'\[ripple\] is not for control.kind "flexible_joint"'),
    ],
)
def test_what_contradicts_itself_is_refused(tmp_path: Path, values: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        load_config(with_ripple(tmp_path, **values))
