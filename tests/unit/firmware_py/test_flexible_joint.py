"""The law for a joint whose reducer is not rigid: feed-forward against the plant, feedback, and runs in lockstep."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.flexible_joint import (
    LARGEST_SHARE,
    Reading,
    SEEN_Hz,
    adapt_link_share,
    motor_and_link_errors,
    reset_flexible,
    see_motion,
    series_at,
    twist_of,
)
from jointctl.firmware_py.friction import reset_adaptation
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.law import reset_law, step_flexible_law
from jointctl.firmware_py.motion_records import Reference
from jointctl.firmware_py.observers import low_pass_gain
from jointctl.firmware_py.records import AdaptationState, FlexibleConstants, FlexibleState, LawConstants, LawState
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import ControllerKind, DriveState, Encoders, Fault, FeedForward
from jointctl.firmware_py.trajectory import NO_REPETITION, NO_TABLE
from jointctl.hil.plant import plant, spring_torque_Nm, step_plant
from jointctl.tools import lockstep
from jointctl.tools.configuration.canopen import canopen_settings
from jointctl.tools.configuration.config import Config, Learning
from jointctl.tools.configuration.load import load_config
from jointctl.tools.configuration.records import axis_constants, trajectory_table
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.session.live_changes import new_motion
from tests.configurations import shipped, written

RATIO = 121.0
JM, JL = 1.2, 0.9
SLOPES, KNEES_Nm = (1.6e4, 2.5e4, 2.9e4), (7.0, 25.0)
ERROR = ((1e-4, 4e-5), (2.0, 4.0), (0.3, -1.0))  # amplitudes, per motor turn, phases
RIPPLE = ((1.5, 0.5), (2.0, 10.0), (1.2, 0.1))


def fill_series(series: Any, amplitudes: Any, orders: Any, phases: Any) -> None:
    series.count = len(amplitudes)
    for i, (amplitude, order, phase) in enumerate(zip(amplitudes, orders, phases, strict=True)):
        series.amplitude[i] = amplitude
        series.turns_prad[i], series.phase_turns[i] = order * RATIO / math.tau, phase / math.tau


def flexible_law(**gains: float) -> tuple[Any, Any]:
    """Constants that are true of `flexible_plant`, and a state; the gains are zero unless given."""
    constants, state = new(LawConstants), new(LawState)
    law, flexible = constants[0], constants[0].flexible
    law.kind, law.feed_forward, law.period_s = ControllerKind.FLEXIBLE_JOINT, FeedForward.NONE, 50e-6
    law.inertia_kgm2, law.reduction_ratio, law.gravity_Nm = JM + JL, RATIO, 12.0
    law.kp, law.kv = gains.get("kp", 0.0), gains.get("kv", 0.0)
    law.observer.bandwidth_radps = gains.get("observer", 0.0)
    flexible.motor_inertia_kgm2, flexible.link_inertia_kgm2, flexible.following_Nm = JM, JL, 60.0
    compliance = flexible.compliance_radpNm = 1.0 / SLOPES[0]
    for i, (knee, slope) in enumerate(zip(KNEES_Nm, SLOPES[1:], strict=True)):
        flexible.knee_Nm[i], flexible.stiffening_radpNm[i] = knee, compliance - 1.0 / slope
        compliance = 1.0 / slope
    fill_series(flexible.kinematic_error, *ERROR)
    fill_series(flexible.torque_ripple, *RIPPLE)
    for velocity in (flexible.motor_velocity, flexible.link_velocity):
        velocity.period_s, velocity.cutoff_Hz = law.period_s, 300.0
        velocity.period_gain = low_pass_gain(300.0, law.period_s)
    reset_law(law, state[0])
    return constants, state


def flexible_plant(**settings: Any) -> tuple[Any, Any]:
    return plant(
        **{
            "flexible": True, "inertia_kgm2": JM + JL, "motor_side_inertia_kgm2": JM, "gravity_Nm": 12.0,
            "reducer_stiffness_Nmprad": SLOPES[0], "reducer_knees_Nm": KNEES_Nm,
            "reducer_stiffness_beyond_Nmprad": SLOPES[1:], "reducer_damping_Nmspr": 0.0,
            "kinematic_error_rad": ERROR[0], "kinematic_error_per_motor_turn": ERROR[1],
            "kinematic_error_phase_rad": ERROR[2], "torque_ripple_Nm": RIPPLE[0],
            "torque_ripple_per_motor_turn": RIPPLE[1], "torque_ripple_phase_rad": RIPPLE[2], **settings,
        }
    )  # fmt: skip


# --- the feed-forward ---
@pytest.mark.parametrize("torque_Nm", [-60.0, -25.001, -6.999, -1.0, 0.0, 3.0, 7.001, 16.0, 24.999, 60.0])
def test_the_twist_of_a_torque_is_the_inverse_of_the_spring(torque_Nm: float) -> None:
    (law, _), (c, _) = flexible_law(), flexible_plant()
    twist, compliance = twist_of(law[0].flexible, torque_Nm)
    assert spring_torque_Nm(c[0], twist) == pytest.approx(torque_Nm, abs=1e-9)
    a_little_more, _ = twist_of(law[0].flexible, torque_Nm + 1e-6)
    assert (a_little_more - twist) * 1e6 == pytest.approx(compliance, rel=1e-3)


def test_the_derivatives_of_a_series() -> None:
    law, _ = flexible_law()
    series = law[0].flexible.kinematic_error
    for angle in np.linspace(-0.5, 0.5, 41):
        value, slope, bend = series_at(series, angle)
        before, after = series_at(series, angle - 1e-6), series_at(series, angle + 1e-6)
        expected = sum(a * math.sin(order * RATIO * angle + phase) for a, order, phase in zip(*ERROR, strict=True))
        assert value == pytest.approx(expected, abs=1e-14)
        assert slope == pytest.approx((after[0] - before[0]) / 2e-6, abs=1e-6)
        assert bend == pytest.approx((after[1] - before[1]) / 2e-6, abs=1e-3)


@kernel
def follow(law_c, law_s, plant_c, plant_s, reference, amplitude_rad, omega_radps, snap_share, errors, late):
    """The feed-forward alone, at every substep of the plant, on a sine that begins at its crest.

    Its torques wait in `late` (N,), and begin with the first one: the motion begins at rest.
    """
    for k in range(len(errors)):
        phase = omega_radps * k * plant_c.step_s
        reference.position_rad = amplitude_rad * math.cos(phase)
        reference.velocity_radps = -amplitude_rad * omega_radps * math.sin(phase)
        reference.acceleration_radps2 = -amplitude_rad * omega_radps**2 * math.cos(phase)
        reference.jerk_radps3 = amplitude_rad * omega_radps**3 * math.sin(phase)
        reference.snap_radps4 = snap_share * amplitude_rad * omega_radps**4 * math.cos(phase)
        reading = Reading(plant_s.joint_position_rad, plant_s.motor_position_rad, 1)
        torque = step_flexible_law(law_c, law_s, reading, reference, 0.0, NO_REPETITION)
        if k == 0:
            plant_s.joint_position_rad = reference.position_rad
            plant_s.motor_position_rad = law_s.flexible.target_rad
            for i in range(len(late)):
                late[i] = torque
        errors[k, 0] = plant_s.joint_position_rad - reference.position_rad
        errors[k, 1] = plant_s.motor_position_rad - law_s.flexible.target_rad
        if len(late) > 0:
            late[k % len(late)], torque = torque, late[k % len(late)]
        step_plant(plant_c, plant_s, torque)


def astray_rad(
    law: Any, state: Any, amplitude_rad: float = 0.3, frequency_Hz: float = 0.7, snap_share: float = 1.0, late: int = 0
) -> float:
    """How far motor or link get from where they should be in half a second; `late`: steps by which the torque is."""
    c, s = flexible_plant()
    errors = np.zeros((round(0.5 / 50e-6), 2))
    motion = amplitude_rad, math.tau * frequency_Hz, snap_share
    follow(law[0], state[0], c[0], s[0], new(Reference)[0], *motion, errors, np.zeros(late))
    return float(np.max(np.abs(errors)))


@pytest.mark.parametrize("frequency_Hz", [0.2, 0.7])
def test_the_feed_forward_alone_moves_the_link_as_desired(frequency_Hz: float) -> None:
    """Nothing damps here: an error of sign or of size in any of the terms would ring on."""
    # the twist is up to 1 mrad here, the kinematic error 0.14 mrad
    assert astray_rad(*flexible_law(), frequency_Hz=frequency_Hz) < 3e-5


@pytest.mark.parametrize(
    "left_out", ["link_inertia_kgm2", "compliance_radpNm", "kinematic_error", "torque_ripple", "gravity_Nm"]
)
def test_each_term_of_the_feed_forward_is_needed(left_out: str) -> None:
    law, state = flexible_law()
    flexible = law[0].flexible
    if left_out in ("kinematic_error", "torque_ripple"):
        flexible[left_out].count = 0
    elif left_out == "gravity_Nm":
        law[0].gravity_Nm = 0.0
    else:
        flexible[left_out] = 0.0
    assert astray_rad(law, state) > 6e-5


def test_a_quick_motion_needs_its_fourth_derivative() -> None:
    found = [astray_rad(*flexible_law(), 0.05, 3.0, snap_share) for snap_share in (1.0, 0.0)]
    assert found[0] < 0.3 * found[1]


def test_the_feed_forward_leads_by_as_much_as_the_torque_is_late() -> None:
    """Torsion and kinematic error included; what the readings are compared with does not lead."""
    late_steps, found = 24, []
    for lead_s in (late_steps * 50e-6, 0.0):
        law, state = flexible_law()
        law[0].feed_forward_lead_s = lead_s
        found.append(astray_rad(law, state, late=late_steps))
    assert found[0] < 0.2 * found[1]


@pytest.mark.parametrize("following_Nm", [0.0, 5.0, 60.0])
def test_no_more_torque_than_is_set_goes_into_the_kinematic_error(following_Nm: float) -> None:
    (law, state), reference, torques = flexible_law(), new(Reference)[0], []
    law[0].flexible.following_Nm, law[0].gravity_Nm, law[0].flexible.torque_ripple.count = following_Nm, 0.0, 0
    reference.velocity_radps = 1.5
    for k in range(400):
        reference.position_rad = 1.5 * k * 50e-6
        reading = Reading(reference.position_rad, reference.position_rad, 1)
        torques.append(step_flexible_law(law[0], state[0], reading, reference, 0.0, NO_REPETITION))
    # both sines at 1.5 rad/s: 1.2 kg m^2 times 1e-4 rad (363 rad/s)^2, and 4e-5 rad (726 rad/s)^2
    assert np.max(np.abs(torques)) == pytest.approx(min(following_Nm, 15.8 + 25.3), rel=0.15, abs=1e-9)


# --- the errors ---
def errors_of(encoders: Encoders) -> tuple[Any, Any]:
    constants, state = new(FlexibleConstants)[0], new(FlexibleState)[0]
    constants.encoders, constants.twist_gain = encoders, 0.1
    for velocity in (constants.motor_velocity, constants.link_velocity):
        velocity.period_s, velocity.period_gain = 1e-3, 1.0
    reset_flexible(state)
    state.target_rad = 0.5005
    return constants, state


@pytest.mark.parametrize(
    ("encoders", "reading", "expected"),
    [
        (Encoders.BOTH, Reading(0.501, 0.503, 1), (0.0025, 0.001)),
        (Encoders.MOTOR, Reading(0.503, 99.0, 1), (0.0025, 0.0025)),
        (Encoders.LINK, Reading(0.501, 99.0, 1), (0.001, 0.001)),
    ],
)
def test_which_encoder_is_compared_with_what(encoders: Encoders, reading: Reading, expected: tuple[float, ...]) -> None:
    constants, state = errors_of(encoders)
    assert motor_and_link_errors(constants, state, reading, 0.5) == pytest.approx(expected, abs=1e-12)
    assert state.twist_error_rad == pytest.approx(expected[1] - expected[0], abs=1e-12)  # no jump at the start


def test_the_expected_twist_is_corrected_slowly_towards_what_is_seen() -> None:
    constants, state = errors_of(Encoders.BOTH)
    motor_and_link_errors(constants, state, Reading(0.5, 0.5005, 1), 0.5)
    for cycle in range(1, 60):
        motor_and_link_errors(constants, state, Reading(0.5, 0.5015, 1), 0.5)  # the motor is 1 mrad further ahead
        assert state.twist_error_rad == pytest.approx(-1e-3 * (1.0 - 0.9**cycle), rel=1e-9)


def test_a_lost_sample_is_no_motion_and_a_gap_is_counted() -> None:
    constants, state = errors_of(Encoders.BOTH)
    motor_and_link_errors(constants, state, Reading(0.5, 0.5005, 1), 0.5)
    motor_and_link_errors(constants, state, Reading(0.501, 0.5015, 1), 0.5)
    assert state.motor_velocity.error_rate_radps == pytest.approx(1.0)
    motor_and_link_errors(constants, state, Reading(0.502, 0.5025, 0), 0.5)
    assert state.motor_velocity.error_rate_radps == pytest.approx(1.0)
    motor_and_link_errors(constants, state, Reading(0.505, 0.5055, 2), 0.5)
    assert state.motor_velocity.error_rate_radps == pytest.approx(2.0)


# --- runs in lockstep ---
def link_error_mrad(config: Config, after_s: float) -> np.ndarray:
    """Of the link itself, in the trajectory."""
    run = LockstepJoint(config).run()
    assert run.fault is Fault.NONE
    late = run.tracking & (run.log.trajectory_s >= after_s)
    error: np.ndarray = run.true_error_rad[late] * 1e3
    return error


def rmse(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


def realistic(**changes: Any) -> Config:
    return shipped("realistic", **{"trajectory__duration_s": 20.0, **changes})


def test_the_realistic_joint_is_tracked_where_its_link_is() -> None:
    error = link_error_mrad(realistic(), 5.0)
    assert rmse(error) < 0.05
    assert np.max(np.abs(error)) < 0.3


def test_what_maps_and_the_second_encoder_buy() -> None:
    """The last is the law for a rigid joint on the motor's encoder."""
    whole = realistic()
    assert whole.reducer is not None
    without_maps = realistic(reducer__map=None)
    motor = {"joint_encoder": whole.joint_encoder.model_copy(update={"law": "encoder"})}
    rigid = shipped("precise", control__learning=None).control
    found = [
        rmse(link_error_mrad(config, 5.0))
        for config in (whole, realistic(**motor), without_maps, realistic(**motor, control=rigid))
    ]
    assert found == sorted(found)
    assert found[1] > 1.2 * found[0]
    assert found[2] > 4.0 * found[0]
    assert found[3] > 5.0 * found[0]


