"""The loop on the virtual joint or arm against the same exchange in C, cyclictest and Python loops; idle, under load.

Ours, C and cyclictest all keep to the last core, and the load to the first: left to the system, the load shares the
core of one measured loop and not that of the next.  Our loop and the one in C run as a process of their own with the
same priority and locked memory, on a bus that both find commissioned by the same driver; the load begins after that.
The C loop has no phases, no limits of motion and no supervision: it is what exchange, laws and the arm's model cost.
The Python loops run in this process, as they would in a user's script, with the drive disabled and zero torque.
FOR THE VIRTUAL JOINT ONLY.
"""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import can
import canopen
import numpy as np

from jointctl.drivers.can.open import open_cyclic_end
from jointctl.drivers.can.virtual_bus import VirtualBus
from jointctl.drivers.canopen.cia import RPDO1_ID, SYNC_ID, TPDO1_ID
from jointctl.drivers.canopen.cyclic import CanopenPort
from jointctl.drivers.drive import DriveGroup
from jointctl.drivers.errors import JointctlError
from jointctl.firmware_py.states import DriveState, StopRequest
from jointctl.tools.configuration.arm import SHIPPED_ARM, ArmConfig, load_arm
from jointctl.tools.configuration.canopen import canopen_section
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.drive_section import GivenPlace
from jointctl.tools.configuration.records import axis_constants, stacked_tables, trajectory_table
from jointctl.tools.session.canopen_drive import CanopenSession
from jointctl.tools.session.loop_handle import RECEIVE_SHARE, LoopHandle
from jointctl.tools.verbs.verb_options import on_bus
from jointctl.tools.wake_up import cores_awake, fifo, wake_up_lateness_ns
from tests.arms import long_arm
from tests.bench.c_programs import NoCompilerError, exchange_program, link_doubles, setting_doubles
from tests.bench.paired import Row, compared, interleaved, measured, separate_virtual_joint, skipped

# --- load: a busy thread of this very process, or a busy process ---

LOADS = ("idle", "Python thread", "busy core")


def cores() -> list[int]:
    """The processors that this process may use."""
    return sorted(os.sched_getaffinity(0))


