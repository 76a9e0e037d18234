"""From an unknown node to a drive whose limits are proven, whose watchdog is armed, and which is still disabled.

Every step writes and reads back.  The order matters: zero targets before anything that could enable, the mode before
the scaling, PDOs last, because they are only valid for the mode and the rate set before.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from jointctl.drivers.canopen.cia import MODE_SHOWN, SUPPORTED_MODE_BIT, ControlWord, Mode, State, state_of_word
from jointctl.drivers.canopen.eds import EdsFile
from jointctl.drivers.canopen.encoder import EncoderFindings, commission_drive_object
from jointctl.drivers.canopen.pdo import (
    OFFSET_RPDO,
    TARGET_POSITION,
    TARGET_TORQUE,
    TARGET_VELOCITY,
    Misfit,
    PdoLayout,
    RATED_TORQUE_UNITS_mNm,
    coarse_numbers,
    configure_loop_pdos,
    joint_angle_per_count_rad,
    joint_torque_per_permille_Nm,
    joint_velocity_per_unit_radps,
    listen_to_our_sync,
    map_velocity_offset,
    position_misfit,
    torque_misfit,
    velocity_misfit,
)
from jointctl.drivers.canopen.sdo import ObjectAccess, object_name
from jointctl.drivers.canopen.settings import CanopenSettings, TorqueLimitObject, interpolation_period
from jointctl.drivers.canopen.switch_off import POWERED_STATES, state_of
from jointctl.drivers.canopen.watchdog import arm_reaction, arm_rpdo_deadline, quick_stop_of
from jointctl.drivers.drive import DriveIdentity
from jointctl.drivers.errors import DeviceError, text_Nm, text_radps
from jointctl.firmware_py.states import in_words

CIA402_PROFILE = 402
MODES = {
    "cst": (Mode.CYCLIC_SYNC_TORQUE,),
    "tq": (Mode.TORQUE,),
    "auto": (Mode.CYCLIC_SYNC_TORQUE, Mode.TORQUE),
    "csp": (Mode.CYCLIC_SYNC_POSITION,),
    "csv": (Mode.CYCLIC_SYNC_VELOCITY,),
    "pv": (Mode.PROFILE_VELOCITY,),
    "velocity or torque": (
        Mode.CYCLIC_SYNC_VELOCITY, Mode.PROFILE_VELOCITY, Mode.CYCLIC_SYNC_TORQUE, Mode.TORQUE,
    ),
}  # fmt: skip
CYCLIC_MODES = (Mode.CYCLIC_SYNC_TORQUE, Mode.CYCLIC_SYNC_VELOCITY, Mode.CYCLIC_SYNC_POSITION)
VELOCITY_MODES = (Mode.CYCLIC_SYNC_VELOCITY, Mode.PROFILE_VELOCITY)
TARGETS = {
    Mode.CYCLIC_SYNC_POSITION: TARGET_POSITION, Mode.CYCLIC_SYNC_VELOCITY: TARGET_VELOCITY,
    Mode.PROFILE_VELOCITY: TARGET_VELOCITY,
}  # fmt: skip
FOLLOWING_TIMEOUT_MS = 20  # of 6066
LARGEST_UNSIGNED = 0xFFFFFFFF
STEEP_RADPS2 = 1000.0  # profile acceleration at the joint, above any that the loop asks for
STEEP_PERMILLE_PS = 1_000_000
TQ_REMARK = "torque mode with profile (TQ) instead of cyclic synchronous torque"
POSITION_INVERTED, VELOCITY_INVERTED = 0x80, 0x40  # of 607E
WITHOUT_6007 = "no object 6007 (abort connection option): when this computer dies, in mode"
MAX_TORQUE, TORQUE_LIMIT = "max torque", "torque limit"
RATED_PERMILLE = 1000.0
ROUNDING = 1e-9  # of a quotient that should be a whole number
LARGEST_PERMILLE = 32767  # 6071 is a signed 16 bit number
ATTEMPTS = 20
PAUSE_S = 0.01  # between two looks at a drive that was commanded to change its state or mode
READY_POLL_S = 0.05  # between two looks at a drive that is not ready yet
Pause = Callable[[float], None]


@dataclass
class Findings:
    """What commissioning learned, filled step by step."""

    identity: DriveIdentity = field(default_factory=lambda: DriveIdentity("", "", "", ""))
    mode: Mode = Mode.CYCLIC_SYNC_TORQUE
    torque_per_permille_Nm: float = 0.0
    max_permille: int = 0
    start_counts: int = 0
    layout: PdoLayout | None = None  # of the loop's PDOs
    heartbeat_watched: bool = True  # the drive sends its own
    second: EncoderFindings | None = None
    counts_per_motor_turn: float = 0.0  # by 608F; 0 = the drive does not report it
    settings: dict[str, str] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


def identify(objects: ObjectAccess, settings: CanopenSettings, eds: EdsFile, findings: Findings) -> None:
    """Device type and identity, compared with what the configuration and the EDS expect."""
    profile = objects.read(0x1000, what="device type") & 0xFFFF
    if profile != CIA402_PROFILE:
        raise DeviceError(f"node {settings.node} has device profile {profile}, a drive has {CIA402_PROFILE} (CiA 402)")
    vendor, product, revision, serial = (
        objects.read_if_present(0x1018, sub, what=what) or 0
        for sub, what in ((1, "vendor ID"), (2, "product code"), (3, "revision"), (4, "serial number"))
    )
    for name, expected, found in (
        ("drive.vendor_id", settings.vendor_id, vendor),
        ("drive.product_code", settings.product_code, product),
    ):
        if expected is not None and expected != found:
            raise DeviceError(
                f"node {settings.node} is another device: {name} is {found:#x}, the configuration says {expected:#x}"
            )
    _compare_with_eds(settings, eds, vendor, product, findings)
    findings.identity = DriveIdentity(
        f"{vendor:#010x}", f"{product:#010x}", f"{revision:#010x}", str(serial), objects.text(0x1008)
    )


def _compare_with_eds(settings: CanopenSettings, eds: EdsFile, vendor: int, product: int, findings: Findings) -> None:
    """An EDS of another maker is refused, unless the configuration names its maker; of another product: a remark."""
    if eds.vendor_id and vendor and eds.vendor_id != vendor:
        text = f"EDS {eds.name} is of vendor {eds.vendor_id:#x}, node {settings.node} is of vendor {vendor:#x}"
        if settings.vendor_id is None:
            raise DeviceError(text, hint=f"use the drive's own EDS file, or say drive.vendor_id = {vendor:#x}")
        findings.remarks.append(text)
    elif eds.product_code and product and eds.product_code != product:
        findings.remarks.append(
            f"EDS {eds.name} is of product {eds.product_code:#x}, node {settings.node} is product {product:#x}"
        )


def wait_until_ready(objects: ObjectAccess, node: int, timeout_s: float, pause: Pause) -> None:
    """Until the statusword is that of a drive which can be switched on; `DeviceError` after `timeout_s`.

    Transition 1 is the drive's own, but some leave Not Ready only after a first controlword.  They get Shutdown and
    Disable Voltage in turn: neither applies power.
    """
    looks = max(1, round(timeout_s / READY_POLL_S))
    for look in range(looks):
        status_word = objects.read(0x6041, what="statusword")
        state = state_of_word(status_word)
        if state not in (State.NOT_READY_TO_SWITCH_ON, State.UNDEFINED):
            if state is State.READY_TO_SWITCH_ON:
                objects.write(0x6040, 0, ControlWord.DISABLE_VOLTAGE, what="controlword")
            return
        if look == looks - 1:
            break
        word = ControlWord.DISABLE_VOLTAGE if look % 2 else ControlWord.SHUTDOWN
        objects.write(0x6040, 0, word, what="controlword")
        pause(READY_POLL_S)
    raise DeviceError(
        f"node {node} is {in_words(state)} (statusword {status_word:04X}h) after {timeout_s:g} s",
        hint="motor supply, safe torque off (STO) and enable inputs; a drive that takes longer: drive.boot_timeout_s",
    )


def disable(objects: ObjectAccess, settings: CanopenSettings, pause: Pause) -> None:
    """Zero every target that could move the motor at enable, take the power stage off, refuse a drive in fault.

    It was off before commissioning began (`brake_if_enabled`): one that has power now has it from another controller.
    """
    if (state := state_of(objects)) in POWERED_STATES:
        raise DeviceError(
            f"node {settings.node} is {in_words(state)}, and was off a moment ago: another controller has enabled it",
            hint="find that program; `jointctl stop` brakes the drive and switches it off",
        )
    objects.write(0x6040, 0, ControlWord.DISABLE_VOLTAGE, what="controlword")
    if settings.holds_alone:  # such a drive need not have a torque mode
        objects.write_if_present(0x6071, 0, 0, what="target torque")
    else:
        objects.write_verified(0x6071, 0, 0, what="target torque")
    for index, what in ((0x60FF, "target velocity"), (0x60B1, "velocity offset"), (0x60B2, "torque offset")):
        objects.write_if_present(index, 0, 0, what=what)
    for _ in range(ATTEMPTS):
        state = state_of(objects)
        if state is not State.OPERATION_ENABLED and state is not State.QUICK_STOP_ACTIVE:
            break
        pause(PAUSE_S)
    if state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
        code = objects.read_if_present(0x603F, what="error code") or 0
        raise DeviceError(
            f"node {settings.node} is in fault (error code {code:04X}h)",
            hint="find the cause, then reset the fault; jointctl never resets one by itself",
        )
    if state is State.OPERATION_ENABLED:
        raise DeviceError(f"node {settings.node} stays enabled although controlword 0 was written")
    wait_until_ready(objects, settings.node, settings.boot_timeout_s, pause)


def choose_mode(objects: ObjectAccess, settings: CanopenSettings, findings: Findings, pause: Pause) -> None:
    """Select the first wanted mode that the drive has, and wait until 6061 confirms it."""
    wanted = MODES[settings.mode]
    supported = objects.read_if_present(0x6502, what="supported drive modes")
    if supported is not None:
        usable = [mode for mode in wanted if supported >> SUPPORTED_MODE_BIT[mode] & 1]
    else:
        findings.remarks.append("the drive does not tell its supported modes (no object 6502)")
        usable = list(wanted)
    if not usable:
        names = " or ".join(mode.name.lower() for mode in wanted)
        raise DeviceError(
            f"node {settings.node} does not support {names} (6502 = {supported:08X}h); drive.mode is {settings.mode}"
        )
    commands_torque = [mode for mode in usable if mode not in VELOCITY_MODES]
    if usable[0] in VELOCITY_MODES and commands_torque and not objects.has(0x6007):
        usable = commands_torque
        findings.remarks.append(f"a mode of torque: {WITHOUT_6007} {settings.mode} it may go on turning the joint")
    findings.mode = usable[0]
    objects.write(0x6060, 0, findings.mode, what="modes of operation")
    for _ in range(ATTEMPTS):
        shown = objects.read(0x6061, what=MODE_SHOWN)
        if shown == findings.mode:
            break
        pause(PAUSE_S)
    else:
        raise DeviceError(f"node {settings.node}: 6061 shows mode {shown}, mode {int(findings.mode)} was selected")
    findings.settings["mode"] = findings.mode.name.lower()


def _refuse(misfit: Misfit) -> None:
    if misfit is not None:
        raise DeviceError(*misfit)


def take_place(objects: ObjectAccess, settings: CanopenSettings, findings: Findings) -> None:
    """In CSP: the target is where the joint stands, before anything could enable; the drive's own following window."""
    _refuse(position_misfit(settings))
    here = objects.read(0x6064, what="position actual value")
    objects.write_verified(0x607A, 0, here, what="target position")
    window = math.ceil(settings.following_error_max_rad / joint_angle_per_count_rad(settings))
    window = min(window, LARGEST_UNSIGNED - 1)  # the greatest number switches it off
    if objects.write_if_present(0x6065, 0, window, what="following error window"):
        objects.write_if_present(0x6066, 0, FOLLOWING_TIMEOUT_MS, what="following error time out")
        findings.settings["following window"] = f"{window} counts = {settings.following_error_max_rad:g} rad"
    else:
        findings.remarks.append("no object 6065: the loop alone watches the following error")


