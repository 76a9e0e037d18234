"""The [drive] section of a serial drive (kind "elmo_serial"), and what follows from it.

There is no [bus] section: the port takes its place, and `Config.bus` repeats it for the parts that only need a name
and a bit rate.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, PrivateAttr
from pydantic_core import PydanticCustomError

from jointctl.drivers.elmo.settings import SERIAL
from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.sections import Ampere, Direction, Rule, Section, between

KIND = "elmo_serial"
BAUD_RATES_bitps = (9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600)


BAUD_RATES_TEXT = "one of " + ", ".join(map(str, BAUD_RATES_bitps))


def _baud_rate(value: int) -> int:
    if value not in BAUD_RATES_bitps:
        raise PydanticCustomError("baud", "must be {rates}", {"rates": BAUD_RATES_TEXT})
    return value


COUNTS_PARAMETER_TEXT = 'a parameter with an index, such as "CA[18]"'


def _counts_parameter(value: str) -> str:
    if not re.fullmatch(r"[A-Z]{2}\[\d{1,3}\]", value):
        raise PydanticCustomError("parameter", f"must be {COUNTS_PARAMETER_TEXT}")
    return value


UnitModeChoice = Literal["torque", "speed", "auto"]


class ElmoSerial(Section):
    """An Elmo drive on RS-232 or USB serial, spoken to over its ASCII interpreter."""

    kind: Literal["elmo_serial"]  # an Elmo drive on its serial line
    port: Annotated[str, Field(min_length=1)]  # as the system names it
    baud_rate_bitps: Annotated[int, AfterValidator(Rule(BAUD_RATES_TEXT, _baud_rate))]  # as the drive is set
    echo: bool = True  # EO: replies carry their command, which proves what they answer; false is faster
    reply_timeout_s: Annotated[float, between(0.01, 2.0)] = 0.2  # of one command during commissioning
    product: Annotated[str, Field(min_length=1)] | None = None  # VR must contain it; none = any
    ampere: Ampere = "sine_amplitude"  # of TC and IQ
    continuous_current_A: Annotated[float, between(0.0, 1000.0, open_low=True)]  # CL[1]
    peak_current_A: Annotated[float, between(0.0, 1000.0, open_low=True)]  # PL[1]
    peak_time_s: Annotated[float, between(0.0, 100.0, open_low=True)] = 3.0  # PL[2]
    torque_direction: Direction = 1  # -1: positive current drives the joint to negative angles
    limit_margin: Annotated[float, between(0.0, 2.0)] = 0.2  # HL, LL lie outside [limits] by this share
    speed_error_radps: Annotated[float, between(0.0, 1000.0, open_low=True)]  # ER[2], at the joint
    position_error_rad: Annotated[float, between(0.0, 10.0, open_low=True)]  # ER[3], at the joint
    dead_man_s: Annotated[float, between(0.0, 0.5, open_low=True)] = 0.05  # torque zero after so long without position
    counts_parameter: Annotated[str, AfterValidator(Rule(COUNTS_PARAMETER_TEXT, _counts_parameter))] | None = (
        None  # compared with counts_per_turn
    )
    _unit_mode: UnitModeChoice = PrivateAttr("torque")

    @property
    def unit_mode(self) -> UnitModeChoice:
        """Torque, except for a sweep: `run` needs the torque."""
        return self._unit_mode

    def in_unit_mode(self, mode: UnitModeChoice) -> ElmoSerial:
        """The same drive in another unit mode; auto: speed where the drive has it."""
        drive = self.model_copy()
        drive._unit_mode = mode
        return drive


def with_serial_bus(data: Any) -> Any:
    """The raw configuration with the [bus] that a serial port stands for; others are returned as they are."""
    drive = data.get("drive") if isinstance(data, dict) else None
    if not isinstance(drive, dict) or drive.get("kind") != KIND:
        return data
    if "bus" in data:
        raise ConfigurationError('[bus] must be absent with drive.kind "elmo_serial": drive.port is the bus')
    port, baud_rate = drive.get("port"), drive.get("baud_rate_bitps")
    good = isinstance(port, str) and port and baud_rate in BAUD_RATES_bitps
    # where port or rate are wrong, the section itself says so
    bus = {"interface": SERIAL, "channel": port if good else "-", "bitrate_bitps": baud_rate if good else 19_200}
    return {**data, "bus": bus}
