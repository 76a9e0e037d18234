"""Between what the user was shown and what the joint does nothing may change, and nothing may jump."""

from __future__ import annotations

import contextlib
import io
import math
import os
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.canopen.commissioning import disable
from jointctl.drivers.drive import UNTOUCHED, CommissioningReport, DriveIdentity
from jointctl.drivers.errors import ConfigurationError, DeviceError, MotionFault
from jointctl.firmware_py.cycle import HISTOGRAM_BINS, Histogram
from jointctl.firmware_py.friction import branch_torque_Nm
from jointctl.firmware_py.motion_records import TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, CommandKind, DriveState, Fault
from jointctl.tools.configuration import checks
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import RADPS_PER_UNIT, friction_constants
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.configuration.records import MOVED_COUNTS, fill_trajectory
from jointctl.tools.inspection.motion_check import CheckMotion, config_of_check, motion_table
from jointctl.tools.inspection.motion_check import make_plan as check_plan
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.output import Output
from jointctl.tools.session import run_watch as run_watch_module
from jointctl.tools.session.control import StopSignals
from jointctl.tools.session.display import PhaseLines
from jointctl.tools.session.plan import agreed, require_braking, resolve
from jointctl.tools.session.run_watch import Around, BusWatch, RunParts, RunWatch
from jointctl.tools.sweeping.carry_out import POSITION_GAIN_ps, middle_rad, sweep_constants
from jointctl.tools.sweeping.options import SweepOptions, both_directions, ordered_points
from jointctl.tools.sweeping.plan import PlanSettings, make_plan, plan_motion, require_torque, shifted
from jointctl.tools.verbs import scope as scope_module
from tests.configurations import VIRTUAL, edited, written
from tests.places import CONFIGS
from tests.sessions import constants_of
from tests.simulated_programs import at_once

# --- Between what the user was shown and what the joint does nothing may change, and nothing may jump ---
SHORT = ("duration_s = 10.0", "duration_s = 1.0")
COARSE = {"encoder__counts_per_turn": 256, "limits__following_error_max_rad": 0.05, "control__velocity_cutoff_Hz": 5.0}
AT_ONCE = ('approach_s = "auto"', "approach_s = 0")


def report(start_rad: float = 0.1, **more: Any) -> CommissioningReport:
    return CommissioningReport(DriveIdentity("", "", "", ""), "cyclic_sync_torque", start_rad, 0.06, 1e-5, **more)


BACK_AND_FORTH = {"duration_s": 6.0, "start_rad": -0.5, "target_rad": 0.55, "dwell_s": 0.1, "repeat": True}
SINES = {"kind": "sine", "duration_s": 6.0, "amplitude_rad": 0.2, "frequency_Hz": 0.2}


@pytest.mark.parametrize("name", ["virtual", "realistic"])
@pytest.mark.parametrize(
    "motion",
    [
        {"kind": "min_jerk", "move_s": 1.0, **BACK_AND_FORTH},
        {"kind": "trapezoid", "speed_radps": 1.5, "acceleration_radps2": 5.0, "jerk_radps3": 50.0, **BACK_AND_FORTH},
        {**SINES, "amplitude_rad": 0.5, "frequency_Hz": 0.5, "shift_s": 0.5},
        {"kind": "table", "file": "way.csv", "duration_s": 2.0},
    ],
)
def test_a_motion_that_could_not_be_braked_is_refused_before_it_begins(
    tmp_path: Path, motion: dict[str, Any], name: str
) -> None:
    """It was shown and followed, up to where the loop saw that: REFERENCE_LIMIT in the middle of the range."""
    times = np.linspace(0.0, 1.0, 101)
    way = -0.5 + 1.05 * times**3 * (10.0 - 15.0 * times + 6.0 * times**2)
    rows = [f"{t:.4f},{x:.9f}" for t, x in zip(times, way, strict=True)]
    (tmp_path / "way.csv").write_text("\n".join(["time_s,position_rad", *rows]) + "\n")

    def braked(brake_radps2: float) -> Config:
        changes = {"sequence__brake_radps2": brake_radps2, "sequence__stop_timeout_s": 60.0}
        path = written(tmp_path / "j.toml", name, trajectory=motion, limits__velocity_max_radps=3.0, **changes)
        return load_config(path)

    log = LockstepJoint(braked(1e3)).run().log
    log = log[log.phase == AxisPhase.TRACKING]
    room_rad = 0.7 - np.sign(log.desired_velocity_radps) * log.desired_position_rad
    least = float(np.max(0.5 * log.desired_velocity_radps**2 / room_rad))
    for brake in (0.97 * least, 1.03 * least):
        config, refused = braked(brake), brake < least
        with pytest.raises(MotionFault, match=r"brake_radps2 \(=.*\), must be in") if refused else nullcontext():
            resolve(config).motion.placed(report(0.0))
        assert (LockstepJoint(config).run().fault is Fault.REFERENCE_LIMIT) is refused