def test_learning_takes_out_what_repeats() -> None:
    learning = Learning(gain=0.6, error_gain_ps2=300.0, lead_cycles=10, half_width_cycles=10)
    config = realistic(trajectory__duration_s=60.0, control__learning=learning)
    error = link_error_mrad(config, 40.0)
    assert rmse(error) < 0.02


def test_a_trapezoid_is_rounded_by_as_much_as_the_reducer_needs(tmp_path: Any) -> None:
    """One that jumps kicked the observer of this joint by 72 Nm, of its 60, and swung by 1.9 mrad."""
    motion = {"kind": "trapezoid", "duration_s": 6.0, "start_rad": 0.0, "target_rad": 0.05, "speed_radps": 0.8}
    motion |= {"acceleration_radps2": 8.0, "dwell_s": 0.2, "repeat": True}
    config = load_config(written(tmp_path / "joint.toml", "realistic", trajectory=motion))
    run = LockstepJoint(config).run()
    assert run.fault is Fault.NONE
    assert np.max(np.abs(run.log.observer_torque_Nm[run.tracking])) < 8.0
    assert np.max(np.abs(run.true_error_rad[run.tracking])) < 0.5e-3


def test_over_which_time_the_acceleration_of_a_trapezoid_changes(tmp_path: Any) -> None:
    motion = {"kind": "trapezoid", "duration_s": 6.0, "start_rad": 0.0, "target_rad": 0.05, "speed_radps": 0.8}

    def rounding_s(name: str, **changes: Any) -> float:
        chosen: dict[str, Any] = {"trajectory": motion | {"acceleration_radps2": 8.0, **changes}}
        config = load_config(written(tmp_path / "joint.toml", name, **chosen))
        return float(axis_constants(config, NO_TABLE)[0].trajectory.rounding_s)

    reducer = shipped("realistic").reducer
    assert reducer is not None
    link_kgm2 = 1.4 * (shipped("realistic").joint.inertia_kgm2 - reducer.motor_inertia_kgm2)
    assert rounding_s("precise") == 0.0  # rigid: it jumps
    assert rounding_s("realistic") == pytest.approx(math.tau * math.sqrt(link_kgm2 / reducer.stiffness_Nmprad))
    for name in ("precise", "realistic"):
        assert rounding_s(name, jerk_radps3=80.0) == pytest.approx(0.1)
        assert rounding_s(name, jerk_radps3=1e9) == pytest.approx(0.01)  # ten cycles


