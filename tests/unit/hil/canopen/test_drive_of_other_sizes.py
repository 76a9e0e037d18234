"""The virtual drive of joints from a finger to a base joint: its quick stop suits the joint, whatever EDS it shows."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from jointctl.drivers.canopen.watchdog import needed_braking
from jointctl.tools.configuration.canopen import canopen_settings
from jointctl.tools.configuration.config import SHIPPED_FOLDER, Config
from jointctl.tools.lockstep import LockstepJoint
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


def test_in_torque_mode_it_is_what_the_limits_need() -> None:
    """Not brake_radps2: the joints of the shipped arm brake by themselves with 12 rad/s2, slower than the loop."""
    config = own_loop_joint(SIZES["wrist"], "cst").changed(drive__cascade=None)
    assert config.sequence.brake_radps2 < 3.0
    assert ramp_radps2(config.changed(sequence__brake_radps2=30.0)) == pytest.approx(11.98, abs=0.01)
    assert ramp_radps2(config.changed(limits__velocity_max_radps=9.0)) == pytest.approx(13.5, rel=0.01)