def _scaled_units(objects: ObjectAccess) -> list[str]:
    """Whether 6064 and 607A are counts of the encoder: a gear ratio (6091) or feed (6092) scales both alike."""
    found = []
    for index, what in ((0x6091, "gear ratio"), (0x6092, "feed constant")):
        try:
            if not (objects.has(index, 1) and objects.has(index, 2)):
                continue
            above, below = (objects.read(index, sub, what=what) for sub in (1, 2))
        except DeviceError as error:
            found.append(f"whether the drive scales 6064 is not known: {error.message}")
            continue
        if index == 0x6091 and above != below:
            found.append(
                f"6091 is {above}:{below}: the drive scales 6064 and 607A by it; encoder.counts_per_turn and "
                "joint.reduction_ratio must be those of the scaled position"
            )
        elif index == 0x6092 and above and below and counts_per_motor_turn(objects) not in (0.0, above / below):
            found.append(
                f"6092 is {above}:{below}: 6064 and 607A are not counts of the encoder (608F) but units of that feed, "
                "and encoder.counts_per_turn must be in them"
            )
    return found


def require_reaction(objects: ObjectAccess, settings: CanopenSettings) -> None:
    """A drive that closes a loop of its own, also in a sweep, must not hold or turn the joint with no one watching."""
    if not objects.has(0x6007):
        raise DeviceError(
            f"node {settings.node} has {WITHOUT_6007} {settings.mode} it may go on holding or turning the joint",
            'drive.mode = "cst" if it has that mode, `sweep --mode torque`; such a drive is not enabled in this one',
        )


