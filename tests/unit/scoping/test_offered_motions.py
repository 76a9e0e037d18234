"""The motions that the scope's page offers fit the joint that is watched."""

from __future__ import annotations

import math
from typing import Any

import pytest

from jointctl.tools.configuration.config import Config
from jointctl.tools.scoping.scope_page import KINDS, offered
from tests.configurations import shipped
from tests.joint_sizes import SIZES, own_loop_joint


def limits_of(config: Config) -> dict[str, Any]:
    limits = config.limits
    return {
        "range": (limits.position_min_rad, limits.position_max_rad), "velocity_max_radps": limits.velocity_max_radps,
        "brake_radps2": config.sequence.brake_radps2,
    }  # fmt: skip


def test_the_shipped_joint_is_offered_what_it_was() -> None:
    settings = limits_of(shipped("csp"))
    assert offered("sine", settings) == {"amplitude_rad": 0.1, "frequency_Hz": 0.2, "offset_rad": 0.0}
    assert offered("min_jerk", settings) == {"start_rad": 0.0, "target_rad": 0.1, "move_s": 2.0, "dwell_s": 0.5}
    assert offered("trapezoid", settings) == {
        "start_rad": 0.0, "target_rad": 0.1, "speed_radps": 0.1, "acceleration_radps2": 0.5, "dwell_s": 0.5,
    }  # fmt: skip
    assert offered("configured", settings) == offered("sine", {}) == {}


@pytest.mark.parametrize("shifted_rad", [0.0, 0.4, 5.0])
@pytest.mark.parametrize("name", SIZES)
def test_each_motion_stays_within_range_speed_and_acceleration(name: str, shifted_rad: float) -> None:
    """0.1 rad at 0.2 Hz was 0.13 rad/s: a base joint of 0.05 rad/s refused whatever was offered."""
    config = own_loop_joint(SIZES[name], "csp")
    settings = limits_of(config)
    low, high = settings["range"] = tuple(end + shifted_rad for end in settings["range"])
    for kind in KINDS[1:]:
        values = offered(kind, settings)
        if kind == "sine":
            reach = [values["offset_rad"] + sign * values["amplitude_rad"] for sign in (-1.0, 1.0)]
            speed = math.tau * values["frequency_Hz"] * values["amplitude_rad"]
        else:
            reach = [values["start_rad"], values["target_rad"]]
            way = reach[1] - reach[0]
            speed = 1.875 * way / values["move_s"] if kind == "min_jerk" else values["speed_radps"]
        assert low < min(reach) < max(reach) < high
        assert 0.0 < speed <= 0.3 * config.limits.velocity_max_radps
    assert 0.0 < offered("trapezoid", settings)["acceleration_radps2"] <= config.sequence.brake_radps2
