"""Motions that never repeat: smooth, within their limits, the same for the same seed; and what is measured of them."""

from __future__ import annotations

import numpy as np
import pytest

from jointctl.firmware_py.motion_records import Reference, TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import Fault, TrajectoryKind
from jointctl.firmware_py.trajectory import reference_at, repetition
from jointctl.tools.experiments.controller_study import EnsembleSettings, checked, random_plant, run_study
from jointctl.tools.experiments.many_runs import Workers
from jointctl.tools.experiments.scenarios import (
    RANDOM_MOTIONS,
    ACCELERATION_radps2,
    Controller,
    CREEP_radps,
    RandomMotion,
    REACH_rad,
    SPEED_radps,
    controller_constants,
    error_figures,
    named,
    random_motion,
    run_scenario,
    settled_share,
    with_chosen_gains,
)
from jointctl.tools.lockstep import LockstepJoint
from tests.configurations import shipped

DURATION_S = 30.0


@pytest.mark.parametrize("kind", RANDOM_MOTIONS)
@pytest.mark.parametrize("index", range(6))
def test_a_motion_is_smooth_begins_and_ends_at_rest_and_stays_within_its_limits(kind: RandomMotion, index: int) -> None:
    table = random_motion(kind, 3, index, DURATION_S).table
    start, c0, c1, c2, c3 = table[:-1].T
    steps = np.diff(table[:, 0])
    ends = c0 + steps * (c1 + steps * (c2 + steps * c3)), c1 + steps * (2.0 * c2 + steps * 3.0 * c3)
    assert start[0] == 0.0
    assert table[-1, 0] >= DURATION_S
    for end, begin, last in zip(ends, (c0, c1), (table[-1, 1], 0.0), strict=True):
        assert begin[0] == pytest.approx(0.0, abs=1e-9)
        assert end[:-1] == pytest.approx(begin[1:], abs=1e-9)
        assert end[-1] == pytest.approx(last, abs=1e-9)
    assert 2.0 * c2[1:] == pytest.approx((2.0 * c2 + 6.0 * c3 * steps)[:-1], abs=1e-6)
    assert np.max(np.abs(c0)) <= REACH_rad * (1.0 + 1e-6)
    assert np.max(np.abs(c1)) <= SPEED_radps * (1.0 + 1e-3)
    assert np.max(np.abs(2.0 * c2)) <= ACCELERATION_radps2 * (1.0 + 1e-2)
    assert np.any(np.abs(c1) > (0.9 * CREEP_radps if kind == "creep" else 0.05))


@pytest.mark.parametrize("kind", RANDOM_MOTIONS)
def test_a_motion_depends_on_seed_and_plant_only_and_never_repeats(kind: RandomMotion) -> None:
    first = random_motion(kind, 3, 1, DURATION_S)
    assert np.array_equal(first.table, random_motion(kind, 3, 1, DURATION_S).table)
    for seed, index in ((3, 2), (4, 1)):
        assert not np.array_equal(first.table, random_motion(kind, seed, index, DURATION_S).table)
    constants = new(TrajectoryConstants)
    constants[0].kind, constants[0].table_rows = TrajectoryKind.TABLE, len(first.table)
    assert repetition(constants[0], first.table, 5.0).period_s == 0.0


def test_rests_are_where_the_reference_rests() -> None:
    motion = random_motion("point_to_point", 3, 1, DURATION_S)
    assert len(motion.rests_s) > 5
    constants, reference = new(TrajectoryConstants), new(Reference)[0]
    constants[0].kind, constants[0].table_rows = TrajectoryKind.TABLE, len(motion.table)
    for begin_s, end_s in motion.rests_s:
        assert 0.4 - 0.01 <= end_s - begin_s <= 1.0 + 0.01
        for time_s in np.linspace(begin_s, end_s, 5):
            reference_at(constants[0], motion.table, 0, float(time_s), reference)
            assert abs(reference.velocity_radps) < 1e-6


