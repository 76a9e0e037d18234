"""A commissioned virtual joint for the lockstep simulation: set up once, run many times.

Commissioning goes through the real driver and the real SDO server, over a bus without a wire: a frame that is sent
is handled at once.  Each run starts from a copy of the device as commissioning left it.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import can
import numpy as np

from jointctl.drivers.can.virtual_bus import decode, encode
from jointctl.drivers.canopen.drive import CanopenDrive
from jointctl.drivers.canopen.exchange import accept, begin, end, link_of
from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.arm_model import Arm
from jointctl.firmware_py.cycle import HISTOGRAM_BINS, WORDS, CycleMemory, Histogram, Word
from jointctl.firmware_py.kernel import bound
from jointctl.firmware_py.records import AxisConstants, AxisState, Command, LogRecord, Sample
from jointctl.firmware_py.schema import dtype_of, new
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.hil.arm_plant import ArmPlant
from jointctl.hil.canopen.device import Cia402Device
from jointctl.hil.faults import fault_rows, no_faults
from jointctl.hil.lockstep import (
    NO_POINTS,
    TRUTHS,
    Codec,
    Scenario,
    TRUE_POSITION_rad,
    World,
    part_of_a_run,
    run_lockstep,
)
from jointctl.hil.virtual_bus import FRAME_SIZE
from jointctl.tools.configuration.arm import ArmConfig
from jointctl.tools.configuration.canopen import canopen_settings
from jointctl.tools.configuration.config import Config, first_on_bus
from jointctl.tools.configuration.records import axis_constants, stacked_tables, trajectory_table
from jointctl.tools.virtual_joint import arm_plant_of, new_device

_COMMISSIONING_STEP_NS = 1000  # the device's clock goes on a little with every frame
_LISTENER_S = 5.0  # at most: it may have gone
_START_GRID_NS = 5_000_000_000
NO_STOP = -1
STEP_RECORDS = 1 << 12  # that a stepped run's ring holds
NO_FAULTS = no_faults()
_HEAD, _FINISHED = int(Word.HEAD), int(AxisPhase.FINISHED)


class DirectBus(can.BusABC):
    """A python-can bus whose only other participant is a virtual device in the same process.

    One thread listens, that of python-can's notifier; it has dealt with a frame when it asks for the next one.
    """

    def __init__(self, device: Cia402Device) -> None:
        super().__init__(channel="direct")
        self._device = device
        self._answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._said = self._taken = self._heard = 0  # frames: of the device, taken by the listener, dealt with
        self._listener: int | None = None
        self._all_heard = threading.Condition()
        self.now_ns = 1

    def _say(self, frames: list[bytes]) -> None:
        self._said += len(frames)
        for frame in frames:
            self._answers.put(frame)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """The device handles the frame before this returns."""
        self.now_ns += _COMMISSIONING_STEP_NS
        self._say(self._device.handle(encode(msg), self.now_ns))

    def sleep(self, seconds: float) -> None:
        """The device's time goes on; returns when what it has said is heard, however busy the computer is."""
        self.now_ns += round(seconds * 1e9)
        self._say(self._device.advance(self.now_ns))
        if self._listener != threading.get_ident():
            with self._all_heard:
                self._all_heard.wait_for(lambda: self._heard == self._said, _LISTENER_S)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self._listener = threading.get_ident()
        with self._all_heard:
            self._heard = self._taken
            self._all_heard.notify_all()
        try:
            frame = self._answers.get(timeout=timeout)
        except queue.Empty:
            return None, False
        self._taken += 1
        return decode(frame, self.now_ns * 1e-9, self.channel_info), False


def codec_of(port: np.recarray) -> Codec:
    """The CANopen driver's codec on this `CanopenPort` array."""
    link = link_of(port)
    frame_bytes = link.frames.view(np.ndarray).view(np.uint8).reshape(len(link.frames), FRAME_SIZE)
    return Codec(begin, accept, end, link, frame_bytes)


