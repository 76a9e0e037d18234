"""Drives as they are met: objects they lack, limits and delays of their own (docs/hardware.md)."""

from __future__ import annotations

from typing import Any

import pytest

from jointctl.drivers.errors import DeviceError, NoDeviceError
from tests.unit.drivers.canopen.odd_drive import OUT_OF_RANGE, READ_ONLY, store, value

pytestmark = pytest.mark.usefixtures("short_timeout")


# --- objects that a drive does not have ------------------------------------------------------------------------


def test_without_6502_the_mode_is_tried(commission: Any) -> None:
    report = commission(without=("6502",))
    assert report.mode == "cyclic_sync_torque"
    assert any("no object 6502" in remark for remark in report.remarks)


def test_without_6502_a_mode_that_is_not_taken_is_refused(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.answers[(0x6061, 0)] = 0
    with pytest.raises(DeviceError, match="6061 shows mode 0, mode 10 was selected"):
        commission(without=("6502",))


def test_without_603f_a_fault_has_no_code(commission: Any, device_on_bus: Any) -> None:
    assert commission(without=("603F",)).mode == "cyclic_sync_torque"
    device_on_bus.answers[(0x6041, 0)] = 0x0218
    with pytest.raises(DeviceError, match=r"is in fault \(error code 0000h\)"):
        commission(without=("603F",))


def test_without_1017_the_drive_is_watched_by_its_boot_up_and_its_samples(commission: Any) -> None:
    assert any("no object 1017" in remark for remark in commission(without=("1017",)).remarks)


def test_without_1016_the_drive_is_not_enabled(commission: Any) -> None:
    with pytest.raises(DeviceError, match=r"no object 1016:1 .* which jointctl needs: without it the drive cannot"):
        commission(without=("1016",))


def test_without_6077_the_torque_is_not_measured(commission: Any, device_on_bus: Any) -> None:
    assert not commission(without=("6077",)).measures_torque
    port = commission.port[0]
    assert (port.torque_at, port.tpdo_length) == (-1, 6)
    assert [value(device_on_bus, 0x1A00, k) for k in range(3)] == [2, 0x60410010, 0x60640020]


def test_60c2_is_not_needed_in_a_profile_mode(commission: Any) -> None:
    assert "60C2" not in commission(without=("60C2",), mode="tq").settings


def test_an_object_that_cannot_be_written_but_holds_the_value(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.refused[(0x60C2, 1)] = device_on_bus.refused[(0x60C2, 2)] = READ_ONLY
    report = commission()
    assert "60C2:1 (interpolation time period) cannot be written; it is 1, as it must be" in report.remarks
    with pytest.raises(DeviceError, match=r"60C2:1 .* was refused: object is read only"):
        commission(rate_Hz=500.0)


# --- torque mode with a slope ----------------------------------------------------------------------------------


def test_a_torque_slope_that_the_drive_limits_is_used_where_the_loop_is_slower(
    commission: Any, device_on_bus: Any
) -> None:
    device_on_bus.refused[(0x6087, 0)] = OUT_OF_RANGE
    store(device_on_bus, 0x6087, 0, 20_000)  # 0.0605 Nm per permille: 1210 Nm/s
    report = commission(mode="tq", torque_rate_max_Nmps=1209.0)
    assert any("6087 = 20000 permille/s" in remark for remark in report.remarks)


def test_a_torque_slope_below_the_rate_of_the_loop_is_refused(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.refused[(0x6087, 0)] = OUT_OF_RANGE
    store(device_on_bus, 0x6087, 0, 20_000)
    with pytest.raises(DeviceError, match=r"at most 1210 Nm/s .*set limits\.torque_rate_max_Nmps to 1210 or less"):
        commission(mode="tq", torque_rate_max_Nmps=1211.0)


def test_without_6087_torque_mode_is_warned_about(commission: Any) -> None:
    assert any("no object 6087" in remark for remark in commission(without=("6087",), mode="tq").remarks)


# --- torque in per mille of what -------------------------------------------------------------------------------


@pytest.mark.parametrize(("reference", "resolution_Nm"), [("rated_torque", 0.0605), ("rated_current", 0.0484)])
def test_permille_of_rated_torque_or_of_rated_current(commission: Any, reference: str, resolution_Nm: float) -> None:
    report = commission(torque_reference=reference, torque_constant_NmpA=0.08, max_torque_permille=None)
    assert report.torque_resolution_Nm == pytest.approx(resolution_Nm)
    assert report.settings["max torque"].endswith("= 60.0 Nm")


# --- time ------------------------------------------------------------------------------------------------------


def test_a_drive_that_boots_for_seconds(commission: Any, device_on_bus: Any) -> None:
    # each attempt: a request and an abort of the library
    device_on_bus.deaf_frames = 10
    commission(boot_timeout_s=1.5)
    assert device_on_bus.deaf_frames == 0


def test_a_drive_that_boots_for_longer_than_allowed(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.deaf_frames = 1000
    with pytest.raises(NoDeviceError, match="node 1 does not answer"):
        commission(boot_timeout_s=0.5)


def test_not_ready_to_switch_on_for_a_while(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.sequences[(0x6041, 0)] = [0x0200] * 20
    commission(boot_timeout_s=2.0)


def test_not_ready_to_switch_on_for_too_long(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.answers[(0x6041, 0)] = 0x0200
    message = r"node 1 is not ready to switch on \(statusword 0200h\) after 0\.3 s \(motor supply, .*boot_timeout_s\)"
    with pytest.raises(DeviceError, match=message):
        commission(boot_timeout_s=0.3)


def test_no_statusword_until_the_first_controlword_that_is_not_zero(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.sequences[(0x6041, 0)] = [0, 0, 0, 0]
    commission(boot_timeout_s=1.0)
    words = [data[4] for cob, data in device_on_bus.requests if cob == 0x601 and data[:3] == b"\x2b\x40\x60"]
    assert words[:2] == [0x00, 0x06]
    assert 0x07 not in words
    assert 0x0F not in words
    assert value(device_on_bus, 0x6041) & 0x6F == 0x40


def test_answers_that_stay_away_now_and_then(commission: Any, device_on_bus: Any) -> None:
    device_on_bus.mute += [(0x1018, 2), (0x6060, 0), (0x1A00, 3), (0x1A00, 3), (0x1016, 1)]
    commission()
    assert device_on_bus.mute == []


# --- EDS files that are wrong where it matters, and elsewhere ---------------------------------------------------


@pytest.mark.parametrize(("torque_Nm", "refused"), [(48.4, False), (49.0, True)])
def test_a_torque_limit_that_6072_would_cut_unseen_is_refused(commission: Any, torque_Nm: float, refused: bool) -> None:
    """1000 permille of 5 A and 0.08 Nm/A at 121:1 are 48.4 Nm; the configuration alone cannot know it."""
    how = {"torque_reference": "rated_current", "torque_constant_NmpA": 0.08, "max_torque_permille": 1000}
    if refused:
        with pytest.raises(DeviceError, match=r"limits.torque_max_Nm \(=49\) must be in \(0..48.4\], what drive.max"):
            commission(torque_max_Nm=torque_Nm, **how)
    else:
        assert commission(torque_max_Nm=torque_Nm, **how).settings["max torque"] == "1000 permille = 48.4 Nm"
