"""Whether the drive's whole numbers suit the joint: what would wrap, be cut or be rounded away is refused."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.canopen.pdo import (
    FINE_UNITS,
    coarse_numbers,
    position_misfit,
    torque_misfit,
    velocity_misfit,
)
from jointctl.drivers.errors import ConfigurationError, DeviceError
from jointctl.firmware_py.states import Fault
from jointctl.hil.lockstep import TRUE_POWER_STATE, TRUE_POSITION_rad, TRUE_VELOCITY_radps
from jointctl.tools.analysis.loop_report import contradictions
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config
from jointctl.tools.configuration.records import axis_constants
from jointctl.tools.lockstep import LockstepJoint
from tests.configurations import own_loop, shipped, written
from tests.joint_sizes import SIZES, Size, own_loop_joint

each_size = pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
RPM = math.tau / 60.0


def csv(settings: Any, **changes: Any) -> Any:
    return dataclasses.replace(settings, **{"mode": "csv", "holds_alone": True, "torque_offset": True} | changes)


@pytest.mark.parametrize(
    ("unit", "ratio", "least_radps"),
    [
        ("r/min", 1.0, 10.0 * RPM),
        ("0.1 r/min", 1.0, RPM),
        ("r/min", 200.0, 0.05 * RPM),
        ("counts/s", 1.0, 10.0 * math.tau / 4096),
    ],
)
def test_a_speed_of_a_few_units_is_refused(
    settings_of_virtual_joint: Any, unit: str, ratio: float, least_radps: float
) -> None:
    """One unit of r/min on a direct drive is 0.1 rad/s: 607F was twice the limit of a joint of 0.05 rad/s."""
    settings = csv(settings_of_virtual_joint, velocity_unit=unit, reduction_ratio=ratio, counts_per_turn=4096)
    found = [
        velocity_misfit(dataclasses.replace(settings, velocity_max_radps=least_radps * factor))
        for factor in (0.999, 1.001)
    ]
    assert found[0] is not None
    assert found[1] is None
    assert f"must be at least {least_radps:.3g}, ten units of 60FF (drive.velocity_unit = {unit}" in found[0][0]


def test_a_speed_beyond_32_bit_is_refused(settings_of_virtual_joint: Any) -> None:
    """With 24 bit behind 100:1 it was cut to 8 of 20 rad/s, and FOLLOWING_ERROR looked for a blocked joint."""
    settings = csv(
        settings_of_virtual_joint, counts_per_turn=2**24, encoder_on_motor=True, reduction_ratio=100.0,
        velocity_max_radps=8.05,
    )  # fmt: skip
    found = velocity_misfit(settings)
    assert found is not None
    assert "must be less than 8.04, what the 32 bit of 60FF" in found[0]
    for harmless in ({"velocity_max_radps": 8.03}, {"velocity_unit": "r/min"}, {"mode": "cst"}, {"mode": "csp"}):
        assert velocity_misfit(dataclasses.replace(settings, **harmless)) is None
    assert velocity_misfit(dataclasses.replace(settings, mode="csp", velocity_offset=True)) is not None


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize(
    ("zero", "least_rad", "most_rad", "fits"),
    [
        (0, -1.05, 1.05, True),
        (0, -1.07, 1.0, False),
        (0, -1.0, 1.07, False),
        (2_000_000_000, -0.05, 0.05, True),
        (2_000_000_000, -0.08, 0.08, False),
        (-2_000_000_000, -0.08, 0.08, False),
    ],
)
def test_a_target_beyond_32_bit_is_refused(
    settings_of_virtual_joint: Any, direction: int, zero: int, least_rad: float, most_rad: float, fits: bool
) -> None:
    """607A would jump by its whole range: a simulated drive turned back with all its torque."""
    settings = csv(
        settings_of_virtual_joint, mode="csp", counts_per_turn=2**24, encoder_on_motor=True, reduction_ratio=762.0,
        encoder_direction=direction, zero_counts=zero, position_min_rad=least_rad, position_max_rad=most_rad,
    )  # fmt: skip
    found = position_misfit(settings)
    assert (found is None) is fits
    assert position_misfit(dataclasses.replace(settings, mode="csv")) is None


def test_the_drive_that_limits_alone_may_have_a_tenth_more(settings_of_virtual_joint: Any) -> None:
    settings = csv(settings_of_virtual_joint, torque_max_Nm=0.3, max_torque_permille=None)
    found = torque_misfit(settings, 12, 0.0276)
    assert found is not None
    assert "to 0.331 Nm, since 6072 counts in 0.0276 Nm" in found[0]
    assert torque_misfit(settings, 12, 0.0274) is None
    given = dataclasses.replace(settings, max_torque_permille=1000)
    found = torque_misfit(given, 1000, 0.03)
    assert found is not None
    assert "to 30 Nm by drive.max_torque_permille (=1000)" in found[0]
    assert torque_misfit(dataclasses.replace(given, holds_alone=False), 1000, 0.03) is None


def test_a_configuration_names_all_of_them(tmp_path: Any) -> None:
    changes = {
        "encoder__counts_per_turn": 2**24, "encoder__side": "motor", "joint__reduction_ratio": 1000.0,
        "limits__velocity_max_radps": 0.9, "limits__position_min_rad": -0.9,
    }  # fmt: skip
    with pytest.raises(ConfigurationError) as error:
        load_config(written(tmp_path / "joint.toml", "csp", **changes))
    for words in ("what the 32 bit of 60FF", "counts of 607A, which holds 32 bit", "to 500 Nm by drive.max_torque"):
        assert words in str(error.value)


@pytest.mark.parametrize(
    ("mode", "changes", "words"),
    [
        ("csv", {"limits__torque_max_Nm": 30.0}, r"the drive alone limits its torque, to 60\.5 Nm"),
        ("csp", {"limits__position_max_rad": 26_000.0}, "counts of 607A, which holds 32 bit"),
        ("csv", {"limits__velocity_max_radps": 1e-4}, "ten units of 60FF"),
    ],
)
def test_commissioning_refuses_it_too(mode: str, changes: dict[str, float], words: str) -> None:
    """By what the drive itself says it is rated for, and also where no file was judged."""
    config = own_loop(mode)
    LockstepJoint(config)
    with pytest.raises(DeviceError, match=words):
        LockstepJoint(config.changed(**changes))


@pytest.mark.parametrize(("rated_Nm", "lines"), [(0.5, 0), (4.8, 0), (5.1, 1)])
def test_coarse_torque_is_reported(rated_Nm: float, lines: int) -> None:
    config = shipped("virtual", drive__rated_torque_Nm=rated_Nm, drive__rated_current_A=10.0 * rated_Nm,
                     drive__max_torque_permille=None)  # fmt: skip
    found = [line for line in contradictions(config) if "counts torque in" in line]
    assert len(found) == lines
    remarks = [line for line in LockstepJoint(config).report.remarks if "counts torque in" in line]
    assert remarks == found


def test_coarse_velocity_is_reported_where_it_is_sent(settings_of_virtual_joint: Any) -> None:
    settings = csv(settings_of_virtual_joint, velocity_unit="r/min", reduction_ratio=1.0, velocity_max_radps=5.0)
    (line,) = coarse_numbers(settings, 0.01)
    assert line.startswith("the drive counts velocity in 0.105 rad/s (drive.velocity_unit = r/min), 2% of")
    assert coarse_numbers(dataclasses.replace(settings, mode="cst"), 0.01) == []
    assert coarse_numbers(dataclasses.replace(settings, velocity_max_radps=1.01 * FINE_UNITS * RPM), 0.01) == []


def coarse_encoder(counts: float, mode: str) -> Config:
    """A finger of 12 bit whose error may swing by so many counts."""
    finger = SIZES["short finger"]._replace(bits=12, rate_Hz=500.0)
    share = counts * math.tau / 4096.0 / (0.2 * finger.travel_rad)
    return own_loop_joint(finger, mode, limits__swing_error_share=share, trajectory__duration_s=4.0)


@pytest.mark.parametrize("mode", ["csp", "csv"])
@pytest.mark.parametrize("counts", [1.0, 2.01])
def test_steps_of_the_encoder_that_look_like_a_swing_are_reported(counts: float, mode: str) -> None:
    """With 0.05 of 0.03 rad a finger of 12 bit ended as a limit cycle whenever it moved, and no line said why."""
    config = coarse_encoder(counts, mode)
    found = [line for line in contradictions(config) if "look like an error that swings" in line]
    assert bool(found) is (LockstepJoint(config).run().fault is Fault.LIMIT_CYCLE) is (counts < 2.0)


@pytest.mark.parametrize(("factor", "enough"), [(1.0, False), (2.0, True)])
def test_a_drive_too_soft_for_the_friction_of_its_joint_is_reported(factor: float, enough: bool) -> None:
    """Its gains suit the inertia, which is a small part of what a finger's motor moves."""
    finger = SIZES["finger"]
    gain = 95.0 * finger.inertia_kgm2 * factor
    gains = {"velocity_gain_Nmspr": gain, "velocity_integral_Nmprad": 50.0 * gain}
    config = own_loop_joint(finger, "csp", gains, trajectory__duration_s=4.0)
    found = [line for line in contradictions(config) if line.startswith("drive.cascade: ")]
    assert bool(found) is not enough
    assert (LockstepJoint(config).run().fault is Fault.NONE) is enough


