"""From a finger to a base joint: what is derived from a joint suits its torque, inertia, speed, travel and encoder."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy import signal

from jointctl.drivers.errors import ConfigurationError, UsageError
from jointctl.firmware_py.states import Fault
from jointctl.tools.analysis.gains import BELIEVED, choose_gains
from jointctl.tools.analysis.linear_loop import loop_settings
from jointctl.tools.analysis.margin_gate import refuse_chatter
from jointctl.tools.configuration.config import Adaptation, Config
from jointctl.tools.configuration.conversions import static_friction_Nm, turning_of, velocity_of_a_step_1ps
from jointctl.tools.configuration.records import axis_constants
from jointctl.tools.experiments.controller_study import EnsembleSettings, StudySettings, random_plant, sized
from jointctl.tools.experiments.scenarios import controller_config, named
from jointctl.tools.inspection.health import PROBLEM
from jointctl.tools.inspection.motion_check import PEAK, TRAVEL_rad, config_of_check, make_plan
from jointctl.tools.sweeping.excitation import designed
from jointctl.tools.sweeping.options import SweepOptions
from jointctl.tools.sweeping.plan import make_plan as sweep_plan
from jointctl.tools.tuning.carry_out import response_task
from jointctl.tools.tuning.frequency_response import (
    VELOCITY_SHARE,
    LARGEST_radps2,
    USUAL_SPEED_radps,
    config_of_response,
    largest_peak_Nm,
    legs_of,
    speed_and_period,
)
from jointctl.tools.tuning.presliding import presliding_motion
from jointctl.tools.verbs.map import MapOptions, config_of_map
from jointctl.tools.verbs.response import AS_IT_FITS
from jointctl.tools.verbs.study import size_warnings
from jointctl.tools.virtual_joint import device_settings, new_device
from tests.configurations import shipped, written
from tests.joint_sizes import SIZES, Size, joint, own_loop_joint
from tests.unit.inspection.test_motion_check import checked

each_size = pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)


@pytest.mark.parametrize("believed", [0.5, 1.0, 1.4])
@each_size
def test_the_check_of_the_direction_finds_direction_and_friction(size: Size, believed: float) -> None:
    """A heavy joint is still hardly in motion when the spring pulls with twice its friction; its inertia is a guess."""
    config = joint(size._replace(inertia_kgm2=believed * size.inertia_kgm2), virtual__inertia_scale=1.0 / believed)
    found, records, fault = checked(config)
    assert fault is Fault.NONE
    assert not [finding.text for finding in found.values() if finding.status == PROBLEM]
    assert 0.85 < found["friction"].numbers["break_away_Nm"] / size.friction_Nm < 1.2
    assert np.max(np.abs(records.velocity_radps)) < size.speed_radps
    assert np.max(np.abs(records.command_torque_Nm)) <= make_plan(config, None).torque_Nm * (1.0 + 1e-9)


@each_size
def test_the_reference_of_that_check_is_within_half_of_its_velocity_limit(size: Size) -> None:
    config = joint(size)
    plan = make_plan(config, None)
    assert plan.velocity_radps <= size.speed_radps
    assert PEAK * plan.travel_rad / plan.ramp_s <= 0.5 * plan.velocity_radps * (1.0 + 1e-9)
    assert config_of_check(config, plan).limits.torque_max_Nm == plan.torque_Nm <= size.torque_Nm
    assert plan.travel_rad >= TRAVEL_rad


@each_size
def test_the_motions_that_measure_friction_fit(size: Size) -> None:
    config = joint(size)
    plan = sweep_plan(config, SweepOptions(quick=True, lockstep=True))
    motion = plan.motion(plan.points, 0.0)
    assert len(plan.points) >= 24
    assert motion.high_rad - motion.low_rad <= plan.settings.width_rad + 1e-9
    assert max(abs(point.velocity_radps) for point in plan.points) <= 0.9 * size.speed_radps
    design = designed(config, 20.0, 1)
    assert np.max(np.abs(design.torque_Nm)) <= 0.8 * size.torque_Nm


def test_a_motion_under_much_gravity_takes_half_of_what_it_and_friction_leave() -> None:
    """Gravity and friction alone are more than 0.8 of the torque: no brake_radps2 made it fit."""
    size = SIZES["loaded base"]
    design = designed(joint(size, joint__gravity_zero_rad=-1.57), 20.0, 1)
    assert np.max(np.abs(design.torque_Nm)) <= 0.5 * (size.torque_Nm + size.friction_Nm + size.gravity_Nm)
    overloaded = joint(size, joint__gravity_zero_rad=-1.57, joint__gravity_Nm=290.0)
    with pytest.raises(UsageError) as error:
        designed(overloaded, 20.0, 1)
    assert "a greater limits.torque_max_Nm" in error.value.hint


@each_size
def test_the_response_slides_and_is_excited_within_speed_and_torque(size: Size) -> None:
    config = config_of_response(joint(size), None)
    speed, _ = speed_and_period(config)
    assert 0.01 <= speed <= VELOCITY_SHARE * size.speed_radps
    peak_Nm = largest_peak_Nm(config)
    assert 0.0 < peak_Nm <= 0.15 * size.torque_Nm
    assert peak_Nm / size.inertia_kgm2 <= LARGEST_radps2 * min(speed / USUAL_SPEED_radps, 1.0) * (1.0 + 1e-9)


@pytest.mark.parametrize(
    ("name", "speed_radps"), [("finger", 0.03), ("wrist", 0.03), ("base", 0.03), ("slow base", 0.025)]
)
def test_a_map_is_as_slow_as_the_joint(name: str, speed_radps: float) -> None:
    motion = config_of_map(joint(SIZES[name]), MapOptions()).trajectory
    assert motion.kind == "trapezoid"
    assert motion.speed_radps == speed_radps


@pytest.mark.parametrize("name", ["short finger", "short elbow", "direct drive"])
def test_a_joint_that_cannot_turn_its_motor_four_times_has_no_map(name: str) -> None:
    with pytest.raises(UsageError, match=r"position_min_rad and position_max_rad leave .* takes .* 4 motor turns"):
        config_of_map(joint(SIZES[name]), MapOptions())


def test_a_map_in_another_mode_is_refused_for_the_mode_before_the_range() -> None:
    with pytest.raises(ConfigurationError, match=r"drive.mode \(=csv\) must be cst, tq or auto"):
        config_of_map(own_loop_joint(SIZES["direct drive"], "csv"), MapOptions())


@pytest.mark.parametrize(("name", "stiff"), [("base", True), ("loaded base", True), ("short elbow", False)])
def test_the_spring_that_measures_bristles_is_quick_enough_for_a_heavy_joint(name: str, stiff: bool) -> None:
    motion = presliding_motion(joint(SIZES[name]))
    assert motion is not None
    assert motion.config.control.kp >= 36.0 * (1.0 - 1e-9)
    assert (motion.stretch_rad < 0.04) is stiff


def test_an_encoder_that_is_coarse_for_that_spring_measures_no_bristles() -> None:
    assert presliding_motion(joint(SIZES["loaded base"]._replace(bits=12))) is None


def test_the_gains_leave_the_torque_that_friction_and_gravity_need() -> None:
    """Otherwise the next motion of a tune is refused, since one count of the encoder reaches the limit."""
    config = joint(SIZES["wrist"], margin__loop_delay_s=1e-3)
    chosen = choose_gains(config, BELIEVED)
    assert chosen.missed == {}
    tuned = config.changed(control=chosen.control)
    refuse_chatter(tuned, loop_settings(tuned)[0])
    left_Nm = 5.0 - 4.0 - (static_friction_Nm(config) or 0.0)
    assert chosen.best.step_Nm < left_Nm


@pytest.mark.parametrize("rate_Hz", [250.0, 500.0, 1000.0, 2000.0])
def test_learning_leads_by_as_long_at_any_rate(rate_Hz: float) -> None:
    config = joint(SIZES["loaded base"]._replace(rate_Hz=rate_Hz), margin__loop_delay_s=1.0 / rate_Hz)
    learning = choose_gains(config, BELIEVED, "precise").control.learning
    assert learning is None or learning.lead_cycles / rate_Hz == pytest.approx(0.01, abs=0.5 / rate_Hz)


@pytest.mark.parametrize(("gravity_Nm", "auto_radps2"), [(0.0, 2.5), (210.0, 0.75)])
def test_set_points_accelerate_by_half_of_what_gravity_leaves(gravity_Nm: float, auto_radps2: float) -> None:
    """More is asked of a joint that holds its load than it has to brake with."""
    record = axis_constants(joint(SIZES["loaded base"]._replace(gravity_Nm=gravity_Nm)), np.zeros((1, 5)))[0]
    assert record.stream.acceleration_max_radps2 == pytest.approx(auto_radps2)


@pytest.mark.parametrize(
    ("friction_Nm", "noise_Nm"), [(0.05, 0.2), (1.2726, 5.0), (7.6, 5.0), (19.0575, 5.0), (100.0, 20.0)]
)
def test_the_adaptation_believes_no_more_noise_than_the_friction_can_make(friction_Nm: float, noise_Nm: float) -> None:
    config = joint(SIZES["base"]._replace(friction_Nm=friction_Nm), control__adaptation=Adaptation())
    record = axis_constants(config, np.zeros((1, 5)))[0].law.adaptation
    assert record.noise_Nm == pytest.approx(noise_Nm)


@pytest.mark.parametrize(("given_Nm", "expected_Nm"), [("auto", 0.0035), (0.01, 0.01)])
def test_the_ripple_that_is_expected_is_a_share_of_the_torque(given_Nm: Any, expected_Nm: float) -> None:
    adaptation = Adaptation(ripple_per_motor_turn=(2.0,), ripple_Nm=given_Nm)
    record = axis_constants(joint(SIZES["finger"], control__adaptation=adaptation), np.zeros((1, 5)))[0].law.adaptation
    assert record.ripple_Nm == pytest.approx(expected_Nm)
    assert record.ripple_max_Nm == pytest.approx(4.0 * expected_Nm)


@pytest.mark.parametrize(("name", "factor"), [("base", 1.0), ("short elbow", 1.0), ("short finger", 50.0 / 15.0)])
def test_a_virtual_drive_holds_its_speed_against_the_friction_of_its_joint(name: str, factor: float) -> None:
    size = SIZES[name]
    expected = 200.0 * size.inertia_kgm2 / 2.1 * factor
    assert device_settings(joint(size)).velocity_gain_Nmspr == pytest.approx(expected)


@pytest.mark.parametrize(("bits", "share"), [(19, 0.9), (12, 0.68)])
def test_a_coarse_encoder_reads_no_plateau_beyond_the_limit(bits: int, share: float) -> None:
    config = shipped("precise", encoder__counts_per_turn=2**bits, loop__rate_Hz=250.0, control__velocity_cutoff_Hz=70.0)
    with pytest.raises(
        UsageError, match=rf"--max-speed \(=0.95\) must be at most .* {share:.0%} of limits.velocity_max"
    ):
        sweep_plan(config, SweepOptions(max_speed_radps=0.95))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (None, []),
        ("finger", ["finger.toml is of a joint of 0.0002 kg m2, and the plants are joints of 2.1 kg m2: --base"]),
        ("base", ["base.toml is of a joint of 300 kg m2"]),
        ("short elbow", []),
    ],
)
def test_a_study_says_whose_joint_its_plants_are(tmp_path: Path, name: str | None, words: list[str]) -> None:
    """A finger's law on joints of 60 Nm ended every run as a fault, and nothing said why."""
    controllers = ["precise"]
    if name is not None:
        size = SIZES[name]
        changes = {"joint__inertia_kgm2": size.inertia_kgm2}
        controllers.append(str(written(tmp_path / f"{name.replace(' ', '_')}.toml", "precise", **changes)))
    said = size_warnings(shipped("precise"), StudySettings(controllers=tuple(controllers)))
    assert len(said) == len(words)
    assert all(word in line for word, line in zip(words, said, strict=True))


