"""From a configuration to the virtual joint: its plant and its faults."""

from __future__ import annotations

from typing import Any

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.schema import new
from jointctl.hil.faults.kinds import FaultConstants, FaultKind, no_faults
from jointctl.hil.plant.records import EncoderSide, FrictionKind
from jointctl.hil.plant.settings import PlantSettings
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import friction_constants, torque_constant_NmpA
from jointctl.tools.configuration.plant import OWN_KEYS, Virtual


def fault_constants(config: Config) -> Any:
    """[[virtual.faults]] as a record array of `FaultConstants`."""
    chosen = config.virtual.faults if config.virtual is not None else ()
    if not chosen:
        return no_faults()
    faults = new(FaultConstants, len(chosen))
    for record, fault in zip(faults, chosen, strict=True):
        record.kind = FaultKind[fault.kind.upper()]
        record.start_s, record.duration_s = fault.at_s, fault.duration_s
        record.magnitude, record.seed = fault.magnitude, fault.seed
    return faults


def plant_keywords(config: Config, torque_constant_NmpA: float, friction: Any = None) -> dict[str, Any]:
    """Keyword arguments of `hil.plant.joint.plant`; the torque constant is in the drive's ampere."""
    assert config.virtual is not None
    settings = {k: getattr(config.virtual, k) for k in Virtual.model_fields if k not in OWN_KEYS}
    return {
        **settings,
        "inertia_kgm2": config.joint.inertia_kgm2 * config.virtual.inertia_scale,
        "reduction_ratio": config.joint.reduction_ratio,
        "torque_constant_NmpA": torque_constant_NmpA,
        "friction_kind": FrictionKind[config.virtual.friction_kind.upper()],
        "friction": friction,
        "encoder_side": EncoderSide[config.encoder.side.upper()],
        "encoder_counts_per_turn": config.encoder.counts_per_turn,
        "encoder_direction": config.encoder.direction,
        "encoder_offset_counts": config.encoder.zero_counts,
    }


def plant_problems(config: Config) -> list[str]:
    """What the plant itself refuses about [virtual], such as a step too long for the stiffness."""
    if config.virtual is None:
        return []
    try:
        PlantSettings(**plant_keywords(config, config.joint.torque_constant_NmpA))
    except ValueError as error:
        return [f"virtual.{error}"]
    return []


def plant_settings(config: Config) -> dict[str, Any]:
    """Keyword arguments for `hil.plant.joint.plant`; needs a [virtual] section."""
    if config.virtual is None:
        raise ConfigurationError(f"{config.path}: [virtual] is missing: the virtual joint needs its true values")
    friction = None
    table = config.virtual.friction or config.friction
    if table is not None:
        friction = friction_constants(table, config.joint.reduction_ratio)[0]
    return plant_keywords(config, torque_constant_NmpA(config), friction)
