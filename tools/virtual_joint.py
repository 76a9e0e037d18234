"""The virtual joint of a configuration in this process: plant, drive, and its bus or serial line."""

from __future__ import annotations

import contextlib
import gc
import math
import os
import re
import stat
import struct
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import astuple
from typing import TYPE_CHECKING, Any

import can
import numpy as np

from jointctl.drivers.can.open import CYCLIC_INTERFACES, open_cyclic_end, open_python_can
from jointctl.drivers.can.virtual_bus import decode, encode
from jointctl.drivers.canopen.eds import read_eds
from jointctl.drivers.canopen.pdo import RATED_TORQUE_UNITS_mNm, joint_velocity_per_unit_radps
from jointctl.drivers.canopen.settings import CanopenSettings
from jointctl.drivers.canopen.watchdog import QUICK_STOP_RAMPS, needed_braking
from jointctl.drivers.errors import BusError, ConfigurationError, DataError
from jointctl.firmware_py.schema import new
from jointctl.hil.arm_plant import ArmPlant, arm_plant
from jointctl.hil.canopen.device import Cia402Device, DeviceRow, DeviceSettings
from jointctl.hil.canopen.encoder_node import EncoderSettings
from jointctl.hil.canopen.records import Device
from jointctl.hil.faults import FaultConstants, FaultKind, no_faults
from jointctl.hil.plant import plant
from jointctl.hil.plant_records import EncoderSide, FrictionKind, PlantConstants, PlantSettings, PlantState
from jointctl.hil.realtime_device import ENDED_WORD, SEND_ERRORS_WORD, STOP_WORD, WORDS, RealtimeDevice
from jointctl.hil.virtual_bus import VirtualBusError, VirtualBusHub, default_socket_path
from jointctl.tools.configuration.arm import ArmConfig
from jointctl.tools.configuration.canopen import (
    TORQUE_MODES,
    CanopenSection,
    canopen_section,
    canopen_settings,
    eds_path,
    encoder_eds_path,
    torque_limit_object,
)
from jointctl.tools.configuration.config import SHIPPED_FOLDER, Config, first_on_bus, raise_if
from jointctl.tools.configuration.conversions import (
    acceleration_beside_gravity_radps2,
    friction_constants,
    static_frictions_Nm,
    torque_constant_NmpA,
)
from jointctl.tools.configuration.sections import OWN_KEYS, Virtual

if TYPE_CHECKING:
    from jointctl.hil.elmo_line import ElmoDevice

# --- Its drive, its plant and its faults, from the configuration ---


_OF_EVERY_DRIVE = ((0x6040, "controlword"), (0x6041, "statusword"))  # mandatory in CiA 402
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
    brakes = [config.virtual is not None and config.virtual.brake for config in arm.joints]
    return arm_plant(links, tuple(arm.arm.gravity_mps2), brakes)


def device_settings(config: Config) -> DeviceSettings:
    """The virtual drive that the configuration describes, with the objects and the identity of its EDS."""
    drive = canopen_section(config)
    path = eds_path(config)
    eds = None if path.resolve() == VIRTUAL_EDS else read_eds(path, drive.node)
    missing = [f"{index:04X} ({name})" for index, name in _OF_EVERY_DRIVE if eds and index not in eds.dictionary]
    if missing:
        lacks = f"it has no {' and no '.join(missing)}"
        raise ConfigurationError(f"drive.eds (={path}) is not that of a CiA 402 drive: {lacks}")
    vendor_id, product_code = (eds.vendor_id, eds.product_code) if eds is not None else (None, None)
    current_A, torque_Nm, constant_NmpA = drive.rated_current_A, drive.rated_torque_Nm, torque_constant_NmpA(config)
    if current_A is None and torque_Nm is None:  # `problems` refuses a file with [virtual] for that
        raise ConfigurationError(
            "drive.rated_current_A or drive.rated_torque_Nm is missing: the virtual drive needs it"
        )
    unit_mNm, settings = RATED_TORQUE_UNITS_mNm[drive.rated_torque_unit], canopen_settings(config)
    return DeviceSettings(
        node_id=drive.node,
        rated_current_mA=round((current_A or (torque_Nm or 0.0) / constant_NmpA) * 1000.0),
        rated_torque_mNm=round((torque_Nm or (current_A or 0.0) * constant_NmpA) * 1000.0 / unit_mNm) * unit_mNm,
        rated_torque_unit_mNm=unit_mNm,
        reduction_ratio=config.joint.reduction_ratio,
        motor_torque_constant_NmpA=torque_constant_NmpA(config),
        torque_direction=drive.torque_direction,
        vendor_id=drive.vendor_id or vendor_id or 0,
        product_code=drive.product_code or product_code or 1,
        torque_limit=astuple(limit) if (limit := torque_limit_object(config)) is not None else None,
        shown=eds.dictionary if eds is not None else None,
        velocity_unit_radps=None if drive.velocity_unit == "counts/s" else joint_velocity_per_unit_radps(settings),
        quick_stop=_quick_stop(drive, config, settings),
        **_second_encoder(config),
        **_drive_loops(drive, config),
    )


