"""Controller, codec, drive and joint in lockstep: commissioned by the real driver, then 1 ms at a time."""

from __future__ import annotations

import time
from typing import Any

import can
import numpy as np
import pytest

from jointctl.drivers.canopen.settings import CanopenSettings
from jointctl.firmware_py.cycle import HISTOGRAM_BINS, WORDS, CycleMemory, Histogram, Word
from jointctl.firmware_py.records import AxisState, Command, LogRecord, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import AxisPhase, DriveRequest, DriveState, Fault
from jointctl.hil.faults import fault_rows, no_faults
from jointctl.hil.lockstep import RECEIVED_SLOT, RPDO_SLOT, Scenario, World, run_lockstep
from jointctl.hil.virtual_bus import FrameQueue
from jointctl.tools.lockstep import DirectBus, LockstepJoint, codec_of
from jointctl.tools.virtual_joint import new_device
from tests.configurations import shipped
from tests.sessions import constants_of

PERIOD_ns = 1_000_000


class Lockstep:
    """The virtual joint after commissioning, and everything that `run_lockstep` works on."""

    def __init__(self, bus: Any, config: Any, **changes: Any) -> None:
        with bus.opened(**changes) as drive:
            report = drive.commission()
            drive.start_cyclic()
            drive._objects.read(0x1000, what="device type")  # answered after the NMT command was taken
            self.port = drive.port()
        bus.stop()
        self.device = bus.device
        self.start_ns = (bus.now_ns // PERIOD_ns + 1) * PERIOD_ns
        self.constants = constants_of(config, start_position_rad=report.start_position_rad)
        self.state, self.sample, self.command = new(AxisState), new(Sample), new(Command)
        reset_axis(self.constants[0], self.state[0])
        self.codec = codec_of(self.port)
        self.log = new(LogRecord, 20_000)

    def run(self, cycles: int, stop_cycle: int = -1, log_every: int = 1) -> Any:
        """The log records of up to `cycles` cycles; `self.words` as they are at the end."""
        device, self.words = self.device, np.zeros(WORDS, np.int64)
        memory = CycleMemory(
            self.constants, self.state, np.zeros((1, 1, 5)), self.sample, self.command, self.words, self.log,
            np.zeros((len(Histogram), HISTOGRAM_BINS), np.int64), np.zeros(2, np.int64),
        )  # fmt: skip
        world = World(
            device.device, device.plant_constants, device.plant_state, new(FrameQueue),
            *fault_rows([no_faults()]),
        )  # fmt: skip
        scenario = Scenario(self.start_ns, PERIOD_ns, cycles, stop_cycle, log_every=log_every)
        written, _ = run_lockstep(memory, self.codec, world, scenario)
        assert written == self.words[Word.HEAD]
        return self.log[:written]


@pytest.fixture
def lockstep(joint: Any, virtual_config: Any) -> Lockstep:
    return Lockstep(joint, virtual_config)


def test_slots_agree_with_the_driver() -> None:
    from jointctl.drivers.canopen import cyclic

    assert (RPDO_SLOT, RECEIVED_SLOT) == (cyclic.SLOT_RPDO, cyclic.SLOT_RECEIVED)


def test_a_whole_run_through_the_real_codec(lockstep: Lockstep) -> None:
    log = lockstep.run(20_000)
    assert Fault(int(lockstep.state[0].fault)) is Fault.NONE
    assert lockstep.state[0].phase == AxisPhase.FINISHED
    assert lockstep.sample[0].drive_state == DriveState.OFF
    phases = [AxisPhase(int(p)) for p in log.phase]
    assert phases == sorted(phases)
    assert set(phases) == set(AxisPhase) - {AxisPhase.QUICK_STOPPING}
    tracking = log[log.phase == AxisPhase.TRACKING]
    assert len(tracking) == pytest.approx(10_000, abs=2)
    assert np.max(np.abs(tracking.error_rad)) < 0.02
    assert np.sqrt(np.mean(tracking.error_rad[-2000:] ** 2)) < 0.003
    assert np.max(np.abs(np.diff(log.command_torque_Nm))) <= 20.0 + 1e-9
    assert log.sample_age_cycles[1:].max() == 0
    assert np.all(log.command_torque_Nm[log.request != DriveRequest.ENABLE] == 0.0)
    # the joint starts from where it stands: 0.1 rad, and no jump when it is enabled
    first = int(np.argmax(log.phase == AxisPhase.APPROACH))
    assert log.position_rad[first] == pytest.approx(0.1, abs=1e-4)
    assert abs(log.command_torque_Nm[first]) < 1.0


def test_the_logged_time_is_that_of_the_logged_reference(lockstep: Lockstep) -> None:
    log = lockstep.run(6000)
    tracking = log[log.phase == AxisPhase.TRACKING]
    expected = 0.35 * np.sin(0.2 * np.pi * tracking.trajectory_s)
    np.testing.assert_allclose(tracking.desired_position_rad, expected, atol=1e-12)


def test_a_controlled_stop(lockstep: Lockstep) -> None:
    log = lockstep.run(20_000, stop_cycle=3000)
    assert (log.phase[2999], log.phase[3000]) == (AxisPhase.APPROACH, AxisPhase.RAMPING) or (
        log.phase[2999],
        log.phase[3000],
    ) == (AxisPhase.TRACKING, AxisPhase.RAMPING)
    assert lockstep.state[0].phase == AxisPhase.FINISHED
    assert lockstep.state[0].fault == Fault.NONE
    assert len(log) < 6000


def test_log_every_and_room(lockstep: Lockstep) -> None:
    log = lockstep.run(1000, log_every=10)
    assert len(log) == 100
    assert np.all(np.diff(log.time_ns) == 10 * PERIOD_ns)
    lockstep.log = new(LogRecord, 3)
    lockstep.start_ns += 1000 * PERIOD_ns
    lockstep.run(100)  # record k is at k % 3, as in the loop's ring
    assert list((lockstep.log.time_ns - lockstep.start_ns) // PERIOD_ns) == [99, 97, 98]
    lockstep.start_ns += 100 * PERIOD_ns
    assert len(lockstep.run(100, log_every=0)) == 0


def test_bit_identical_on_repeat(
    lockstep: Lockstep, device_on_bus: Any, settings_of_virtual_joint: CanopenSettings, virtual_config: Any
) -> None:
    """The same state of everything, run twice."""
    device = lockstep.device
    memory = (
        device.device, device.plant_constants, device.plant_state, lockstep.port, lockstep.codec.link.frames,
        lockstep.state, lockstep.sample, lockstep.command,
    )  # fmt: skip
    saved = [array.copy() for array in memory]
    first = lockstep.run(4000).tobytes()
    for array, old in zip(memory, saved, strict=True):
        array[:] = old
    lockstep.log[:] = np.zeros(1, lockstep.log.dtype)
    assert lockstep.run(4000).tobytes() == first


def test_a_drive_that_is_not_operational_ends_the_run_without_power(lockstep: Lockstep) -> None:
    lockstep.device.device[0].nmt = 127
    lockstep.run(20_000)
    assert lockstep.state[0].phase == AxisPhase.FINISHED
    assert lockstep.state[0].fault == Fault.NO_SAMPLES
    assert np.all(lockstep.log.request == DriveRequest.OFF)


def test_a_wrong_direction_of_the_torque_is_caught(joint: Any, virtual_config: Any) -> None:
    run = Lockstep(joint, virtual_config, torque_direction=-1)
    log = run.run(20_000)
    assert run.state[0].phase == AxisPhase.FINISHED
    assert run.state[0].fault in (Fault.FOLLOWING_ERROR, Fault.VELOCITY_LIMIT, Fault.TORQUE_SATURATED)
    assert np.max(np.abs(log.position_rad - 0.1)) < 0.5


def test_a_motor_that_turns_the_other_way_can_be_tried() -> None:
    """The virtual drive is mounted as the configuration says: every figure of the joint is the same, to the bit."""
    logs = {}
    for torque, encoder in ((1, 1), (-1, 1), (1, -1), (-1, -1)):
        turned = {"drive__torque_direction": torque, "encoder__direction": encoder}
        run = LockstepJoint(shipped(trajectory__duration_s=2.0, **turned)).run()
        assert run.fault is Fault.NONE
        logs[torque, encoder] = run.log
    for key, log in logs.items():
        same = logs[1, key[1]]  # counts of an encoder are rounded down, which is another way round
        assert np.array_equal(log.position_rad, same.position_rad)
        assert np.array_equal(log.measured_torque_Nm, same.measured_torque_Nm)
        assert np.max(np.abs(log.measured_torque_Nm)) > 10.0


def test_what_the_drive_says_when_an_rpdo_comes_is_heard(lockstep: Lockstep) -> None:
    """A target torque that does not fit the RPDO: EMCY 8210.  It was dropped, as SYNC alone was listened to."""
    lockstep.port[0].rpdo_length = 3
    lockstep.run(50)
    assert lockstep.sample[0].drive_error == 0x8210
    lockstep.sample[0].drive_error = 0
    lockstep.port[0].rpdo_length = 4  # the twin
    lockstep.start_ns += 50 * PERIOD_ns
    lockstep.run(2)
    lockstep.sample[0].drive_error = 0
    lockstep.start_ns += 2 * PERIOD_ns
    lockstep.run(50)
    assert lockstep.sample[0].drive_error == 0


def test_the_direct_bus_waits_for_a_listener_that_is_slow(virtual_config: Any) -> None:
    """On a busy computer the proof of the watchdog was over before its answer was heard."""
    bus = DirectBus(new_device(virtual_config))
    heard: list[int] = []

    def listen(message: can.Message) -> None:
        time.sleep(0.05)
        heard.append(message.arbitration_id)

    notifier = can.Notifier(bus, [listen], timeout=0.1)
    try:
        bus.sleep(1.0)
        assert heard[0] == 0x701  # boot-up
        before = len(heard)
        bus.send(can.Message(arbitration_id=0x601, data=b"\x40\x41\x60\0\0\0\0\0", is_extended_id=False))
        bus.sleep(0.0)
        assert heard[before:] == [0x581]
    finally:
        notifier.stop()
        bus.shutdown()