def require_one_direction(objects: ObjectAccess, settings: CanopenSettings, findings: Findings) -> None:
    """Where a velocity is commanded, it must count in the direction of 6064, or the joint would turn the other way."""
    if findings.mode is Mode.CYCLIC_SYNC_POSITION and not settings.velocity_offset:
        return
    polarity = objects.read_if_present(0x607E, what="polarity") or 0
    inverted = [
        word for bit, word in ((POSITION_INVERTED, "positions"), (VELOCITY_INVERTED, "velocities")) if polarity & bit
    ]
    if len(inverted) == 1:
        raise DeviceError(
            f"node {settings.node}: 607E (polarity) is {polarity:02X}h, which inverts {inverted[0]} alone: in mode "
            f"{settings.mode} the joint would turn away from where it is commanded",
            "clear its bits 6 and 7 in the maker's software and check encoder.direction; a mode of torque does without",
        )
    if inverted:
        findings.remarks.append(
            f"607E is {polarity:02X}h: positions and velocities are inverted, as some drives do in some modes only: "
            "clear it, and check encoder.direction"
        )


def require_own_loop(objects: ObjectAccess, settings: CanopenSettings, findings: Findings) -> None:
    """What else a run needs of a drive that closes its own loop."""
    if settings.torque_offset and not objects.has(0x60B2):
        raise DeviceError(
            f"node {settings.node} has no object 60B2 (torque offset), which drive.cascade.torque_offset (=true) needs",
            "torque_offset = false leaves the feed-forward away: the drive's loop alone then follows",
        )
    if not objects.has(0x6077):
        findings.remarks.append("no object 6077: a torque at its limit, or one that swings, is not noticed")


