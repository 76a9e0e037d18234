"""From a configuration to what the serial driver needs to know."""

from __future__ import annotations

from jointctl.drivers.elmo.line_budget import highest_rate_Hz
from jointctl.drivers.elmo.settings import ElmoSettings
from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import torque_constant_NmpA
from jointctl.tools.configuration.elmo import KIND, ElmoSerial

RAMP_SPARE = 4.0  # of the drive's ramps in speed mode over sequence.brake_radps2: steeper than what the sweep asks for


def elmo_section(config: Config) -> ElmoSerial:
    """[drive] of a serial drive; `ConfigurationError` for any other."""
    if not isinstance(config.drive, ElmoSerial):
        raise ConfigurationError(f'{config.path}: drive.kind (={config.drive.kind}) must be "{KIND}" for a serial port')
    return config.drive


def refuse_serial(config: Config, what: str) -> None:
    """`ConfigurationError` for a serial drive: its joint is simulated in real time only, behind a pseudo-terminal."""
    if config.is_serial:
        raise ConfigurationError(
            f'{config.path}: drive.kind (={KIND}) must be "canopen" for {what}',
            "the serial joint runs in real time only: `jointctl hil --serial`, then `jointctl run CONFIG -p PORT`",
        )


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
        ramp_radps2=RAMP_SPARE * config.sequence.brake_radps2,
        mode=drive.unit_mode,
        product=drive.product,
        counts_parameter=drive.counts_parameter,
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