USUAL_RAMPS_radps2 = {0x6084: 4.8, 0x6085: 12.0}  # at the joint, by the EDS


def _quick_stop(drive: CanopenSection, config: Config, settings: CanopenSettings) -> tuple[int, float] | None:
    """The ramp of its quick stop (object, rad/s2 at the joint), where that of the EDS does not suit the joint.

    A real drive's is set to its joint: no faster than the torque can brake it, and no slower than its limits need; a
    drive that closes its own loop has the loop's own stop for a measure too.
    """
    index = QUICK_STOP_RAMPS.get(drive.quick_stop_option, 0)
    if not index:
        return None
    of_loop, *of_limits = (radps2 for radps2, _ in needed_braking(settings))
    most = acceleration_beside_gravity_radps2(config)
    usual = USUAL_RAMPS_radps2[index]
    wanted = max(min(usual, most), *of_limits, 0.0 if drive.mode in TORQUE_MODES else of_loop)
    return None if wanted == usual else (index, wanted)


SUITED_FRICTION_radps2 = 15.0  # static friction over the inertia, up to which a gain for the inertia overcomes it
MOST_STIFF = 10.0  # of the gains for the inertia: 950 1/s, which a current lag of a millisecond bears


def _drive_loops(drive: CanopenSection, config: Config) -> dict[str, Any]:
    """Its own loops: the gains that the configuration has, else those of `DeviceSettings`, which suit 2.1 kg m2.

    The velocity loop brakes as well, in every mode: a real drive's was tuned to its joint's inertia and friction.
    """
    assert config.virtual is not None
    inertia_kgm2, friction = config.joint.inertia_kgm2, config.virtual.friction or config.friction
    static_Nm = 0.0 if friction is None else max(static_frictions_Nm(config, friction))
    sticky = static_Nm / inertia_kgm2 / SUITED_FRICTION_radps2
    suited = min(max(sticky, 1.0), MOST_STIFF) * inertia_kgm2 / PlantSettings.inertia_kgm2
    gains: dict[str, Any] = {
        name: getattr(DeviceSettings, name) * suited for name in ("velocity_gain_Nmspr", "velocity_integral_Nmprad")
    }
    cascade = drive.cascade
    if cascade is None:
        return gains
    given = {
        "velocity_gain_Nmspr": cascade.velocity_gain_Nmspr,
        "velocity_integral_Nmprad": cascade.velocity_integral_Nmprad,
        "position_gain_ps": cascade.position_gain_ps if drive.mode == "csp" else None,
    }
    gains |= {name: gain for name, gain in given.items() if gain is not None}
    return {**gains, "velocity_feed": 1.0 - cascade.velocity_share, "loop_rate_Hz": cascade.loop_rate_Hz}


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


# --- The virtual joint in this process, on its bus ---


_LONGEST_WAIT_NS = 2_000_000  # timers and the plant move on at least this often
_FRAMES_AT_ONCE = 64  # received before timers are looked at again
_SEND_TIMEOUT_S = 0.01
_ERRORS_IN_A_ROW = 100
_FOREIGN_FRAME = struct.pack("<IB3x8s", 0x7FF, 0, b"")  # means nothing to a drive, but compiles what takes frames
_PAUSE_S = 0.001  # after a failed receive, so that a dead bus does not take a whole core


