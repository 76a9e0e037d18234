"""Do the constants that turn the drive's reading into torque agree with each other?  And what the sidecar keeps.

A CiA 402 drive tells its torque in thousandths of a rated value, so that a wrong torque constant or rated value scales
all friction by the same factor, and nothing in the curve's shape shows it.  But three of the numbers are tied: rated
torque is about torque constant times rated current.  A factor of 1.41 between them is rms against sine amplitude.
A serial drive tells amperes and has no rated torque: its torque constant cannot be checked this way.
"""

from __future__ import annotations

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import ConfigurationError, DeviceError
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import joint_rad_per_count, torque_constant_NmpA
from jointctl.tools.configuration.elmo import ElmoSerial

DOUBTFUL_FACTOR = 1.25  # motors are rated at a speed, where losses take part of the torque
WRONG_FACTOR = 3.0


def _factor(config: Config) -> float | None:
    """Torque constant times rated current over rated torque; None if one of them is not given."""
    drive = config.drive
    if isinstance(drive, ElmoSerial) or drive.rated_torque_Nm is None or drive.rated_current_A is None:
        return None
    return torque_constant_NmpA(config) * drive.rated_current_A / drive.rated_torque_Nm


def _text(config: Config, factor: float) -> str:
    drive = config.canopen
    return (
        f"joint.torque_constant_NmpA (={torque_constant_NmpA(config):.4g} in the drive's ampere) times "
        f"drive.rated_current_A (={drive.rated_current_A:g}) is {factor:.3g} times drive.rated_torque_Nm "
        f"(={drive.rated_torque_Nm:g}): one of them is wrong, or rms and sine amplitude are mixed up"
    )


def refuse_constants(config: Config) -> None:
    """Raise `ConfigurationError` if no motor can have these constants."""
    factor = _factor(config)
    if factor is not None and not 1.0 / WRONG_FACTOR <= factor <= WRONG_FACTOR:
        raise ConfigurationError(f"{config.path}: {_text(config, factor)}", "nothing was moved; see the data sheets")


def require_torque(report: CommissioningReport) -> None:
    """`DeviceError` where the torque of every sample would be zero."""
    if not report.measures_torque:
        raise DeviceError(
            "the drive does not tell its torque in the cyclic exchange (object 6077): friction would read as zero, "
            "and a blocked joint would not be noticed",
            "use an EDS with 6077, and let it be mapped to a PDO",
        )


def constant_remarks(config: Config) -> list[str]:
    """What the user should look at before the joint moves."""
    factor = _factor(config)
    if factor is None or 1.0 / DOUBTFUL_FACTOR <= factor <= DOUBTFUL_FACTOR:
        return []
    return [_text(config, factor) + "; friction would be wrong by that factor"]


def recorded_limits(config: Config) -> dict[str, float]:
    """For the sidecar: what `identify` compares the data with when no configuration is at hand; at the joint."""
    return {
        "torque_max_Nm": config.limits.torque_max_Nm,
        "velocity_max_radps": config.limits.velocity_max_radps,
    }


def measuring_constants(config: Config) -> dict[str, float]:
    """What turns readings into velocity and friction: points measured with other numbers are not one sweep."""
    drive = config.drive
    found = {
        "torque_constant_NmpA": torque_constant_NmpA(config),
        "torque_direction": float(drive.torque_direction),
        "rad_per_count": joint_rad_per_count(config),
        "gravity_Nm": config.joint.gravity_Nm,
        "gravity_zero_rad": config.joint.gravity_zero_rad,
    }
    if not isinstance(drive, ElmoSerial):
        found["rated_torque"] = float(drive.torque_reference == "rated_torque")
    return found


def torque_source(config: Config) -> str:
    """For the sidecar: which reading of the drive the torque comes from."""
    if config.is_serial:
        return "current IQ as the drive measures it; motor_torque_Nm = current_A * torque_constant_NmpA"
    return "object 6077 as the drive measures it; current_A = motor_torque_Nm / torque_constant_NmpA"
