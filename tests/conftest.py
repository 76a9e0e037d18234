"""Builders that several test modules share: a small axis on a stub joint, a drive on a bus in this process."""

from __future__ import annotations

import dataclasses
import itertools
import signal
import struct
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from drivers.canopen.drive import CanopenDrive
from drivers.canopen.settings import CanopenSettings
from firmware_py.axis import step_axis
from firmware_py.friction import paper_friction
from firmware_py.lyapunov import solve_lyapunov_p
from firmware_py.records import NEURONS, AxisConstants, AxisState, Command, Sample
from firmware_py.schema import new
from firmware_py.sequence import reset_axis
from firmware_py.states import AxisPhase, ControllerKind, DriveRequest, DriveState, StopRequest, TrajectoryKind
from firmware_py.velocity import low_pass_gain
from hil.canopen.device import Cia402Device
from tools.configuration.drive_settings import canopen_settings
from tools.configuration.load import load_config
from tools.simulation.virtual_joint import new_device

PERIOD_s = 1e-3
INERTIA_kgm2 = 2.1


def pytest_configure() -> None:
    """Ctrl-C reaches what the tests start, although `nohup` or `&` makes a shell start pytest with SIGINT ignored."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def small_axis_constants() -> Any:
    """`AxisConstants` whose phases are short: 0.35 sin(0.2 pi t), approach 0.2 s, limits of a few cycles."""
    constants = new(AxisConstants)
    axis = constants[0]
    law, network = axis.law, axis.law.network
    law.kind = ControllerKind.COMPUTED_TORQUE_RBF
    law.period_s, law.inertia_kgm2, law.kp, law.kv, law.reduction_ratio = PERIOD_s, INERTIA_kgm2, 784.0, 56.0, 121.0
    law.friction = paper_friction()[0]
    law.lugre.stiffness_Nmprad, law.lugre.damping_Nmspr = 8e4, 200.0
    _, p12, p22 = solve_lyapunov_p(784.0, 56.0, 1800.0, 1800.0)
    network.p_b[0], network.p_b[1] = p12 / INERTIA_kgm2, p22 / INERTIA_kgm2
    half = (0.05, 0.03, 0.01, 0.008, 0.004, 0.001, 0.0005)
    for i, centre in enumerate((*(-c for c in half), 0.0, *half)):
        network.centres[i, 0] = network.centres[i, 1] = centre
    for i in range(NEURONS):
        network.inverse_width[i] = 1.0 / (2.0 * 5.0**2)
    network.learning_rate, network.initial_weight = 80.0, 0.01
    axis.velocity.period_s, axis.velocity.cutoff_Hz = PERIOD_s, 100.0
    axis.velocity.period_gain = low_pass_gain(100.0, PERIOD_s)
    trajectory = axis.trajectory
    trajectory.kind, trajectory.amplitude_rad, trajectory.omega_radps = TrajectoryKind.SINE, 0.35, 0.2 * np.pi
    limits = axis.limits
    limits.position_min_rad, limits.position_max_rad, limits.velocity_max_radps = -1.0, 1.0, 10.0
    limits.torque_max_Nm, limits.torque_rate_max_Nmps = 60.0, 20000.0
    limits.following_error_max_rad, limits.position_jump_max_rad = 0.2, 0.02
    limits.sample_age_max_cycles, limits.saturation_max_cycles, limits.skipped_max_cycles = 5, 20, 8
    limits.standstill_radps = 0.02
    sequence = axis.sequence
    sequence.approach_s, sequence.brake_radps2, sequence.release_s = 0.2, 20.0, 0.01
    sequence.settle_cycles, sequence.wait_max_cycles, sequence.enable_max_cycles = 4, 40, 30
    sequence.stop_max_cycles, sequence.off_max_cycles, sequence.supervisor_max_cycles = 100, 20, 10
    sequence.may_enable = 1
    return constants


class StubJoint:
    """A frictionless inertia behind a drive that takes `delay_cycles` a step of its state machine."""

    def __init__(self, position_rad: float = 0.0, delay_cycles: int = 2) -> None:
        self.position_rad = position_rad
        self.velocity_radps = 0.0
        self.drive_state = DriveState.OFF
        self.delay_cycles = delay_cycles
        self._waited = 0
        self.load_Nm = 0.0

    def step(self, request: int, torque_Nm: float, cycles: int) -> None:
        """Move on by `cycles` periods with the command of the last cycle."""
        for _ in range(cycles):
            self._step_drive(request)
            force_Nm = self.load_Nm + (torque_Nm if self.drive_state == DriveState.ENABLED else 0.0)
            before_radps = self.velocity_radps
            self.velocity_radps += force_Nm / INERTIA_kgm2 * PERIOD_s
            if self.drive_state != DriveState.ENABLED:
                self.velocity_radps = 0.0  # friction and brake hold an unpowered joint
            self.position_rad += 0.5 * (before_radps + self.velocity_radps) * PERIOD_s

    def _step_drive(self, request: int) -> None:
        targets = {
            (DriveRequest.ENABLE, DriveState.OFF): DriveState.STARTING,
            (DriveRequest.ENABLE, DriveState.STARTING): DriveState.ENABLED,
            (DriveRequest.QUICK_STOP, DriveState.ENABLED): DriveState.STOPPING,
            (DriveRequest.QUICK_STOP, DriveState.STOPPING): DriveState.OFF,
            (DriveRequest.OFF, DriveState.STARTING): DriveState.OFF,
            (DriveRequest.OFF, DriveState.ENABLED): DriveState.OFF,
            (DriveRequest.OFF, DriveState.STOPPING): DriveState.OFF,
        }
        target = targets.get((DriveRequest(request), self.drive_state))
        self._waited += 1
        if target is None:
            self._waited = 0
        elif self._waited >= self.delay_cycles:
            self.drive_state, self._waited = target, 0


class Rig:
    """One axis on a stub joint, cycle by cycle; the records may be changed between cycles."""

    def __init__(self, position_rad: float = 0.0) -> None:
        self.joint = StubJoint(position_rad)
        self.constants = small_axis_constants()
        self.axis = self.constants[0]
        self.state = new(AxisState)[0]
        self.sample = new(Sample)[0]
        self.command = new(Command)[0]
        self.table = np.zeros((1, 5))
        self.twin_rad = 0.0  # by how much a second encoder is off the one that feeds the law
        self.stop = StopRequest.NONE
        self.supervisor_age_cycles = 0
        self.phases: list[AxisPhase] = []
        self.torques_Nm: list[float] = []
        self.requests: list[DriveRequest] = []
        reset_axis(self.axis, self.state)

    @property
    def phase(self) -> AxisPhase:
        return AxisPhase(int(self.state.phase))

    def tick(self, elapsed_cycles: int = 1, *, fresh: bool = True, offset_rad: float = 0.0) -> None:
        """One cycle: the joint moves on, its sample comes (or not), the axis answers."""
        self.joint.step(int(self.command.request), float(self.command.torque_Nm), elapsed_cycles)
        if fresh:
            self.sample.position_rad = self.joint.position_rad + offset_rad
            self.sample.second_position_rad = self.sample.position_rad + self.twin_rad
            self.sample.drive_state = self.joint.drive_state
            self.sample.count += 1
        step_axis(
            self.axis,
            self.state,
            self.table,
            self.sample,
            self.command,
            elapsed_cycles,
            int(self.stop),
            self.supervisor_age_cycles,
        )
        self.phases.append(self.phase)
        self.torques_Nm.append(float(self.command.torque_Nm))
        self.requests.append(DriveRequest(int(self.command.request)))

    def run(self, cycles: int) -> Rig:
        for _ in range(cycles):
            self.tick()
        return self

    def until(self, phase: AxisPhase, at_most: int = 2000) -> Rig:
        """Tick until the phase is reached."""
        for _ in range(at_most):
            if self.phase >= phase:
                break
            self.tick()
        assert self.phase == phase
        return self


@pytest.fixture
def axis_constants() -> Any:
    """A record array of one `AxisConstants`."""
    return small_axis_constants()


@pytest.fixture
def rig() -> Callable[..., Rig]:
    """Builds an axis on a stub joint: `rig(position_rad)`."""
    return Rig


CONFIGS = Path(__file__).resolve().parents[1] / "configs"
_FRAME = struct.Struct("<IB3x8s")
_channels = itertools.count()
DEVICE_TIME_FACTOR = 4.0
PASS_TIME, TIME_PASSED = 0x1FFFFFF0, 0x1FFFFFF1  # extended identifiers: no frames of CANopen


class DeviceOnBus:
    """The virtual drive on python-can's in-process bus, in a thread.

    Its time moves on 1 ms with every frame, and with every wait of the driver by that time, however busy the computer
    is: the driver's end asks for it with a frame of its own, and goes on when it has heard all that was said meanwhile.

    `answers` replaces the value in expedited SDO upload responses, (index, sub) -> value; `mute` lists objects whose
    next requests stay unanswered; `requests` are the frames that came in.  `sequences` are answers used up one by one
    before the true ones; `refused` are downloads answered with that SDO abort code; `deaf_frames` frames are lost.
    """

    def __init__(self, device: Cia402Device | None) -> None:
        self.device = device
        self.channel = f"device {next(_channels)}"
        self.now_ns = 1_000_000
        self.answers: dict[tuple[int, int], int] = {}
        self.mute: list[tuple[int, int]] = []
        self.refused: dict[tuple[int, int], int] = {}
        self.sequences: dict[tuple[int, int], list[int]] = {}
        self.deaf_frames = 0
        self.requests: list[tuple[int, bytes]] = []
        self._bus = can.Bus(interface="virtual", channel=self.channel)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> DeviceOnBus:
        if self.device is not None:
            # nobody's frame: everything is compiled before a master counts the time of its first request
            self.device.handle(_FRAME.pack(0x7E5, 0, b""), self.now_ns)
        self._thread.start()
        return self

    def stop(self) -> None:
        """From here on the device only moves when the test moves it."""
        self._ended.set()
        self._thread.join()

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._bus.shutdown()

    def _run(self) -> None:
        while not self._ended.is_set():
            message = self._bus.recv(0.05)
            if message is None:
                continue
            if message.arbitration_id == PASS_TIME:
                self._pass_time(struct.unpack("<d", message.data)[0])
                self._bus.send(can.Message(arbitration_id=TIME_PASSED))
                continue
            data = bytes(message.data)
            self.requests.append((message.arbitration_id, data))
            if self.device is None:
                continue
            if self.deaf_frames:
                self.deaf_frames -= 1
                continue
            if message.arbitration_id == 0x600 + self.device.settings.node_id:
                place = struct.unpack_from("<HB", data, 1)
                if place in self.mute:
                    self.mute.remove(place)
                    continue
                if data[0] & 0xE0 == 0x20 and place in self.refused:
                    abort = struct.pack("<BHBI", 0x80, *place, self.refused[place])
                    self._reply(_FRAME.pack(0x580 + self.device.settings.node_id, 8, abort))
                    continue
            self.now_ns += 1_000_000
            for frame in self.device.handle(_FRAME.pack(message.arbitration_id, len(data), data), self.now_ns):
                self._reply(frame)

    def _pass_time(self, seconds: float) -> None:
        if self.device is None:
            return
        until_ns = self.now_ns + round(seconds * 1e9)
        while self.now_ns < until_ns:
            self.now_ns = min(self.now_ns + 10_000_000, until_ns)
            for frame in self.device.advance(self.now_ns):
                self._reply(frame)

    def _reply(self, frame: bytes) -> None:
        identifier, size, payload = _FRAME.unpack(frame)
        if identifier & 0x780 == 0x580 and payload[0] & 0xE2 == 0x42:
            place = struct.unpack_from("<HB", payload, 1)
            if self.sequences.get(place) or place in self.answers:
                value = self.sequences[place].pop(0) if self.sequences.get(place) else self.answers[place]
                value &= 0xFFFFFFFF
                payload = payload[:4] + struct.pack("<I", value)
        self._bus.send(can.Message(arbitration_id=identifier, data=payload[:size], is_extended_id=False))

    def drive(self, settings: CanopenSettings) -> CanopenDrive:
        """The real driver on another end of this bus; its waiting is short, but long for the device."""
        bus = can.Bus(interface="virtual", channel=self.channel)
        passed = threading.Event()

        def hear(message: can.Message) -> None:
            if message.arbitration_id == TIME_PASSED:
                passed.set()

        def sleep(seconds: float) -> None:
            threading.Event().wait(seconds / DEVICE_TIME_FACTOR)
            if self._ended.is_set() or drive._network.notifier is None:
                return
            passed.clear()
            bus.send(can.Message(arbitration_id=PASS_TIME, data=struct.pack("<d", seconds)))
            passed.wait(5.0)

        drive = CanopenDrive(bus, settings, sleep=sleep)
        assert drive._network.notifier is not None
        drive._network.notifier.add_listener(hear)
        return drive


@pytest.fixture
def device_on_bus() -> Iterator[DeviceOnBus]:
    """The virtual joint of configs/virtual.toml on a bus of its own."""
    with DeviceOnBus(new_device(load_config(CONFIGS / "virtual.toml"))) as device:
        yield device


@pytest.fixture
def empty_bus() -> Iterator[DeviceOnBus]:
    """A bus on which nobody answers."""
    with DeviceOnBus(None) as device:
        yield device


@pytest.fixture
def settings_of_virtual_joint() -> CanopenSettings:
    """What configs/virtual.toml tells the driver; it waits for nobody for long."""
    return dataclasses.replace(canopen_settings(load_config(CONFIGS / "virtual.toml")), boot_timeout_s=0.2)


@pytest.fixture
def virtual_config() -> Any:
    """configs/virtual.toml."""
    return load_config(CONFIGS / "virtual.toml")