@each_size
def test_a_target_is_caught_up_with_by_the_torque_that_gravity_leaves(size: Size) -> None:
    """Under 210 of 300 Nm the target was 3.3 times as quick as the joint could be; it still stops as it is planned."""
    config, left_Nm = own_loop_joint(size, "csp"), size.torque_Nm - size.gravity_Nm
    constants = axis_constants(config, np.zeros((1, 5)))[0].velocity_command
    assert constants.acceleration_max_radps2 == pytest.approx(left_Nm / size.inertia_kgm2)
    brisk = config.changed(sequence__brake_radps2=1.2 * left_Nm / size.inertia_kgm2)
    constants = axis_constants(brisk, np.zeros((1, 5)))[0].velocity_command
    assert constants.acceleration_max_radps2 == pytest.approx(1.2 * left_Nm / size.inertia_kgm2)


@each_size
@pytest.mark.parametrize("mode", ["csp", "csv"])
def test_a_joint_of_any_size_follows_without_a_jump(size: Size, mode: str) -> None:
    config = own_loop_joint(size, mode, trajectory__duration_s=4.0)
    joint = LockstepJoint(config)
    run = joint.run()
    assert (run.fault, joint.report.remarks) == (Fault.NONE, ())
    assert contradictions(config) == []
    enabled = int(run.truth[:, TRUE_POWER_STATE].argmax())
    first = run.truth[enabled : enabled + int(0.02 * size.rate_Hz) + 2, TRUE_POSITION_rad]
    assert abs(first - first[0]).max() < 0.1 * config.limits.following_error_max_rad
    assert abs(run.truth[:, TRUE_VELOCITY_radps]).max() < size.speed_radps
    assert abs(run.true_error_rad[run.tracking]).max() < 0.2 * config.limits.following_error_max_rad
