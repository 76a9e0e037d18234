"""[drive], kind = "canopen": the section, what the CANopen driver gets of it, and the arithmetic of the bus."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, ValidationError
from pydantic_core import PydanticCustomError

from jointctl.drivers.can.frames import bus_load, highest_rate_Hz
from jointctl.drivers.can.open import split_channel
from jointctl.drivers.canopen.cia import EVENT_DRIVEN, HIGHEST_NODE, LAST_SYNCHRONOUS
from jointctl.drivers.canopen.pdo import (
    coarse_numbers,
    joint_torque_per_permille_Nm,
    position_misfit,
    torque_misfit,
    velocity_misfit,
)
from jointctl.drivers.canopen.settings import (
    CanopenSettings,
    JointEncoderSettings,
    TemperatureObject,
    TorqueLimitObject,
    interpolation_period,
)
from jointctl.drivers.errors import ConfigurationError, DeviceError
from jointctl.firmware_py.states import CommandKind
from jointctl.tools.configuration.config import Config, ConfigurationProblems, beside, problem_line
from jointctl.tools.configuration.conversions import joint_settings, torque_constant_NmpA
from jointctl.tools.configuration.drive_section import (
    FOR_A_NODE,
    FOR_A_PORT,
    DriveSection,
    GivenPlace,
    SentWithTarget,
    wrong_kind,
)
from jointctl.tools.configuration.sections import (
    Bus,
    Identity,
    LimitPlace,
    Node,
    ObjectPlace,
    Section,
    auto_or_number,
    between,
    index_and_sub,
    whole_channel,
)

TPDO_BYTES, RPDO_BYTES = 8, 4
VELOCITY_RPDO_BYTES = 6  # 60FF and 607A are longer than 6071
OFFSET_BYTES, VELOCITY_OFFSET_BYTES = 2, 4  # 60B2 in the same frame, 60B1 in one of its own
CASCADE_LAWS = ("computed_torque", "flexible_joint")
SECOND_POSITION_BYTES = 4
TORQUE_MODES = ("cst", "tq", "auto")  # of `CanopenSettings.mode`; the others may end in a velocity mode
HIGHEST_LOAD = 0.8  # of the bus by the cyclic frames; the rest is for heartbeats, SDO and EMCY
CAN_RATE_HZ = (100.0, 4000.0)
TORQUE_WANTED = "drive.mode (={}) must be cst, tq or auto for {}: see [drive.cascade]"
DRIVE_MODES = {"auto": "velocity or torque", "csv": "csv", "pv": "pv"}  # `sweep --mode`: `CanopenSettings.mode`


class Cascade(Section):
    """For `mode` csp or csv: the drive closes its own loops, and these are sent to it or known of it; docs/law.md."""

    torque_offset: bool = True  # 60B2: the law's torques for inertia, gravity and friction
    velocity_offset: bool = True  # 60B1: csp only, where the speed is part of csv's target
    # of the target's speed in 60B1; less where the drive's own velocity feed-forward does the rest
    velocity_share: Annotated[float, between(0.0, 1.0)] = 1.0
    # by which the motion is sent ahead of its time; auto = until it takes effect, by rpdo_transmission_type and rate
    lead_s: Annotated[float | Literal["auto"], auto_or_number(0.0, 0.1)] = "auto"
    # of the position loop: csv closes it here, and needs it; of csp it is the drive's, and for `check` and [virtual]
    position_gain_ps: Annotated[float, between(0.0, 1000.0, open_low=True)] | None = None
    # of the drive's velocity loop, at the joint; for `check` and [virtual]
    velocity_gain_Nmspr: Annotated[float, between(0.0, 1e6, open_low=True)] | None = None
    velocity_integral_Nmprad: Annotated[float, between(0.0, 1e8)] | None = None  # gain of its integral
    loop_rate_Hz: Annotated[float, between(500.0, 1e5)] = 8000.0  # of the drive's loops


class CanopenSection(DriveSection):
    kind: Literal["canopen"]  # a CiA 402 drive on CANopen
    node: Node  # CANopen node of the drive
    eds: Annotated[str, Field(min_length=1)]  # beside the configuration file, or the name of a shipped one
    # torque mode: cyclic synchronous, profile, or what 6502 offers; csp, csv: the drive closes its own loops
    mode: Literal["cst", "tq", "auto", "csp", "csv"]
    vendor_id: Identity | None = None  # expected in 1018:1; none = any
    product_code: Identity | None = None  # expected in 1018:2; none = any
    rated_current_A: Annotated[float, between(0.0, 1000.0, open_low=True)] | None = None  # compared with 6075
    rated_torque_Nm: Annotated[float, between(0.0, 10_000.0, open_low=True)] | None = None  # motor; compared with 6076
    rated_torque_unit: Literal["mNm", "uNm"] = "mNm"  # of 6076: mNm, or µNm as maxon's EPOS4 has it
    rated_tolerance: Annotated[float, between(0.0, 0.2)] = 0.01  # of the comparisons with 6075 and 6076, relative
    torque_reference: Literal["rated_torque", "rated_current"]  # what 1000 permille of 6071 and 6077 mean
    max_torque_permille: Annotated[int, between(1, 10_000)] | None = None  # 6072; none = derived from torque_max_Nm
    # where the drive has no 6072: the maker's own object that limits torque or current, "3001:2"; only ever lowered
    torque_limit_object: LimitPlace | None = None
    # what that object holds where 6071 holds 1000 permille
    torque_limit_rated_counts: Annotated[float, between(0.0, 1e9, open_low=True)] | None = None
    velocity_unit: Literal["counts/s", "r/min", "0.1 r/min"] = "counts/s"  # of 60FF; counts of 6064, r/min of the motor
    heartbeat_s: Annotated[float, between(0.01, 2.0)]  # the drive stops itself when our heartbeat is older
    master_node: Node = 126  # whose heartbeat the drive watches
    boot_timeout_s: Annotated[float, between(0.0, 60.0)] = 3.0  # for the first answer, and for leaving Not Ready
    sdo_timeout_s: Annotated[float, between(0.02, 10.0)] | None = None  # of one SDO request (three times); None = 0.3 s
    quick_stop_option: Annotated[int, between(0, 4)] = 2  # 605A: 2 = brake on the quick stop ramp, then power off
    # 1 = the torque is taken over at the next SYNC, 254/255 = at once
    rpdo_transmission_type: Annotated[int, between(0, 255)] = 1
    temperature_object: ObjectPlace | None = None  # the drive's own, "2103"; read once a second, to be shown and logged
    temperature_unit_degC: Annotated[float, between(0.0, 1000.0, open_low=True)] = 1.0  # of one count of it
    temperature_offset_degC: Annotated[float, between(-1000.0, 1000.0)] = 0.0  # at 0 counts; -273.15 for kelvin
    cascade: Cascade | None = None

    simulated: ClassVar[bool] = True
    sends_frames: ClassVar[bool] = True
    begins_within_s: ClassVar[float] = 0.5  # to Ready To Switch On, which applies no power
    when_the_loop_ends: ClassVar[str] = (
        "its heartbeat on the bus has ended with it, so the drive stops the joint by itself"
    )
    torque_source: ClassVar[str] = (
        "object 6077 as the drive measures it; current_A = motor_torque_Nm / torque_constant_NmpA"
    )

    def problems(self, config: Config) -> list[str]:
        return (
            node_problems(config) + joint_encoder_problems(config) + canopen_problems(config) + cascade_problems(config)
        )

    def files(self, config: Config) -> tuple[tuple[str, Path], ...]:
        found = (("drive.eds", eds_path(config)), ("joint_encoder.eds", encoder_eds_path(config)))
        return tuple((key, path) for key, path in found if path is not None)

    def moved(self, config: Config, given: GivenPlace, environ: Mapping[str, str]) -> Config:
        """Flag beats environment (CAN_INTERFACE, CAN_CHANNEL, CAN_BITRATE) beats file."""
        if given.port is not None:
            raise wrong_kind(config.path, self.kind, FOR_A_PORT)
        config = config.changed(bus=_moved_bus(config.bus, given, environ))
        if given.node is None:
            return config
        node: object = given.node  # of a program it may be anything
        if not isinstance(node, Integral) or isinstance(node, bool) or not 1 <= int(node) <= HIGHEST_NODE:
            raise ConfigurationError(f"command line: node (={node}) must be a whole number in [1..{HIGHEST_NODE}]")
        config = config.changed(drive__node=int(node))
        if found := node_problems(config):
            raise ConfigurationProblems([f"command line: {line}" for line in found])
        return config

    def silence_s(self) -> float:
        """See `DriveSection`: it is asked to send as often as we do."""
        return self.heartbeat_s

    def assumed_delay(self, config: Config) -> tuple[float, str]:
        period_s, kind = 1.0 / config.loop.rate_Hz, self.rpdo_transmission_type
        if kind > LAST_SYNCHRONOUS:
            return period_s, f"assumed: at most one period (drive.rpdo_transmission_type = {kind}, asynchronous)"
        periods = max(kind, 1)
        count = "one period" if periods == 1 else f"at most {periods} periods"
        return periods * period_s, f"assumed: {count} (drive.rpdo_transmission_type = {kind}, synchronous)"

    def in_sweep_mode(self, mode: str) -> CanopenSection:
        if mode == "speed":
            raise DeviceError("--mode (=speed) must be auto, csv, pv or torque: it is a CANopen drive")
        if mode == "torque" and self.cascade is None:
            return self
        if mode == "torque":
            raise ConfigurationError(TORQUE_WANTED.format(self.mode, "a motion by torque"))
        return self.model_copy(update={"mode": DRIVE_MODES[mode], "cascade": None})

    def own_loop(self) -> CommandKind:
        if self.cascade is None:
            return CommandKind.TORQUE
        return CommandKind.POSITION if self.mode == "csp" else CommandKind.VELOCITY

    def sent_with_target(self, rate_Hz: float) -> SentWithTarget | None:
        """The lead: the periods of a synchronous RPDO, and one in which the drive moves on to the target."""
        cascade, kind = self.cascade, self.rpdo_transmission_type
        if cascade is None:
            return None
        lead_s = cascade.lead_s
        if isinstance(lead_s, str):
            lead_s = (1.0 + (max(kind, 1) if kind <= LAST_SYNCHRONOUS else 0.0)) / rate_Hz
        return SentWithTarget(lead_s, cascade.position_gain_ps or 0.0, cascade.torque_offset)

    def free_of_torque_limit(self) -> CanopenSection:
        return self.model_copy(update={"max_torque_permille": None})

    def motor_current(self) -> tuple[str, float] | None:
        return None if self.rated_current_A is None else ("drive.rated_current_A", self.rated_current_A)

    def constants_factor(self, config: Config) -> tuple[float, str] | None:
        """Torque constant times rated current over rated torque."""
        if self.rated_torque_Nm is None or self.rated_current_A is None:
            return None
        constant = torque_constant_NmpA(config)
        factor = constant * self.rated_current_A / self.rated_torque_Nm
        return factor, (
            f"joint.torque_constant_NmpA (={constant:.4g} in the drive's ampere) times "
            f"drive.rated_current_A (={self.rated_current_A:g}) is {factor:.3g} times drive.rated_torque_Nm "
            f"(={self.rated_torque_Nm:g}): one of them is wrong, or rms and sine amplitude are mixed up"
        )

    def coarse_numbers(self, config: Config) -> list[str]:
        settings = canopen_settings(config)
        return coarse_numbers(settings, _permille_Nm(settings))

    def measuring_constants(self) -> dict[str, float]:
        return {"rated_torque": float(self.torque_reference == "rated_torque")}


def canopen_section(config: Config) -> CanopenSection:
    """[drive] of a CANopen drive; `ConfigurationError` for any other."""
    if not isinstance(config.drive, CanopenSection):
        raise wrong_kind(config.path, config.drive.kind, FOR_A_NODE)
    return config.drive


def eds_path(config: Config) -> Path:
    """The EDS file: beside the configuration, else a shipped one."""
    return beside(config.path, canopen_section(config).eds)


def encoder_eds_path(config: Config) -> Path | None:
    encoder = config.joint_encoder
    return beside(config.path, encoder.eds) if encoder is not None and encoder.source == "node" else None


def canopen_settings(config: Config) -> CanopenSettings:
    """Sections [drive], [encoder], [joint], [limits] and [loop] for commissioning."""
    return CanopenSettings(
        **joint_settings(CanopenSettings, config, canopen_section(config)),
        eds_path=eds_path(config),
        joint_encoder=joint_encoder_settings(config),
        encoder_incremental=config.encoder.kind == "incremental",
        temperature=temperature_object(config),
        torque_limit=torque_limit_object(config),
        **_offsets(canopen_section(config)),
    )


def _offsets(drive: CanopenSection) -> dict[str, Any]:
    cascade = drive.cascade
    if cascade is None:
        return {}
    velocity = drive.mode == "csp" and cascade.velocity_offset
    share = cascade.velocity_share
    return {
        "torque_offset": cascade.torque_offset, "velocity_offset": velocity, "velocity_share": share,
        "holds_alone": True,
    }  # fmt: skip


def rpdo_bytes(drive: CanopenSection) -> tuple[int, ...]:
    """Data bytes of the RPDOs of a cycle."""
    first = RPDO_BYTES if drive.mode in TORQUE_MODES else VELOCITY_RPDO_BYTES
    offsets = _offsets(drive)
    first += OFFSET_BYTES if offsets.get("torque_offset") else 0
    return (first, VELOCITY_OFFSET_BYTES) if offsets.get("velocity_offset") else (first,)


def temperature_object(config: Config) -> TemperatureObject | None:
    """Which object of the drive tells its temperature."""
    drive = canopen_section(config)
    if drive.temperature_object is None:
        return None
    place = index_and_sub(drive.temperature_object)
    return TemperatureObject(*place, drive.temperature_unit_degC, drive.temperature_offset_degC)


def torque_limit_object(config: Config) -> TorqueLimitObject | None:
    """Which object of the maker's own limits torque or current."""
    drive = canopen_section(config)
    if drive.torque_limit_object is None or drive.torque_limit_rated_counts is None:
        return None
    return TorqueLimitObject(*index_and_sub(drive.torque_limit_object), drive.torque_limit_rated_counts)


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
        eds_path=encoder_eds_path(config),
        index=index,
        sub=sub,
    )