@pytest.mark.parametrize(("duration_s", "refused"), [(2.2, False), (6.0, True), (0.0, True)])
def test_the_second_sine_must_be_braked_too(tmp_path: Path, duration_s: float, refused: bool) -> None:
    second = {"at_s": 2.4, "amplitude_rad": 0.5, "frequency_Hz": 0.5, "shift_s": 1.6, "offset_rad": 0.0}
    motion = {**SINES, "duration_s": duration_s, "frequency_Hz": 1.25, "shift_s": 0.0, "switch": second}
    changes = {"trajectory": motion, "limits__velocity_max_radps": 3.0}
    config = load_config(written(tmp_path / "j.toml", **changes))
    constants = new(TrajectoryConstants)
    fill_trajectory(constants[0], config, np.zeros((1, 5)))
    with pytest.raises(MotionFault, match="would come to rest at") if refused else nullcontext():
        require_braking(config, constants[0], np.zeros((1, 5)))


def test_the_jerk_of_a_rounded_trapezoid_is_shown(tmp_path: Path) -> None:
    motion = {"kind": "trapezoid", "duration_s": 6.0, "start_rad": 0.0, "target_rad": 0.1, "speed_radps": 0.5}

    def line(**more: float) -> str:
        chosen: dict[str, Any] = {"trajectory": motion | {"acceleration_radps2": 2.0, **more}}
        config = load_config(written(tmp_path / "joint.toml", "virtual", **chosen))
        return next(
            one for one in resolve(config).motion.envelope(constants_of(config)[0], report()) if "trapezoid" in one
        )

    assert " rad/s3" not in line()
    assert "rad/s and 2.000 rad/s2, 40 rad/s3, " in line(jerk_radps3=40.0)


# --- no approach ---
@pytest.mark.parametrize(("start_rad", "refused"), [(0.0, False), (0.005, False), (0.0051, True), (-0.04, True)])
def test_without_an_approach_the_joint_must_stand_where_the_trajectory_begins(
    tmp_path: Path, start_rad: float, refused: bool
) -> None:
    config = edited(tmp_path, AT_ONCE)
    with pytest.raises(MotionFault, match="approach_s") if refused else contextlib.nullcontext():
        resolve(config).motion.require_start(start_rad)
    resolve(edited(tmp_path)).motion.require_start(start_rad)  # with one it may stand elsewhere
    lines = resolve(config).motion.placed(report(start_rad)).lines
    assert "approach   none: at once to +0.0000 rad" in lines


def test_that_is_why_it_would_be_pulled_there_with_all_its_torque(tmp_path: Path) -> None:
    config = edited(tmp_path, AT_ONCE, ("frequency_Hz = 0.1", "frequency_Hz = 0.1\noffset_rad = 0.14"))
    joint = LockstepJoint(config)
    run = joint.run()
    assert run.fault is Fault.NONE  # 0.04 rad are less than the following error that is allowed
    assert np.max(np.abs(run.log.command_torque_Nm)) == config.limits.torque_max_Nm
    with pytest.raises(MotionFault, match="approach_s"):
        resolve(config).motion.require_start(joint.report.start_position_rad)


