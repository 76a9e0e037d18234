"""`jointctl.Joint` at simulated time: motions, set-points, refusals, faults, one's own law."""

from __future__ import annotations

import functools
import math
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import jointctl
from jointctl import lockstep_joint
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py import slow_start
from jointctl.firmware_py.slow_start import compiling
from jointctl.firmware_py.states import AxisPhase
from jointctl.joint import Joint, SetPointError

RATE_Hz = 100.0


@pytest.fixture
def joint() -> Iterator[Joint]:
    with Joint("virtual", lockstep=True) as joint:
        joint.enable()
        yield joint


def sine(amplitude_rad: float, frequency_Hz: float, t_s: float) -> tuple[float, float]:
    """From rest: the amplitude grows for a second."""
    omega = math.tau * frequency_Hz
    u = min(t_s, 1.0)
    share, rate = u * u * (3.0 - 2.0 * u), 6.0 * u * (1.0 - u)
    return (
        amplitude_rad * share * math.sin(omega * t_s),
        amplitude_rad * (share * omega * math.cos(omega * t_s) + rate * math.sin(omega * t_s)),
    )


def streamed(joint: Joint, seconds: float, rate_Hz: float = RATE_Hz, *, velocity: bool = True, **more: float) -> None:
    start_rad = joint.state.desired_position_rad
    for k in range(1, round(seconds * rate_Hz) + 1):
        position_rad, velocity_radps = sine(0.05, 0.5, k / rate_Hz)
        joint.command(start_rad + position_rad, velocity_radps if velocity else None, time_s=k / rate_Hz, **more)
        joint.step(1.0 / rate_Hz)


def test_a_move_that_could_not_be_braked_is_refused_and_the_program_goes_on(joint: Joint) -> None:
    """It was begun, and ended the program by REFERENCE_LIMIT."""
    joint.move_to(0.19)
    with pytest.raises(ConfigurationError, match=r"would come to rest at .* sequence.brake_radps2 \(=2\)"):
        joint.move_to(0.69, duration_s=0.95)
    joint.move_to(0.69, duration_s=2.0)
    assert joint.state.position_rad == pytest.approx(0.69, abs=1e-3)


def test_it_is_commissioned_then_enabled_then_moves_and_is_off_afterwards() -> None:
    with Joint("virtual", lockstep=True) as joint:
        assert joint.state.phase == "commissioned"
        joint.enable()
        assert joint.state.phase == "tracking"
        joint.move_to(0.2, duration_s=1.0)
        assert joint.state.desired_position_rad == pytest.approx(0.2)
        assert abs(joint.state.position_rad - 0.2) < 1e-3
    assert joint.state.phase == "finished"
    assert joint.state.fault == ""


@pytest.mark.parametrize("rate_Hz", [50.0, 200.0, 1000.0])
def test_the_reference_is_the_cubic_through_the_set_points_a_delay_later(joint: Joint, rate_Hz: float) -> None:
    start_rad = joint.state.desired_position_rad
    first = len(joint.records)
    streamed(joint, 3.0, rate_Hz)
    log = joint.records[first:]
    delay = round(joint.config.stream.delay_s * 1000.0)
    wanted = np.array([start_rad + sine(0.05, 0.5, k / 1000.0 + 1.0 / rate_Hz)[0] for k in range(len(log))])
    off = log.desired_position_rad[delay + 100 :] - wanted[100 : len(log) - delay]
    assert np.abs(off).max() < 1e-6
    assert np.abs(log.error_rad).max() < 2e-3


def test_where_no_set_point_comes_the_reference_brakes_and_never_goes_beyond(joint: Joint) -> None:
    rate_radps = 0.1
    start_rad = joint.state.desired_position_rad
    for k in range(1, 101):  # up to a constant speed, then nothing more
        t_s = k / RATE_Hz
        joint.command(start_rad + 0.5 * rate_radps * t_s * t_s, rate_radps * t_s, time_s=t_s)
        joint.step(1.0 / RATE_Hz)
    joint.step(0.5)
    state = joint.state
    brake_rad = rate_radps**2 / (2.0 * joint.config.sequence.brake_radps2)
    assert state.desired_position_rad == pytest.approx(start_rad + 0.5 * rate_radps + brake_rad, abs=1e-6)
    assert joint.records[-1].desired_velocity_radps == 0.0
    assert state.phase == "tracking"
    joint.command(state.desired_position_rad + 0.001, 0.0)  # and it may begin again
    joint.step(0.2)
    assert joint.state.desired_position_rad == pytest.approx(state.desired_position_rad + 0.001)


