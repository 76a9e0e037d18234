"""One contract for every drive: commissioned it is known, limited and off; made safe it is off."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from typing import Any, ClassVar, Literal, Protocol

import pytest

from jointctl.drivers.canopen.settings import CanopenSettings
from jointctl.drivers.drive import Declined, Drive
from jointctl.drivers.elmo.drive import ElmoDrive
from jointctl.drivers.elmo.settings import ElmoSettings
from jointctl.drivers.errors import DeviceError, NoDeviceError
from jointctl.hil.canopen.records import PowerState
from jointctl.hil.elmo_line import ElmoDevice
from jointctl.tools.configuration.drive_section import GivenPlace
from jointctl.tools.configuration.elmo import elmo_settings
from jointctl.tools.configuration.load import load_config, moved, shipped_config
from jointctl.tools.virtual_joint import serve_virtual_elmo
from tests.python_process import eventually


class Bench(Protocol):
    """A drive, and the virtual device behind it."""

    drive: Drive

    def powered(self) -> bool: ...
    def power_up(self) -> None: ...
    def fall_silent(self) -> None: ...


class DriveContract:
    """Subclassed by every make of drive; the fixture `bench` is theirs."""

    off: ClassVar[str]

    def test_commissioning_tells_who_where_and_how_fine(self, bench: Bench) -> None:
        report = bench.drive.commission()
        assert report.identity.vendor
        assert report.mode
        assert report.start_position_rad == pytest.approx(0.1, abs=1e-3)
        assert 0.0 < report.torque_resolution_Nm < 1.0
        assert 0.0 < report.position_resolution_rad < 1e-3
        assert report.settings
        assert not bench.powered()

    def test_the_port_exists_after_commissioning_and_has_no_descriptor(self, bench: Bench) -> None:
        with pytest.raises(DeviceError, match="not been commissioned"):
            bench.drive.port()
        bench.drive.commission()
        ports = bench.drive.port()
        assert len(ports) == 1
        assert ports[0].fd == -1
        assert abs(ports[0].position_radpcount) > 0.0

    def test_starting_the_exchange_enables_nothing(self, bench: Bench) -> None:
        bench.drive.commission()
        bench.drive.start_cyclic()
        assert not bench.powered()

    def test_commissioning_takes_the_power_off_and_can_be_repeated(self, bench: Bench) -> None:
        bench.drive.commission()
        bench.power_up()
        assert bench.powered()
        with pytest.raises(DeviceError, match="left as it is"):
            bench.drive.commission()  # no one was asked
        with pytest.raises(Declined):
            bench.drive.commission(lambda question: False)
        assert bench.powered()
        report = bench.drive.commission(lambda question: "switch it off?" in question)
        assert not bench.powered()
        assert any("at rest" in remark for remark in report.remarks)

    def test_make_safe_takes_the_power_off_and_says_so(self, bench: Bench) -> None:
        bench.drive.commission()
        bench.drive.start_cyclic()
        bench.power_up()
        assert bench.powered()
        assert bench.drive.make_safe() == self.off
        assert not bench.powered()
        assert bench.drive.make_safe() == self.off

    def test_a_drive_that_was_not_commissioned_is_left_alone(self, bench: Bench) -> None:
        bench.power_up()
        assert bench.drive.make_safe() == "untouched"
        assert bench.powered()

    def test_clearing_a_fault_enables_nothing(self, bench: Bench) -> None:
        bench.drive.clear_fault()
        assert not bench.powered()

    def test_a_silent_drive_is_no_device(self, bench: Bench) -> None:
        bench.fall_silent()
        with pytest.raises(NoDeviceError):
            bench.drive.commission()

    def test_make_safe_does_not_claim_what_it_cannot_know(self, bench: Bench) -> None:
        bench.drive.commission()
        bench.fall_silent()
        assert bench.drive.make_safe().startswith("unknown")

    def test_whoever_reads_the_temperature_neither_waits_nor_raises(self, bench: Bench) -> None:
        bench.drive.commission()
        bench.drive.start_cyclic()
        meter = bench.drive.thermometer()
        bench.fall_silent()
        began_s = time.monotonic()
        readings = [meter.poll() for _ in range(100)] if meter is not None else []
        assert time.monotonic() - began_s < 5.0  # an answer's time each would be 20 s
        assert all(found is None or found.temperature_degC is None for found in readings)

    def test_close_may_be_called_twice(self, bench: Bench) -> None:
        bench.drive.close()
        bench.drive.close()


class CanopenBench:
    """configs/virtual.toml on a bus in this process."""

    def __init__(self, device: Any, settings: CanopenSettings) -> None:
        self._bus = device
        self.drive: Drive = device.drive(settings)

    def _write(self, value: int) -> None:
        device = self._bus.device
        frame = bytes((0x2B, 0x40, 0x60, 0x00, value, 0, 0, 0))
        self._bus.now_ns += 1_000_000
        device.handle((0x600 + device.settings.node_id).to_bytes(4, "little") + b"\x08\0\0\0" + frame, self._bus.now_ns)

    def power_up(self) -> None:
        for control in (0x06, 0x07, 0x0F):
            for _ in range(3):
                self._write(control)

    def powered(self) -> bool:
        return int(self._bus.device.device[0].state) == PowerState.OPERATION_ENABLED

    def fall_silent(self) -> None:
        self._bus.device = None


class PatientClock:
    """Passes slowly, so that a computer that stands still for a while is no silent drive."""

    def __init__(self) -> None:
        self._now_s = self._seen_s = time.monotonic()
        self.pace = 0.05

    def __call__(self) -> float:
        seen_s = time.monotonic()
        self._now_s += self.pace * (seen_s - self._seen_s)
        self._seen_s = seen_s
        return self._now_s


class ElmoBench:
    """configs/elmo_serial.toml on a pseudo-terminal."""

    def __init__(self, device: ElmoDevice, settings: ElmoSettings) -> None:
        self._device, self._clock = device, PatientClock()
        self.drive: Drive = ElmoDrive(settings, clock=self._clock)

    def power_up(self) -> None:
        self._device.interpreter.execute(b"MO=1")

    def powered(self) -> bool:
        return bool(self._device.interpreter.m.motor_on)

    def fall_silent(self) -> None:
        self._device.faults.mute = True
        self._clock.pace = 1.0


class TestCanopenDrive(DriveContract):
    off = "switch on disabled"

    @pytest.fixture
    def bench(self, device_on_bus: Any, settings_of_virtual_joint: CanopenSettings) -> Iterator[Bench]:
        bench = CanopenBench(device_on_bus, settings_of_virtual_joint)
        yield bench
        bench.drive.close()

    def test_the_temperature_is_read_while_the_exchange_goes_on(self, bench: Bench) -> None:
        assert bench.drive.thermometer() is None
        bench.drive.commission()
        bench.drive.start_cyclic()
        meter = bench.drive.thermometer()
        assert meter is not None
        found = eventually(meter.poll, 60.0)
        assert (found.temperature_degC, found.problem) == (25.0, "")
        assert bench.drive.make_safe() == self.off


class TestElmoDrive(DriveContract):
    off = "off"
    mode: ClassVar[Literal["torque", "speed"]] = "torque"

    @pytest.fixture
    def bench(self) -> Iterator[Bench]:
        config = load_config(shipped_config("elmo_serial"))
        with serve_virtual_elmo(config) as device:
            settings = elmo_settings(moved(config, GivenPlace(port=device.path)))
            # slow: a busy computer delays the virtual drive, and the measured line is not the subject here
            bench = ElmoBench(device, dataclasses.replace(settings, rate_Hz=20.0, mode=self.mode))
            yield bench
            bench.drive.close()


class TestElmoDriveInSpeedMode(TestElmoDrive):
    mode = "speed"