@pytest.mark.parametrize("name", ["finger", "wrist", "direct drive", "base"])
def test_the_plants_of_a_study_are_of_the_size_of_its_base(name: str) -> None:
    """A finger's had bristles of 60 Nm, which no step of its simulation bears, and as much torque ripple as torque."""
    size = SIZES[name]
    base = joint(size)
    for index in range(5):
        plant = random_plant(base, EnsembleSettings(stick_slip_share=0.0), 4711, index)
        assert plant.virtual is not None
        assert 0.0 < max(plant.virtual.torque_ripple_Nm) <= 0.025 * size.torque_Nm
        assert 500.0 <= plant.virtual.bristle_stiffness_Nmprad / size.torque_Nm <= 4200.0
        assert new_device(plant)


def test_a_study_says_that_a_shipped_file_is_of_another_joint_too() -> None:
    """csp brings gains for 2.1 kg m2 in [drive.cascade]: every run on a wrist was a fault."""
    wrist = own_loop_joint(SIZES["wrist"], "csp")
    (line,) = size_warnings(wrist, StudySettings(controllers=("drive_alone", "csp")))
    assert line.startswith("csp is of a joint of 2.1 kg m2, and the plants are joints of 0.05 kg m2")


def test_a_study_with_a_slow_bus_has_the_filter_of_its_base() -> None:
    """The 100 Hz of the paper's law, which such a drive does not use, were refused at 100 Hz."""
    slow = own_loop_joint(SIZES["slow base"]._replace(rate_Hz=100.0), "csv")
    for controller in named(("drive_alone", "drive_without_torque")):
        assert controller_config(slow, controller).control.velocity_cutoff_Hz == slow.control.velocity_cutoff_Hz == 20.0