# --- the second sine ---
CREST_s = 2.5


@pytest.mark.parametrize(
    ("switch", "told"),
    [
        (f"at_s = {CREST_s}\namplitude_rad = 0.35\nfrequency_Hz = 0.05\nshift_s = 2.5\noffset_rad = 0.0", ""),
        (f"at_s = {CREST_s}\namplitude_rad = 0.35\nfrequency_Hz = 0.1\nshift_s = 0.0\noffset_rad = 0.0009", ""),
        (f"at_s = {CREST_s}\namplitude_rad = 0.35\nfrequency_Hz = 0.1\nshift_s = 0.0\noffset_rad = 0.0011", "position"),
        ("at_s = 3.0\namplitude_rad = 0.35\nfrequency_Hz = 0.1\nshift_s = 0.2\noffset_rad = 0.0", "position"),
        ("at_s = 5.0\namplitude_rad = -0.35\nfrequency_Hz = 0.1\nshift_s = 0.0\noffset_rad = 0.0", "speed"),
        ("at_s = 10.0\namplitude_rad = 0.3\nfrequency_Hz = 0.2\nshift_s = 0.0\noffset_rad = 0.0", ""),  # never reached
    ],
)
def test_the_reference_does_not_jump_at_a_switch(tmp_path: Path, switch: str, told: str) -> None:
    change = ("frequency_Hz = 0.1", f"frequency_Hz = 0.1\n[trajectory.switch]\n{switch}")
    if not told:
        edited(tmp_path, change)
        return
    with pytest.raises(ConfigurationError, match=rf"trajectory.switch.at_s .* the {told} would jump"):
        edited(tmp_path, change)


# --- a table that is edited while the question is open ---
def with_table(tmp_path: Path) -> tuple[Config, Path]:
    way = tmp_path / "way.csv"
    way.write_text("time_s,position_rad\n0,0\n1,0.1\n2,0.2\n3,0.2\n")
    start, end = VIRTUAL.index("[trajectory]"), VIRTUAL.index("[virtual]")
    path = tmp_path / "joint.toml"
    path.write_text(
        VIRTUAL[:start] + '[trajectory]\nkind = "table"\nduration_s = 3.0\nfile = "way.csv"\n\n' + VIRTUAL[end:]
    )
    return load_config(path), way


@pytest.mark.parametrize("text", ["time_s,position_rad\n0,0\n1,0.1\n", "time_s,position_rad\n0,0.4\n1,0.1\n", ""])
def test_a_table_that_was_edited_meanwhile_changes_nothing(tmp_path: Path, text: str) -> None:
    """The file is read once, when the run is planned: what was shown is what the loop gets."""
    config, way = with_table(tmp_path)
    plan, before = resolve(config), resolve(config).motion.placed(report())
    way.write_text(text)
    placed = plan.motion.placed(report())
    plan.motion.require_start(0.1)
    assert np.array_equal(placed.table, before.table)
    assert np.array_equal(placed.table, plan.motion.table)
    assert placed.constants.tobytes() == before.constants.tobytes()
    assert placed.constants[0].trajectory.table_rows == 4
    assert placed.lines == before.lines


# --- what the user is told ---
class SilentLoop:
    """300 cycles, with so many samples; the drive of a neighbour has owed its answer for so many cycles."""

    def __init__(self, samples: int, owed_cycles: int) -> None:
        histograms = np.zeros((len(Histogram), HISTOGRAM_BINS), np.int64)
        histograms[Histogram.WORK, 20] = histograms[Histogram.WAKE, 5] = 300
        histograms[Histogram.ROUND_TRIP, 100] = samples
        state = SimpleNamespace(sample_age_cycles=np.array([0, owed_cycles]))
        self.block = SimpleNamespace(histograms=histograms, state=state)
        self.block.whole = self.block
        self.cycles = 300
        self.may_enable = False

    def allow_enable(self) -> None:
        self.may_enable = True