@pytest.mark.parametrize(
    ("point", "words"),
    [
        ((math.nan,), r"position_rad \(=nan\)"),
        ((0.1, math.inf), r"velocity_radps \(=inf\)"),
        ((5.0,), r"position_rad \(=5\) must be in \[-0.7..0.7\]"),
        ((0.1, 100.0), r"velocity_radps \(=100\)"),
        ((0.69,), "from the set-point before, must be within"),
        ((0.14,), "takes more than"),
        ((0.1, 0.0, math.nan), "acceleration_radps2"),
        ((0.1, 0.0, 0.0, 1e6), r"torque_Nm \(=1e\+06\)"),
        (("x",), r"position_rad \(=x\) must be a number"),
    ],
)
def test_a_set_point_that_breaks_a_limit_is_refused_and_changes_nothing(
    joint: Joint, point: tuple[float, ...], words: str
) -> None:
    before = joint.state.desired_position_rad
    with pytest.raises(SetPointError, match=words):
        joint.command(*point)
    joint.step(0.3)
    assert joint.state.desired_position_rad == before
    joint.command(before)  # the next good one is followed
    joint.step(0.1)


@pytest.mark.parametrize(
    ("time_s", "words"),
    [
        *((time_s, "after the set-point before") for time_s in (7.0, 6.9, 7.5, 4e9)),
        *((time_s, r"time_s .* must be in \[-4e\+09..4e\+09\]") for time_s in (math.nan, math.inf, 1e12, -1e300)),
        ("7.01", r"time_s \(=7.01\) must be a number"),
    ],
)
def test_times_must_be_numbers_that_ascend_without_a_gap(joint: Joint, time_s: float, words: str) -> None:
    at_rad = joint.state.desired_position_rad
    joint.command(at_rad, 0.0, time_s=7.0)
    joint.step(0.01)
    with pytest.raises(SetPointError, match=words):
        joint.command(at_rad, 0.0, time_s=time_s)
    joint.command(at_rad, 0.0, time_s=7.01)


def test_a_set_point_without_a_time_may_follow_one_with_a_time(joint: Joint) -> None:
    at_rad = joint.state.desired_position_rad
    joint.command(at_rad + 0.001, time_s=7.0)
    joint.step(0.01)
    joint.command(at_rad + 0.002)
    joint.step(0.2)
    assert joint.state.desired_position_rad >= at_rad + 0.002


def test_a_torque_comes_on_top_and_goes_at_its_rate(joint: Joint) -> None:
    at_rad = joint.state.desired_position_rad
    for k in range(1, 201):
        joint.command(at_rad, 0.0, 0.0, min(3.0, 0.1 * k), time_s=0.01 * k)
        joint.step(0.01)
    assert float(joint._motor.axis[0].stream.torque_Nm) == pytest.approx(3.0)
    first = len(joint.records)
    joint.step(1.0)
    assert float(joint._motor.axis[0].stream.torque_Nm) == 0.0
    steps = np.abs(np.diff(joint.records[first:].command_torque_Nm))
    assert steps.max() < 3.0


def test_a_motion_waits_for_the_one_before_and_set_points_are_for_rest(joint: Joint) -> None:
    joint.move_to(0.2, duration_s=1.0, wait=False)
    with pytest.raises(SetPointError, match="a motion is under way"):
        joint.command(0.2)
    joint.move_to(0.0, duration_s=1.0)
    assert joint.state.desired_position_rad == pytest.approx(0.0, abs=1e-12)


