"""Loops that swing, in lockstep with the whole joint: each ends within a second of its first swing, its twin not."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.states import AxisPhase, Fault, Notice, Reaction
from jointctl.hil.lockstep import TRUE_POSITION_rad
from jointctl.tools.configuration.sections import Hold
from jointctl.tools.experiments.scenarios import controller_constants, named
from jointctl.tools.lockstep import LockstepJoint, LockstepRun
from tests.bench.swing_alarms import outcomes, tasks
from tests.configurations import KALMAN, shipped

LIMIT_Nm = 60.0
NEAR_LIMIT_Nm = 57.0  # a torque that reaches it on both sides swings between its limits
SWING_CYCLES = 300  # between the two sides
WITHIN_CYCLES = 1000


def carry_out(
    controller: str, duration_s: float, *, bits: int = 19, side: str = "joint", control: dict[str, Any] | None = None,
    watched: bool = True, at_rest: bool = False, **virtual: Any,
) -> LockstepRun:  # fmt: skip
    """`configs/precise.toml` with another law, encoder or joint."""
    law = named((controller,))[0].control.model_copy(update=control or {})
    there = {f"virtual__{key}": value for key, value in virtual.items()}
    config = shipped(
        "precise", trajectory__duration_s=duration_s, encoder__counts_per_turn=2**bits, encoder__side=side, **there
    )
    if at_rest:
        config = config.changed(trajectory=Hold(kind="hold", duration_s=duration_s, position_rad=0.2))
    joint = LockstepJoint(config)
    chosen = named((controller,))[0]
    constants = controller_constants(
        config, type(chosen)(chosen.name, law, chosen.friction), joint.report.start_position_rad
    )
    if not watched:
        swing = constants[0].limits.swing
        swing.torque_Nm = swing.error_rad = constants[0].law.learning.growth = 0.0
    return joint.run(constants)


def first_swing(run: LockstepRun) -> int | None:
    """The first cycle in which the torque has been near both of its limits within 0.3 s."""
    torque = np.asarray(run.log.command_torque_Nm)
    sides = np.sign(torque) * (np.abs(torque) >= NEAR_LIMIT_Nm)
    at = np.flatnonzero(sides)
    for before, now in itertools.pairwise(at.tolist()):
        if sides[before] != sides[now] and now - before <= SWING_CYCLES:
            return int(now)
    return None


def tripped(run: LockstepRun) -> int:
    return int(np.argmax(run.log.fault != Fault.NONE))


def soft(link_inertia: float) -> dict[str, Any]:
    """A soft reducer, the encoder on the motor; a link of 0.9 kg m^2 times `link_inertia` behind it."""
    return {
        "flexible": True, "motor_side_inertia_kgm2": 1.2, "inertia_scale": (1.2 + 0.9 * link_inertia) / 2.1,
        "reducer_stiffness_Nmprad": 1e4, "side": "motor", "bits": 16,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("controller", "duration_s", "joint"),
    [
        ("precise", 60.0, {"command_delay_s": 0.004}),  # on top of the period that the synchronous RPDO takes
        ("precise", 30.0, {"command_delay_s": 0.005}),
        ("precise", 60.0, soft(5.0)),
        ("precise", 20.0, {**soft(5.0), "reducer_stiffness_Nmprad": 3e4, "side": "joint", "bits": 19}),
        ("precise", 10.0, {"bits": 15}),
        ("pid", 10.0, {"command_delay_s": 0.008}),
        ("paper", 10.0, {"command_delay_s": 0.008}),
        (
            "precise",
            10.0,
            {"command_delay_s": 0.002, "control": {"kp": 14400.0, "kv": 400.0, "velocity_cutoff_Hz": 400.0}},
        ),
    ],
    ids=["5 ms", "6 ms", "heavy link", "joint encoder", "coarse encoder", "pid, 9 ms", "paper, 9 ms", "gains"],
)
def test_a_loop_that_swings_ends_within_a_second_of_its_first_swing(
    controller: str, duration_s: float, joint: dict[str, Any]
) -> None:
    """The same loop unwatched reaches both limits again and again."""
    swings = first_swing(carry_out(controller, duration_s, watched=False, **joint))
    run = carry_out(controller, duration_s, **joint)
    assert run.fault is Fault.LIMIT_CYCLE
    assert Reaction(int(run.state.reaction)) is Reaction.QUICK_STOP
    assert swings is None or tripped(run) <= swings + WITHIN_CYCLES
    assert run.state.fault_value > 1.0
    assert not run.log.command_torque_Nm[tripped(run) :].any()
    assert run.log.phase[-1] == AxisPhase.FINISHED


@pytest.mark.parametrize(
    ("controller", "duration_s", "joint"),
    [
        ("precise", 60.0, {"command_delay_s": 0.002}),
        ("precise", 60.0, soft(1.0)),
        ("precise", 10.0, {"bits": 17}),
        ("pid", 10.0, {"command_delay_s": 0.004}),
        ("paper_lugre", 10.0, {"command_delay_s": 0.0015}),
        (
            "precise",
            10.0,
            {"command_delay_s": 0.0, "control": {"kp": 6400.0, "kv": 160.0, "velocity_cutoff_Hz": 300.0}},
        ),
        ("precise", 10.0, {"bits": 15, "control": KALMAN[15]}),
    ],
    ids=["3 ms", "light link", "fine encoder", "pid, 5 ms", "paper, 2.5 ms", "gains", "coarse encoder, Kalman filter"],
)
def test_its_twin_that_settles_goes_on(controller: str, duration_s: float, joint: dict[str, Any]) -> None:
    run = carry_out(controller, duration_s, **joint)
    assert run.fault is Fault.NONE
    assert run.state.notices == 0


@pytest.mark.parametrize(("delay_s", "stops"), [(0.003, True), (0.002, False)])
def test_learning_that_makes_the_error_grow_is_switched_off_before_the_joint_swings(
    delay_s: float, stops: bool
) -> None:
    """4 ms from sample to torque: feedback alone is stable, learning is not.  With 3 ms both are."""
    run = carry_out("precise", 100.0, command_delay_s=delay_s)
    assert run.fault is Fault.NONE
    assert bool(run.state.notices & Notice.LEARNING_OFF) is stops
    tracked = np.asarray(run.log.error_rad[run.tracking])
    repetitions = np.sqrt(np.mean(tracked[:100_000].reshape(10, -1) ** 2, axis=1))
    unwatched = carry_out("precise", 100.0, command_delay_s=delay_s, watched=False)
    tracked = np.asarray(unwatched.log.error_rad[unwatched.tracking])
    grown = np.sqrt(np.mean(tracked[:100_000].reshape(10, -1) ** 2, axis=1))
    if stops:
        assert grown[-1] > 2.0 * repetitions[-1]
        assert repetitions[-1] < 1.2 * repetitions[0]  # that of the law without learning
    else:
        np.testing.assert_array_equal(grown, repetitions)  # who is not tripped is not touched


@pytest.mark.trips("loop: a joint that hunts at rest", "stick_slip")
@pytest.mark.stays("loop: a joint that hunts at rest", "lugre")
@pytest.mark.parametrize(("friction", "hunts"), [("stick_slip", True), ("lugre", False)])
def test_a_joint_that_hunts_at_rest_is_reported(friction: str, hunts: bool) -> None:
    """Half a swing in 0.9 s, by 10 mrad: too slow for a limit cycle, and no harm."""
    soft = {"kp": 300.0, "kv": 25.0, "ki": 6000.0}
    run = carry_out("pid", 20.0, at_rest=True, control=soft, friction_kind=friction)
    assert run.fault is Fault.NONE
    assert run.state.notices == (Notice.HUNTS if hunts else 0)


@pytest.mark.trips("loop: the noise of its command", "(16, True)")
@pytest.mark.stays("loop: the noise of its command", "(17, False)")
@pytest.mark.parametrize(("bits", "noisy"), [(16, True), (17, False)])
def test_a_coarse_encoder_is_reported_as_torque_noise(bits: int, noisy: bool) -> None:
    run = carry_out("precise", 20.0, bits=bits)
    assert run.fault is Fault.NONE
    assert bool(run.state.notices & Notice.TORQUE_NOISE) is noisy
    assert (run.log.notices[0], run.log.notices[-1]) == (0, run.state.notices)  # in the log since when
    if noisy:
        assert run.state.swing.noise_told_Nm > 0.2 * LIMIT_Nm
        assert np.abs(run.log.command_torque_Nm).max() < LIMIT_Nm


@pytest.mark.parametrize("friction", ["lugre", "stick_slip"])
@pytest.mark.parametrize(("bits", "rmse_rad"), [(14, 0.2e-3), (15, 0.1e-3), (16, 0.06e-3)])
def test_with_the_kalman_filter_a_coarse_encoder_is_quiet_and_precise(
    bits: int, rmse_rad: float, friction: str
) -> None:
    """Without learning, which needs its repetitions."""
    control = {**KALMAN[bits], "learning": None}
    run = carry_out("precise", 30.0, bits=bits, control=control, friction_kind=friction)
    assert run.fault is Fault.NONE
    assert run.state.notices == 0
    tracked = np.asarray(run.log.error_rad[run.tracking])[10_000:]
    assert np.sqrt(np.mean(tracked**2)) <= rmse_rad
    torque = np.asarray(run.log.command_torque_Nm[run.tracking])[10_000:]
    assert np.mean(np.abs(np.diff(torque))) <= 3.0


@pytest.mark.parametrize("friction", ["lugre", "stick_slip"])
@pytest.mark.parametrize("bits", [14, 15, 16])
def test_with_the_kalman_filter_a_coarse_encoder_does_not_hunt_at_rest(bits: int, friction: str) -> None:
    run = carry_out("precise", 30.0, bits=bits, control=KALMAN[bits], friction_kind=friction, at_rest=True)
    assert run.fault is Fault.NONE
    assert run.state.notices == 0
    resting = run.truth[run.tracking, TRUE_POSITION_rad][10_000:]
    assert np.ptp(resting) <= math.tau / 2**bits


@pytest.mark.parametrize("controller", ["paper", "precise", "pid"])
def test_joints_that_are_well_raise_no_alarm(controller: str) -> None:
    """A few of the runs of `tests/bench/swing_alarms.py`, which carries out as many as one likes."""
    found = [outcome for task in tasks([915311], 4, [controller], runs=6) for outcome in outcomes(task)]
    assert len(found) == 6
    assert [outcome for outcome in found if outcome.alarm or outcome.fault != Fault.NONE.name] == []
