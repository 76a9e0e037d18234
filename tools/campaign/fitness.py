"""Which configurations a campaign can judge: what its sizes and its envelope take for granted."""

from __future__ import annotations

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.campaign.envelope import load_Nm
from jointctl.tools.configuration.config import Config

LEAST_SCALE = 0.9  # of the friction, RIPPLE_Nm the most of the motor: what a scenario draws
RIPPLE_Nm = 1.4


def _demands(config: Config) -> list[tuple[str, float, float]]:
    """(key, value, least value): harmless sizes are just inside these limits, trajectories use that much room."""
    limits, sequence = config.limits, config.sequence
    return [
        ("limits.position_max_rad", limits.position_max_rad, 0.7),
        ("-limits.position_min_rad", -limits.position_min_rad, 0.7),
        ("limits.velocity_max_radps", limits.velocity_max_radps, 1.0),
        ("limits.torque_max_Nm", limits.torque_max_Nm, 60.0),
        ("limits.following_error_max_rad", limits.following_error_max_rad, 0.05),
        ("limits.position_jump_max_rad", limits.position_jump_max_rad, 0.02),
        ("limits.sample_age_max_s", limits.sample_age_max_s, 0.05),
        ("limits.skipped_max_s", limits.skipped_max_s, 0.05),
        ("sequence.supervisor_timeout_s", sequence.supervisor_timeout_s, 1.0),
        ("drive.heartbeat_s", config.canopen.heartbeat_s, 0.2),
    ]


def require_fit(config: Config) -> None:
    """`ConfigurationError` for a configuration whose campaign would prove nothing, or find what is no violation."""
    virtual = config.virtual
    if virtual is None:
        raise ConfigurationError(f"{config.path}: [virtual] is missing: the campaign needs a virtual joint")
    friction = virtual.friction or config.friction
    if friction is None:
        raise ConfigurationError(f"{config.path}: [friction] is missing, and so is [virtual.friction]")
    if virtual.faults:
        raise ConfigurationError(f"{config.path}: [[virtual.faults]] must be empty: the campaign brings its own")
    for key, value, least in _demands(config):
        if value < least:
            raise ConfigurationError(
                f"{config.path}: {key} (={value:g}) must be at least {least:g}: the campaign's harmless faults and its "
                "trajectories are made for the limits of configs/virtual.toml"
            )
    weakest_Nm = config.joint.reduction_ratio * min(abs(friction.positive.tc_Nm), abs(friction.negative.tc_Nm))
    held_Nm = LEAST_SCALE * weakest_Nm * (1.0 - virtual.friction_ripple) - RIPPLE_Nm
    if load_Nm(config) >= held_Nm:
        raise ConfigurationError(
            f"{config.path}: the loads of [virtual] (={load_Nm(config):g} Nm) must be less than {held_Nm:.2f} Nm, what "
            "friction holds in the worst scenario: beyond, the joint needs a brake, and no envelope can be derived"
        )