@pytest.mark.parametrize("velocity", [False, True])
@pytest.mark.parametrize(("samples", "owed_cycles"), [(0, 300), (300, 0), (300, 4)])
def test_a_drive_that_says_nothing_is_told_by_the_loop_and_not_as_a_delay(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, samples: int, owed_cycles: int, velocity: bool
) -> None:
    config = edited(tmp_path)
    log: Any = SimpleNamespace(path=tmp_path / "log.mcap", write_event=lambda *_: None)
    loop: Any = SilentLoop(samples, owed_cycles)
    nothing: Any = None
    signals = StopSignals()
    signals.agreed()
    parts = RunParts(loop, Around(signals, BusWatch(config, None)), log, nothing, PhaseLines(Output()), {})
    plan = resolve(config)
    axis = plan.motion.placed(report()).constants[0]
    if velocity:
        axis.command_kind, axis.velocity_command.position_gain_ps = CommandKind.VELOCITY, POSITION_GAIN_ps
    monkeypatch.setattr(run_watch_module, "beside", at_once)
    with RunWatch(plan, axis, parts) as watch:
        watch.check_delay()
        assert not loop.may_enable
        watch._may_enable()
    heard = samples > 0 and owed_cycles == 0
    assert loop.may_enable is heard
    assert (watch.delay_s is None) is not heard
    if heard:
        assert watch.delay_s == pytest.approx(1e-3)


@pytest.mark.parametrize(
    ("state", "said"),
    [("switch on disabled", "the drive is disabled"), (UNTOUCHED, "the drive was left as it is"), ("", "no drive")],
)
def test_the_end_of_the_scope_tells_how_the_drive_is(
    monkeypatch: pytest.MonkeyPatch, capsys: Any, virtual_config: Any, state: str, said: str
) -> None:
    shown: list[tuple[str, ...]] = []  # on the page

    class Runs:
        code, drive_state, told, ended_by = 0, state, {}, ""

        def __init__(self, *_: Any, **__: Any) -> None: ...
        def one(self) -> bool:
            raise KeyboardInterrupt

        def tell(self, stage: str, lines: list[str]) -> None:
            shown.append((stage, *lines))

    monkeypatch.setattr(scope_module, "_Runs", Runs)
    monkeypatch.setattr("jointctl.tools.scoping.feed.scope_order", lambda *_, **__: SimpleNamespace(url=""))
    monkeypatch.setattr("jointctl.tools.scoping.feed.scope_server", lambda *_, **__: contextlib.nullcontext())
    scope_module.live_scope(virtual_config, Output())
    told = capsys.readouterr().err
    assert said in told
    assert ("disabled" in told) is (state == "switch on disabled")
    assert [stage for stage, *_ in shown] == ["ended"]
    assert shown[0][1] in told


def test_a_sweep_on_a_drive_that_does_not_tell_its_torque_is_refused() -> None:
    with pytest.raises(DeviceError, match="object 6077"):
        require_torque(report(measures_torque=False))
    require_torque(report())


# --- feed-forward beyond what was measured ---
@pytest.mark.parametrize(
    ("more", "refused"),
    [
        ((), True),
        ((("velocity_max_radps = 1.0 ", "velocity_max_radps = 0.85 "),), False),  # zero at 50 deg/s = 0.873 rad/s
        ((('feed_forward = "lugre_desired"', 'feed_forward = "none"'),), False),
    ],
)
def test_a_friction_curve_that_pushes_with_the_motion_below_the_velocity_limit_is_refused(
    tmp_path: Path, more: tuple[tuple[str, str], ...], refused: bool
) -> None:
    """LuGre on such a curve has no steady state: the run ended in the middle of the motion as NOT_FINITE."""
    curve = (
        ("a0 = 0.17995 ", "a0 = 0.2 "), ("a1 = 0.0012298\n", "a1 = -0.004\n"), ("a2 = -6.5261e-7\n", "a2 = 0.0\n"),
        ("a3 = -7.6969e-9\n", "a3 = 0.0\n"), ("\nknee = 40.0", "\nknee = 10.0"), ("max = 200.0 ", "max = 20.0 "),
    )  # fmt: skip
    if refused:
        with pytest.raises(ConfigurationError, match=r"friction.positive: .* oppose .* at 50\.\d+ deg/s it does not"):
            edited(tmp_path, *curve, *more)
    else:
        edited(tmp_path, *curve, *more)


