"""From a configuration to what the CANopen driver needs to know, and the arithmetic of the bus."""

from __future__ import annotations

from jointctl.drivers.can.frames import bus_load, highest_rate_Hz
from jointctl.drivers.canopen.settings import CanopenSettings, JointEncoderSettings, TemperatureObject
from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import torque_constant_NmpA
from jointctl.tools.configuration.object_place import index_and_sub

TPDO_BYTES, RPDO_BYTES = 8, 4
VELOCITY_RPDO_BYTES = 6  # 60FF is longer than 6071
SECOND_POSITION_BYTES = 4
_FRAMES = ("TPDO", "RPDO", "second encoder")
TORQUE_MODES = ("cst", "tq", "auto")  # of `CanopenSettings.mode`; the others may end in a velocity mode
HIGHEST_LOAD = 0.8  # of the bus by the cyclic frames; the rest is for heartbeats, SDO and EMCY


def canopen_settings(config: Config) -> CanopenSettings:
    """Sections [drive], [encoder], [joint], [limits] and [loop] for commissioning."""
    drive = config.canopen
    return CanopenSettings(
        node=drive.node,
        eds_path=config.eds_path,
        mode=drive.mode,
        rate_Hz=config.loop.rate_Hz,
        heartbeat_s=drive.heartbeat_s,
        master_node=drive.master_node,
        quick_stop_option=drive.quick_stop_option,
        rpdo_transmission_type=drive.rpdo_transmission_type,
        torque_reference=drive.torque_reference,
        torque_direction=drive.torque_direction,
        torque_max_Nm=config.limits.torque_max_Nm,
        torque_constant_NmpA=torque_constant_NmpA(config),
        reduction_ratio=config.joint.reduction_ratio,
        counts_per_turn=config.encoder.counts_per_turn,
        encoder_on_motor=config.encoder.side == "motor",
        encoder_direction=config.encoder.direction,
        zero_counts=config.encoder.zero_counts,
        vendor_id=drive.vendor_id,
        product_code=drive.product_code,
        rated_current_A=drive.rated_current_A,
        rated_torque_Nm=drive.rated_torque_Nm,
        rated_tolerance=drive.rated_tolerance,
        max_torque_permille=drive.max_torque_permille,
        velocity_unit=drive.velocity_unit,
        torque_rate_max_Nmps=config.limits.torque_rate_max_Nmps,
        boot_timeout_s=drive.boot_timeout_s,
        joint_encoder=joint_encoder_settings(config),
        encoder_incremental=config.encoder.kind == "incremental",
        sdo_timeout_s=drive.sdo_timeout_s,
        velocity_max_radps=config.limits.velocity_max_radps,
        temperature=temperature_object(config),
    )


def temperature_object(config: Config) -> TemperatureObject | None:
    """Which object of the drive tells its temperature."""
    drive = config.canopen
    if drive.temperature_object is None:
        return None
    place = index_and_sub(drive.temperature_object)
    return TemperatureObject(*place, drive.temperature_unit_degC, drive.temperature_offset_degC)


def joint_encoder_settings(config: Config) -> JointEncoderSettings | None:
    """Section [joint_encoder] for commissioning."""
    encoder = config.joint_encoder
    if encoder is None:
        return None
    index, sub = index_and_sub(encoder.object)
    return JointEncoderSettings(
        counts_per_turn=encoder.counts_per_turn,
        direction=encoder.direction,
        zero_counts=encoder.zero_counts,
        incremental=encoder.kind == "incremental",
        feeds_law=encoder.law == "joint_encoder",
        node=encoder.node if encoder.source == "node" else None,
        eds_path=config.encoder_eds_path,
        index=index,
        sub=sub,
    )


def cycle_bytes(config: Config) -> tuple[int, ...]:
    """Data bytes of the frames of one cycle: SYNC, TPDO, RPDO, and the TPDO of a second encoder."""
    rpdo = RPDO_BYTES if config.canopen.mode in TORQUE_MODES else VELOCITY_RPDO_BYTES
    second = () if config.joint_encoder is None else (SECOND_POSITION_BYTES,)
    return (0, TPDO_BYTES, rpdo, *second)


def cyclic_bus_load(config: Config) -> float:
    """Share of the bus that the cyclic frames take at worst-case stuffing; refuses more than HIGHEST_LOAD."""
    rate_Hz, bitrate = config.loop.rate_Hz, config.bus.bitrate_bitps
    lengths = cycle_bytes(config)
    load = bus_load(lengths, rate_Hz, bitrate)
    if load > HIGHEST_LOAD:
        highest = highest_rate_Hz(lengths, bitrate, HIGHEST_LOAD)
        frames = " + ".join(("SYNC", *(f"{name}({n})" for name, n in zip(_FRAMES, lengths[1:], strict=False))))
        raise ConfigurationError(
            f"loop.rate_Hz (={rate_Hz:g}) must be at most {highest:.0f} at bus.bitrate_bitps (={bitrate}): "
            f"{frames} = {load * bitrate / rate_Hz:.0f} bits a cycle, "
            f"{load:.0%} of the bus, {HIGHEST_LOAD:.0%} allowed"
        )
    return load