def limit_velocity(objects: ObjectAccess, settings: CanopenSettings, findings: Findings) -> None:
    """With a loop of its own: no stale target, the drive's own limit 607F, ramps that leave the loop's in charge."""
    _refuse(velocity_misfit(settings))
    if findings.mode in VELOCITY_MODES:
        objects.write_verified(0x60FF, 0, 0, what="target velocity")
    unit_radps = joint_velocity_per_unit_radps(settings)
    if settings.velocity_max_radps is not None and objects.has(0x607F):
        highest = min(math.ceil(settings.velocity_max_radps / unit_radps), LARGEST_UNSIGNED)
        objects.write_verified(0x607F, 0, highest, what="max profile velocity")
        findings.settings["max velocity"] = f"{highest} {settings.velocity_unit} = {text_radps(highest * unit_radps)}"
    if findings.mode is Mode.PROFILE_VELOCITY:
        steep = min(round(STEEP_RADPS2 / unit_radps), LARGEST_UNSIGNED)
        objects.write_verified(0x6083, 0, steep, what="profile acceleration")
        objects.write_verified(0x6084, 0, steep, what="profile deceleration")
        findings.remarks.append("profile velocity mode (PV) instead of cyclic synchronous velocity")


def _compare_rated(
    name: str, found: float, expected: float | None, tolerance: float, unit: str, count: float = 0.0
) -> list[str]:
    """Remarks for the user; `DeviceError` where they do not agree: within half a `count`, which the drive rounds to."""
    if expected is None:
        return [f"drive.{name} is not given: nothing to compare the drive's {found:g} {unit} with"] if found else []
    if found == 0.0:
        raise DeviceError(f"drive.{name} (={expected:g}) cannot be compared: the drive does not tell its rated value")
    if abs(found - expected) > max(tolerance * expected, 0.501 * count):
        text = f"drive.{name} (={expected:g}) does not agree with the drive's {found:g} {unit}"
        finer = unit == "Nm" and abs(found * 1e-3 - expected) <= tolerance * expected
        raise DeviceError(text, 'a drive whose 6076 counts µNm: drive.rated_torque_unit = "uNm"' if finer else "")
    return []


