"""Supervisor, loop, `jointctl stop` and the virtual drives at simulated time, in one process that can be forked.

Each program is a greenlet that runs the code that ships: the real `Session`, the real driver, the portable loop on
the kernels of the compiled one, the real `stop_node`.  Only what waits is replaced: sleeping lets the drive and the
other programs go on, and an SDO answer is there or does not come.  A frame is delivered in the instant in which it is
sent; every frame is counted, and a hook runs after it.  Nothing depends on the computer's clock.

An arm may be on several buses, where the nodes of all its drives must differ: the portable loop has one, which here
sends each RPDO to its drive's bus and all else to every bus.  A bus is named by the first joint on it.

Importing this replaces the clock of the whole process: for programs of their own only.
"""

from __future__ import annotations

import contextlib
import logging
import mmap
import struct
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from functools import partial
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import canopen
import greenlet
import numpy as np
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoCommunicationError

from jointctl import live_joint as live_joint_module
from jointctl.drivers.canopen import drive as drive_module
from jointctl.drivers.canopen import switch_off as switch_off_module
from jointctl.drivers.canopen.cia import SDO_ANSWER_ID
from jointctl.drivers.canopen.drive import CanopenDrive
from jointctl.drivers.canopen.switch_off import stop_node
from jointctl.drivers.drive import DriveGroup
from jointctl.firmware_py.cycle import Word
from jointctl.firmware_py.libc import NANOSECONDS
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase
from jointctl.hil.arm_plant import no_arm_plant
from jointctl.hil.canopen.device_core import advance_together
from jointctl.hil.canopen.records import PowerState
from jointctl.hil.faults import FaultKind, fault_rows, no_faults
from jointctl.hil.lockstep import TRUE_POWER_STATE, TRUTHS, Scenario, run_lockstep
from jointctl.hil.lockstep import World as Joint
from jointctl.hil.virtual_bus import FrameQueue
from jointctl.tools.configuration.arm import ArmConfig, ArmModel
from jointctl.tools.configuration.canopen import canopen_settings
from jointctl.tools.configuration.config import Config, first_on_bus
from jointctl.tools.lockstep import codec_of
from jointctl.tools.output import Output
from jointctl.tools.recording.run_summary import KeptRecords
from jointctl.tools.session import loop_memory, portable_loop
from jointctl.tools.session import run_watch as run_watch_module
from jointctl.tools.session import session as session_module
from jointctl.tools.session.canopen_drive import CanopenSession
from jointctl.tools.session.control import StopSignals
from jointctl.tools.session.loop_handle import RECEIVE_SHARE, LoopHandle
from jointctl.tools.virtual_joint import arm_plant_of, new_devices
from tests.made_faults import one_fault

STEP_NS = 1_000_000
FAST_STEPS = 5
OFF_STEPS = 100  # without power, where nothing is timed
SHORT_NAP_s, OFF_NAP_s = 0.05, 0.25  # a supervisor that looks often does so less often without power
LONGEST_CHUNK = 250  # cycles of the loop in one compiled call
FRAME_NS = 1_000
LOOK_s = 0.005
GENERAL_ERROR = 0x0800_0000  # SDO abort code
SUPERVISOR, SESSION = "supervisor", "session"  # the second: a thread of the first, where that is a user's program
SWITCHING_OFF = "switching off "  # threads of the first, one a drive of an arm
_FRAME = struct.Struct("<IB3x8s")
# nothing gets to the drive, or drives, or comes from there
CUT_OFF, BUS_OFF = one_fault(FaultKind.FRAMES_LOST, duration_s=1e9), one_fault(FaultKind.BUS_OFF, duration_s=1e9)
POWERED = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE)