def test_what_a_study_is_given_and_the_shipped_joints_are_not_scaled() -> None:
    own = EnsembleSettings(torque_ripple_Nm=(0.0, 2e-3), bristle_damping_Nmspr=3.0)
    found = sized(joint(SIZES["finger"]), own)
    assert (found.torque_ripple_Nm, found.bristle_damping_Nmspr) == ((0.0, 2e-3), 3.0)
    assert found.bristle_stiffness_Nmprad == pytest.approx((150.0, 1250.0))
    for name in ("precise", "realistic", "csp", "paper"):
        assert sized(shipped(name), EnsembleSettings()) == EnsembleSettings()


@pytest.mark.parametrize("believed_kgm2", [0.3, 0.6, 1.5, 2.1, 5.0])
def test_an_inertia_that_the_file_has_too_large_takes_no_friction_off_a_light_joint(believed_kgm2: float) -> None:
    size = Size(60.0, believed_kgm2, 121.0, 5.0, 1.0, 1.0)
    found, _, _ = checked(joint(size, virtual__inertia_scale=0.3 / believed_kgm2))
    assert 0.85 < found["friction"].numbers["break_away_Nm"] / size.friction_Nm < 1.2


# --- a reducer that is soft ---


class Soft(NamedTuple):
    size: Size
    motor_kgm2: float
    stiffness_Nmprad: float
    jumps: bool  # whether the acceleration of a motion that measures may