def cycle_bytes(config: Config) -> tuple[int, ...]:
    """Data bytes of the frames of one cycle: SYNC, TPDO, RPDOs, and the TPDO of a second encoder."""
    second = () if config.joint_encoder is None else (SECOND_POSITION_BYTES,)
    return (0, TPDO_BYTES, *rpdo_bytes(canopen_section(config)), *second)


def cyclic_bus_load(config: Config) -> float:
    """Share of the bus that the cyclic frames take at worst-case stuffing; refuses more than HIGHEST_LOAD."""
    rate_Hz, bitrate = config.loop.rate_Hz, config.bus.bitrate_bitps
    lengths = cycle_bytes(config)
    load = bus_load(lengths, rate_Hz, bitrate)
    if load > HIGHEST_LOAD:
        highest = highest_rate_Hz(lengths, bitrate, HIGHEST_LOAD)
        sent = len(rpdo_bytes(canopen_section(config)))
        names = ("TPDO", *["RPDO"] * sent, "second encoder")
        frames = " + ".join(("SYNC", *(f"{name}({n})" for name, n in zip(names, lengths[1:], strict=False))))
        raise ConfigurationError(
            f"loop.rate_Hz (={rate_Hz:g}) must be at most {highest:.0f} at bus.bitrate_bitps (={bitrate}): "
            f"{frames} = {load * bitrate / rate_Hz:.0f} bits a cycle, "
            f"{load:.0%} of the bus, {HIGHEST_LOAD:.0%} allowed"
        )
    return load


