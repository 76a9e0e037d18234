"""The virtual drive of joints from a finger to a base joint: its quick stop suits the joint, whatever EDS it shows."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.canopen.watchdog import needed_braking
from jointctl.firmware_py.states import Fault
from jointctl.hil.canopen.device_core import sample_objects
from jointctl.hil.lockstep import TRUE_POSITION_rad
from jointctl.tools.configuration.canopen import canopen_settings
from jointctl.tools.configuration.config import SHIPPED_FOLDER, Config
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.sweeping.carry_out import config_of_sweep
from jointctl.tools.virtual_joint import new_device
from tests.joint_sizes import SIZES, Size, own_loop_joint

each_size = pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)


def ramp_radps2(config: Config, name: str = "quick_stop_deceleration") -> float:
    device = new_device(config).device[0]
    return float(device.drive[name]) / abs(float(device.counts_per_rad))


@each_size
def test_it_brakes_as_fast_as_the_limits_need_and_the_torque_allows(size: Size) -> None:
    config = own_loop_joint(size, "csp")
    most = (size.torque_Nm - size.gravity_Nm) / size.inertia_kgm2
    least = max(radps2 for radps2, _ in needed_braking(canopen_settings(config)))
    assert least <= most
    assert ramp_radps2(config) == pytest.approx(max(min(12.0, most), least), rel=0.01)
    assert not [text for text in LockstepJoint(config).report.remarks if "quick stop" in text]


@pytest.mark.parametrize("name", ["finger", "base"])
def test_it_is_the_ramp_that_605a_names(name: str) -> None:
    config = own_loop_joint(SIZES[name], "csv", drive__quick_stop_option=1)
    least = max(radps2 for radps2, _ in needed_braking(canopen_settings(config)))
    assert ramp_radps2(config, "profile_deceleration") >= least
    assert ramp_radps2(config) == pytest.approx(11.98, abs=0.01)


def test_an_eds_beside_the_file_has_no_ramps_of_its_own(tmp_path: Path) -> None:
    """1000000 counts per s2 of the file were 0.04 rad/s2 with 20 bit on the motor of a base joint."""
    shutil.copy(SHIPPED_FOLDER / "virtual_joint.eds", tmp_path / "own.eds")
    base = SIZES["base"]
    shown = own_loop_joint(base, "csp", drive__eds=str(tmp_path / "own.eds"), encoder__side="motor")
    for name in ("quick_stop_deceleration", "profile_deceleration", "profile_acceleration"):
        assert ramp_radps2(shown, name) == pytest.approx(ramp_radps2(own_loop_joint(base, "csp"), name), rel=1e-3)


def test_a_sweep_in_a_velocity_mode_has_the_ramp_of_a_run() -> None:
    config = own_loop_joint(SIZES["finger"], "csp")
    assert ramp_radps2(config_of_sweep(config, "csv")) == pytest.approx(ramp_radps2(config))


def test_in_torque_mode_it_is_what_the_limits_need() -> None:
    """Not brake_radps2: the joints of the shipped arm brake by themselves with 12 rad/s2, slower than the loop."""
    config = own_loop_joint(SIZES["wrist"], "cst").changed(drive__cascade=None)
    assert config.sequence.brake_radps2 < 3.0
    assert ramp_radps2(config.changed(sequence__brake_radps2=30.0)) == pytest.approx(11.98, abs=0.01)
    assert ramp_radps2(config.changed(limits__velocity_max_radps=9.0)) == pytest.approx(13.5, rel=0.01)


@pytest.mark.parametrize("unit", ["r/min", "0.1 r/min"])
@pytest.mark.parametrize("mode", ["csp", "csv"])
@pytest.mark.parametrize(("name", "side", "direction"), [("base", "motor", -1), ("wrist", "joint", 1)])
def test_it_takes_velocities_in_the_unit_of_the_file(
    mode: str, unit: Any, name: str, side: Any, direction: Any
) -> None:
    """It was refused: only counts per s were known."""
    config = own_loop_joint(
        SIZES[name], mode, drive__velocity_unit=unit, encoder__side=side, encoder__direction=direction,
        drive__torque_direction=direction, trajectory__duration_s=4.0,
    )  # fmt: skip
    joint = LockstepJoint(config)
    run, plain = joint.run(), LockstepJoint(config.changed(drive__velocity_unit="counts/s")).run()
    assert run.fault is Fault.NONE
    assert abs(run.true_error_rad[run.tracking]).max() < 0.02 * config.limits.following_error_max_rad
    assert np.ptp(run.truth[:, TRUE_POSITION_rad] - plain.truth[:, TRUE_POSITION_rad]) > 0.0  # rounded otherwise


@pytest.mark.parametrize(("unit", "motor_radps"), [("r/min", math.tau / 60.0), ("0.1 r/min", math.tau / 600.0)])
def test_it_reports_velocities_in_that_unit_and_with_the_encoders_sign(unit: Any, motor_radps: float) -> None:
    direct = SIZES["direct drive"]
    config = own_loop_joint(direct, "csv", drive__velocity_unit=unit, encoder__direction=-1)
    device = new_device(config)
    device.plant_state[0].joint_velocity_radps = 3.0
    sample_objects(device.device[0], device.plant_constants[0], device.plant_state[0])
    assert int(device.device[0].drive.velocity) == pytest.approx(-3.0 / motor_radps, abs=1.0)
