"""The faults of the campaign in real time: a loop process of its own, the virtual bus, the drive in this process.

Faults count from the moment in which the power stage is on; the joint tracks by then.  Processes that die or hang are
in tests/hil/test_processes.py.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.canopen import watchdog
from jointctl.drivers.canopen.cia import Mode
from jointctl.drivers.errors import DeviceError, MotionFault
from jointctl.firmware_py.states import AxisPhase, DriveRequest, Fault
from jointctl.hil.faults import LOCKSTEP_ONLY, FaultKind
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config
from jointctl.tools.configuration.sections import FAULT_KINDS
from jointctl.tools.session import control as session_control
from jointctl.tools.session import session as session_module
from jointctl.tools.session.control import STOOD_S, Control, StopSignals
from jointctl.tools.session.display import Display, Snapshot
from jointctl.tools.session.loop_handle import LoopHandle
from jointctl.tools.session.plan import TerminalConsent
from jointctl.tools.session.result import RunResult
from jointctl.tools.virtual_joint import fault_constants
from tests.configurations import written
from tests.places import CONFIGS
from tests.real_time_joint import real_time_joint
from tests.sessions import session_of

SHIPPED = (CONFIGS / "virtual.toml").read_text()
AT_s = 0.7
OFF = ("switch on disabled", "fault")
MOTION = (Fault.VELOCITY_LIMIT, Fault.FOLLOWING_ERROR, Fault.POSITION_JUMP, Fault.POSITION_FROZEN)
GONE = (Fault.STALE_SAMPLE, Fault.BUS_ERROR)

RunWith = Callable[..., RunResult]


@pytest.fixture
def run_with(tmp_path: Path) -> RunWith:
    """`run_with(kind, duration_s, magnitude)`: one whole run with this fault in [[virtual.faults]]."""

    def run(
        kind: FaultKind, duration_s: float, magnitude: float, tracking_s: float = 1.2, heartbeat_s: float = 0.4
    ) -> RunResult:
        path = written(
            tmp_path / "joint.toml", bus__channel=f"fault-{os.getpid()}-{uuid.uuid4().hex[:8]}",
            sequence__approach_s=0.3, virtual__initial_position_rad=0.0, trajectory__duration_s=tracking_s,
            # a busy computer must not be the fault that is seen
            limits__sample_age_max_s=0.25, limits__skipped_max_s=0.25, drive__heartbeat_s=heartbeat_s,
            sequence__stop_timeout_s=1.0, sequence__off_timeout_s=0.7,
        )  # fmt: skip
        with path.open("a") as file:
            file.write(
                f'\n[[virtual.faults]]\nkind = "{kind.name.lower()}"\nat_s = {AT_s}\n'
                f"duration_s = {duration_s}\nmagnitude = {magnitude}\n"
            )
        config = load_config(path)
        with real_time_joint(config):
            result = session_of(config, tmp_path / "run.mcap", allow_low_margin=True).run()
        assert result is not None
        return result

    return run


LONG = 60.0
HARMFUL: list[tuple[FaultKind, float, float, tuple[Fault, ...]]] = [
    (FaultKind.FRAMES_LOST, 1.5, 1.0, GONE),
    (FaultKind.SYNC_LOST, LONG, 1.0, GONE),
    (FaultKind.TPDO_LOST, LONG, 1.0, GONE),
    (FaultKind.CONTROLLER_HEARTBEAT_LOST, LONG, 1.0, (*GONE, Fault.DRIVE_NOT_ENABLED)),
    (FaultKind.RPDO_LENGTH, LONG, 2.0, (*MOTION, *GONE, Fault.DRIVE_NOT_ENABLED)),  # the last: by 1400:5
    (FaultKind.DRIVE_HEARTBEAT_LOST, LONG, 1.0, (Fault.DRIVE_SILENT,)),
    (FaultKind.TPDO_LENGTH, LONG, 7.0, GONE),
    (FaultKind.TPDO_CORRUPTED, 0.05, 1.0, (*MOTION, Fault.DRIVE_FAULT, Fault.DRIVE_NOT_ENABLED)),
    (FaultKind.DRIVE_REBOOT, 1.0, 1.0, (Fault.DRIVE_RESTARTED,)),
    (FaultKind.DRIVE_FAULT, 0.1, 0x7121, (Fault.DRIVE_FAULT,)),
    (FaultKind.ENCODER_STUCK, LONG, 1.0, MOTION),
    (FaultKind.ENCODER_JUMP, LONG, 0.1, MOTION),
    (FaultKind.ENCODER_REVERSED, LONG, 1.0, MOTION),
    (FaultKind.TORQUE_REVERSED, LONG, 1.0, MOTION),
    (FaultKind.CURRENT_LOOP_DEAD, LONG, 1.0, MOTION),
    (FaultKind.LOAD_JUMP, LONG, -50.0, MOTION),
]
HARMLESS: list[tuple[FaultKind, float, float]] = [
    (FaultKind.FRAMES_LOST, 0.01, 1.0),
    (FaultKind.SYNC_LOST, 0.02, 1.0),
    (FaultKind.TPDO_LOST, 0.02, 1.0),
    (FaultKind.TPDO_LENGTH, 0.02, 7.0),
    (FaultKind.RPDO_LENGTH, 0.005, 2.0),
    (FaultKind.CONTROLLER_HEARTBEAT_LOST, 0.3, 1.0),  # with its period, a third of drive.heartbeat_s, 0.63 of 1 s
    (FaultKind.ENCODER_STUCK, 0.002, 1.0),
    (FaultKind.CURRENT_LOOP_DEAD, 0.002, 1.0),
    (FaultKind.TORQUE_REVERSED, 0.002, 1.0),
    (FaultKind.RPDO_LOST, 0.005, 1.0),
    (FaultKind.RPDO_DUPLICATED, LONG, 1.0),
    (FaultKind.TPDO_DUPLICATED, LONG, 0.5),
    (FaultKind.FOREIGN_FRAMES, LONG, 3.0),
    (FaultKind.DRIVE_HEARTBEAT_LOST, 0.5, 1.0),
    (FaultKind.ENCODER_JUMP, LONG, 0.0003),
    (FaultKind.LOAD_JUMP, LONG, 3.0),
]


def once_enabled(records: Any) -> bool:
    """The loop asked to enable in one stretch of cycles only."""
    asked = np.flatnonzero(np.asarray(records.request) == DriveRequest.ENABLE)
    return len(asked) > 0 and bool((np.diff(asked) == 1).all())


@pytest.mark.parametrize(("kind", "duration_s", "magnitude", "causes"), HARMFUL, ids=lambda v: getattr(v, "name", None))
def test_the_joint_is_stopped_and_disabled_and_the_user_is_told(
    run_with: RunWith, kind: FaultKind, duration_s: float, magnitude: float, causes: tuple[Fault, ...]
) -> None:
    result = run_with(kind, duration_s, magnitude, 4.0)  # longer than the slowest watcher takes
    assert result.fault in causes
    text = result.fault_text
    assert text is not None
    assert text.happened
    assert text.cause
    assert text.next_step
    assert "6061" not in text.happened
    assert once_enabled(result.records)
    assert np.abs(result.records.command_torque_Nm).max() <= 60.0
    assert (np.asarray(result.records.command_torque_Nm)[result.records.request != DriveRequest.ENABLE] == 0.0).all()
    assert result.drive_state in OFF
    if kind is FaultKind.DRIVE_FAULT:
        assert "7121h" in text.happened
    assert result.records.fault[-1] == result.fault  # and it is in the log
    assert (result.records.phase == AxisPhase.TRACKING).any()


@pytest.mark.parametrize(("kind", "duration_s", "magnitude"), HARMLESS, ids=lambda v: getattr(v, "name", None))
def test_its_twin_goes_on_to_the_end(run_with: RunWith, kind: FaultKind, duration_s: float, magnitude: float) -> None:
    result = run_with(
        kind, duration_s, magnitude, heartbeat_s=1.0 if kind is FaultKind.CONTROLLER_HEARTBEAT_LOST else 0.4
    )
    assert result.fault is Fault.NONE, result.fault_text
    assert result.drive_state == "switch on disabled"
    tracked = result.records[result.records.phase == AxisPhase.TRACKING]
    assert tracked.trajectory_s[-1] == pytest.approx(1.2, abs=0.06)
    assert result.records.phase[-1] == AxisPhase.FINISHED


# --- what is asked of the drive after the fault, and between two motions ---
class AtTracking(Display):
    """Does something to the drive once the joint tracks."""

    def __init__(self, do: Callable[[], None]) -> None:
        self._do: Callable[[], None] | None = do

    def show(self, snapshot: Snapshot) -> None:
        if self._do is not None and snapshot.record.trajectory_s > AT_s:
            self._do()
            self._do = None


def short(tmp_path: Path, base: str) -> Config:
    return load_config(written(
        tmp_path / "joint.toml", base, bus__channel=f"fault-{os.getpid()}-{uuid.uuid4().hex[:8]}",
        virtual__initial_position_rad=0.0, trajectory__duration_s=4.0, limits__sample_age_max_s=0.25,
        limits__skipped_max_s=0.25,
    ))  # fmt: skip


@pytest.mark.parametrize("left", [True, False])
def test_a_drive_that_leaves_its_mode_by_itself_is_reported_as_that(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left: bool
) -> None:
    """Its twin stands still in its mode.  6061 is read once a second: here once, before the joint is enabled."""
    monkeypatch.setattr(watchdog, "PERIOD_S", 1000.0)
    config = short(tmp_path, "csp")
    with real_time_joint(config) as joint:
        (device,) = joint._devices

        def do() -> None:
            if left:
                device.device[0].drive.mode = Mode.PROFILE_VELOCITY
            else:
                joint.plant_states[0].added_load_torque_Nm = -500.0  # it is pushed out of its way

        result = session_of(config, tmp_path / "run.mcap", lambda _: AtTracking(do), allow_low_margin=True).run()
    assert result is not None
    assert ("6061 (modes of operation display) is 3 after the run, 8 was set" in result.fault_text.happened) is left
    assert ("changed its mode" in result.fault_text.cause) is left
    assert result.drive_state in OFF


@pytest.mark.parametrize("swapped", [True, False])
def test_one_yes_is_not_for_a_drive_that_takes_the_place_of_the_first(tmp_path: Path, swapped: bool) -> None:
    config, control = short(tmp_path, "virtual"), Control(StopSignals())
    with real_time_joint(config) as joint:
        for motion in range(2):
            if swapped and motion:
                joint._devices[0].device[0].communication.identity[3] = 2
            session = session_of(config, tmp_path / f"{motion}.mcap", control=control, allow_low_margin=True)
            another = swapped and motion == 1
            with pytest.raises(DeviceError, match=r"serial 2; it was .* serial 1") if another else nullcontext():
                assert session.run() is not None
            assert session.drive_state in OFF
    assert (tmp_path / "1.mcap").exists() is not swapped  # nothing has moved


def test_the_question_comes_when_the_loop_is_ready_to_move(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A loop that compiled for minutes moved the joint so long after the yes."""
    config, said = short(tmp_path, "virtual"), list[str]()
    wait_ready = LoopHandle.wait_ready

    def waited(loop: LoopHandle, *how: Any) -> None:
        wait_ready(loop, *how)
        said.append("ready")

    monkeypatch.setattr(LoopHandle, "wait_ready", waited)
    monkeypatch.setattr(TerminalConsent, "agreed", lambda *_: bool(said.append("asked")))
    with real_time_joint(config):
        assert session_of(config, tmp_path / "run.mcap", allow_low_margin=True).run() is None
    assert said == ["ready", "asked"]