def _moved_bus(own: Bus, given: GivenPlace, environ: Mapping[str, str]) -> Bus:
    bus: dict[str, Any] = own.model_dump()
    bitrate, origin = given.bitrate, "command line"
    if bitrate is None and environ.get("CAN_BITRATE"):
        origin = "environment"
        try:
            bitrate = int(environ["CAN_BITRATE"])
        except ValueError:
            value = environ["CAN_BITRATE"]
            raise ConfigurationError(f"environment: CAN_BITRATE (={value}) must be a whole number of bit/s") from None
    bus["interface"] = given.interface or environ.get("CAN_INTERFACE") or own.interface
    if bus["interface"] != own.interface:  # what the file says besides is for the interface of the file
        bus["channel"], bus["options"] = split_channel(bus["channel"])[0], None
    bus["channel"] = given.channel or environ.get("CAN_CHANNEL") or bus["channel"]
    bus["bitrate_bitps"] = bus["bitrate_bitps"] if bitrate is None else bitrate
    try:
        return whole_channel(Bus.model_validate(bus))
    except PydanticCustomError as error:
        raise ConfigurationProblems([f"{origin}: bus.{error.message()}"]) from None
    except ValidationError as error:
        lines = [problem_line(e, bus, ("bus",)) for e in error.errors(include_url=False)]
        raise ConfigurationProblems([f"{origin}: {line}" for line in lines]) from None


