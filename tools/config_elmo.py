"""The [drive] section of a serial drive (kind "elmo_serial"), and what follows from it.

There is no [bus] section: the port takes its place, and `Config.bus` repeats it for the parts that only need a name
and a bit rate.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from drivers.elmo.line_budget import highest_rate_Hz
from drivers.elmo.settings import ElmoSettings
from drivers.errors import ConfigurationError
from hil.elmo_commands import ElmoDeviceSettings
from tools.config_sections import Ampere, Direction, Section, between

if TYPE_CHECKING:
    from tools.config import Config

KIND = "elmo_serial"
INTERFACE = "serial"  # `Config.bus.interface` of a serial drive
BAUD_RATES_bitps = (9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600)


def _baud_rate(value: int) -> int:
    if value not in BAUD_RATES_bitps:
        raise PydanticCustomError("baud", "must be one of {rates}", {"rates": ", ".join(map(str, BAUD_RATES_bitps))})
    return value


def _counts_parameter(value: str) -> str:
    if not re.fullmatch(r"[A-Z]{2}\[\d{1,3}\]", value):
        raise PydanticCustomError("parameter", 'must be a parameter with an index, such as "CA[18]"')
    return value


class ElmoSerial(Section):
    """An Elmo drive on RS-232 or USB serial, spoken to over its ASCII interpreter."""

    kind: Literal["elmo_serial"]
    port: Annotated[str, Field(min_length=1)]  # as the system names it
    baud_rate_bitps: Annotated[int, AfterValidator(_baud_rate)]
    echo: bool = True  # EO: replies carry their command, which proves what they answer; false is faster
    reply_timeout_s: Annotated[float, between(0.01, 2.0)] = 0.2  # of one command during commissioning
    product: Annotated[str, Field(min_length=1)] | None = None  # VR must contain it; None = any
    ampere: Ampere = "sine_amplitude"  # of TC and IQ
    continuous_current_A: Annotated[float, between(0.0, 1000.0, open_low=True)]  # CL[1]
    peak_current_A: Annotated[float, between(0.0, 1000.0, open_low=True)]  # PL[1]
    peak_time_s: Annotated[float, between(0.0, 100.0, open_low=True)] = 3.0  # PL[2]
    torque_direction: Direction = 1  # -1: positive current drives the joint to negative angles
    limit_margin: Annotated[float, between(0.0, 2.0)] = 0.2  # HL, LL lie outside [limits] by this share
    speed_error_radps: Annotated[float, between(0.0, 1000.0, open_low=True)]  # ER[2], at the joint
    position_error_rad: Annotated[float, between(0.0, 10.0, open_low=True)]  # ER[3], at the joint
    dead_man_s: Annotated[float, between(0.0, 1.0, open_low=True)] = 0.05  # torque zero after so long without position
    counts_parameter: Annotated[str, AfterValidator(_counts_parameter)] | None = None  # compared with counts_per_turn


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
    bus = {"interface": INTERFACE, "channel": port if good else "-", "bitrate_bitps": baud_rate if good else 19_200}
    return {**data, "bus": bus}


def elmo_section(config: Config) -> ElmoSerial:
    """[drive] of a serial drive; `ConfigurationError` for any other."""
    if not isinstance(config.drive, ElmoSerial):
        raise ConfigurationError(f'{config.path}: drive.kind (={config.drive.kind}) must be "{KIND}" for a serial port')
    return config.drive


def with_port_override(config: Config, port: str | None) -> Config:
    """The configuration on another serial port; None leaves it as it is."""
    if port is None:
        return config
    drive = elmo_section(config).model_copy(update={"port": port})
    return config.model_copy(update={"drive": drive, "bus": config.bus.model_copy(update={"channel": port})})


def elmo_settings(config: Config, torque_constant_NmpA: float) -> ElmoSettings:
    """Sections [drive], [encoder], [joint], [limits] and [loop] for the driver."""
    drive, limits = elmo_section(config), config.limits
    return ElmoSettings(
        port=drive.port,
        baud_rate_bitps=drive.baud_rate_bitps,
        echo=drive.echo,
        reply_timeout_s=drive.reply_timeout_s,
        rate_Hz=config.loop.rate_Hz,
        torque_max_Nm=limits.torque_max_Nm,
        torque_constant_NmpA=torque_constant_NmpA,
        torque_direction=drive.torque_direction,
        reduction_ratio=config.joint.reduction_ratio,
        counts_per_turn=config.encoder.counts_per_turn,
        encoder_on_motor=config.encoder.side == "motor",
        encoder_direction=config.encoder.direction,
        zero_counts=config.encoder.zero_counts,
        continuous_current_A=drive.continuous_current_A,
        peak_current_A=drive.peak_current_A,
        peak_time_s=drive.peak_time_s,
        velocity_max_radps=limits.velocity_max_radps,
        position_min_rad=limits.position_min_rad,
        position_max_rad=limits.position_max_rad,
        limit_margin=drive.limit_margin,
        speed_error_radps=drive.speed_error_radps,
        position_error_rad=drive.position_error_rad,
        dead_man_s=drive.dead_man_s,
        product=drive.product,
        counts_parameter=drive.counts_parameter,
    )


def elmo_device_settings(config: Config) -> ElmoDeviceSettings:
    """The virtual drive that the configuration describes."""
    drive = elmo_section(config)
    return ElmoDeviceSettings(
        maximum_current_A=max(20.0, drive.peak_current_A),
        counts_per_turn=config.encoder.counts_per_turn,
        current_sign=drive.torque_direction * config.encoder.direction,
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


def serial_problems(config: Config) -> list[str]:
    """What does not fit together, one line each, without the file name."""
    drive = elmo_section(config)
    found = []
    if drive.continuous_current_A > drive.peak_current_A:
        found.append(
            f"drive.continuous_current_A (={drive.continuous_current_A:g}) must be at most drive.peak_current_A "
            f"(={drive.peak_current_A:g})"
        )
    from tools.config_records import torque_constant_NmpA  # which imports the whole configuration

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