class PumpedDevice:
    """Runs a device on a python-can bus: `start`, `stop`, or a `with` block, as `RealtimeDevice`; the bus stays the
    caller's.  `words` int64[WORDS]: SEND_ERRORS_WORD counts lost frames, ENDED_WORD is 1 = stopped, 2 = bus gone.

    A Python thread carries the frames.  It answers within about a millisecond on an idle computer and within tens of
    them on a busy one; the compiled `hil.realtime_device`, for buses that are file descriptors, within microseconds.
    """

    def __init__(self, device: Cia402Device, bus: can.BusABC) -> None:
        self._device, self.plant_states = device, device.plant_state
        self._bus = bus
        self.words = np.zeros(WORDS, np.int64)
        self._thread: threading.Thread | None = None

    def _send(self, frames: list[bytes]) -> None:
        for frame in frames:
            message = decode(frame, 0.0, "")
            assert message is not None
            try:
                self._bus.send(message, _SEND_TIMEOUT_S)
            except (can.CanError, OSError):
                self.words[SEND_ERRORS_WORD] += 1

    def _take(self, message: can.Message) -> None:
        try:
            frame = encode(message)
        except ValueError:  # error frames and CAN FD are nothing to the device
            return
        self._send(self._device.handle(frame, time.monotonic_ns()))

    def _run(self) -> None:
        errors = 0
        while self.words[STOP_WORD] == 0:
            now_ns = time.monotonic_ns()
            self._send(self._device.advance(now_ns))
            wait_ns = min(max(int(self._device.device[0].next_due_ns) - now_ns, 0), _LONGEST_WAIT_NS)
            try:
                message = self._bus.recv(wait_ns * 1e-9)
                for _ in range(_FRAMES_AT_ONCE):
                    if message is None:
                        break
                    self._take(message)
                    message = self._bus.recv(0.0)
                else:
                    if message is not None:
                        self._take(message)
                errors = 0
            except (can.CanError, OSError):
                errors += 1
                if errors >= _ERRORS_IN_A_ROW:
                    self.words[ENDED_WORD] = 2
                    return
                time.sleep(_PAUSE_S)
        self.words[ENDED_WORD] = 1

    def start(self) -> None:
        """Compile if need be, then boot: the boot-up message is sent."""
        if self._thread is not None:
            raise RuntimeError("the device is running already")
        self.words[:] = 0
        self._send(self._device.handle(_FOREIGN_FRAME, time.monotonic_ns()))
        self._thread = threading.Thread(target=self._run, name="device", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread; the plant stays where it is.  Harmless when not running."""
        if self._thread is None:
            return
        self.words[STOP_WORD] = 1
        self._thread.join()
        self._thread = None

    def __enter__(self) -> PumpedDevice:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def new_device(config: Config) -> Cia402Device:
    """The drive with its plant, as the configuration says that the joint truly is, and with the objects of its EDS."""
    return new_devices([config])[0]


def new_devices(joints: Sequence[Config]) -> list[Cia402Device]:
    """`new_device` for each joint of an arm, their records in one row."""
    row = DeviceRow(new(Device, len(joints)), new(PlantConstants, len(joints)), new(PlantState, len(joints)))
    devices = []
    for index, config in enumerate(joints):
        made = plant(**plant_settings(config))
        try:
            devices.append(
                Cia402Device(VIRTUAL_EDS, device_settings(config), *made, fault_constants(config), (row, index))
            )
        except (ValueError, OverflowError) as error:  # what the EDS file must hold for a virtual drive
            raise ConfigurationError(
                f"drive.eds (={canopen_section(config).eds}) does not make a virtual drive: {error}"
            ) from None
    return devices


def _start_buses(stack: ExitStack, configs: Iterable[Config], timing: bool) -> None:
    for config in configs:
        try:
            path = default_socket_path(config.bus.channel)
            stack.enter_context(VirtualBusHub(path, config.bus.bitrate_bitps, timing))
        except VirtualBusError as error:
            raise BusError(str(error)) from None


@contextmanager
def serve_virtual_joint(
    given: Config | ArmConfig, timing: bool = False, bus_is_up: Callable[[], None] | None = None
) -> Iterator[RealtimeDevice | PumpedDevice]:
    """Drive in threads of this process; the bus as well if it is a virtual one, all others exist already.

    A bus that can be found has a drive that answers, unless the caller is notified with `bus_is_up` that there is a bus
    already, and waits for the drive.
    """
    joints = [given] if isinstance(given, Config) else list(given.joints)
    config, buses = joints[0], first_on_bus(joints)
    with ExitStack() as stack:
        own_buses = [joints[axis] for axis in sorted(set(buses)) if joints[axis].bus.interface == "jointctl"]
        if bus_is_up is not None:
            _start_buses(stack, own_buses, timing)
            bus_is_up()
        arm, devices = None if isinstance(given, Config) else arm_plant_of(given), new_devices(joints)
        if config.bus.interface in CYCLIC_INTERFACES:
            gc.disable()  # what a compiler leaves behind is little beside what it holds
            RealtimeDevice(devices, -1, arm).compile()
            gc.enable()
        if bus_is_up is None:
            _start_buses(stack, own_buses, timing)
        if config.bus.interface not in CYCLIC_INTERFACES:
            if len(devices[0].faults):
                raise ConfigurationError(
                    f"bus.interface (={config.bus.interface}) must be one of {', '.join(CYCLIC_INTERFACES)} "
                    "for [[virtual.faults]]"
                )
            bus = open_python_can(config.bus.interface, config.bus.channel, config.bus.bitrate_bitps)
            stack.callback(bus.shutdown)
            yield stack.enter_context(PumpedDevice(devices[0], bus))
            return
        ends = {
            axis: stack.enter_context(open_cyclic_end(joints[axis].bus.interface, joints[axis].bus.channel)).fileno()
            for axis in sorted(set(buses))
        }
        yield stack.enter_context(RealtimeDevice(devices, [ends[axis] for axis in buses], arm))


# --- The same behind a virtual Elmo drive on a pseudo-terminal ---


def new_elmo_device(config: Config) -> ElmoDevice:
    """The drive with its plant, as the configuration says that the joint truly is; its port is open, nobody serves."""
    from jointctl.hil.elmo_drive import ElmoDeviceSettings, ElmoInterpreter  # not loaded for another drive
    from jointctl.hil.elmo_line import ElmoDevice
    from jointctl.tools.configuration.elmo import elmo_section

    drive = elmo_section(config)
    settings = ElmoDeviceSettings(
        maximum_current_A=max(20.0, drive.peak_current_A),
        counts_per_turn=config.encoder.counts_per_turn,
        current_sign=drive.torque_direction * config.encoder.direction,
    )
    return ElmoDevice(ElmoInterpreter(settings, *plant(**plant_settings(config))), drive.baud_rate_bitps)


@contextmanager
def serve_virtual_elmo(config: Config, link: str | None = None) -> Iterator[ElmoDevice]:
    """Drive and plant in a thread of this process; `link` is a path that shall point to the port."""
    with new_elmo_device(config) as device:
        if link is not None:
            _make_link(link, device.path)
        try:
            yield device
        finally:
            # by now it may be that of another program
            if link is not None and _target(link) == device.path:
                with contextlib.suppress(OSError):
                    os.unlink(link)


def _target(link: str) -> str:
    """Where a link points; empty if there is none."""
    try:
        return os.readlink(link)
    except OSError:
        return ""


def _make_link(link: str, port: str) -> None:
    """`DataError` where anything but the link of an earlier `hil` of this user has the name: it is left alone."""
    try:
        with contextlib.suppress(FileNotFoundError):
            _require_own_link(link)
            os.unlink(link)
        os.symlink(port, link)  # never follows or replaces anything
    except (OSError, ValueError) as error:  # ValueError: a zero in its name
        raise DataError(f"--link (={link}): cannot be made: {getattr(error, 'strerror', None) or error}") from None


def _require_own_link(link: str) -> None:
    """A link to a pseudo-terminal, which ended with its `hil` or belongs to this user."""
    hint = "give a name that is free, or remove what is there by hand"
    found = os.lstat(link)
    kind = next((words for is_it, words in _KINDS if is_it(found.st_mode)), "a file")
    if not stat.S_ISLNK(found.st_mode):
        raise DataError(f"--link (={link}): is {kind}, and only the link of an earlier hil is replaced", hint)
    target = os.readlink(link)
    if found.st_uid != os.getuid() or not _PORT.fullmatch(target):
        raise DataError(f"--link (={link}): is a link to {target} which no hil of yours has made: left as it is", hint)
    with contextlib.suppress(FileNotFoundError):
        if os.stat(target).st_uid != os.getuid():
            raise DataError(f"--link (={link}): is a link to {target}, the terminal of another user", hint)


_PORT = re.compile(r"/dev/pts/[0-9]+")
_KINDS = (
    (stat.S_ISREG, "a regular file"),
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISSOCK, "a socket"),
)