class World:
    """The virtual drives, the bus, and the programs on it.  `on_frame` runs after each frame."""

    def __init__(self, given: Config | ArmConfig) -> None:
        joints = [given] if isinstance(given, Config) else list(given.joints)
        self.devices = new_devices(joints)
        row = self.devices[0].whole_row
        self.queues = new(FrameQueue, len(joints))
        for index, device in enumerate(self.devices):
            device.queue = self.queues[index : index + 1]
        arm = no_arm_plant() if isinstance(given, Config) else arm_plant_of(given)
        self.bus = first_on_bus(joints)  # of each axis
        self.buses = sorted(set(self.bus))
        self.joints = Joint(*row, self.queues, *fault_rows([no_faults()] * len(joints)), arm, bus=np.array(self.bus))
        self.now_ns = 1_000_000_000
        self.frames = 0
        self.on_frame: Callable[[int, int], None] = lambda number, identifier: None
        self.lost_to_drive = self.lost_from_drive = False
        self.sdo_refused = False  # the drives answer each request with an abort
        self.cut_off: int | None = None  # the axis whose drive is on the bus no more
        self.off_bus: int | None = None  # of which the computer's adapter is off
        self.fast = False  # frame by frame no more: whole cycles of the loop in one compiled call
        self.long_naps = False  # once the loop runs
        self.ears: list[Any] = []
        self.programs: dict[str, Program] = {}
        self.dead: list[Program] = []
        self.current: Program | None = None
        self.hub = greenlet.getcurrent()
        self.powered = False
        self.power_changes: list[tuple[int, bool]] = []
        self.enabled_unproven = False
        self.watchdog_proven = lambda: True
        self._let_joints_move()
        for device in self.devices:
            device.advance(self.now_ns)  # the boot-up message: no one is there yet

    def lost_faults(self) -> tuple[Any, Any]:
        """`cut_off` and `off_bus` as faults of the axes and their memories."""
        rows = [no_faults() for _ in self.devices]
        for axis, fault in ((self.cut_off, CUT_OFF), (self.off_bus, BUS_OFF)):
            if axis is not None:
                rows[axis] = np.concatenate([rows[axis], fault]).view(np.recarray)
        return fault_rows(rows, -1)

    # --- time ---

    def sleep(self, seconds: float) -> None:
        """The calling program waits; the drive and the others go on."""
        if self.long_naps and not self.powered and seconds < SHORT_NAP_s:
            seconds = OFF_NAP_s
        self.sleep_until_ns(self.now_ns + max(0, round(seconds * NANOSECONDS)))

    def sleep_until_ns(self, until_ns: int, *_: Any) -> None:
        program = self.current
        assert program is not None, "only a program may wait"
        program.wake_ns = until_ns
        self.hub.switch()

    def next_wake_ns(self) -> int:
        """Of the other programs."""
        others = [one.wake_ns for one in self.programs.values() if one is not self.current]
        return min(others, default=self.now_ns + LONGEST_CHUNK * STEP_NS)

    def run(self, until: Callable[[], bool]) -> None:
        """Until that holds, or no program is left."""
        while self.programs and not until():
            program = min(self.programs.values(), key=lambda one: one.wake_ns)
            if program.wake_ns > self.now_ns:
                self._advance(min(program.wake_ns, self.now_ns + self.step_ns))
                continue
            self.current = program
            program.greenlet.switch()
            self.current = None
            if program.greenlet.dead:
                self.programs.pop(program.name, None)

    def pass_time(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """The drive alone."""
        end_ns = self.now_ns + round(seconds * NANOSECONDS)
        while self.now_ns < end_ns and not until():
            self._advance(self.now_ns + self.step_ns)

    @property
    def step_ns(self) -> int:
        """The drive's timers are looked at so often."""
        if not self.fast:
            return STEP_NS
        return (FAST_STEPS if self.powered else OFF_STEPS) * STEP_NS

    def _let_joints_move(self) -> None:
        """All of them, up to now: each drive alone would move its joint as if it were no arm's."""
        of = self.joints
        advance_together(of.device, of.plant_constants, of.plant, self.now_ns, of.queue, of.arm)

    def _advance(self, to_ns: int) -> None:
        self.now_ns = to_ns
        self._let_joints_move()
        for axis, device in enumerate(self.devices):
            for frame in device.advance(to_ns):
                self._from_drive(axis, frame)
        self.look()

    def look(self) -> None:
        self.note_power([int(device.device[0].state) for device in self.devices], self.now_ns)

    def note_power(self, states: Sequence[int], time_ns: int) -> None:
        """The drives' states at that time: `powered` is whether any of them has power."""
        powered = any(state in POWERED for state in states)
        if powered != self.powered:
            self.powered = powered
            self.power_changes.append((time_ns, powered))
            if powered and not self.watchdog_proven():
                self.enabled_unproven = True

    # --- programs ---

    def start(self, name: str, function: Callable[[], Any]) -> None:
        self.programs[name] = Program(name, function, self.now_ns, self.hub)

    def kill(self, *names: str) -> None:
        """They execute nothing more, nor do their threads; one that is executing now ends here."""
        if SUPERVISOR in names:
            names = (*names, SESSION, *(name for name in self.programs if name.startswith(SWITCHING_OFF)))
        for name in names:
            if (program := self.programs.pop(name, None)) is not None:
                self.dead.append(program)  # what is forgotten would be unwound, and so act once more
        if self.current is not None and self.current.name in names:
            self.hub.switch()
            raise AssertionError("a dead program was woken")

    def hang(self, name: str) -> None:
        """It executes nothing more, but its threads go on."""
        if (program := self.programs.pop(name, None)) is not None:
            self.dead.append(program)

    # --- frames ---

    def send(self, sender: Any, identifier: int, data: bytes, bus: int = 0) -> None:
        """A frame of a program: to every other one on that bus, and to its drives, which answer at once."""
        self.now_ns += FRAME_NS
        frame = _FRAME.pack(identifier, len(data), data)
        self._let_joints_move()
        answers = [
            (axis, answer)
            for axis, device in enumerate(self.devices)
            if self.bus[axis] == bus and not self._is_cut_off(axis) and not self.lost_to_drive
            for answer in device.handle(frame, self.now_ns)
        ]
        for ear in list(self.ears):
            if ear is not sender and ear.bus in (bus, None):
                ear.deliver(identifier, data)
        self.look()
        self._count(identifier)
        for axis, answer in answers:
            self._from_drive(axis, answer)

    def _is_cut_off(self, axis: int) -> bool:
        return axis == self.cut_off or self.bus[axis] == self.off_bus

    def _from_drive(self, axis: int, frame: bytes) -> None:
        identifier, size, data = _FRAME.unpack(frame)
        if self.sdo_refused and identifier - SDO_ANSWER_ID in range(1, 128):
            data = b"\x80" + data[1:4] + struct.pack("<L", GENERAL_ERROR)
        if not self.lost_from_drive and not self._is_cut_off(axis):
            for ear in list(self.ears):
                if ear.bus in (self.bus[axis], None):
                    ear.deliver(identifier, data[:size])
        self._count(identifier)

    def _count(self, identifier: int) -> None:
        self.frames += 1
        self.on_frame(self.frames, identifier)


class Program:
    """A greenlet that is woken at `wake_ns`."""

    def __init__(self, name: str, function: Callable[[], Any], wake_ns: int, hub: greenlet.greenlet) -> None:
        self.name, self.wake_ns = name, wake_ns
        self.greenlet = greenlet.greenlet(function, hub)


class SimulatedNetwork(canopen.Network):
    """The `canopen` library on a simulated bus."""

    def __init__(self, world: World, bus: int, listeners: tuple[can.Listener, ...]) -> None:
        super().__init__()
        self._world, self._ears = world, listeners
        self.bus: Any = bus

    def connect(self, *_: Any, **__: Any) -> SimulatedNetwork:
        self._world.ears.append(self)
        return self

    def disconnect(self) -> None:
        if self in self._world.ears:
            self._world.ears.remove(self)

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        self._world.send(self, can_id, bytes(data), self.bus)

    def deliver(self, identifier: int, data: bytes) -> None:
        self.notify(identifier, bytearray(data), self._world.now_ns * 1e-9)
        if self._ears:
            message = can.Message(arbitration_id=identifier, data=data, is_extended_id=False)
            for ear in self._ears:
                ear.on_message_received(message)


class SimulatedBus:
    """A python-can bus for the portable loop: all buses of the world, with `port` CanopenPort[axes]."""

    bus = None

    def __init__(self, world: World, port: Any) -> None:
        self._world, self._port = world, port
        self._waiting: deque[can.Message] = deque()
        world.ears.append(self)

    def deliver(self, identifier: int, data: bytes) -> None:
        self._waiting.append(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        identifier, of = message.arbitration_id, self._port
        own = np.flatnonzero((of.rpdo_id == identifier) | (of.offset_rpdo_id == identifier))
        for bus in {self._world.bus[axis] for axis in own} or self._world.buses:
            self._world.send(self, identifier, bytes(message.data), bus)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if not self._waiting and timeout:
            self._world.sleep(timeout)
        return self._waiting.popleft() if self._waiting else None


class SimulatedProcess:
    """What the supervisor sees of the loop process."""

    def __init__(self) -> None:
        self.code: int | None = None

    def poll(self) -> int | None:
        return self.code

    def kill(self) -> None:
        self.code = -9 if self.code is None else self.code

    def wait(self, timeout: float | None = None) -> int:
        return self.code or 0


class SimulatedLoop(LoopHandle):
    """The handle of a loop that is a program of the world."""

    world: World

    def __init__(
        self, config: Config, table: Any, port: type, tail_paths: Sequence[Path] = (), marker_fds: Sequence[int] = (),
        arm: ArmModel | None = None, joints: Sequence[Config] = (),
    ) -> None:  # fmt: skip
        self.block = loop_memory.new_block(table, port, arm)
        self._tail = self.lost_records = 0
        self._after_end = config.drive.when_the_loop_ends
        self._period_ns = round(NANOSECONDS / config.loop.rate_Hz)
        self._process: Any = SimulatedProcess()
        self._bus = SimulatedBus(self.world, self.block.port)
        self._memory, self._codec = self.block.memory(), codec_of(self.block.port)
        self._cycles(0, 0)  # loads what is compiled, before anything is forked
        self.block.words[Word.READY] = 1

    def __exit__(self, *_: object) -> None:
        self.world.programs.pop("loop", None)

    def wait_ready(self, alive: Any = lambda: None, tell: Any = None) -> None:
        alive()
        self.running()

    def go(self, constants: Any, port: Any) -> None:
        super().go(constants, port)
        if self._process.code is None:
            self.world.start("loop", self._cycle)

    def wait_for_cycle(self, deadline_ns: int, *_: Any) -> None:
        """In the loop: until its next deadline, or, where nothing is counted any more, until its end."""
        world = self.world
        world.sleep_until_ns(deadline_ns)
        if not world.fast:
            return
        while (self.block.state.phase != AxisPhase.FINISHED).any():
            cycles = max(1, min(LONGEST_CHUNK, (world.next_wake_ns() - deadline_ns) // self._period_ns))
            deadline_ns += self._cycles(deadline_ns, cycles) * self._period_ns
            world.sleep_until_ns(deadline_ns)
        self._ended()
        world.kill("loop")

    def _cycles(self, first_ns: int, cycles: int) -> int:
        """So many whole cycles in one call; how many there were until FINISHED."""
        block, world, period_ns = self.block, self.world, self._period_ns
        axes = block.axes
        truth, joints = np.zeros((cycles, TRUTHS * axes)), world.joints
        if world.cut_off is not None or world.off_bus is not None:
            rows, memories = world.lost_faults()
            joints = joints._replace(faults=rows, fault_memory=memories)
        scenario = Scenario(
            first_ns, period_ns, cycles, supervisor_beats=False,
            lost_to_drive=world.lost_to_drive, lost_from_drive=world.lost_from_drive,
        )  # fmt: skip
        written, rows = run_lockstep(self._memory, self._codec, joints, scenario, truth)
        world.queues.count[:] = 0
        done = written // axes
        for row in range(rows):
            world.note_power(truth[row, TRUE_POWER_STATE::TRUTHS].astype(int).tolist(), first_ns + row * period_ns)
        if done:
            world.now_ns = max(world.now_ns, first_ns + (done - 1) * period_ns)
            block.words[Word.LOOP_NS] = world.now_ns
            world.look()
        return done

    def _ended(self) -> None:
        self.block.words[Word.ENDED] = 1
        self._process.code = 0

    def _cycle(self) -> None:
        portable_loop.run_portable_loop(self._bus, self.block, self._period_ns, int(RECEIVE_SHARE * self._period_ns))
        self._ended()

    def die(self) -> None:
        """SIGKILL."""
        self._process.kill()
        self.world.kill("loop")


class SimulatedThread:
    """The session of a program that uses `jointctl.Joint`: a program of the world, which ends with its interpreter."""

    def __init__(self, world: World, *, target: Callable[[], Any], name: str) -> None:
        self._world, self._target = world, target
        self.ident: int | None = None

    def start(self) -> None:
        self.ident = 1
        self._world.start(SESSION, self._target)


class SimulatedEvent:
    """What one program waits for and another one sets."""

    def __init__(self, world: World) -> None:
        self._world, self._happened = world, False

    def set(self) -> None:
        self._happened = True

    def wait(self, timeout: float) -> bool:
        if not self._happened:
            self._world.sleep(timeout)
        return self._happened


def at_once(work: Callable[[], str]) -> Future[str]:
    """`run_watch.beside` without a thread, in no time."""
    future: Future[str] = Future()
    try:
        future.set_result(work())
    except BaseException as error:
        future.set_exception(error)
    return future


class SilentLog:
    """Keeps the texts of events."""

    def __init__(self, path: Path, *_: Any) -> None:
        self.path = path

    def __enter__(self) -> SilentLog:
        return self

    def __exit__(self, *_: object) -> None: ...
    def write_event(self, level: int, source: str, text: str, time_ns: int = 0) -> None: ...
    def write_records(self, records: Any) -> None: ...
    def take_states(self, records: Any, joint: int = 0) -> None: ...
    def write_frames(self, frames: Any) -> None: ...
    def write_temperature(self, time_ns: int, degC: float | None) -> None: ...
    def is_in_place(self) -> bool:
        return True


Places = Sequence[tuple[int, int]]  # bus and node of each drive


def stop_of_this_computer(world: World, signals: StopSignals, places: Places) -> None:
    """`jointctl stop`: the request through the lock of the bus, and the frames."""
    stop_of_another_computer(world, places)
    signals.on_stop_command()


def stop_of_another_computer(world: World, places: Places) -> None:
    """The frames alone."""
    for bus, node in places:  # each command is a program of its own
        world.start(f"stop {node} after frame {world.frames}", partial(stop_node, bus, node, sleep=world.sleep))  # type: ignore[arg-type]


class SimulatedGroup(DriveGroup):
    """Switches its drives off at the same time, each in a program of the world in the place of a thread."""

    def __init__(self, world: World, drives: Sequence[CanopenDrive]) -> None:
        super().__init__(drives)
        self._world = world

    def make_safe(self, *, asked: bool = False) -> list[str]:
        if len(self.drives) == 1:
            return super().make_safe(asked=asked)
        states: dict[int, str] = {}

        def switch_off(axis: int) -> None:
            states[axis] = self.drives[axis].make_safe(asked=asked)

        for axis in range(len(self.drives)):
            self._world.start(f"{SWITCHING_OFF}{axis}", partial(switch_off, axis))
        while len(states) < len(self.drives):
            self._world.sleep(LOOK_s)
        return [states[axis] for axis in range(len(self.drives))]


@contextlib.contextmanager
def simulated(joint: Config | ArmConfig) -> Iterator[World]:
    """The world of one run, with the drives of `joint`; supervisors that are made inside run in it."""
    logging.getLogger("canopen").setLevel(logging.CRITICAL)
    world = World(joint)

    def read_response(client: Any) -> Any:
        if client.responses.empty():
            world.sleep(client.RESPONSE_TIMEOUT)
        if client.responses.empty():
            raise SdoCommunicationError("No SDO response received")
        response = client.responses.get_nowait()
        if response[0] == 0x80:
            raise canopen.SdoAbortedError(struct.unpack_from("<L", response, 4)[0])
        return response

    def new_network(bus: Any, _: Any, *listeners: can.Listener) -> SimulatedNetwork:
        return SimulatedNetwork(world, bus, listeners)

    def open_simulated(
        _: Any, configs: Sequence[Config], gate: Callable[[], None] = lambda: None, private: bool = False
    ) -> DriveGroup:
        drives: list[CanopenDrive] = []
        for axis, first in enumerate(first_on_bus(configs)):
            bus: Any = first if first == axis else drives[first]
            settings = canopen_settings(configs[axis])
            drives.append(CanopenDrive(bus, settings, world.sleep, gate=gate, clock=lambda: world.now_ns * 1e-9))
        return SimulatedGroup(world, drives)

    loops: list[SimulatedLoop] = []

    def new_loop(*arguments: Any, **more: Any) -> SimulatedLoop:
        loops.append(made(*arguments, **more))
        return loops[-1]

    made = type("Loop", (SimulatedLoop,), {"world": world})
    threads = SimpleNamespace(Event=partial(SimulatedEvent, world), main_thread=threading.main_thread)
    private = SimpleNamespace(mmap=lambda fd, size: mmap.mmap(fd, size, flags=mmap.MAP_PRIVATE))
    with contextlib.ExitStack() as stack:
        for place, name, value in (
            (time, "sleep", world.sleep),
            (time, "monotonic", lambda: world.now_ns * 1e-9),
            (time, "monotonic_ns", lambda: world.now_ns),
            (SdoClient, "read_response", read_response),
            (drive_module, "new_network", new_network),
            (switch_off_module, "new_network", new_network),
            (portable_loop, "sleep_until_ns", lambda *when: loops[-1].wait_for_cycle(*when)),
            (portable_loop, "slept_ns", lambda *_: 0),
            (loop_memory, "mmap", private),
            (session_module, "LoopHandle", new_loop),
            (CanopenSession, "open_all", open_simulated),
            (session_module, "recording", lambda _: contextlib.nullcontext()),
            (run_watch_module, "beside", at_once),
            (session_module, "RunLogWriter", SilentLog),
            (session_module, "KeptRecords", lambda _: KeptRecords(Path(tempfile.gettempdir()))),
            (live_joint_module, "threading", threads),
            (live_joint_module, "os", SimpleNamespace(getpid=lambda: 0)),  # a fork of the world has all that is in it
            (live_joint_module, "_SessionThread", partial(SimulatedThread, world)),
        ):
            stack.callback(setattr, place, name, getattr(place, name))
            setattr(place, name, value)
        yield world


def quiet_output() -> Output:
    """Prints nothing."""
    return Output(quiet=True, stdout=StringIO(), stderr=StringIO())