SOFT = {
    "finger": Soft(Size(1.0, 2e-3, 100.0, 0.08, 6.0, 0.8, 16), 1.5e-3, 100.0, True),
    "wrist": Soft(Size(6.0, 0.08, 100.0, 0.8, 3.0, 1.5, 18), 0.03, 2.5e3, True),
    "belt": Soft(Size(40.0, 1.0, 10.0, 2.0, 4.0, 1.5, 18), 0.3, 829.0, False),
    "planetary": Soft(Size(100.0, 4.0, 25.0, 6.0, 3.0, 1.5, 18), 1.5, 1.2e4, False),
    "series elastic": Soft(Size(40.0, 0.6, 50.0, 2.0, 4.0, 1.2, 17), 0.35, 144.0, False),
    "base": Soft(Size(400.0, 25.0, 120.0, 50.0, 1.5, 2.0, 20), 10.0, 2e5, False),
    "large base": Soft(Size(1000.0, 250.0, 160.0, 100.0, 0.6, 2.0, 20), 60.0, 4.5e5, False),
}
each_soft = pytest.mark.parametrize("one", SOFT.values(), ids=SOFT)


def soft_joint(one: Soft, **more: Any) -> Config:
    """With both encoders and the law of realistic.toml, with gains as they are chosen."""
    base, size, stiffness = shipped("realistic"), one.size, one.stiffness_Nmprad
    assert base.joint_encoder is not None
    assert base.reducer is not None
    rigid = joint(size)
    link_kgm2 = size.inertia_kgm2 - one.motor_kgm2
    critical_Nmspr = 2.0 * (stiffness * one.motor_kgm2 * link_kgm2 / size.inertia_kgm2) ** 0.5
    reducer = base.reducer.model_copy(
        update={
            "motor_inertia_kgm2": one.motor_kgm2, "stiffness_Nmprad": stiffness, "loop_stiffness_Nmprad": None,
            "knees_Nm": (), "stiffness_beyond_Nmprad": (), "damping_Nmspr": 0.04 * critical_Nmspr, "map": None,
        }
    )  # fmt: skip
    second = base.joint_encoder.model_copy(
        update={"counts_per_turn": 2**size.bits, "stiffness_Nmprad": 0.6 * stiffness}
    )
    return rigid.changed(
        encoder=base.encoder, joint_encoder=second, reducer=reducer,
        control=base.control.model_copy(update={"kp": 2400.0, "kv": 40.0}),
        limits__following_error_max_rad=max(0.1, 1.5 * size.torque_Nm / stiffness), **more,
    )  # fmt: skip


def turns(
    times_s: np.ndarray, acceleration_radps2: np.ndarray, one: Soft, payload: float = 1.0, stiffness: float = 1.0
) -> tuple[float, float]:
    """(largest twist, largest change of the twist in one cycle) of the reducer under this acceleration of the link."""
    link_kgm2, spring_Nmprad = payload * soft_joint(one).link_kgm2, stiffness * one.stiffness_Nmprad
    damped = [link_kgm2, 0.04 * (spring_Nmprad * link_kgm2) ** 0.5, spring_Nmprad]
    _, twist, _ = signal.lsim(([link_kgm2], damped), acceleration_radps2, times_s - times_s[0])
    return float(np.max(np.abs(twist))), float(np.max(np.abs(np.diff(acceleration_radps2)))) * link_kgm2 / damped[2]