def set_torque_slope(objects: ObjectAccess, torque_per_permille_Nm: float, torque_rate_max_Nmps: float) -> list[str]:
    """Make 6087 [permille/s], the ramp of the profile torque mode (TQ), as steep as the drive allows; remarks.

    `DeviceError` if it stays below `torque_rate_max_Nmps`, the loop's own limit: the law would reckon with a torque
    that the drive has not reached yet, which is a delay that no margin accounts for.
    """
    if not objects.has(0x6087):
        return [f"{TQ_REMARK}; no object 6087: see in the drive's manual that its torque ramp is steep or off"]
    highest = objects.highest(0x6087)
    steep = STEEP_PERMILLE_PS if highest is None else min(STEEP_PERMILLE_PS, highest)
    try:
        slope = objects.write_verified(0x6087, 0, steep, what="torque slope")
    except DeviceError:
        slope = objects.read(0x6087, what="torque slope")
    slope_Nmps = slope * torque_per_permille_Nm
    if slope_Nmps < torque_rate_max_Nmps:
        raise DeviceError(
            f"the drive ramps its torque with at most {slope_Nmps:.0f} Nm/s (6087 = {slope} permille/s), slower than "
            f"limits.torque_rate_max_Nmps (={torque_rate_max_Nmps:g})",
            hint=f"set limits.torque_rate_max_Nmps to {slope_Nmps:.0f} or less, or use cyclic synchronous torque",
        )
    return [TQ_REMARK] if slope == STEEP_PERMILLE_PS else [f"{TQ_REMARK}; 6087 = {slope} permille/s"]


def _write_max_torque(objects: ObjectAccess, permille: int) -> None:
    """6072; a drive without it is refused, unless its maker's own limit is configured."""
    try:
        objects.write_verified(0x6072, 0, permille, what=MAX_TORQUE)
    except DeviceError as error:
        if not objects.lack(0x6072):
            raise
        other = "unless drive.torque_limit_object names the maker's own object that limits torque or current"
        raise DeviceError(error.message, f"{error.hint}, {other}") from error.__cause__