# --- a sweep that is resumed with another configuration ---
@pytest.mark.parametrize(
    ("change", "same"),
    [
        (("torque_constant_NmpA = 0.1 ", "torque_constant_NmpA = 0.141 "), False),
        (("torque_constant_NmpA = 0.1 ", "gravity_Nm = 5.0\ntorque_constant_NmpA = 0.1 "), False),
        (("\ndirection = 1 ", "\ndirection = -1 "), False),
        (("kp = 784.0 ", "kp = 700.0 "), True),
    ],
)
def test_points_that_were_measured_with_other_constants_are_another_plan(
    tmp_path: Path, change: tuple[str, str], same: bool
) -> None:
    options = SweepOptions(points=4)
    first = make_plan(edited(tmp_path), options).hash
    assert (make_plan(edited(tmp_path, change), options).hash == first) is same


def test_a_simulated_sweep_is_another_one_than_a_measured_one(tmp_path: Path) -> None:
    config = edited(tmp_path)
    assert make_plan(config, SweepOptions(lockstep=True)).hash != make_plan(config, SweepOptions()).hash


# --- what a drive adds to its target by itself ---
class Offsets:
    """Objects of a drive that is off."""

    remarks: tuple[str, ...] = ()

    def __init__(self) -> None:
        self.values = {0x6041: 0x40, 0x60FF: 5, 0x60B1: 1000, 0x60B2: 30, 0x6071: 9}

    def read(self, index: int, sub: int = 0, *, what: str) -> int:
        return self.values[index]

    def write(self, index: int, sub: int, value: int, *, what: str) -> None:
        self.values[index] = value

    write_verified = write_if_present = write


def test_no_target_and_no_offset_is_left_from_before(settings_of_virtual_joint: Any) -> None:
    objects: Any = Offsets()
    disable(objects, settings_of_virtual_joint, lambda _: None)
    assert [objects.values[index] for index in (0x6071, 0x60FF, 0x60B1, 0x60B2)] == [0, 0, 0, 0]


@pytest.mark.parametrize("velocity_side", ["joint", "motor"])
def test_the_check_judges_the_curve_that_the_law_computes(velocity_side: str) -> None:
    """Reading a configuration must not load the compiler, so `checks` has the curve once more, in its own units."""
    config = load_config(shipped_config("paper"))
    friction = config.friction.model_copy(update={"velocity_side": velocity_side})
    ratio = config.joint.reduction_ratio
    branches = friction_constants(friction, ratio)[0]
    radps_per_unit = RADPS_PER_UNIT[friction.velocity_unit] / (ratio if velocity_side == "motor" else 1.0)
    scale = 1.0 / ratio if friction.torque_side == "joint" else 1.0
    for direction, branch, sign in (
        (friction.positive, branches.positive, 1.0), (friction.negative, branches.negative, -1.0),
    ):  # fmt: skip
        knee, greatest = abs(direction.knee), abs(direction.max)
        for speed in (0.01 * knee, 0.5 * knee, 0.999 * knee, 1.001 * knee, 0.6 * greatest, greatest, 1.7 * greatest):
            computed_Nm = branch_torque_Nm(branch, speed * radps_per_unit)
            assert scale * checks._sliding_Nm(direction, sign, speed) == pytest.approx(computed_Nm, rel=1e-12)


# --- A joint that is moved while the question is open: the motion would not be the one that was shown ---
def moved(joint: LockstepJoint, by_rad: float) -> Any:
    state = joint.plant_state.copy()
    state.joint_position_rad += by_rad
    return state