def test_a_motion_whose_call_was_interrupted_is_under_way_all_the_same(
    joint: Joint, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program may go on after Ctrl-C: no set-point is taken meanwhile, and the next motion waits."""
    times = np.linspace(0.0, 2.0, 21)
    post = joint._motor.post

    def interrupted(*motion: Any) -> None:
        post(*motion)
        raise KeyboardInterrupt

    joint.move_to(0.0, duration_s=0.5)
    with monkeypatch.context() as patched:
        patched.setattr(joint._motor, "post", interrupted)
        with pytest.raises(KeyboardInterrupt):
            joint.follow(times, np.zeros(21))
    joint.step(1.0)
    with pytest.raises(SetPointError, match="a motion is under way"):
        joint.command(0.0)
    joint.follow(times, 0.2 * np.sin(np.pi * times / 4.0) ** 2)
    assert joint.state.desired_position_rad == pytest.approx(0.2)
    moved = joint.records.desired_position_rad[joint.records.phase == AxisPhase.TRACKING]
    assert np.abs(np.diff(moved)).max() < 1e-3


def test_a_table_is_followed_twice(joint: Joint) -> None:
    times = np.linspace(0.0, 2.0, 21)
    for amplitude_rad in (0.1, -0.1):
        joint.follow(times, amplitude_rad * np.sin(np.pi * times / 4.0) ** 2)
        assert joint.state.desired_position_rad == pytest.approx(amplitude_rad)


@pytest.mark.parametrize(
    ("times", "positions", "words"),
    [
        ([0.0, 1.0], [0.0, 3.0], r"\[-0.7..0.7\]"),
        ([0.0, 0.01, 0.02], [0.0, 0.5, 0.0], "limits"),
        ([0.0, 1.0, 0.5], [0.0, 0.1, 0.0], r"times_s\[2\]"),
        ([0.0, 1.0], [0.0, math.nan], r"positions_rad\[1\]"),
        ([0.0], [0.0], "must both be"),
        ([0.0, 1.0], ["a", "b"], "numbers"),
        ([0.0, 1.0], ["0.1", "0.1"], "numbers"),
        (np.array(["2026-11-27", "2026-11-28"], "datetime64[ns]"), [0.1, 0.1], "numbers"),
        ([0.0, 1.0], np.array([0.1j, 0.1]), "numbers"),
        ([0.0, 1.0, 2.0], np.ma.array([0.1, 0.2, 0.1], mask=[0, 1, 0]), r"positions_rad\[1\] \(=nan\)"),
        ([0.0, 1e13], [0.1, 0.1], "lasts 1e[+]13 s, must be at most 100000 s"),
    ],
)
def test_a_table_is_checked_before_it_begins(
    joint: Joint, times: npt.ArrayLike, positions: npt.ArrayLike, words: str
) -> None:
    before = joint.state.desired_position_rad
    with pytest.raises(jointctl.ConfigurationError, match=words):
        joint.follow(times, positions)
    joint.step(0.1)
    assert joint.state.desired_position_rad == before


@pytest.mark.parametrize("duration_s", [0.0, -1.0, 1e6])
def test_a_duration_is_refused_by_the_name_that_the_program_gave_it(joint: Joint, duration_s: float) -> None:
    with pytest.raises(jointctl.ConfigurationError, match=r"^duration_s \(=.*\) must be in \[0.001..100000\] s"):
        joint.move_to(0.2, duration_s=duration_s)
    joint.move_to(0.11, duration_s=1.0)


@pytest.mark.parametrize("wait_s", [0.001, 1e300])
def test_a_fault_is_raised_with_its_cause_however_long_is_waited(wait_s: float) -> None:
    fault = pytest.raises(jointctl.MotionFault, match="VELOCITY_LIMIT")
    with fault, Joint("virtual", lockstep=True) as joint:
        joint.enable()
        for _ in range(3000):
            joint.step_torque(40.0)
            joint.wait(wait_s)


def test_a_law_in_python_holds_the_joint(joint: Joint) -> None:
    state, target_rad = joint.state, joint.state.position_rad + 0.02
    for _ in range(2000):
        state = joint.step_torque(8000.0 * (target_rad - state.position_rad) - 300.0 * state.velocity_radps)
    assert abs(state.position_rad - target_rad) < 5e-3


def test_after_a_torque_of_ones_own_no_motion_is_promised(joint: Joint) -> None:
    joint.step_torque(0.0)
    at_rad = joint.state.desired_position_rad
    for move in (lambda: joint.move_to(0.3), lambda: joint.follow([0.0, 1.0], [0.1, 0.2]), lambda: joint.command(0.1)):
        with pytest.raises(jointctl.UsageError, match="no motion or set-point would be followed"):
            move()
    joint.wait(0.1)  # with the last torque
    assert joint.state.desired_position_rad == at_rad


def test_a_stop_takes_the_torque_of_ones_own_law_away(joint: Joint) -> None:
    for _ in range(60):
        joint.step_torque(30.0)
    joint.stop()
    assert (joint.state.phase, joint.state.fault) == ("finished", "")


def test_approve_has_the_last_word() -> None:
    with Joint("virtual", lockstep=True) as joint, pytest.raises(jointctl.MotionFault, match="not approved"):
        joint.enable(approve=lambda lines: False)
    assert joint.state.phase == "commissioned"


async def asked_later(lines: Sequence[str]) -> bool:
    return False


@pytest.mark.parametrize("approve", [lambda lines: "n", lambda lines: None, lambda lines: 1, asked_later])
@pytest.mark.filterwarnings("ignore:coroutine")
def test_what_only_counts_as_true_is_no_consent(approve: Any) -> None:
    with (
        Joint("virtual", lockstep=True) as joint,
        pytest.raises(jointctl.UsageError, match=r"must return True or False"),
    ):
        joint.enable(approve=approve)
    assert joint.state.phase == "commissioned"


def test_a_joint_is_for_one_block() -> None:
    with Joint("virtual", lockstep=True) as joint:
        with pytest.raises(jointctl.UsageError, match="begin a new Joint"), joint:
            pass
        joint.enable()
    with pytest.raises(jointctl.UsageError, match="begin a new Joint"), joint:
        pass


def test_without_enable_nothing_is_followed() -> None:
    with Joint("virtual", lockstep=True) as joint:
        joint.step(2.0)
        assert (joint.state.phase, joint.state.drive_state) == ("waiting", "switch on disabled")
        with pytest.raises(jointctl.MotionFault, match="follows nothing"):
            joint.step_torque(1.0)
        for call in (lambda: joint.move_to(0.1), lambda: joint.command(0.1)):
            with pytest.raises(jointctl.UsageError, match="enable"):
                call()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"foxglove": 8765}, r"foxglove \(=8765\) must be True, False or HOST:PORT"),
        ({"ros2": "robot"}, r"ros2 \(=robot\) must be True, False or the number of a domain"),
        ({"target": 0}, r"node \(=0\) must be a whole number"),
    ],
)
def test_what_is_no_argument_of_a_joint_is_named(given: dict[str, Any], words: str) -> None:
    with pytest.raises(jointctl.JointctlError, match=words):
        Joint("virtual", lockstep=True, **given)


def test_the_first_joint_says_that_it_compiles(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = lockstep_joint.LockstepMotor

    def compiled(axes: Any) -> Any:
        with compiling():
            time.sleep(0.2)
        return made(axes)

    monkeypatch.setattr(lockstep_joint, "LockstepMotor", compiled)
    monkeypatch.setattr(slow_start, "slow_start", functools.partial(slow_start.slow_start, after_s=0.0))
    with Joint("virtual", lockstep=True):
        pass
    assert capsys.readouterr() == ("", "Joint: compiling, which only the first start does\n")
    monkeypatch.setattr(lockstep_joint, "LockstepMotor", made)
    with Joint("virtual", lockstep=True):
        pass
    assert capsys.readouterr() == ("", "")


def test_a_table_of_another_thread_does_not_take_the_place_of_one_that_is_about_to_be_followed(
    joint: Joint, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loop reads its rows where they are written: the joint would move as nobody has checked, or jump."""
    motor: Any = joint._motor
    take, times_s, start_rad = motor.post, np.linspace(0.0, 1.0, 21), joint.state.desired_position_rad
    hump_rad = 0.1 * np.sin(np.pi * times_s) ** 2
    other = threading.Thread(target=joint.follow, args=(times_s, start_rad - hump_rad))

    def post(*motion: Any) -> None:  # the rows are written, and the loop does not know of them yet
        monkeypatch.setattr(motor, "post", take)
        other.start()
        other.join(0.3)
        take(*motion)

    monkeypatch.setattr(motor, "post", post)
    joint.follow(times_s, start_rad + hump_rad, wait=False)
    other.join(60.0)
    assert not other.is_alive()
    joint.wait(2.0)
    ways_rad = joint.records.desired_position_rad[joint.records.phase == AxisPhase.TRACKING] - start_rad
    assert [ways_rad.max(), ways_rad.min()] == pytest.approx([0.1, -0.1], abs=1e-3)
    assert np.argmax(ways_rad) < np.argmin(ways_rad)
