"""Do the constants that turn the drive's reading into torque agree with each other?  And what the sidecar keeps.

A CiA 402 drive tells its torque in thousandths of a rated value, so that a wrong torque constant or rated value scales
all friction by the same factor, and nothing in the curve's shape shows it.  But three of the numbers are tied: rated
torque is about torque constant times rated current.  A factor of 1.41 between them is rms against sine amplitude.
A serial drive tells amperes and has no rated torque: its torque constant cannot be checked this way.
"""

from __future__ import annotations

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import ConfigurationError, DeviceError
from jointctl.tools.configuration.checks import rated_contradiction
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import joint_rad_per_count, torque_constant_NmpA

WRONG_FACTOR = 3.0


def refuse_constants(config: Config) -> None:
    """Raise `ConfigurationError` if no motor can have these constants."""
    found = config.drive.constants_factor(config)
    if found is not None and not 1.0 / WRONG_FACTOR <= found[0] <= WRONG_FACTOR:
        raise ConfigurationError(f"{config.path}: {found[1]}", "nothing was moved; see the data sheets")


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
    return [line + "; friction would be wrong by that factor" for line in rated_contradiction(config)]


def recorded_limits(config: Config) -> dict[str, float]:
    """For the sidecar: what `identify` compares the data with when no configuration is at hand; at the joint."""
    return {
        "torque_max_Nm": config.limits.torque_max_Nm,
        "velocity_max_radps": config.limits.velocity_max_radps,
    }


def measuring_constants(config: Config) -> dict[str, float]:
    """What turns readings into velocity and friction: points measured with other numbers are not one sweep."""
    return {
        "torque_constant_NmpA": torque_constant_NmpA(config),
        "torque_direction": float(config.drive.torque_direction),
        "rad_per_count": joint_rad_per_count(config),
        "gravity_Nm": config.joint.gravity_Nm,
        "gravity_zero_rad": config.joint.gravity_zero_rad,
        **config.drive.measuring_constants(),
    }