def lower_makers_limit(
    objects: ObjectAccess, settings: CanopenSettings, limit: TorqueLimitObject, permille_Nm: float
) -> str:
    """Bound the torque by the maker's own object to `torque_max_Nm`, rounded down; in words.

    Other than 6072, it is where the maker's software keeps what motor and drive bear.  So it is only lowered, which
    bounds a wrong unit too, and holds its old value again when the drive has been made safe.
    """
    index, sub, name = limit.index, limit.sub, object_name(limit.index, limit.sub)
    count_Nm = RATED_PERMILLE * permille_Nm / limit.rated_counts
    counts = math.floor(settings.torque_max_Nm / count_Nm * (1.0 + ROUNDING))
    if counts < 1:
        raise DeviceError(
            f"limits.torque_max_Nm (={settings.torque_max_Nm:g}) is below one count of object {name} (torque limit), "
            f"{count_Nm:g} Nm by drive.torque_limit_rated_counts (={limit.rated_counts:g})"
        )
    if counts * count_Nm < settings.torque_max_Nm * (1.0 - settings.rated_tolerance):
        raise DeviceError(
            f"limits.torque_max_Nm (={settings.torque_max_Nm:g}) would be cut to {counts * count_Nm:g} Nm by object "
            f"{name} (torque limit), whose count is {count_Nm:g} Nm: the loop would not notice that its torque is cut",
            f"limits.torque_max_Nm = {counts * count_Nm:g} or less",
        )
    before = objects.read(index, sub, what=TORQUE_LIMIT)
    if before < counts:
        raise DeviceError(
            f"limits.torque_max_Nm (={settings.torque_max_Nm:g}) needs {counts} in object {name} (torque limit), which "
            f"holds {before} = {before * count_Nm:g} Nm and is only ever lowered",
            "correct drive.torque_limit_rated_counts, or set the limit in the maker's software; if a run was killed, "
            "or could not reach the drive at its end, restart the drive",
        )
    objects.lower(index, sub, counts, before, what=TORQUE_LIMIT)
    return f"{name} = {counts} (was {before}) = {text_Nm(counts * count_Nm)}"