@contextmanager
def on_core(core: int | None) -> Iterator[None]:
    """Keeps the calling thread, and what it starts, on one core; None: wherever the system puts it."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, before if core is None else {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextmanager
def python_thread() -> Iterator[None]:
    """A thread that computes in Python and so wants the interpreter's lock all the time."""
    ended = threading.Event()

    def work() -> None:
        total = 0
        with on_core(cores()[0]):
            while not ended.is_set():
                total += sum(range(2000))

    thread = threading.Thread(target=work, name="load", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@contextmanager
def busy_core() -> Iterator[int]:
    """Another process that never sleeps; gives its number.  It ends by itself when this one has gone: input closes."""
    code = "import select, sys\nwhile not select.select([sys.stdin], [], [], 0)[0]: sum(range(20000))"
    with on_core(cores()[0]):
        process = subprocess.Popen([sys.executable, "-S", "-c", code], stdin=subprocess.PIPE)
    try:
        yield process.pid
    finally:
        process.kill()
        process.communicate()


@contextmanager
def load(name: str) -> Iterator[None]:
    """One of `LOADS`."""
    if name == "Python thread":
        with python_thread():
            yield
    elif name == "busy core":
        with busy_core():
            yield
    elif name == "idle":
        yield
    else:
        raise ValueError(f"load (={name!r}) must be one of {', '.join(LOADS)}")


# --- durations ---


@dataclass(frozen=True)
class LoopTimes:
    """Durations [us], one a cycle, arrays (N,): wake-up after the deadline, SYNC to TPDO, work without waiting."""

    wake_us: np.ndarray
    round_trip_us: np.ndarray
    work_us: np.ndarray
    skipped: int = 0  # slots

    def quantile(self, name: str, share: float) -> float:
        """Of `wake`, `round_trip` or `work` [us]; nan where nothing was measured."""
        values = getattr(self, f"{name}_us")
        return float(np.quantile(values, share)) if len(values) else float("nan")


NO_VALUES: np.ndarray = np.zeros(0)


def times_from_ns(rows: np.ndarray) -> LoopTimes:
    """From int64[N, 3] of wake-up, wait (not positive: no sample came) and work [ns]."""
    wake, wait, work = (rows[:, column] * 1e-3 for column in range(3))
    return LoopTimes(wake, wait[wait > 0.0], work)


# --- compiled loops ---

SETTLE_S = 0.5  # left out at the beginning: the C loop enables the drives in it
POLL_S = 0.02
END_S = 3.0
PATIENCE_S = 0.25  # so long a computer may stand still without ending the run
ENABLED_SHARE = 0.9


def joints_of(given: Config | ArmConfig) -> tuple[Config, ...]:
    """One, or those of an arm."""
    return (given,) if isinstance(given, Config) else given.joints


def _tables(given: Config | ArmConfig) -> np.ndarray:
    return stacked_tables([trajectory_table(config) for config in joints_of(given)])


@contextmanager
def commissioned(given: Config | ArmConfig) -> Iterator[tuple[DriveGroup, Any]]:
    """(drives, AxisConstants) of the joints as they stand; afterwards the drives are off."""
    drives = CanopenSession().open_all(joints_of(given))
    try:
        starts = [report.start_position_rad for report in drives.commission()]
        if isinstance(given, Config):
            yield drives, axis_constants(given, trajectory_table(given), start_position_rad=starts[0])
        else:
            yield drives, given.axis_constants(list(_tables(given)), starts)
    finally:
        drives.make_safe()
        drives.close()


def _loop(given: Config | ArmConfig) -> LoopHandle:
    config = joints_of(given)[0]
    arm = None if isinstance(given, Config) else given.model
    return LoopHandle(config, _tables(given), CanopenPort, arm=arm)


def run_ours(given: Config | ArmConfig, seconds: float, load_name: str) -> LoopTimes:
    """The control loop for so long after it has settled; this process only gives its sign of life meanwhile."""
    config = joints_of(given)[0]
    with _loop(given) as loop, commissioned(given) as (drive, constants):
        loop.bus_is_there()
        loop.wait_ready()
        drive.start_cyclic()
        loop.go(constants, drive.port())
        chunks = []
        end_s = math.inf
        with load(load_name):
            while time.monotonic() < end_s and loop.running():
                loop.beat()
                chunks.append(loop.new_records())
                if end_s == math.inf and (chunks[-1]["drive_state"] == DriveState.ENABLED).any():
                    end_s = time.monotonic() + SETTLE_S + seconds
                time.sleep(POLL_S)
        ended_early, verdicts = not loop.running(), [loop.of_axis(axis).verdict() for axis in range(loop.block.axes)]
        loop.request_stop(StopRequest.OFF)
        end_s = time.monotonic() + END_S
        while time.monotonic() < end_s and loop.running():
            loop.beat()
            time.sleep(POLL_S)
    if ended_early:
        faults = ", ".join(f"{fault.name} ({value:g})" for fault, value in verdicts)
        raise JointctlError(f"the control loop stopped by itself while it was measured: {faults}")
    records = np.concatenate(chunks)
    enabled = int(np.argmax(records["drive_state"] == DriveState.ENABLED))
    records = records[enabled + round(SETTLE_S * config.loop.rate_Hz) :]
    _require_enabled("our", records["drive_state"] == DriveState.ENABLED)
    rows = np.column_stack([records["wake_late_ns"], records["round_trip_ns"], records["work_ns"]])
    return replace(times_from_ns(rows.astype(np.int64)), skipped=int(records["skipped"].sum()))


def _require_enabled(whose: str, enabled: np.ndarray) -> None:
    """`JointctlError` unless the drive was enabled most of the time: cycles that command nothing are no measurement."""
    share = float(np.mean(enabled)) if len(enabled) else 0.0
    if share < ENABLED_SHARE:
        raise JointctlError(f"{whose} loop had the drive enabled in {share:.0%} of its cycles only")


def run_c(program: Path, given: Config | ArmConfig, seconds: float, load_name: str) -> LoopTimes:
    """The same exchange in C for so long after it has settled."""
    config = joints_of(given)[0]
    rate_Hz = config.loop.rate_Hz
    cycles = round((SETTLE_S + seconds) * rate_Hz)
    period_ns = round(1e9 / rate_Hz)
    with (
        open_cyclic_end(config.bus.interface, config.bus.channel) as end,
        commissioned(given) as (drive, constants),
    ):
        settings = [setting_doubles(*one) for one in zip(constants, drive.port(), strict=True)]
        if not isinstance(given, Config):
            settings += [given.model.constants[0].gravity_mps2, link_doubles(given.model.links).ravel()]
        drive.start_cyclic()
        fd = end.fileno()
        receive_ns = int(RECEIVE_SHARE * period_ns)
        numbers = (fd, config.loop.priority or 0, period_ns, receive_ns, cycles, len(joints_of(given)))
        with load(load_name), cores_awake(), on_core(config.loop.cpu):  # as ours, and awake as cyclictest as well
            result = subprocess.run(
                [str(program), *map(str, numbers)],
                input=np.concatenate(settings).tobytes(),
                stdout=subprocess.PIPE,
                pass_fds=(fd,),
                check=False,
                timeout=10.0 * (SETTLE_S + seconds) + 10.0,
            )
    rows = np.frombuffer(result.stdout, np.int64)
    if result.returncode != 0 or len(rows) != 5 * cycles:
        raise JointctlError(f"the C loop ended with code {result.returncode} after {len(rows) // 5} of {cycles} cycles")
    rows = rows.reshape(cycles, 5)[round(SETTLE_S * rate_Hz) : -round(0.1 * rate_Hz)]
    enabled = rows[:, 3] == 1
    _require_enabled("the C", enabled)
    return replace(times_from_ns(rows[enabled]), skipped=int(rows[:, 4].sum()))


def cyclictest_path() -> str | None:
    """Where rt-tests' cyclictest is installed, if it is."""
    return shutil.which("cyclictest")


def run_cyclictest(path: str, config: Config, seconds: float, load_name: str) -> LoopTimes:
    """cyclictest's wake-ups at the same rate and priority; whole microseconds."""
    period_us = round(1e6 / config.loop.rate_Hz)
    options = ["-q", "-m", "-t1", f"-i{period_us}", f"-l{round(seconds * config.loop.rate_Hz)}", "-h20000"]
    if config.loop.priority:
        options.append(f"-p{config.loop.priority}")
    with load(load_name), on_core(config.loop.cpu):
        result = subprocess.run(
            [path, *options], capture_output=True, text=True, check=False, timeout=10.0 * seconds + 10.0
        )
    pairs = [line.split() for line in result.stdout.splitlines() if line[:1].isdigit()]
    counts = np.array([[int(late), int(count)] for late, count in pairs], np.int64)
    if result.returncode != 0 or not len(counts):
        raise JointctlError(f"cyclictest ended with code {result.returncode} and no histogram")
    return LoopTimes(np.repeat(counts[:, 0], counts[:, 1]).astype(float), NO_VALUES, NO_VALUES)


def run_sleep_only(config: Config, seconds: float, load_name: str) -> LoopTimes:
    """Our compiled sleep without any exchange, in this process: what cyclictest does."""
    with load(load_name), on_core(config.loop.cpu), fifo(config.loop.priority or 1), cores_awake():
        late_ns = wake_up_lateness_ns(config.loop.rate_Hz, round(seconds * config.loop.rate_Hz))
    return LoopTimes(late_ns * 1e-3, NO_VALUES, NO_VALUES)


# --- loops in Python ---


def _frame(identifier: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


def run_python_can(config: Config, seconds: float, load_name: str) -> LoopTimes:
    """Absolute deadlines, SYNC, wait for the TPDO, RPDO, with python-can's send and recv; no law is computed."""
    period_ns = round(1e9 / config.loop.rate_Hz)
    node = canopen_section(config).node
    sync, rpdo = _frame(SYNC_ID), _frame(RPDO1_ID + node, bytes(4))
    cycles = round(seconds * config.loop.rate_Hz)
    rows, done = np.zeros((cycles, 3), np.int64), 0
    with commissioned(config) as (drive, _), VirtualBus(config.bus.channel) as bus, ExitStack() as stack:
        drive.start_cyclic()
        stack.enter_context(load(load_name))
        deadline_ns = time.monotonic_ns() + period_ns
        ended_ns = deadline_ns + round(seconds * 1e9)
        while done < cycles and deadline_ns < ended_ns:  # under load a cycle takes many periods
            row = rows[done]
            time.sleep(max(0, deadline_ns - time.monotonic_ns()) * 1e-9)
            wake_ns = time.monotonic_ns()
            row[0] = wake_ns - deadline_ns
            deadline_ns += row[0] // period_ns * period_ns
            bus.send(sync)
            started_ns = time.monotonic_ns()
            end_ns = deadline_ns + int(RECEIVE_SHARE * period_ns)
            answer = None
            while (left_ns := end_ns - time.monotonic_ns()) > 0:
                answer = bus.recv(left_ns * 1e-9)
                if answer is None or answer.arbitration_id == TPDO1_ID + node:
                    break
            waited_ns = time.monotonic_ns() - started_ns
            bus.send(rpdo)
            row[1] = waited_ns if answer is not None else -1
            row[2] = time.monotonic_ns() - wake_ns - waited_ns
            deadline_ns += period_ns
            done += 1
    return times_from_ns(rows[:done])


class _StampedBus(VirtualBus):
    """Remembers when each frame was sent."""

    def __init__(self, channel: str) -> None:
        super().__init__(channel)
        self.sent_ns: list[int] = []

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.sent_ns.append(time.monotonic_ns())
        super().send(msg, timeout)


def run_canopen_sync(config: Config, seconds: float, load_name: str) -> LoopTimes:
    """`network.sync.start(period)`: how far each interval between two SYNC frames is off, as the wake-up time."""
    period_s = 1.0 / config.loop.rate_Hz
    bus: Any = _StampedBus(config.bus.channel)
    network: Any = canopen.Network(bus)
    network.connect()
    try:
        network.sync.start(period_s)
        with load(load_name):
            time.sleep(seconds)
        network.sync.stop()
    finally:
        network.disconnect()
        bus.shutdown()
    off_us = np.abs(np.diff(bus.sent_ns) * 1e-3 - period_s * 1e6)
    return LoopTimes(off_us, NO_VALUES, NO_VALUES)


# --- the comparison ---

Loop = Callable[[Any, float, str], LoopTimes]  # one segment: joint, seconds, name of the load
GROUP = "loop"
RATES_Hz = (1000.0, 2000.0)
GOAL = 1.2
MEDIAN, HIGH = 0.5, 0.99
_AGAINST_C = (
    ("wake-up p50", "wake", MEDIAN, None),
    ("wake-up p99", "wake", HIGH, GOAL),
    ("work p50", "work", MEDIAN, None),
    ("work p99", "work", HIGH, GOAL),
    ("round trip p50", "round_trip", MEDIAN, None),
    ("round trip p99", "round_trip", HIGH, None),
)
_AGAINST_CYCLICTEST = (("wake-up p50", "wake", MEDIAN, GOAL), ("wake-up p99", "wake", HIGH, None))
_BARE = (("sleep alone, p50", "wake", MEDIAN, None), ("sleep alone, p99", "wake", HIGH, None))
_AGAINST_PYTHON = (("wake-up p50", "wake", MEDIAN, None), ("wake-up p99", "wake", HIGH, None))
_INTERVALS = (("SYNC interval off by, p99", "wake", HIGH, None),)


@dataclass(frozen=True)
class Rounds:
    """How often each comparison is measured: what is close, more often, for the p99 of some seconds is noisy."""

    in_c: int
    cyclictest: int
    in_python: int


@dataclass(frozen=True)
class Case:
    """One rate and one load; a segment lasts `seconds`."""

    config: Config | ArmConfig
    load_name: str
    seconds: float

    @property
    def name(self) -> str:
        """As the table has it."""
        joints = joints_of(self.config)
        several = f"{len(joints)} joints, " if len(joints) > 1 else ""
        return f"{several}{joints[0].loop.rate_Hz / 1000.0:g} kHz, {self.load_name}"


def _rows(
    case: str,
    ours: list[LoopTimes],
    other: list[LoopTimes],
    name: str,
    quantities: tuple[tuple[str, str, float, float | None], ...],
) -> Iterator[Row]:
    for what, field, share, goal in quantities:
        one = [times.quantile(field, share) for times in ours]
        two = [times.quantile(field, share) for times in other]
        if not any(math.isnan(value) for value in two):
            yield compared(GROUP, f"{case}: {what}", one, two, "us", name, goal=goal)


def _in_turn(case: Case, rounds: int, *loops: Loop) -> list[list[LoopTimes]]:
    return interleaved(rounds, *(partial(loop, case.config, case.seconds, case.load_name) for loop in loops))


def _against_c(case: Case, program: Path, rounds: int) -> Iterator[Row]:
    ours, theirs = _in_turn(case, rounds, run_ours, partial(run_c, program))
    yield from _rows(case.name, ours, theirs, "C loop", _AGAINST_C)
    if isinstance(case.config, ArmConfig):
        skipped_slots = [float(sum(times.skipped for times in one)) for one in (ours, theirs)]
        note = f"in C {skipped_slots[1]:g}, in {rounds * case.seconds:g} s each"
        yield measured(GROUP, f"{case.name}: slots skipped", [skipped_slots[0]], "", note=note)


def _against_cyclictest(case: Case, path: str, rounds: int) -> Iterator[Row]:
    ours, theirs, bare = _in_turn(case, rounds, run_ours, partial(run_cyclictest, path), run_sleep_only)
    yield from _rows(case.name, ours, theirs, "cyclictest", _AGAINST_CYCLICTEST)
    yield from _rows(case.name, bare, theirs, "cyclictest", _BARE)


def _against_python(case: Case, rounds: int) -> Iterator[Row]:
    ours, python_can, canopen = _in_turn(case, rounds, run_ours, run_python_can, run_canopen_sync)
    yield from _rows(case.name, ours, python_can, "python-can loop", _AGAINST_PYTHON)
    intervals = [LoopTimes(np.abs(np.diff(times.wake_us)), times.work_us, times.work_us) for times in ours]
    yield from _rows(case.name, intervals, canopen, "canopen SYNC", _INTERVALS)


def arm_for_comparison(path: Path, channel: str) -> ArmConfig:
    """An arm with the law that the C source knows."""
    arm = on_bus(load_arm(path), GivenPlace("jointctl", channel))
    joints = tuple(
        joint.changed(
            control__kind="computed_torque_rbf", control__observer_radps=0.0, control__adaptation=None,
            loop__cpu=cores()[-1], limits__sample_age_max_s=PATIENCE_S, limits__skipped_max_s=PATIENCE_S,
        )
        for joint in arm.joints
    )  # fmt: skip
    return replace(arm, joints=joints)


def arm_exchange_rows(folder: Path, *, rounds: int, seconds: float) -> Iterator[Row]:
    """Three and seven drives against the same exchange in C: virtual arms, on a virtual bus that models bit times.

    The virtual arm keeps to the loops' core.  On another one, waking its bus now and then takes an interrupt of that
    core, 8 us in a virtual machine: while it is busy, or where it has been idle for 250 us, when Linux ends to poll.
    At 1 kHz that time comes 1 us from where one of the loops sends, so that p99 tells which, not what they cost.
    """
    try:
        program = exchange_program(folder)
    except NoCompilerError as error:
        yield skipped(GROUP, "an arm against a C loop", error.message)
        return
    long = folder / "long-arm"
    long.mkdir()
    for path in (SHIPPED_ARM, long_arm(long)):
        channel = f"bench-{path.parent.name}{os.getpid()}"
        with ExitStack() as stack:
            with on_core(cores()[-1]):
                stack.enter_context(separate_virtual_joint(path, channel, timing=True))
            yield from _against_c(Case(arm_for_comparison(path, channel), "idle", seconds), program, rounds)


def exchange_rows(config: Config, folder: Path, *, rounds: Rounds, seconds: float, quick: bool) -> Iterator[Row]:
    """Starts a virtual joint of its own on a bus of its own; `quick`: one rate, idle and the Python thread only."""
    program: Path | None = None
    try:
        program = exchange_program(folder)
    except NoCompilerError as error:
        yield skipped(GROUP, "against a C loop", error.message)
    cyclictest = cyclictest_path()
    if cyclictest is None:
        yield skipped(GROUP, "against cyclictest", "not installed (package rt-tests)")
    channel = f"bench{os.getpid()}"
    config = config.changed(
        bus__interface="jointctl", bus__channel=channel, loop__cpu=cores()[-1],
        limits__sample_age_max_s=PATIENCE_S, limits__skipped_max_s=PATIENCE_S,
    )  # fmt: skip
    with separate_virtual_joint(config.path, channel):
        for rate_Hz in RATES_Hz[:1] if quick else RATES_Hz:
            for name in LOADS[:2] if quick else LOADS:
                case = Case(config.changed(loop__rate_Hz=rate_Hz), name, seconds)
                if program is not None:
                    yield from _against_c(case, program, rounds.in_c)
                if cyclictest is not None:
                    yield from _against_cyclictest(case, cyclictest, rounds.cyclictest)
                yield from _against_python(case, rounds.in_python)