def node_problems(config: Config) -> list[str]:
    """Drive, encoder and this program are three nodes: else the drive would watch its own heartbeat, not ours."""
    drive, encoder, found = canopen_section(config), config.joint_encoder, []
    if drive.node == drive.master_node:
        found.append(f"drive.master_node (={drive.master_node}) must differ from drive.node")
    if encoder is not None and encoder.node is not None and encoder.node in (drive.node, drive.master_node):
        found.append(f"joint_encoder.node (={encoder.node}) must differ from drive.node and drive.master_node")
    return found


def joint_encoder_problems(config: Config) -> list[str]:
    """[joint_encoder] against the rest."""
    encoder, found = config.joint_encoder, []
    if encoder is None:
        return []
    if (encoder.source == "node") != (encoder.node is not None):
        found.append('joint_encoder.node must be given with source = "node", and only then')
    if encoder.kind == "incremental" and config.encoder.kind == "incremental":
        found.append("joint_encoder.kind and encoder.kind are both incremental: one of them must know its angle")
    if encoder.disagreement_max_rad >= config.limits.following_error_max_rad * 10.0:
        found.append(
            f"joint_encoder.disagreement_max_rad (={encoder.disagreement_max_rad:g}) must be less than ten times "
            "limits.following_error_max_rad"
        )
    return found