def test_a_load_on_the_link_is_held_where_the_link_is_and_the_rigid_law_on_the_motor_does_not_see_it() -> None:
    whole = realistic(virtual__load_step_Nm=3.0, virtual__load_step_at_s=6.0)
    error = link_error_mrad(whole, 8.0)
    assert rmse(error) < 0.06
    rigid = shipped("precise", control__learning=None).control
    other = whole.changed(joint_encoder__law="encoder", control=rigid)
    assert abs(np.mean(link_error_mrad(other, 8.0))) > 0.12  # 3 Nm on 1.6e4 Nm/rad and more


def test_a_run_repeats_bit_by_bit() -> None:
    config = realistic(trajectory__duration_s=2.0, virtual__initial_position_rad=0.3)
    first, second = (LockstepJoint(config).run().log for _ in range(2))
    assert first.tobytes() == second.tobytes()


# --- bad input ---
@pytest.mark.parametrize(
    ("believed", "moves"),
    [
        ({}, True),
        ({"joint_encoder__direction": -1}, False),  # the sign of one
        ({"encoder__counts_per_turn": 131072}, False),  # the ratio of one
        ({"encoder__counts_per_turn": 524288, "joint_encoder__counts_per_turn": 65536}, False),  # plugs swapped
    ],
)
def test_encoders_that_are_not_those_of_the_file_are_found_before_motion(
    monkeypatch: pytest.MonkeyPatch, believed: dict[str, Any], moves: bool
) -> None:
    true = realistic(trajectory__duration_s=0.5, virtual__initial_position_rad=0.1)
    monkeypatch.setattr(lockstep, "canopen_settings", lambda _: canopen_settings(true.changed(**believed)))
    run = LockstepJoint(true).run()
    assert (run.fault is Fault.NONE) is moves
    enabled = bool(np.any(run.log.drive_state == DriveState.ENABLED))
    assert enabled is moves
    if not moves:
        assert run.fault is Fault.POSITION_DISAGREEMENT


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reducer": None}, "[reducer] is missing: control.kind (=flexible_joint) needs it"),
        ({"reducer__motor_inertia_kgm2": None}, "reducer.motor_inertia_kgm2 is missing"),
        ({"reducer__motor_inertia_kgm2": 2.1}, "reducer.motor_inertia_kgm2 (=2.1) must be less than joint.inertia"),
        ({"reducer__motor_inertia_kgm2": 6.5e-5}, "(=6.5e-05) must be at least 0.0021, 0.001 of joint.inertia_kgm2"),
        ({"reducer__stiffness_Nmprad": 297.0}, "(=[26000.0, 31000.0]) must be at most 2970, 10 times reducer.stiff"),
        ({"reducer__knees_Nm": [25.0, 7.0]}, "reducer.knees_Nm (=[25.0, 7.0]) must be at most 2 torques in ascending"),
        ({"reducer__stiffness_beyond_Nmprad": [1e4]}, "reducer.stiffness_beyond_Nmprad (=[10000.0]) must be 2"),
        ({"reducer__stiffness_Nmprad": 3e4}, "reducer.stiffness_beyond_Nmprad (=[26000.0, 31000.0]) must rise from"),
        ({"reducer__loop_stiffness_Nmprad": 2.6e7}, "reducer.loop_stiffness_Nmprad (=2.6e+07) must be at most 310000"),
        ({"reducer__damping_Nmspr": 8000.0}, "reducer.damping_Nmspr (=8000) must be at most 233.7, the critical one"),
        ({"joint_encoder__stiffness_Nmprad": 10.0}, "joint_encoder.stiffness_Nmprad (=10) must be in [1700..310000]"),
        ({"joint_encoder__stiffness_Nmprad": 1e7}, "joint_encoder.stiffness_Nmprad (=1e+07) must be in [1700..310000]"),
        ({"reducer__map__direction": -1}, "reducer.map.direction (=-1) differs from encoder.direction (=1): the map"),
        ({"reducer__map__zero_counts": 7}, "reducer.map.zero_counts (=7) differs from encoder.zero_counts (=0): the"),
        ({"reducer__map__torque_ripple_Nm": [1.0]}, "reducer.map.torque_ripple_Nm must be as long a list as its"),
        ({"reducer__map__kinematic_error_rad": [0.0019, 5e-4]}, "so small that the link never turns against the motor"),
        ({"reducer__map__kinematic_error_rad": [-2.0, -4.0]}, "following_error_max_rad (=0.1) must be more than 6.002"),
        ({"reducer__map__torque_ripple_Nm": [1030.0, -0.3]}, "torque_ripple_Nm (=[1030.0, -0.3]) must be less"),
        ({"reducer__knees_Nm": [7.0, 25.0, 60.0]}, "reducer.knees_Nm (=[7.0, 25.0, 60.0]) must be a list of up to 2 n"),
        ({"encoder__side": "joint"}, "are the two encoders swapped?"),
        ({"control__feed_forward": "measured"}, "control.feed_forward (=measured) must be none, desired or lugre"),
        ({"control__filtered_error_rate": False}, "control.filtered_error_rate (=false) must be true for control.kind"),
        ({"control__observer_radps": 0.0}, "control.observer_radps (=0) must be more than 0 with control.kind"),
        ({"limits__following_error_max_rad": 0.002}, "by which the reducer twists at limits.torque_max_Nm"),
        ({"limits__position_max_rad": 0.351}, "limits.position_max_rad (=0.351) must leave room for the motor"),
        ({"margin__payload_range": [1.1, 1.4]}, "(=[1.1, 1.4]) must be two factors in ascending order with 1"),
        ({"margin__payload_range": [1.4, 0.7]}, "(=[1.4, 0.7]) must be two factors in ascending order with 1"),
    ],
)  # fmt: skip
def test_bad_input_is_one_clear_line(tmp_path: Any, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        load_config(written(tmp_path / "joint.toml", "realistic", **changes))
    lines = caught.value.message.splitlines()
    assert [line for line in lines if message in line], lines


def test_what_is_just_inside_is_accepted(tmp_path: Any) -> None:
    changes = {"limits__following_error_max_rad": 0.003, "limits__position_max_rad": 0.3535}
    load_config(written(tmp_path / "joint.toml", "realistic", **changes))
    changes = {"reducer__loop_stiffness_Nmprad": 3e5, "joint_encoder__stiffness_Nmprad": 1800.0}
    load_config(written(tmp_path / "joint.toml", "realistic", **changes))
    load_config(written(tmp_path / "joint.toml", "realistic", reducer__damping_Nmspr=232.0))
    changes = {"reducer__motor_inertia_kgm2": 0.0022, "reducer__damping_Nmspr": 0.0}
    load_config(written(tmp_path / "joint.toml", "realistic", **changes))
    load_config(written(tmp_path / "joint.toml", "realistic", reducer__stiffness_Nmprad=3101.0))
    changes = {"reducer__map__kinematic_error_rad": [0.0015, 2e-4], "reducer__map__torque_ripple_Nm": [59.0, -0.9]}
    load_config(written(tmp_path / "joint.toml", "realistic", **changes))


def test_a_table_and_a_motion_of_a_program_leave_room_for_the_motor_too(tmp_path: Any) -> None:
    def with_top(top_rad: float) -> Config:
        rows = [f"{time_s},{top_rad if time_s == 2 else 0.0}" for time_s in range(5)]
        (tmp_path / "motion.csv").write_text("\n".join(["time_s,position_rad", *rows, ""]))
        motion = {"kind": "table", "duration_s": 4.0, "file": "motion.csv"}
        return load_config(written(tmp_path / "joint.toml", "realistic", trajectory=motion))

    words = r"limits.position_max_rad \(=0.7\) must leave room for the motor, .*: 0.70197 is reached"
    config = with_top(0.6995)
    with pytest.raises(ConfigurationError, match=words):
        trajectory_table(config)
    move = {"kind": "min_jerk", "duration_s": 2.0, "start_rad": 0.0, "target_rad": 0.6995, "move_s": 2.0}
    with pytest.raises(ConfigurationError, match=words):
        new_motion(config, np.zeros((1, 5)), move)
    new_motion(
        config, np.zeros((1, 5)), move | {"start_rad": 0.6995, "target_rad": 0.0}
    )  # from where it stands already
    trajectory_table(with_top(0.697))
    new_motion(config, np.zeros((1, 5)), move | {"target_rad": 0.697})


def adapting() -> tuple[Any, Any]:
    constants = flexible_law()[0]
    law = constants[0]
    law.period_s = 1e-3
    seen = law.adaptation.seen
    seen.period_s, seen.cutoff_Hz, seen.period_gain = 1e-3, SEEN_Hz, low_pass_gain(SEEN_Hz, 1e-3)
    state = new(AdaptationState)
    reset_adaptation(law.adaptation, state[0], 0.12)
    return law, state[0]


@pytest.mark.parametrize("every", [1, 3])
def test_the_observer_of_adaptation_finds_a_torque_with_and_without_each_sample(every: int) -> None:
    """Both masses are driven off by 3 Nm, and the feedback holds against 1 Nm of it."""
    law, state = adapting()
    for k in range(400):
        time_s = 1e-3 * k
        error_rad = -0.5 * (3.0 - 1.0) / (JM + JL) * time_s * time_s
        see_motion(law, state, 1.0, error_rad, error_rad, every if k % every == 0 else 0)
    assert state.seen_disturbance_Nm == pytest.approx(3.0, abs=0.1 * every)


def learn_share(law: Any, state: Any, true: float, offset_rad: float, noise_rad: float = 0.0) -> None:
    """Reversals for 20 s, of which the regression sees every tenth millisecond; what is used comes after at 5 rad/s."""
    random = np.random.default_rng(3)
    for k in range(2000):
        twist_rad = 1e-3 * math.tanh(5.0 * math.sin(0.08 * k))
        apart_rad = (state.used_link_share - true) * twist_rad + offset_rad + noise_rad * random.standard_normal()
        adapt_link_share(law.flexible, state, twist_rad, apart_rad)
        state.used_link_share += 0.05 * (state.link_share - state.used_link_share)


@pytest.mark.parametrize("true", [0.02, 0.12, 0.3])
@pytest.mark.parametrize("offset_rad", [-3e-4, 3e-4])
def test_the_share_of_the_link_is_found_beside_an_offset(true: float, offset_rad: float) -> None:
    law, state = adapting()
    learn_share(law, state, true, offset_rad, 1e-4)
    assert state.link_share == pytest.approx(true, abs=0.01)
    assert state.twist_offset_rad == pytest.approx(offset_rad, abs=5e-5)


def test_the_share_of_the_link_stays_within_its_bounds() -> None:
    for true, bound in ((-5.0, 0.0), (5.0, LARGEST_SHARE)):
        law, state = adapting()
        learn_share(law, state, true, 0.0)
        assert state.link_share == bound
        assert np.all(np.isfinite(state.twist_covariance))


def test_a_share_that_is_configured_above_its_bound_stays() -> None:
    law, state = adapting()
    law.flexible.link_friction_share = 0.6
    reset_adaptation(law.adaptation, state, 0.6)
    learn_share(law, state, 0.6, 0.0)
    assert state.link_share == pytest.approx(0.6, abs=1e-6)


def test_encoders_that_are_apart_from_the_start_tell_no_share() -> None:
    """Of 3 mrad, that no friction made, the first reading is the offset."""
    law, state = adapting()
    see_motion(law, state, 0.0, 0.0, 3e-3, 1)
    for k in range(200):
        adapt_link_share(law.flexible, state, 1e-3, 3e-3)
        assert state.link_share == pytest.approx(0.12, abs=1e-9), k
