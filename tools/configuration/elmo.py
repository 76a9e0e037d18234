"""[drive], kind = "elmo_serial": the section, and what the serial driver gets of it.

There is no [bus] section: the port takes its place, and `Config.bus` repeats it for the parts that only need a name
and a bit rate.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field, PrivateAttr
from pydantic_core import PydanticCustomError

from jointctl.drivers.elmo.settings import SERIAL, ElmoSettings, highest_rate_Hz
from jointctl.drivers.errors import ConfigurationError, DeviceError
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import joint_settings, torque_constant_NmpA
from jointctl.tools.configuration.drive_section import FOR_A_NODE, FOR_A_PORT, DriveSection, GivenPlace, wrong_kind
from jointctl.tools.configuration.sections import Rule, between

RAMP_SPARE = 4.0  # of the drive's ramps in speed mode over sequence.brake_radps2: steeper than what the sweep asks for
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
SWEEP_MODES: dict[str, UnitModeChoice] = {"auto": "auto", "speed": "speed", "torque": "torque"}  # of `sweep --mode`


class ElmoSection(DriveSection):
    """An Elmo drive on RS-232 or USB serial, spoken to over its ASCII interpreter."""

    kind: Literal["elmo_serial"]  # an Elmo drive on its serial line
    port: Annotated[str, Field(min_length=1)]  # as the system names it
    baud_rate_bitps: Annotated[int, AfterValidator(Rule(BAUD_RATES_TEXT, _baud_rate))]  # as the drive is set
    echo: bool = True  # EO: replies carry their command, which proves what they answer; false is faster
    reply_timeout_s: Annotated[float, between(0.01, 2.0)] = 0.2  # of one command during commissioning
    product: Annotated[str, Field(min_length=1)] | None = None  # VR must contain it; none = any
    continuous_current_A: Annotated[float, between(0.0, 1000.0, open_low=True)]  # CL[1]
    peak_current_A: Annotated[float, between(0.0, 1000.0, open_low=True)]  # PL[1]
    peak_time_s: Annotated[float, between(0.0, 100.0, open_low=True)] = 3.0  # PL[2]
    limit_margin: Annotated[float, between(0.0, 2.0)] = 0.2  # HL, LL lie outside [limits] by this share
    speed_error_radps: Annotated[float, between(0.0, 1000.0, open_low=True)]  # ER[2], at the joint
    position_error_rad: Annotated[float, between(0.0, 10.0, open_low=True)]  # ER[3], at the joint
    dead_man_s: Annotated[float, between(0.0, 0.5, open_low=True)] = 0.05  # torque zero after so long without position
    # compared with counts_per_turn
    counts_parameter: Annotated[str, AfterValidator(Rule(COUNTS_PARAMETER_TEXT, _counts_parameter))] | None = None
    _unit_mode: UnitModeChoice = PrivateAttr("torque")

    when_the_loop_ends: ClassVar[str] = "a serial drive does not notice that: it has been commanded to switch off"
    torque_source: ClassVar[str] = (
        "current IQ as the drive measures it; motor_torque_Nm = current_A * torque_constant_NmpA"
    )

    @property
    def unit_mode(self) -> UnitModeChoice:
        """Torque, except for a sweep: `run` needs the torque."""
        return self._unit_mode

    def in_unit_mode(self, mode: UnitModeChoice) -> ElmoSection:
        """The same drive in another unit mode; auto: speed where the drive has it."""
        drive = self.model_copy()
        drive._unit_mode = mode
        return drive

    @classmethod
    def completed(cls, data: dict[str, Any]) -> dict[str, Any]:
        """With the [bus] that a serial port stands for."""
        if "bus" in data:
            raise ConfigurationError('[bus] must be absent with drive.kind "elmo_serial": drive.port is the bus')
        port, baud_rate = data["drive"].get("port"), data["drive"].get("baud_rate_bitps")
        good = isinstance(port, str) and port and baud_rate in BAUD_RATES_bitps
        # where port or rate are wrong, the section itself says so
        bus = {"interface": SERIAL, "channel": port if good else "-", "bitrate_bitps": baud_rate if good else 19_200}
        return {**data, "bus": bus}

    def problems(self, config: Config) -> list[str]:
        if config.joint_encoder is not None:
            return ['[joint_encoder] needs a CANopen drive: drive.kind must be "canopen"', *elmo_problems(config)]
        return elmo_problems(config)

    def moved(self, config: Config, given: GivenPlace, environ: Mapping[str, str]) -> Config:
        """On another port; the environment speaks of CAN only."""
        if given.bus is not None:
            raise ConfigurationError(
                f"command line: {given.bus} names a CAN bus, the drive is on a serial port: use -p"
            )
        if given.node is not None:
            raise wrong_kind(config.path, self.kind, FOR_A_NODE)
        if given.port is None:
            return config
        return config.changed(drive__port=given.port, bus__channel=given.port)

    def assumed_delay(self, config: Config) -> tuple[float, str]:
        return 1.0 / config.loop.rate_Hz, "assumed: at most one period (serial line)"

    def in_sweep_mode(self, mode: str) -> ElmoSection:
        if mode not in SWEEP_MODES:
            raise DeviceError(f"--mode (={mode}) must be auto, speed or torque: it is a serial drive")
        return self.in_unit_mode(SWEEP_MODES[mode])


def elmo_section(config: Config) -> ElmoSection:
    """[drive] of a serial drive; `ConfigurationError` for any other."""
    if not isinstance(config.drive, ElmoSection):
        raise wrong_kind(config.path, config.drive.kind, FOR_A_PORT)
    return config.drive


def elmo_settings(config: Config) -> ElmoSettings:
    """Sections [drive], [encoder], [joint], [limits] and [loop] for the driver."""
    drive = elmo_section(config)
    return ElmoSettings(
        **joint_settings(ElmoSettings, config, drive),
        ramp_radps2=RAMP_SPARE * config.sequence.brake_radps2,
        mode=drive.unit_mode,
    )


def serial_line_share(config: Config) -> float:
    """Share of the period that the characters of a cycle take at worst; refuses more than all of it."""
    drive, rate_Hz = elmo_section(config), config.loop.rate_Hz
    highest = highest_rate_Hz(drive.baud_rate_bitps, drive.echo)
    if rate_Hz > highest:
        raise ConfigurationError(
            f"{config.path}: loop.rate_Hz (={rate_Hz:g}) must be at most {highest:.0f} at drive.baud_rate_bitps "
            f"(={drive.baud_rate_bitps}) with drive.echo (={str(drive.echo).lower()})"
        )
    return rate_Hz / highest


def elmo_problems(config: Config) -> list[str]:
    """What does not fit together, one line each, without the file name."""
    drive = elmo_section(config)
    found = []
    if drive.continuous_current_A > drive.peak_current_A:
        found.append(
            f"drive.continuous_current_A (={drive.continuous_current_A:g}) must be at most drive.peak_current_A "
            f"(={drive.peak_current_A:g})"
        )

    reach_Nm = drive.peak_current_A * torque_constant_NmpA(config) * config.joint.reduction_ratio
    if config.limits.torque_max_Nm > reach_Nm * (1.0 + 1e-9):
        found.append(
            f"limits.torque_max_Nm (={config.limits.torque_max_Nm:g}) must be in (0..{reach_Nm:g}], "
            "what drive.peak_current_A gives at the joint"
        )
    if drive.dead_man_s * config.loop.rate_Hz < 1.0:
        found.append(f"drive.dead_man_s (={drive.dead_man_s:g}) must be at least one period")
    if drive.dead_man_s > config.limits.sample_age_max_s:
        found.append(
            f"drive.dead_man_s (={drive.dead_man_s:g}) must be at most limits.sample_age_max_s "
            f"(={config.limits.sample_age_max_s:g})"
        )
    return found