def canopen_problems(config: Config) -> list[str]:
    """[drive] against the rest."""
    drive, limits, found = canopen_section(config), config.limits, []
    if not CAN_RATE_HZ[0] <= config.loop.rate_Hz <= CAN_RATE_HZ[1]:
        found.append(f"loop.rate_Hz (={config.loop.rate_Hz:g}) must be in [{CAN_RATE_HZ[0]:g}..{CAN_RATE_HZ[1]:g}]")
    elif drive.mode in ("cst", "csp", "csv"):  # in TQ, which auto may take, a drive need not have 60C2
        try:
            interpolation_period(config.loop.rate_Hz)
        except DeviceError as error:
            found.append(error.message)
    if LAST_SYNCHRONOUS < drive.rpdo_transmission_type < EVENT_DRIVEN:
        kind = drive.rpdo_transmission_type
        found.append(
            f"drive.rpdo_transmission_type (={kind}) must be in [0..{LAST_SYNCHRONOUS}] or in [{EVENT_DRIVEN}..255]"
        )
    if drive.rated_torque_Nm is not None and drive.max_torque_permille is not None:
        if drive.torque_reference == "rated_torque":
            reach = drive.rated_torque_Nm * config.joint.reduction_ratio * drive.max_torque_permille / 1000.0
            if limits.torque_max_Nm > reach * (1.0 + 1e-9):
                found.append(
                    f"limits.torque_max_Nm (={limits.torque_max_Nm:g}) must be in (0..{reach:g}], "
                    "what drive.max_torque_permille allows"
                )
    if (drive.torque_limit_object is None) != (drive.torque_limit_rated_counts is None):
        found.append("drive.torque_limit_object and drive.torque_limit_rated_counts must be given together")
    if drive.rated_torque_unit == "uNm" and drive.rated_torque_Nm is None:  # a wrong unit would be a thousand times
        found.append('drive.rated_torque_unit (="uNm") needs drive.rated_torque_Nm, which 6076 is compared with')
    # the other one follows from the torque constant: a drive that lacks 6075 or 6076 cannot be compared with it
    reference = f"{drive.torque_reference}_{'A' if drive.torque_reference == 'rated_current' else 'Nm'}"
    if config.virtual is not None and getattr(drive, reference) is None:
        found.append(f"drive.{reference} is missing: the virtual drive needs it, torque is in thousandths of it")
    return found


