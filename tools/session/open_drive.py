"""The one place that knows which drive a configuration means: everything else goes through the `Drive` protocol."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import can

from jointctl.drivers.can.open import CYCLIC_INTERFACES, SHARED_INTERFACES, open_python_can
from jointctl.drivers.can.socketcan import interface_blamed
from jointctl.drivers.canopen.drive import CanopenDrive
from jointctl.drivers.drive import Approval, CommissioningReport, Drive
from jointctl.drivers.elmo.codes import motor_fault_text
from jointctl.drivers.elmo.drive import ElmoDrive
from jointctl.drivers.elmo.line_budget import command_time_s
from jointctl.firmware_py.realtime import Histogram
from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import torque_constant_NmpA
from jointctl.tools.configuration.drive_settings import canopen_settings, cyclic_bus_load
from jointctl.tools.configuration.elmo import ElmoSerial
from jointctl.tools.configuration.elmo_settings import elmo_settings, serial_line_share
from jointctl.tools.session.fault_words import FaultText, fault_text, serial_fault_text
from jointctl.tools.session.loop_delay import QUANTILE, measured_delay_s, quantile_s
from jointctl.tools.session.portable_loop import check_portable_rate


def check_cyclic_rate(config: Config) -> None:
    """`ConfigurationError` if bus or line do not carry the rate; before anything is opened."""
    if isinstance(config.drive, ElmoSerial):
        serial_line_share(config)
        return
    cyclic_bus_load(config)
    # a name that python-can does not know is told when the bus is opened
    if config.bus.interface not in CYCLIC_INTERFACES and config.bus.interface in can.VALID_INTERFACES:
        check_portable_rate(config.bus.interface, config.loop.rate_Hz)


def open_drive(config: Config, gate: Callable[[], None] = lambda: None) -> Drive:
    """The drive of the configuration, its bus or port open; nothing has been sent to it.

    `gate` is called before each step until the loop runs, and raises where none may follow.  The caller holds the lock.
    """
    if isinstance(config.drive, ElmoSerial):
        return ElmoDrive(elmo_settings(config, torque_constant_NmpA(config)), gate=gate)

    def open_bus() -> can.BusABC:
        bus = config.bus
        return open_python_can(bus.interface, bus.channel, bus.bitrate_bitps)

    reopen = None if config.bus.interface in SHARED_INTERFACES else open_bus
    return CanopenDrive(open_bus(), canopen_settings(config), reopen=reopen, gate=gate)


def commission(config: Config, drive: Drive, approve: Approval | None = None) -> CommissioningReport:
    """`Drive.commission`; a failure also names what is wrong with the interface, if something is."""
    with interface_blamed(config.bus.interface, config.bus.channel, config.bus.bitrate_bitps):
        return drive.commission(approve)


def loop_delay_s(config: Config, histograms: Any) -> float:
    """The loop delay as measured in the first cycles, with the drive off.

    Serial: round trip of PX and work at their 99th percentile, and TC on the line; the drive takes it at its end.
    """
    drive = config.drive
    if isinstance(drive, ElmoSerial):
        path_s = quantile_s(histograms[Histogram.ROUND_TRIP], QUANTILE)
        if math.isnan(path_s):
            return 1.0 / config.loop.rate_Hz
        return path_s + quantile_s(histograms[Histogram.WORK], QUANTILE) + command_time_s(drive.baud_rate_bitps)
    return measured_delay_s(
        histograms, drive.rpdo_transmission_type, 1.0 / config.loop.rate_Hz, 1.0 / config.bus.bitrate_bitps
    )


def drive_fault_text(config: Config, fault: Fault, value: float, drive_error: int, encoder_error: int = 0) -> FaultText:
    """A fault in the words that fit the drive, its line and the joint's encoders."""
    if not config.is_serial:
        two_encoders = config.joint_encoder is not None
        return fault_text(fault, value, drive_error, encoder_error, two_encoders=two_encoders)
    text = serial_fault_text(fault, value) or fault_text(fault, value, 0)
    happened = text.happened.format(value=value, word=f"{round(value):X}h") if math.isfinite(value) else text.happened
    if drive_error:
        happened += f"; the drive says {motor_fault_text(drive_error)}"
    return FaultText(happened, text.cause, text.next_step)