@each_soft
@pytest.mark.parametrize("excites", [False, True])
def test_a_sweep_turns_round_as_its_reducer_and_its_law_bear(one: Soft, excites: bool) -> None:
    """A jump of 7 rad/s2 twists a planetary gear by a milliradian, which the law answered with 147 of its 100 Nm."""
    config = soft_joint(one)
    if excites:
        table = designed(config, 20.0, 1).motion.table
    else:
        plan = sweep_plan(config, SweepOptions(quick=True, lockstep=True))
        assert (plan.settings.rounding_s == 0.0) is one.jumps
        table = plan.motion(plan.points, 0.0).table
    times_s = np.arange(max(table[-1, 0] - 60.0, 0.0), table[-1, 0], 1e-3)  # the fastest plateaus
    row = np.searchsorted(table[:, 0], times_s, side="right") - 1
    acceleration = 2.0 * table[row, 3] + 6.0 * table[row, 4] * (times_s - table[row, 0])
    twist_rad, jump_rad = turns(times_s, acceleration, one)
    assert config.joint_encoder is not None
    assert twist_rad < config.joint_encoder.disagreement_max_rad
    control = config.control
    answered_Nm = one.size.inertia_kgm2 * (control.kp + control.kv * velocity_of_a_step_1ps(config)) * jump_rad
    assert answered_Nm < 0.5 * one.size.torque_Nm


@each_soft
def test_a_response_stays_within_what_its_encoders_may_differ(one: Soft) -> None:
    """Triangle and multisine, by the law of the response: at its resonance a belt twisted by more under the first one.

    With the link and the stiffness at the ends that the gate looks at, and however hard the joint may brake.
    """
    brake_radps2 = 20.0 * soft_joint(one).sequence.brake_radps2
    task = response_task(soft_joint(one, sequence__brake_radps2=brake_radps2), None, AS_IT_FITS.legs)
    config, sine = task.config, task.sine
    assert task.gains or config.control.kind == "computed_torque_observer"
    assert config.joint_encoder is not None
    assert config.reducer is not None
    allowed_rad, rate_Hz = config.joint_encoder.disagreement_max_rad, config.loop.rate_Hz
    legs = legs_of(config, 1)
    velocity, damping = legs.velocity_radps, config.reducer.damping_Nmspr
    times_s, acceleration = np.arange(len(velocity) - 1) / rate_Hz, np.diff(velocity) * rate_Hz
    torque_Nm = task.largest_Nm * np.tile(sine.wave, 3)
    ends_of_stiffness = (1.0 - config.margin.stiffness_error, 1.0, 1.0 + config.margin.stiffness_error)
    for payload, stiffness in itertools.product((*config.margin.payload_range, 1.0), ends_of_stiffness):
        twist_rad, _ = turns(times_s, acceleration, one, payload, stiffness)
        assert twist_rad < 0.8 * allowed_rad
        ratio = 1.0 + one.motor_kgm2 / (payload * config.link_kgm2)
        twisted = ([1.0], [one.motor_kgm2, damping * ratio, stiffness * one.stiffness_Nmprad * ratio])
        _, twist, _ = signal.lsim(twisted, torque_Nm, np.arange(len(torque_Nm)) / rate_Hz)
        assert np.max(np.abs(twist)) < 0.37 * allowed_rad
    control, (_, jump_rad) = config.control, turns(times_s, acceleration, one)
    if control.kind == "flexible_joint":
        answered_ps2 = control.kp + control.kv * velocity_of_a_step_1ps(config)
        assert one.size.inertia_kgm2 * answered_ps2 * jump_rad < 0.5 * one.size.torque_Nm
    assert one.jumps or jump_rad < (0.05 if control.kind == "flexible_joint" else 0.2) * allowed_rad
    for start in legs.starts:
        assert np.ptp(velocity[start : start + len(sine.wave)]) < 1e-9
    assert task.largest_Nm > 1e-3 * one.size.torque_Nm


@pytest.mark.parametrize("kind", ["precise", "realistic"])
def test_the_motions_of_the_shipped_joints_are_what_they_were(kind: str) -> None:
    assert turning_of(shipped(kind), 1.6) == (1.6, 0.0)