@dataclass(frozen=True)
class LockstepRun:
    """What one simulated run left."""

    log: Any  # LogRecord recarray, shape (N,)
    state: Any  # AxisState record
    plant: Any  # PlantState record
    device: Any  # Device record
    fault: Fault
    truth: np.ndarray  # float64 (N, TRUTHS): what the joint truly did, columns `hil.lockstep.TRUE_*`
    thermometer: bool = False  # whether the drive reports the motor's temperature, which is one of those

    @property
    def tracking(self) -> np.ndarray:
        """bool (N,): the records of the trajectory itself, without approach and stop."""
        return np.asarray(self.log.phase == AxisPhase.TRACKING)

    @property
    def true_error_rad(self) -> np.ndarray:
        """Joint position minus desired position, (N,); the log's error is that of the encoder."""
        return np.asarray(self.truth[:, TRUE_POSITION_rad] - self.log.desired_position_rad)


def _memory(
    constants: np.recarray, state: np.recarray, tables: np.ndarray, log: np.recarray, arm: Arm | None = None
) -> CycleMemory:
    axes = len(state)
    return CycleMemory(
        constants, state, tables, new(Sample, axes), new(Command, axes), np.zeros(WORDS, np.int64), log,
        np.zeros((len(Histogram), HISTOGRAM_BINS), np.int64), np.zeros(2, np.int64), arm,
    )  # fmt: skip


class SteppedRun:
    """A run that goes on when it is asked to; between two steps `memory` and `world` are the caller's."""

    def __init__(self, memory: CycleMemory, codec: Codec, world: World, start_ns: int, *, thermometer: bool) -> None:
        self.memory, self._codec, self.world = memory, codec, world
        self.now_ns = start_ns
        self._period_ns = round(float(memory.constants[0].law.period_s) * 1e9)
        self._phases, self._axes = memory.state["phase"], len(memory.state)
        self._words, self._ring = memory.words.data, memory.ring.view(dtype_of(LogRecord), np.ndarray)
        self._kept: list[np.ndarray] = []
        self._taken = 0
        self._part = np.zeros(2, np.int64)
        self._truth = np.zeros((0, TRUTHS))  # none
        self._scenario = Scenario(start_ns, self._period_ns, 0, thermometer=thermometer)
        self._carry_out = bound(part_of_a_run, memory, codec, world, self._scenario, self._part, self._truth)

    def step(self, cycles: int) -> None:
        """So many cycles, fewer if all axes have FINISHED; the simulated time goes on all the same."""
        axes, most = self._axes, len(self._ring) // self._axes
        while cycles > 0:
            count = min(cycles, most)
            if self._words[_HEAD] + count * axes - self._taken > len(self._ring):
                self._keep()
            if self._phases[0] != _FINISHED or (self._phases != _FINISHED).any():
                self._part[:] = self.now_ns, count
                self._carry_out()
            self.now_ns += count * self._period_ns
            cycles -= count

    def newest(self, axis: int = 0) -> Any:
        """The newest log record of an axis, a structured scalar that the next step may change."""
        return self._ring[(self._words[_HEAD] - self._axes + axis) % len(self._ring)]

    def _keep(self) -> None:
        head, size = self._words[_HEAD], len(self._ring)
        begin, end = self._taken % size, self._taken % size + head - self._taken
        self._kept += [self._ring[begin:end].copy(), self._ring[: max(end - size, 0)].copy()]
        self._taken = head

    def records(self) -> Any:
        """Every log record so far, a record array (N,): of each cycle one for each axis."""
        self._keep()
        self._kept = [np.concatenate(self._kept)]
        return self._kept[0].view(np.recarray)


