"""From a configuration to the virtual joint: its drive, its plant and its faults."""

from __future__ import annotations

import math
from typing import Any

from jointctl.drivers.canopen.eds import read_eds
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.schema import new
from jointctl.hil.arm_plant import ArmPlant, arm_plant
from jointctl.hil.canopen.device import DeviceSettings
from jointctl.hil.canopen.encoder_node import EncoderSettings
from jointctl.hil.faults import FaultConstants, FaultKind, no_faults
from jointctl.hil.plant_records import EncoderSide, FrictionKind, PlantSettings
from jointctl.tools.configuration.arm import ArmConfig
from jointctl.tools.configuration.canopen import CanopenSection, canopen_section, eds_path, encoder_eds_path
from jointctl.tools.configuration.config import SHIPPED_FOLDER, Config, raise_if
from jointctl.tools.configuration.conversions import friction_constants, torque_constant_NmpA
from jointctl.tools.configuration.sections import OWN_KEYS, Virtual

VIRTUAL_EDS = SHIPPED_FOLDER / "virtual_joint.eds"  # what the virtual drive is, whatever objects it shows


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
    """Keyword arguments of `hil.plant.plant`; the torque constant is in the drive's ampere."""
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


def _true_friction(config: Config) -> Any:
    """The `FrictionConstants` of the virtual joint; None where the configuration has none."""
    assert config.virtual is not None
    table = config.virtual.friction or config.friction
    return None if table is None else friction_constants(table, config.joint.reduction_ratio)[0]


def plant_problems(config: Config) -> list[str]:
    """What the plant itself refuses about [virtual], such as a step too long for the stiffness."""
    if config.virtual is None:
        return []
    try:
        PlantSettings(**plant_keywords(config, config.joint.torque_constant_NmpA, _true_friction(config)))
    except ValueError as error:
        return [f"virtual.{error}"]
    return []


def plant_settings(config: Config) -> dict[str, Any]:
    """Keyword arguments for `hil.plant.plant`; `ConfigurationError` for what the plant refuses of [virtual]."""
    if config.virtual is None:
        raise ConfigurationError(f"{config.path}: [virtual] is missing: the virtual joint needs its true values")
    raise_if([f"{config.path}: {line}" for line in plant_problems(config)])
    return plant_keywords(config, torque_constant_NmpA(config), _true_friction(config))


def arm_plant_problems(arm: ArmConfig) -> list[str]:
    """What the virtual arm refuses of its joints' [virtual]."""
    found = []
    for config in arm.joints:
        virtual, name = config.virtual, config.path.name
        if virtual is None:
            found.append(f"{name}: [virtual] is missing: the virtual joint needs its true values")
        elif virtual.friction_kind == "stick_slip":
            found.append(f"{name}: virtual.friction_kind (=stick_slip) must be none, sign or lugre in an arm")
        elif arm.joints[0].virtual is not None and virtual.step_s != arm.joints[0].virtual.step_s:
            found.append(
                f"{name}: virtual.step_s (={virtual.step_s:g}) must be that of {arm.joints[0].path.name} "
                f"(={arm.joints[0].virtual.step_s:g})"
            )
    return found


def arm_plant_of(arm: ArmConfig) -> ArmPlant:
    """What connects the virtual joints of an arm; masses and inertias times virtual.inertia_scale of each joint."""
    raise_if([f"{arm.path}: {line}" for line in arm_plant_problems(arm)])
    links = arm.model.links.copy()
    for link, config in zip(links, arm.joints, strict=True):
        assert config.virtual is not None
        scale = config.virtual.inertia_scale
        for name in ("mass_kg", "moment_kgm", "inertia_kgm2"):
            link[name] *= scale
        link.motor_inertia_kgm2 *= 0.0 if config.virtual.flexible else scale
    return arm_plant(links, tuple(arm.arm.gravity_mps2))


def device_settings(config: Config) -> DeviceSettings:
    """The virtual drive that the configuration describes, with the objects and the identity of its EDS."""
    drive = canopen_section(config)
    path = eds_path(config)
    eds = None if path.resolve() == VIRTUAL_EDS else read_eds(path, drive.node)
    vendor_id, product_code = (eds.vendor_id, eds.product_code) if eds is not None else (None, None)
    current_A, torque_Nm, constant_NmpA = drive.rated_current_A, drive.rated_torque_Nm, torque_constant_NmpA(config)
    if current_A is None and torque_Nm is None:  # `problems` refuses a file with [virtual] for that
        raise ConfigurationError(
            "drive.rated_current_A or drive.rated_torque_Nm is missing: the virtual drive needs it"
        )
    return DeviceSettings(
        node_id=drive.node,
        rated_current_mA=round((current_A or (torque_Nm or 0.0) / constant_NmpA) * 1000.0),
        rated_torque_mNm=round((torque_Nm or (current_A or 0.0) * constant_NmpA) * 1000.0),
        reduction_ratio=config.joint.reduction_ratio,
        motor_torque_constant_NmpA=torque_constant_NmpA(config),
        torque_direction=drive.torque_direction,
        vendor_id=drive.vendor_id or vendor_id or 0,
        product_code=drive.product_code or product_code or 1,
        shown=eds.dictionary if eds is not None else None,
        **_second_encoder(config),
        **_drive_loops(drive),
    )


def _drive_loops(drive: CanopenSection) -> dict[str, Any]:
    """Its own loops in CSP and CSV, with the gains that the configuration knows; else those of `DeviceSettings`."""
    cascade = drive.cascade
    if cascade is None:
        return {}
    gains = {
        "velocity_gain_Nmspr": cascade.velocity_gain_Nmspr,
        "velocity_integral_Nmprad": cascade.velocity_integral_Nmprad,
        "position_gain_ps": cascade.position_gain_ps if drive.mode == "csp" else None,
    }
    known = {name: gain for name, gain in gains.items() if gain is not None}
    return {**known, "velocity_feed": 1.0 - cascade.velocity_share, "loop_rate_Hz": cascade.loop_rate_Hz}


def _second_encoder(config: Config) -> dict[str, Any]:
    """The virtual joint's second encoder: true to the configuration, but for [virtual]."""
    encoder = config.joint_encoder
    if encoder is None:
        return {}
    counts, zero = encoder.counts_per_turn, encoder.zero_counts
    path = encoder_eds_path(config)
    if encoder.source == "drive" or path is None or encoder.node is None:
        return {"second_counts_prad": encoder.direction * counts / math.tau, "second_offset_counts": float(zero)}
    return {"encoder": EncoderSettings(path, encoder.node, counts, encoder.direction, zero)}