@pytest.mark.parametrize(
    ("by_rad", "far"), [(0.6, True), (0.051, True), (-0.051, True), (0.049, False), (-0.049, False), (0.0, False)]
)
def test_a_joint_that_was_moved_is_not_enabled(tmp_path: Path, by_rad: float, far: bool) -> None:
    """It was driven the longer way in the time of the shorter one: 0.99 rad/s where 0.26 rad/s were shown."""
    joint = LockstepJoint(edited(tmp_path, SHORT))
    run = joint.run(plant_state=moved(joint, by_rad))
    assert (AxisPhase.TRACKING in run.log.phase) is not far
    if not far:  # the twin: within the following error
        assert run.fault is Fault.NONE
        return
    assert run.fault is Fault.MOVED_BEFORE_START
    assert run.state.fault_value == pytest.approx(by_rad, abs=1e-4)
    assert not np.isin(run.log.drive_state, (DriveState.STARTING, DriveState.ENABLED)).any()
    assert not run.log.command_torque_Nm.any()


def test_the_tolerance(tmp_path: Path) -> None:
    config = edited(tmp_path, SHORT)
    sequence = constants_of(config, start_position_rad=0.25)[0].sequence
    assert (sequence.start_rad, sequence.moved_max_rad) == (0.25, config.limits.following_error_max_rad)
    assert constants_of(config)[0].sequence.moved_max_rad == 0.0  # not known where it stands: not checked
    coarse = load_config(written(tmp_path / "coarse.toml", **COARSE))
    sequence = constants_of(coarse, start_position_rad=0.25)[0].sequence
    assert sequence.moved_max_rad == pytest.approx(MOVED_COUNTS * math.tau / 256)


@pytest.mark.parametrize(("by_rad", "fault"), [(0.6, Fault.MOVED_BEFORE_START), (0.04, Fault.NONE)])
def test_a_sweep_is_not_begun_elsewhere(by_rad: float, fault: Fault) -> None:
    joint = LockstepJoint(load_config(CONFIGS / "sweep_virtual.toml"))
    settings = PlanSettings(
        width_rad=0.2, acceleration_radps2=4.0, transit_radps=0.5, dwell_s=0.3, settle_s=0.1, reduction_ratio=121.0
    )
    motion = plan_motion(ordered_points(both_directions([0.2], 2), 1, None), settings)
    placed = shifted(motion, middle_rad(joint.config, motion, joint.report.start_position_rad))
    joint.table = placed.table
    constants = sweep_constants(joint.config, joint.report, placed)
    constants[0].sequence.supervisor_max_cycles = 0
    run = joint.run(constants, plant_state=moved(joint, by_rad))
    assert run.fault is fault
    assert (run.log.drive_state == DriveState.ENABLED).any() is np.bool_(fault is Fault.NONE)


def test_the_motion_check_looks_as_well(tmp_path: Path) -> None:
    config = edited(tmp_path, SHORT)
    plan = check_plan(config, None)
    check = CheckMotion(config_of_check(config, plan), plan).constants(report(), motion_table(plan, 0.1))[0].sequence
    assert (check.start_rad, check.moved_max_rad) == (0.1, pytest.approx(1.25 * plan.travel_rad))


@pytest.mark.parametrize(("early", "late", "yes"), [("y\n", "n\n", False), ("n\n", "y\n", True), ("", "y\n", True)])
def test_what_was_typed_before_the_question_is_no_answer(
    monkeypatch: pytest.MonkeyPatch, early: str, late: str, yes: bool
) -> None:
    """While the loop compiled, say: the joint moved at once when it was ready."""
    leader, follower = os.openpty()

    class Answering(io.StringIO):
        def write(self, text: str) -> int:
            if "[y/N]" in text:
                os.write(leader, late.encode())
            return super().write(text)

    os.write(leader, early.encode())
    with open(follower) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        assert agreed(Output(stderr=Answering())) is yes
    os.close(leader)