@pytest.mark.parametrize("hung_s", [31, 29])
def test_a_yes_does_not_outlast_a_log_folder_that_hangs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hung_s: int
) -> None:
    now_ns, late, control = session_control.now_ns, [0], Control(StopSignals())
    monkeypatch.setattr(session_control, "now_ns", lambda: now_ns() + late[0])

    def hang(*_: object) -> None:
        for _s in range(hung_s):
            late[0] += 10**9
            control.signals.note_standstill()  # as its thread does once a second

    monkeypatch.setattr(session_module, "prepare_log", hang)
    config = short(tmp_path, "virtual")
    session = session_of(config, tmp_path / "run.mcap", control=control, allow_low_margin=True)
    refused = pytest.raises(MotionFault, match="after the motion was agreed to")
    with real_time_joint(config), refused if hung_s > STOOD_S else nullcontext():
        assert session.run() is not None
    assert session.drive_state in OFF


# --- the configuration ---
def configured(tmp_path: Path, table: str) -> Config:
    path = tmp_path / "joint.toml"
    path.write_text(SHIPPED + table)
    return load_config(path)


def test_faults_come_from_the_configuration(tmp_path: Path) -> None:
    table = '\n[[virtual.faults]]\nkind = "encoder_jump"\nat_s = 2.0\nmagnitude = -0.1\n'
    table += '\n[[virtual.faults]]\nkind = "tpdo_lost"\nat_s = 1.0\nduration_s = 0.5\nmagnitude = 0.25\nseed = 7\n'
    first, second = fault_constants(configured(tmp_path, table))
    assert (first.kind, first.start_s, first.magnitude) == (FaultKind.ENCODER_JUMP, 2.0, -0.1)
    assert (second.kind, second.start_s, second.duration_s) == (FaultKind.TPDO_LOST, 1.0, 0.5)
    assert (second.magnitude, second.seed) == (0.25, 7)
    assert len(fault_constants(load_config(CONFIGS / "virtual.toml"))) == 0


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ('kind = "encoder_jmp"\nat_s = 1.0', "(=encoder_jmp) must be one of"),
        ('kind = "encoder_jump"', "at_s is missing"),
        ('kind = "encoder_jump"\nat_s = -1.0', "at_s (=-1) must be in [0..1e+06]"),
        ('kind = "encoder_jump"\nat_s = 1.0\nduration_s = 0.0', "duration_s (=0) must be in (0..1e+06]"),
        ('kind = "encoder_jump"\nat = 1.0', "is not a known key"),
        ('kind = "clock_step"\nat_s = 1.0', "(=clock_step) must be one of"),
    ],
)
def test_a_bad_fault_is_refused_by_one_line(tmp_path: Path, table: str, words: str) -> None:
    from jointctl.drivers.errors import ConfigurationError

    with pytest.raises(ConfigurationError) as caught:
        configured(tmp_path, f"\n[[virtual.faults]]\n{table}\n")
    assert words in caught.value.message
    assert "virtual.faults" in caught.value.message


def test_all_kinds_but_those_of_the_controllers_own_computer_can_be_configured() -> None:
    named = {FaultKind[name.upper()] for name in FAULT_KINDS}
    assert named == set(FaultKind) - {FaultKind.NONE, *LOCKSTEP_ONLY}