def _permille_Nm(settings: CanopenSettings) -> float:
    """Joint torque of a thousandth of the rated value [Nm], as far as the file knows it; 0 else."""
    return joint_torque_per_permille_Nm(
        settings, 1e3 * (settings.rated_torque_Nm or 0.0), round(1e3 * (settings.rated_current_A or 0.0))
    )


def _misfits(config: Config) -> list[str]:
    """What the drive's whole numbers cannot express, or would let the drive have beyond the limits."""
    settings = canopen_settings(config)
    found = [velocity_misfit(settings), position_misfit(settings)]
    if permille_Nm := _permille_Nm(settings):
        permille = settings.max_torque_permille or math.ceil(settings.torque_max_Nm / permille_Nm)
        found.append(torque_misfit(settings, permille, permille_Nm))
    return [f"{text}; {remedy}" for text, remedy in filter(None, found)]


def cascade_problems(config: Config) -> list[str]:
    """drive.mode csp and csv against the rest."""
    drive, control = canopen_section(config), config.control
    mode, cascade = drive.mode, drive.cascade
    if (mode in ("csp", "csv")) != (cascade is not None):
        if cascade is not None:
            return [f'[drive.cascade] must be left out unless drive.mode (={mode}) is "csp" or "csv"']
        return [] if mode in TORQUE_MODES else [f"[drive.cascade] is missing: drive.mode (={mode}) needs it"]
    if cascade is None:
        return []
    found = []
    if control.kind not in CASCADE_LAWS:
        found.append(
            f"control.kind (={control.kind}) must be {' or '.join(CASCADE_LAWS)} with drive.mode (={mode}): the "
            "drive's own loop is the feedback, and the law's feed-forward is sent with it"
        )
    found += [
        f"[control.{name}] must be left out with drive.mode (={mode}): the feedback is the drive's"
        for name in ("learning", "adaptation")
        if getattr(control, name) is not None
    ]
    if control.feed_forward == "measured":
        found.append(
            f"control.feed_forward (=measured) must be none, desired or lugre_desired with drive.mode (={mode})"
        )
    if mode == "csv" and cascade.position_gain_ps is None:
        found.append(
            "drive.cascade.position_gain_ps is missing: with drive.mode (=csv) the position loop is closed here"
        )
    if (cascade.velocity_gain_Nmspr is None) != (cascade.velocity_integral_Nmprad is None):
        found.append("drive.cascade.velocity_gain_Nmspr and velocity_integral_Nmprad must be given together")
    second = config.joint_encoder
    if second is not None and second.law == "joint_encoder" and control.kind != "flexible_joint":
        found.append(
            f'joint_encoder.law (=joint_encoder) needs control.kind "flexible_joint" (={control.kind}) with drive.mode '
            f"(={mode}): the drive closes its loop on encoder 6064"
        )
    return found + _misfits(config)
