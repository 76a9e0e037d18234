"""A CANopen drive in a session."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from jointctl.drivers.can.frames import worst_frame_bits
from jointctl.drivers.can.open import CYCLIC_INTERFACES, SHARED_INTERFACES
from jointctl.drivers.canopen.cia import EVENT_DRIVEN, State, state_of_word, state_text
from jointctl.drivers.drive import Drive, DriveGroup
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.cycle import Histogram
from jointctl.firmware_py.states import CommandKind, Fault
from jointctl.tools.configuration.canopen import RPDO_BYTES, canopen_section, canopen_settings, cyclic_bus_load
from jointctl.tools.configuration.config import Config, first_on_bus
from jointctl.tools.session.fault_words import FaultText, emergency_text, fault_text
from jointctl.tools.session.loop_memory import quantile_s
from jointctl.tools.session.session_drive import SessionDrive

if TYPE_CHECKING:
    import can


_BAD = (State.FAULT, State.FAULT_REACTION_ACTIVE, State.UNDEFINED)


class CanopenSession(SessionDrive):
    """See `SessionDrive`.  The drive watches the loop's heartbeat by itself: no guard."""

    def check_rate(self, config: Config) -> None:
        import can

        cyclic_bus_load(config)
        # a name that python-can does not know is reported when the bus is opened
        if config.bus.interface not in CYCLIC_INTERFACES and config.bus.interface in can.VALID_INTERFACES:
            from jointctl.tools.session.portable_loop import check_portable_rate

            check_portable_rate(config.bus.interface, config.loop.rate_Hz)

    def open(self, config: Config, gate: Callable[[], None] = lambda: None, private: bool = False) -> Drive:
        from jointctl.drivers.can.open import open_python_can
        from jointctl.drivers.canopen.drive import CanopenDrive

        def open_bus() -> can.BusABC:
            bus = config.bus
            return open_python_can(bus.interface, bus.channel, bus.bitrate_bitps)

        reopen = None if config.bus.interface in SHARED_INTERFACES else open_bus
        private = private and config.bus.interface == "jointctl"  # a bus of metal is never ours alone
        return CanopenDrive(open_bus(), canopen_settings(config), reopen=reopen, gate=gate, private=private)

    def open_all(
        self, configs: Sequence[Config], gate: Callable[[], None] = lambda: None, private: bool = False
    ) -> DriveGroup:
        """See `SessionDrive`; all drives of a bus share one end of it."""
        from jointctl.drivers.canopen.drive import CanopenDrive

        if len(configs) == 1:
            return DriveGroup([self.open(configs[0], gate, private)])
        require_buses(configs)
        drives: list[CanopenDrive] = []
        buses = first_on_bus(configs)
        with contextlib.ExitStack() as stack:
            for axis, config in enumerate(configs):
                if buses[axis] < axis:
                    drives.append(CanopenDrive(drives[buses[axis]], canopen_settings(config), gate=gate))
                    continue
                first = self.open(config, gate, private)
                assert isinstance(first, CanopenDrive)
                stack.callback(first.close)
                drives.append(first)
            stack.pop_all()
        return DriveGroup(drives, buses, [config.path.name for config in configs])

    def loop_delay_s(self, config: Config, histograms: np.ndarray) -> float:
        kind, rate_Hz = canopen_section(config).rpdo_transmission_type, config.loop.rate_Hz
        return measured_delay_s(histograms, kind, 1.0 / rate_Hz, 1.0 / config.bus.bitrate_bitps)

    def fault_text(
        self, config: Config, fault: Fault, value: float, drive_error: int, encoder_error: int = 0
    ) -> FaultText:
        return fault_text(
            fault, value, drive_error, encoder_error, two_encoders=config.joint_encoder is not None,
            own_loop=config.drive.own_loop() is not CommandKind.TORQUE,
        )  # fmt: skip

    def error_text(self, code: int) -> str:
        return f"EMCY {emergency_text(code)}"

    def state_text(self, status_word: int) -> str:
        return state_text(status_word)

    def in_fault(self, status_word: int) -> bool:
        return state_of_word(status_word) in _BAD

    def bits_sent(self, ports: np.recarray, axis: int = 0) -> float:
        """Each drive's exchange counts what it sends itself, SYNC, and everything that it receives."""
        first, *others = ports[ports.bus == ports[axis].bus]
        of_others = sum(int(port.cycle) * worst_frame_bits(int(port.rpdo_length)) for port in others)
        return float(first.bits_sent) + of_others

    def refuse_others(self, port: np.recarray) -> None:
        one = port[0]
        if one.of_others or one.of_another_sync or one.of_another_heart:
            from jointctl.drivers.canopen.network import another_controller, own_heartbeat

            rpdo = f"RPDO to node {one.node} ({one.rpdo_id:03X}h) with other commands"
            heartbeat = own_heartbeat(int(one.own_heartbeat_id))
            seen = ((one.of_others, rpdo), (one.of_another_sync, "SYNC"), (one.of_another_heart, heartbeat))
            raise another_controller(", ".join(f"{count} x {words}" for count, words in seen if count))

    def load_row(self, share: float) -> tuple[str, str]:
        return "bus load", f"{share:.1%} at worst-case stuffing"


def require_buses(configs: Sequence[Config]) -> None:
    """`ConfigurationError` for joints of an arm that one loop cannot command."""
    for config in configs:
        if config.bus.interface not in CYCLIC_INTERFACES:
            raise ConfigurationError(
                f"{config.path}: bus.interface (={config.bus.interface}) must be one of "
                f"{', '.join(CYCLIC_INTERFACES)} for an arm"
            )


def measured_delay_s(histograms: np.ndarray, rpdo_transmission_type: int, period_s: float, bit_s: float) -> float:
    """Loop delay [s] from the histograms of the first cycles; `bit_s` is the duration of one bit on the bus.

    From the position sample (SYNC) to the moment at which the torque computed from it takes effect in the drive.

    Round trip and work at their 99th percentile, and the RPDO on the wire.  A synchronous RPDO waits for the next
    SYNC (transmission type n > 1: for the n-th), so that its delay is a whole number of periods.
    """
    rpdo_s = worst_frame_bits(RPDO_BYTES) * bit_s
    path_s = quantile_s(histograms[Histogram.ROUND_TRIP]) + quantile_s(histograms[Histogram.WORK]) + rpdo_s
    if rpdo_transmission_type >= EVENT_DRIVEN:
        return path_s
    periods = math.ceil(path_s / period_s)
    return period_s * max(periods, rpdo_transmission_type, 1)
