"""What each option of the law does to the motion, seen with and without it on the virtual joint."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from jointctl.firmware_py.states import Fault, Notice
from jointctl.tools.analysis.linear_loop import loop_settings
from jointctl.tools.analysis.margins import learning_convergence
from jointctl.tools.configuration.config import Config, Learning
from jointctl.tools.configuration.sections import Trajectory
from jointctl.tools.experiments.paper_experiments import ideal, law, r1
from jointctl.tools.experiments.scenarios import (
    Controller,
    Scenario,
    changed,
    controller_config,
    controller_constants,
    from_file,
    run_scenario,
)
from jointctl.tools.lockstep import LockstepJoint, LockstepRun
from tests.configurations import shipped


def joint(config: Config, duration_s: float, **virtual: Any) -> Config:
    """The joint with other true values, and a trajectory of this length."""
    true = {f"virtual__{key}": value for key, value in virtual.items()}
    return config.changed(trajectory__duration_s=duration_s, **true)


def run(config: Config, controller: Controller, scenario: Scenario = "sine") -> LockstepRun:
    there = LockstepJoint(config)
    made = run_scenario(there, controller_constants(config, controller, 0.0), scenario)
    assert made.fault is Fault.NONE
    return made


def tracked(made: LockstepRun) -> Any:
    return made.log[made.tracking]


# --- friction feed-forward ---
def test_feed_forward_on_the_desired_velocity_removes_the_spikes_of_stick_slip() -> None:
    config = joint(r1(), 40.0, friction_kind="stick_slip")
    measured = tracked(run(config, law("measured")))
    desired = tracked(run(config, law("desired", feed_forward="desired", zero_rule="zero")))
    late = measured.trajectory_s > 1.0  # the joint starts at rest: not what this is about
    assert np.max(np.abs(measured.command_torque_Nm[late])) == pytest.approx(60.0, abs=1.0)
    assert np.max(np.abs(measured.error_rad[late])) > 2.5e-3
    assert np.max(np.abs(desired.command_torque_Nm[late])) < 29.0
    assert np.max(np.abs(desired.error_rad[late])) < 1.1e-3


@pytest.mark.parametrize(("rule", "torque_Nm"), [("paper", 121.0 * 0.14537), ("zero", 0.0), ("linear", 0.0)])
def test_the_zero_speed_rule_decides_what_pushes_a_joint_at_rest(rule: str, torque_Nm: float) -> None:
    config = joint(ideal("stick_slip", 0.9, 0.9), 2.0)  # the model overestimates the friction
    controller = law(rule, zero_rule=rule, zero_band_radps=0.01)
    at_rest = tracked(run(config.changed(trajectory__amplitude_rad=0.0), controller))
    assert at_rest.friction_torque_Nm[0] == pytest.approx(torque_Nm)
    moved_rad = float(np.max(np.abs(at_rest.position_rad)))
    assert (moved_rad > 1e-5) == (rule == "paper")


# --- network ---
def test_leakage_stops_the_drift_of_narrow_neurons_under_noise() -> None:
    config = joint(r1(), 60.0, encoder_noise_counts=2.0)
    options = {"feed_forward": "desired", "zero_rule": "zero", "widths": 0.005}
    drifting = tracked(run(config, law("drifting", **options)))
    leaking = tracked(run(config, law("leaking", **options, leakage_1ps=0.1)))

    def growth_Nm(log: Any) -> float:
        """Of the largest weight, from 30 to 59 s."""
        largest = np.max(np.abs(log.weights), axis=1)
        return float(largest[log.trajectory_s > 59.0][0] - largest[log.trajectory_s > 30.0][0])

    assert growth_Nm(drifting) > 8.0
    assert abs(growth_Nm(leaking)) < 0.5


def test_in_the_dead_zone_the_weights_rest() -> None:
    config = joint(r1(), 20.0)
    for zone_rad, rests in ((0.0, False), (3e-4, True)):
        log = tracked(run(config, law("zone", dead_zone_rad=zone_rad)))
        steps_Nm = np.abs(np.diff(log.weights[:, 0]))
        inside = np.abs(log.error_rad[1:]) < 3e-4
        assert np.any(inside)
        assert np.any(~inside)
        assert (np.max(steps_Nm[inside]) == 0.0) == rests
        assert np.max(steps_Nm[~inside]) > 0.0


def test_projection_bounds_the_network_and_costs_what_it_keeps_back() -> None:
    config = joint(r1(), 20.0)
    free = tracked(run(config, law("free", feed_forward="none")))
    bounded = tracked(run(config, law("bounded", feed_forward="none", weight_limit_Nm=0.05)))
    assert np.max(np.abs(free.weights)) > 1.0
    assert np.max(np.abs(bounded.weights)) == pytest.approx(0.05)
    assert np.max(np.abs(bounded.network_torque_Nm)) <= 15 * 0.05
    late = free.trajectory_s > 5.0
    assert np.max(np.abs(bounded.error_rad[late])) > 4.0 * np.max(np.abs(free.error_rad[late]))


def test_the_matched_filter_removes_the_bias_that_the_network_learns_from_the_lag() -> None:
    config = joint(ideal("stick_slip"), 30.0)

    def bias_rad(matched: bool) -> float:
        """Mean true error of one stroke, away from the reversals."""
        made = run(config, law("x", feed_forward="desired", zero_rule="zero", filtered_error_rate=matched))
        stroke = (made.log.trajectory_s > 23.0) & (made.log.trajectory_s < 27.0) & made.tracking
        return float(abs(np.mean(made.true_error_rad[stroke])))

    assert bias_rad(False) > 1.5e-4
    assert bias_rad(True) < 1e-5


# --- observer and iterative learning ---
@pytest.mark.parametrize("scenario", ["frequency", "amplitude"])
def test_learning_starts_anew_without_a_jump_when_the_trajectory_changes(scenario: Scenario) -> None:
    log = tracked(run(r1(), from_file("precise"), scenario))
    change = int(np.argmax(log.trajectory_s > 82.4995))
    assert abs(log.learned_torque_Nm[change - 1]) > 0.5
    assert np.all(log.learned_torque_Nm[change : change + 5000] == 0.0)  # nothing of the old trajectory comes back
    together = log.learned_torque_Nm + log.observer_torque_Nm
    usual_Nm = np.max(np.abs(np.diff(together[change - 1000 : change])))
    assert abs(together[change] - together[change - 1]) <= usual_Nm
    usual_Nm = np.max(np.abs(np.diff(log.command_torque_Nm[change - 1000 : change])))
    assert abs(log.command_torque_Nm[change] - log.command_torque_Nm[change - 1]) <= usual_Nm


def test_learning_leaves_less_than_half_of_the_error_of_the_first_period() -> None:
    log = tracked(run(joint(r1(), 60.0), from_file("precise")))

    def rms_rad(from_s: float) -> float:
        period = (log.trajectory_s >= from_s) & (log.trajectory_s < from_s + 9.0)
        return float(np.sqrt(np.mean(log.error_rad[period] ** 2)))

    assert rms_rad(50.0) < 0.5 * rms_rad(1.0)


# gain, error gain [1/s^2], lead [cycles], half width [cycles]
_LEARNING = {
    "shipped": (0.4, 15000.0, 10, 5),
    "too greedy": (0.6, 60000.0, 10, 5),
    "lead too long": (0.6, 10000.0, 24, 5),
}


@pytest.mark.parametrize("name", list(_LEARNING))
def test_the_convergence_that_is_computed_is_the_one_that_is_seen(name: str) -> None:
    gain, error_gain, lead, half_width = _LEARNING[name]
    precise = from_file("precise")
    values = {"gain": gain, "error_gain_ps2": error_gain, "lead_cycles": lead, "half_width_cycles": half_width}
    learning = {**precise.control.learning.model_dump(), **values}
    controller = replace(precise, control=changed(precise.control, {"learning": learning}, name))
    config = joint(r1(), 100.0)
    settings, _ = loop_settings(controller_config(config, controller))
    computed = learning_convergence(settings, Learning(**values))
    there = LockstepJoint(config)
    made = run_scenario(there, controller_constants(config, controller, 0.0))
    error_rad = np.abs(made.log.error_rad[made.tracking])
    switched_off = bool(int(made.state.notices) & Notice.LEARNING_OFF)  # its error had grown in three repetitions
    diverged = switched_off or made.fault is not Fault.NONE or float(np.max(error_rad[-20_000:])) > 3e-4
    assert (computed.worst_factor > 1.0) == diverged == (name != "shipped")
    if name == "shipped":
        assert computed.worst_factor == pytest.approx(0.6, abs=0.01)  # 1 - gain, at low frequency
        assert computed.remaining_1_Hz < 0.01
        slow, _ = loop_settings(controller_config(config, controller), 3e-3)
        assert learning_convergence(slow, Learning(**values)).worst_factor < 1.0


@pytest.mark.parametrize(("side", "counts", "stable"), [("joint", 2**19, False), ("motor", 2**14, True)])
def test_with_a_soft_reducer_the_encoder_belongs_on_the_motor(side: str, counts: int, stable: bool) -> None:
    config = joint(r1(), 6.0, flexible=True, reducer_stiffness_Nmprad=1.3e4)
    config = config.changed(encoder__side=side, encoder__counts_per_turn=counts)
    made = run_scenario(LockstepJoint(config), controller_constants(config, from_file("precise"), 0.0))
    assert (made.fault is Fault.NONE) == stable
    if stable:
        assert np.max(np.abs(made.true_error_rad[made.tracking & (made.log.trajectory_s > 1.0)])) < 3e-4


def test_where_the_drive_closes_the_loop_the_friction_that_is_fed_forward_stays_at_rest() -> None:
    """The observer's torque is not sent there: what it would hand over at rest would have no end."""
    move = {"kind": "min_jerk", "start_rad": -0.2, "target_rad": 0.2, "move_s": 1.0, "duration_s": 6.0}
    config = shipped(
        "realistic", drive__mode="csp", drive__cascade=shipped("csp").drive.cascade,
        trajectory=TypeAdapter(Trajectory).validate_python(move),
    )  # fmt: skip
    made = LockstepJoint(config).run()
    log = made.log[made.tracking]
    friction_Nm = log.friction_torque_Nm[(log.trajectory_s > 1.05) & (log.trajectory_s < 6.0)]
    assert np.ptp(friction_Nm) == 0.0
    assert friction_Nm[0] > 10.0