def test_a_rest_counts_as_settled_when_the_error_is_and_stays_within_the_band() -> None:
    time_s = np.arange(0.0, 10.0, 1e-3)
    rests = np.array([[k + 0.5, k + 1.0] for k in range(10)])
    error = np.zeros_like(time_s)
    for k, (begin_s, _) in enumerate(rests):
        error[(time_s >= begin_s) & (time_s < begin_s + 0.01 * k)] = 30e-6  # the last four take longer than 50 ms
    assert settled_share(time_s, error, rests, 20e-6) == pytest.approx(0.6)
    assert settled_share(time_s, error, rests, 40e-6) == 1.0
    error[(time_s >= 0.9) & (time_s < 0.95)] = -30e-6  # leaves the band again
    assert settled_share(time_s, error, rests, 20e-6) == pytest.approx(0.5)
    error[(time_s >= 2.0) & (time_s < 2.4)] = 1.0  # while it moves
    assert settled_share(time_s, error, rests, 20e-6) == pytest.approx(0.5)
    assert settled_share(time_s, error, np.zeros((0, 2)), 20e-6) is None


def test_creep_tells_a_law_that_sticks_from_one_that_does_not() -> None:
    """A joint with stick-slip: without integral action and friction model it stands most of the time."""
    base = shipped("precise", trajectory__duration_s=20.0)
    config = random_plant(base, EnsembleSettings(stick_slip_share=1.0), 3, 0)
    joint, motion = LockstepJoint(config), random_motion("creep", 3, 0, 20.0)
    stuck, later = {}, {}
    for controller in named(("computed_torque", "precise")):
        constants = controller_constants(config, controller, joint.report.start_position_rad)
        run = run_scenario(joint, constants, "creep", motion=motion)
        figures = error_figures(run, 2.0, motion)
        stuck[controller.name], later[controller.name] = figures.stuck_share, figures.stuck_later_share
    assert stuck["computed_torque"] is not None
    assert stuck["precise"] is not None
    assert stuck["computed_torque"] > 0.5
    assert stuck["precise"] < 0.5 * stuck["computed_torque"]
    assert later["computed_torque"] > 0.5, "that of a law that sticks goes on"
    assert later["precise"] == 0.0 < stuck["precise"], "static friction lets go at a turn, and later no more"


@pytest.mark.parametrize("flexible", [False, True])
def test_a_study_has_motions_that_never_repeat(flexible: bool) -> None:
    base = shipped("precise", trajectory__duration_s=6.0)
    controllers = named(("realistic",) if flexible else ("precise",))
    data = {"plants": 1, "after_s": 2.0, "scenario": "point_to_point", "plant": {"flexible": flexible}}
    result = run_study(base, controllers, checked(data, "test"), workers=Workers(1))
    name = result.controllers[0]
    assert result.faults(name) == 0
    assert np.all(result.values(name, "true_rmse_mrad") < 0.5)
    assert np.all(result.values(name, "settled_share") >= 0.0)
    assert np.all(np.isnan(result.values(name, "stuck_share")))
    assert np.all(result.values(name, "phase_margin_deg") > 10.0)


def test_a_hard_move_does_not_ring_in_a_reducer_with_a_kinematic_error() -> None:
    """At 0.8 rad/s the motor makes up for sines of 31 and 62 Hz: too late, that is an excitation of the resonance."""
    base = shipped("realistic", trajectory__duration_s=30.0)
    config = random_plant(base, EnsembleSettings(flexible=True), 52077, 1)
    controller = with_chosen_gains(config, Controller("realistic", base.control, base.friction))
    joint, motion = LockstepJoint(config), random_motion("point_to_point", 52077, 1, 30.0)
    constants = controller_constants(config, controller, joint.report.start_position_rad)
    run = run_scenario(joint, constants, "point_to_point", motion=motion)
    assert run.fault is Fault.NONE
    assert error_figures(run, 10.0).true_rmse_mrad < 0.1