class LockstepJoint:
    """The joint of a configuration, commissioned, disabled and operational."""

    def __init__(self, config: Config) -> None:
        self.config = config
        virtual = new_device(config)
        bus = DirectBus(virtual)
        self._settings = canopen_settings(config)
        drive = CanopenDrive(bus, self._settings, sleep=bus.sleep, clock=lambda: bus.now_ns * 1e-9)
        try:
            self.report: CommissioningReport = drive.commission()
            drive.start_cyclic()
            self._port = drive.port()
        finally:
            drive.close()
        # How long commissioning takes on the device's clock depends on how threads were run, and even at rest the last
        # bits of the plant move with each step: a run begins at a time that does not depend on it.
        self.start_ns = (bus.now_ns // _START_GRID_NS + 1) * _START_GRID_NS
        virtual.advance(self.start_ns - _COMMISSIONING_STEP_NS)
        self._virtual = virtual
        self.faults = virtual.faults
        self.table = trajectory_table(config)
        self.plant_constants = virtual.plant_constants.copy()
        self.plant_state = virtual.plant_state.copy()

    @property
    def quick_stop_radps2(self) -> float:
        """With which the drive brakes at a quick stop."""
        device = self._virtual.device[0]
        return float(device.drive.quick_stop_deceleration / abs(device.counts_per_rad))

    def constants(self) -> Any:
        """Fresh `AxisConstants` for this joint where it stands; may be changed before `run`."""
        constants = axis_constants(self.config, self.table, start_position_rad=self.report.start_position_rad)
        constants[0].sequence.supervisor_max_cycles = 0  # nobody to watch: simulated time has no wall clock
        return constants

    def stepped(self, constants: np.recarray, table: np.ndarray, records: int = STEP_RECORDS) -> SteppedRun:
        """A run that goes on when it is asked to; `table` float64 (N, 5) as in `reference_at`."""
        state = new(AxisState)
        reset_axis(constants[0], state[0])
        memory = _memory(constants, state, table[np.newaxis], new(LogRecord, records))
        world = World(
            self._virtual.device.copy(), self.plant_constants, self.plant_state.copy(), self._virtual.queue.copy(),
            *fault_rows([NO_FAULTS]),
        )  # fmt: skip
        return SteppedRun(
            memory,
            codec_of(self._port.copy()),
            world,
            self.start_ns,
            thermometer=self._settings.temperature is not None,
        )

    def run(
        self,
        constants: np.recarray | None = None,
        *,
        plant_constants: np.recarray | None = None,
        plant_state: np.recarray | None = None,
        log_every: int = 1,
        stop_cycle: int = NO_STOP,
        longest_s: float | None = None,
        ideal_velocity: bool = False,
        table: np.ndarray | None = None,
    ) -> LockstepRun:
        """One run from power off to FINISHED; the given record arrays are not changed.

        Without `longest_s` a run may take ten seconds more than approach and trajectory together.
        `table` float64 (N, 5) takes the place of the configuration's, see `reference_at`.
        `ideal_velocity` gives the controller the true position and velocity, for textbook experiments.
        """
        constants = self.constants() if constants is None else constants
        axis = constants[0]
        if len(self._virtual.faults):
            raise ConfigurationError(
                "[[virtual.faults]] are carried out by run_with_faults(joint.faults), not by run()"
            )
        if ideal_velocity and axis.law.filtered_error_rate != 0:
            raise ConfigurationError("control.filtered_error_rate (=true) must be false with an ideal velocity")
        cycles = self._longest_cycles(axis, longest_s)
        records = cycles // log_every + 1 if log_every else 1
        return self._carry_out(
            constants, plant_constants, plant_state, new(LogRecord, records), np.zeros((records, TRUTHS)),
            table=table, log_every=log_every, cycles=cycles, stop_cycle=stop_cycle, ideal_velocity=ideal_velocity,
        )  # fmt: skip

    def run_as_configured(self, constants: np.recarray, table: np.ndarray, log_every: int = 1) -> LockstepRun:
        """A motion with the [[virtual.faults]] of the configuration, if any; they begin with each motion anew."""
        constants[0].sequence.supervisor_max_cycles = 0
        self.table = table
        if len(self.faults):
            return self.run_with_faults(self.faults, constants)
        return self.run(constants, log_every=log_every)

    def run_with_faults(
        self,
        faults: np.ndarray,
        constants: np.recarray | None = None,
        *,
        plant_constants: np.recarray | None = None,
        plant_state: np.recarray | None = None,
        epoch_at_start: bool = False,
        stop_cycle: int = NO_STOP,
        longest_s: float | None = None,
        tail_s: float = 0.0,
        set_points: np.ndarray = NO_POINTS,
    ) -> LockstepRun:
        """As `run`, with these `FaultConstants`; `truth` has a row each period.

        The faults' times count from the first time that the power stage is on, or from the start of the run.
        The joint is watched for `tail_s` after the controller has ended and is silent.
        `set_points`: those of a program, see `hil.lockstep.Scenario`.
        """
        constants = self.constants() if constants is None else constants
        cycles = self._longest_cycles(constants[0], longest_s)
        tail_cycles = int(tail_s / float(constants[0].law.period_s))
        return self._carry_out(
            constants, plant_constants, plant_state, new(LogRecord, cycles), np.zeros((cycles + tail_cycles, TRUTHS)),
            log_every=1, cycles=cycles, stop_cycle=stop_cycle, tail_cycles=tail_cycles,
            faults=faults, epoch_ns=-1 if epoch_at_start else 0, set_points=set_points,
        )  # fmt: skip

    @staticmethod
    def _longest_cycles(axis: AxisConstants, longest_s: float | None) -> int:
        """How many cycles a run may take; by default ten seconds more than approach and trajectory together."""
        if longest_s is None:
            longest_s = float(axis.sequence.approach_s + axis.trajectory.duration_s) + 10.0
        return int(longest_s / float(axis.law.period_s))

    def _carry_out(
        self,
        constants: np.recarray,
        plant_constants: np.recarray | None,
        plant_state: np.recarray | None,
        log: np.recarray,
        truth: np.ndarray,
        faults: np.ndarray = NO_FAULTS,
        epoch_ns: int = 0,
        table: np.ndarray | None = None,
        **how: Any,
    ) -> LockstepRun:
        """A run from copies of device and plant; `how`: fields of `Scenario`."""
        constants = constants.copy()  # temperature and set-points are written into it
        axis = constants[0]
        state = new(AxisState)
        reset_axis(axis, state[0])
        plant = (self.plant_state if plant_state is None else plant_state).copy()
        world = World(
            self._virtual.device.copy(),
            self.plant_constants if plant_constants is None else plant_constants,
            plant,
            self._virtual.queue.copy(),
            *fault_rows([faults], epoch_ns),
        )
        memory = _memory(constants, state, (self.table if table is None else table)[np.newaxis], log)
        period_ns, thermometer = round(float(axis.law.period_s) * 1e9), self._settings.temperature is not None
        scenario = Scenario(self.start_ns, period_ns, thermometer=thermometer, **how)
        written, rows = run_lockstep(memory, codec_of(self._port.copy()), world, scenario, truth)
        return LockstepRun(
            log[:written], state[0], plant[0], world.device[0], Fault(int(state[0].fault)), truth[:rows], thermometer
        )


class LockstepArm:
    """The joints of an arm, each commissioned as `LockstepJoint` is, then moved in one loop."""

    def __init__(self, arm: ArmConfig) -> None:
        self.arm = arm
        joints = [LockstepJoint(config) for config in arm.joints]
        self.start_ns = max(joint.start_ns for joint in joints)
        for joint in joints:
            joint._virtual.advance(self.start_ns - _COMMISSIONING_STEP_NS)
        self._devices = np.concatenate([joint._virtual.device for joint in joints]).view(np.recarray)
        self._devices.time_ns[:] = self._devices.time_ns[0]  # the drives share the grid of their substeps
        self._queues = np.concatenate([joint._virtual.queue for joint in joints]).view(np.recarray)
        self._ports = np.concatenate([joint._port for joint in joints]).view(np.recarray)
        self.plant_constants = np.concatenate([joint.plant_constants for joint in joints]).view(np.recarray)
        self.plant_state = np.concatenate([joint._virtual.plant_state for joint in joints]).view(np.recarray)
        counts = np.abs(self._devices.counts_per_rad)
        self.quick_stop_radps2 = self._devices.drive.quick_stop_deceleration / counts  # of each drive, float64 (N,)
        self.tables = stacked_tables([trajectory_table(config) for config in arm.joints])
        self.reports = [joint.report for joint in joints]
        self._thermometer = all(joint._settings.temperature is not None for joint in joints)

    def stepped(self, constants: np.recarray, tables: np.ndarray) -> SteppedRun:
        """A run that goes on when it is asked to; `tables` float64 (axes, rows, 5)."""
        memory = self._memory(constants, tables, STEP_RECORDS, self.arm.model.memory())
        world = self._world((self.plant_constants, self.plant_state), arm_plant_of(self.arm))
        return SteppedRun(memory, codec_of(self._ports.copy()), world, self.start_ns, thermometer=self._thermometer)

    @staticmethod
    def _memory(constants: np.recarray, tables: np.ndarray, records: int, model: Arm) -> CycleMemory:
        """The loop's, as a run begins; `records`: for each axis."""
        state = new(AxisState, len(constants))
        for axis, its_constants in zip(state, constants, strict=True):
            reset_axis(its_constants, axis)
        return _memory(constants, state, tables, new(LogRecord, records * len(constants)), model)

    def constants(self) -> Any:
        """Fresh `AxisConstants`, one a joint; may be changed before `run`."""
        constants = self.arm.axis_constants(list(self.tables), [report.start_position_rad for report in self.reports])
        constants.sequence.supervisor_max_cycles[:] = 0
        return constants

    def run(
        self,
        constants: np.recarray | None = None,
        *,
        model: Arm | None = None,
        plant: ArmPlant | None = None,
        plant_constants: np.recarray | None = None,
        longest_s: float | None = None,
        log_every: int = 1,
        stop_cycle: int = NO_STOP,
    ) -> list[LockstepRun]:
        """One run of all joints from power off to FINISHED, a result each; what is given is not changed.

        `model` is what the controller believes of the arm, `plant` what the arm is.
        """
        constants = self.constants() if constants is None else constants
        plants = self.plant_constants if plant_constants is None else plant_constants, self.plant_state
        world = self._world(plants, arm_plant_of(self.arm) if plant is None else plant)
        cycles = LockstepJoint._longest_cycles(constants[0], longest_s)
        return self._carry_out(
            constants, self.arm.model.memory() if model is None else model, world,
            cycles=cycles, stop_cycle=stop_cycle, log_every=log_every,
        )  # fmt: skip

    def run_with_faults(
        self,
        faults: Sequence[np.ndarray],
        constants: np.recarray,
        plants: tuple[Any, Any],
        plant: ArmPlant,
        *,
        longest_s: float,
        tail_s: float,
    ) -> list[LockstepRun]:
        """As `run`, with these `FaultConstants` of each joint; times count from the start of the run.

        `plants`: constants and states, one a joint.  The joints are watched for `tail_s` after the controller has
        ended.
        """
        rows, memories = fault_rows(faults, -1)
        world = self._world(plants, plant)._replace(faults=rows, fault_memory=memories)
        tail_cycles = int(tail_s / float(constants[0].law.period_s))
        cycles = LockstepJoint._longest_cycles(constants[0], longest_s)
        return self._carry_out(constants, self.arm.model.memory(), world, cycles=cycles, tail_cycles=tail_cycles)

    def _world(self, plants: tuple[Any, Any], plant: ArmPlant) -> World:
        """The drives, and what they move, as they are when a run begins; constants and states of the joints."""
        return World(
            self._devices.copy(), plants[0], plants[1].copy(), self._queues.copy(),
            *fault_rows([NO_FAULTS] * len(self._devices)), ArmPlant(*(part.copy() for part in plant)),
            bus=np.array(first_on_bus(self.arm.joints)),
        )  # fmt: skip

    def _carry_out(self, constants: np.recarray, model: Arm, world: World, **how: Any) -> list[LockstepRun]:
        """`how`: fields of `Scenario`."""
        constants = constants.copy()
        axes = len(constants)
        scenario = Scenario(self.start_ns, round(float(constants[0].law.period_s) * 1e9), **how)
        rows = scenario.cycles // scenario.log_every + 1
        memory = self._memory(constants, self.tables, rows, model)
        state = memory.state
        truth = np.zeros((rows + scenario.tail_cycles, TRUTHS * axes))
        written, kept = run_lockstep(memory, codec_of(self._ports.copy()), world, scenario, truth)
        return [
            LockstepRun(
                memory.ring[axis:written:axes], state[axis], world.plant[axis], world.device[axis],
                Fault(int(state[axis].fault)), truth[:kept, TRUTHS * axis : TRUTHS * (axis + 1)],
            )
            for axis in range(axes)
        ]  # fmt: skip