def limit_torque(objects: ObjectAccess, settings: CanopenSettings, findings: Findings) -> None:
    """Scaling from the rated values, then the drive's own torque limit (6072, or the maker's own) from the joint's."""
    torque = objects.read_if_present(0x6076, what="motor rated torque")
    current_mA = objects.read_if_present(0x6075, what="motor rated current")
    unit_mNm = RATED_TORQUE_UNITS_mNm[settings.rated_torque_unit]
    rated_mNm, rated_mA = (torque or 0) * unit_mNm, current_mA or 0
    tolerance = settings.rated_tolerance
    findings.remarks += [
        *_compare_rated(
            "rated_torque_Nm", rated_mNm * 1e-3, settings.rated_torque_Nm, tolerance, "Nm", 1e-3 * unit_mNm
        ),
        *_compare_rated("rated_current_A", rated_mA * 1e-3, settings.rated_current_A, tolerance, "A", 1e-3),
    ]
    scale = joint_torque_per_permille_Nm(settings, rated_mNm, rated_mA)
    if scale <= 0.0:
        of_torque = settings.torque_reference == "rated_torque"
        index, found = ("6076", torque) if of_torque else ("6075", current_mA)
        why = f"it has no object {index}" if found is None else f"object {index} is 0"
        raise DeviceError(f"node {settings.node}: {why}, so 6071 has no scale (drive.torque_reference)")
    findings.torque_per_permille_Nm = scale
    permille = settings.max_torque_permille
    if permille is None:
        permille = int(-(-settings.torque_max_Nm // scale))
    elif settings.torque_max_Nm > permille * scale * (1.0 + settings.rated_tolerance):
        raise DeviceError(
            f"limits.torque_max_Nm (={settings.torque_max_Nm:g}) must be in (0..{permille * scale:g}], what "
            f"drive.max_torque_permille (={permille}) allows by the drive's own rated value: the loop would not notice "
            "that its torque is cut"
        )
    _refuse(torque_misfit(settings, permille, scale))
    findings.remarks += coarse_numbers(settings, scale)
    findings.max_permille = min(permille, LARGEST_PERMILLE)
    if findings.max_permille < permille:
        findings.remarks.append(f"6072 holds at most {LARGEST_PERMILLE} permille: torque is limited to that")
    limits = []
    if settings.torque_limit is None:
        _write_max_torque(objects, findings.max_permille)
    else:
        limits.append(lower_makers_limit(objects, settings, settings.torque_limit, scale))
    if settings.torque_limit is None or objects.write_if_present(0x6072, 0, findings.max_permille, what=MAX_TORQUE):
        limits.insert(0, f"{findings.max_permille} permille = {text_Nm(findings.max_permille * scale)}")
    else:
        findings.remarks.append(f"no object 6072: the drive limits its torque by {limits[0]}")
    if findings.mode is Mode.TORQUE:
        findings.remarks += set_torque_slope(objects, scale, settings.torque_rate_max_Nmps)
    findings.settings["max torque"] = ", ".join(limits)


def set_sync(objects: ObjectAccess, rate_Hz: float, *, cyclic: bool) -> dict[str, str]:
    """Settings for the report.  60C2 = SYNC period: needed in the cyclic modes, optional in the profile modes."""
    listen_to_our_sync(objects, rate_Hz)
    if not cyclic and not (objects.has(0x60C2, 1) and objects.has(0x60C2, 2)):
        return {}
    names = {1: "interpolation time period", 2: "interpolation time index"}
    value, exponent = interpolation_period(rate_Hz)
    held, held_exponent = (objects.read(0x60C2, sub, what=what) for sub, what in names.items())
    if held_exponent != exponent and math.isclose(held * 10.0**held_exponent, 1.0 / rate_Hz):  # as 10 x 10^-4 s
        return {"60C2": f"{held}e{held_exponent} s"}
    objects.write_verified(0x60C2, 1, value, what=names[1])
    objects.write_verified(0x60C2, 2, exponent, what=names[2])
    return {"60C2": f"{value}e{exponent} s"}


def counts_per_motor_turn(objects: ObjectAccess) -> float:
    """608F: increments (sub 1) in motor revolutions (sub 2); 0 where the drive does not report them (CiA 402-2)."""
    try:
        increments, turns = (
            objects.read(0x608F, sub, what="position encoder resolution") if objects.has(0x608F, sub) else 0
            for sub in (1, 2)
        )
    except DeviceError:
        return 0.0
    return increments / turns if turns else 0.0


def _unsigned(objects: ObjectAccess, index: int, sub: int) -> int | None:
    """None also where the drive refuses to give it."""
    try:
        value = objects.read_if_present(index, sub, what="unit or ramp of the quick stop")
    except DeviceError:
        return None
    return None if value is None else value & 0xFFFFFFFF


def arm_watchdog(objects: ObjectAccess, settings: CanopenSettings, findings: Findings) -> None:
    """The drive watches our heartbeat and stops by itself when it stays away; it sends its own as well."""
    milliseconds = round(settings.heartbeat_s * 1000.0)
    consumer = settings.master_node << 16 | milliseconds
    lack = objects.lack(0x1016, 1)
    if lack:
        raise DeviceError(
            f"{lack} object 1016:1 (consumer heartbeat time), which jointctl needs: "
            "without it the drive cannot notice that this computer has died",
            hint="use the EDS file that belongs to this drive and firmware; a drive without a heartbeat consumer is "
            "not enabled",
        )
    if objects.read(0x1016, 1, what="consumer heartbeat time"):
        # left armed by a controller that was ended: its error ends with the entry, and does not pass for ours
        objects.write(0x1016, 1, 0, what="consumer heartbeat time")
    objects.write_verified(0x1016, 1, consumer, what="consumer heartbeat time")
    findings.heartbeat_watched = objects.write_if_present(0x1017, 0, milliseconds, what="producer heartbeat time")
    if not findings.heartbeat_watched:
        findings.remarks.append("no object 1017: a restarted drive is noticed by its boot-up message and its silence")
    findings.settings["on a lost heartbeat"], remarks = arm_reaction(objects, settings)
    quick_stop = quick_stop_of(lambda *place: _unsigned(objects, *place), settings)
    findings.settings["quick stop"] = quick_stop.words
    findings.remarks += [*remarks, *filter(None, [quick_stop.problem(settings)])]
    findings.settings["watchdog"] = f"{milliseconds} ms on the heartbeat of node {settings.master_node}"


def _map_pdos(objects: ObjectAccess, settings: CanopenSettings, findings: Findings) -> PdoLayout:
    """Those of the loop in the mode that was chosen; a drive without 60B1 goes without velocity offset."""
    wanted = settings.velocity_offset and findings.mode is Mode.CYCLIC_SYNC_POSITION
    if wanted and not objects.has(0x60B1):
        wanted = False
        findings.remarks.append("no object 60B1: without velocity offset the joint lags by its speed / position gain")
    layout = configure_loop_pdos(
        objects, settings.node, settings.rpdo_transmission_type, TARGETS.get(findings.mode, TARGET_TORQUE),
        mode=findings.mode, max_permille=findings.max_permille, torque_offset=settings.torque_offset,
        spare=frozenset({OFFSET_RPDO} if wanted else ()),
    )  # fmt: skip
    if not wanted:
        return layout
    return replace(layout, offset_rpdo_id=map_velocity_offset(objects, settings.node, settings.rpdo_transmission_type))


def commission(
    objects: ObjectAccess, settings: CanopenSettings, eds: EdsFile, pause: Pause, prove: Callable[[], str] | None = None
) -> Findings:
    """All steps on a node in pre-operational; it ends disabled, with its PDOs mapped.

    `pause` sleeps; `prove` shows that the armed watchdog works and returns what the drive said (None: not proven).
    """
    findings = Findings(remarks=eds.all_remarks())
    identify(objects, settings, eds, findings)
    disable(objects, settings, pause)
    choose_mode(objects, settings, findings, pause)
    limit_torque(objects, settings, findings)
    if findings.mode in TARGETS:
        require_reaction(objects, settings)
        require_one_direction(objects, settings, findings)
    if settings.holds_alone:
        require_own_loop(objects, settings, findings)
    if findings.mode in TARGETS:
        limit_velocity(objects, settings, findings)
    if findings.mode is Mode.CYCLIC_SYNC_POSITION:
        take_place(objects, settings, findings)
    findings.settings.update(set_sync(objects, settings.rate_Hz, cyclic=findings.mode in CYCLIC_MODES))
    arm_watchdog(objects, settings, findings)
    if prove is not None:
        findings.settings["watchdog detects"] = prove()
    findings.layout = _map_pdos(objects, settings, findings)
    for rpdo_id in filter(None, (findings.layout.rpdo_id, findings.layout.offset_rpdo_id)):
        deadline, remarks = arm_rpdo_deadline(objects, settings, rpdo_id)
        if deadline:
            findings.settings["RPDO deadline"] = deadline
        findings.remarks += remarks
    second = settings.joint_encoder
    if second is not None and second.node is None:
        findings.second = commission_drive_object(objects, second, settings.node)
        findings.settings["joint encoder"] = findings.second.words
    findings.start_counts = objects.read(0x6064, what="position actual value")
    findings.counts_per_motor_turn = counts_per_motor_turn(objects)
    findings.remarks += [*_scaled_units(objects), *objects.remarks]
    return findings
