"""Frequency response and fit: what a joint truly is comes out of what its positions say."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from jointctl.drivers.errors import DataError, MotionFault, UsageError
from jointctl.firmware_py.friction import DEGREE, friction_curve_Nm
from jointctl.firmware_py.motion_records import Reference, TrajectoryConstants
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, Encoders, Fault, TrajectoryKind
from jointctl.firmware_py.trajectory import reference_at
from jointctl.tools.analysis.linear_loop import TwoMasses, sampled_joint
from jointctl.tools.analysis.margin_gate import passes
from jointctl.tools.configuration.conversions import friction_constants, static_friction_Nm
from jointctl.tools.configuration.found_values import with_break_away, with_sliding, without_friction
from jointctl.tools.configuration.records import axis_constants
from jointctl.tools.session.fault_words import FaultText
from jointctl.tools.tuning import carry_out, joint_fit
from jointctl.tools.tuning.carry_out import (
    FED,
    FED_STIFF,
    FED_STIFFEST,
    SUITED,
    Carried,
    HUNTING_Hz,
    TooQuick,
    TooWeak,
    measured_response,
    response_by_any_law,
    response_task,
    task_by,
)
from jointctl.tools.tuning.frequency_response import (
    GOOD_COHERENCE,
    Channel,
    FrequencyResponse,
    ResponsePlan,
    SHORT_PERIOD_s,
    SPEED_radps,
    config_of_response,
    excitation_table,
    from_dict,
    grown,
    largest_peak_Nm,
    legs_of,
    multisine,
    response_of,
    room_rad,
    speed_and_period,
)
from jointctl.tools.tuning.joint_fit import (
    Estimate,
    Gravity,
    fit_from_dict,
    fit_joint,
    fitted_again,
    friction_of,
    gravity_of,
)
from jointctl.tools.verbs.response import AS_IT_FITS
from jointctl.tools.virtual_joint import plant_settings
from tests.configurations import shipped
from tests.unit.identification.synthetic_friction import paper_data

T = 1e-3
SOFT = TwoMasses(0.9, 1.3, 2.4e4, 15.0, (0.0, 0.0), (12.0, 0.0))
RIGID = TwoMasses(2.1, 1.0, 0.0, 0.0, (0.0, 0.0), (15.0, 0.0))


def plan(peak_Nm: float = 6.0, pairs: int = 3) -> ResponsePlan:
    config = config_of_response(shipped("precise"), None)
    return ResponsePlan(legs_of(config, pairs), multisine(1000.0, speed_and_period(config)[1]), peak_Nm)


def made_response(joint: TwoMasses, late: tuple[float, float], seed: int = 1, motor: bool = True) -> FrequencyResponse:
    """The model itself with 3 % of noise."""
    random = np.random.default_rng(seed)
    frequency = multisine(1000.0, 4.0).frequency_Hz
    true = sampled_joint(T, *late, joint, Encoders.BOTH).response(np.exp(2j * math.pi * frequency * T))
    channels = []
    for column in (1, 0):
        size = len(frequency)
        noise = 0.03 * (random.normal(size=size) + 1j * random.normal(size=size))
        channels.append(Channel(true[:, column, 0] * (1.0 + noise), np.full(size, 0.06), np.full(size, 0.99)))
    return FrequencyResponse(frequency, channels[0], channels[1] if motor else None, 12, 5.0, T)


def test_the_multisine_has_its_lines_a_peak_of_one_and_nothing_between() -> None:
    sine = multisine(1000.0, 4.0)
    assert np.max(np.abs(sine.wave)) == pytest.approx(1.0)
    spectrum = np.abs(np.fft.rfft(sine.wave))
    others = np.setdiff1d(np.arange(len(spectrum)), sine.bins)
    assert np.max(spectrum[others]) < 1e-9 * np.max(spectrum)
    assert np.min(spectrum[sine.bins]) > 0.1 * np.max(spectrum)
    assert np.min(np.diff(sine.bins)) >= 2
    assert sine.frequency_Hz[0] == 1.0
    assert sine.frequency_Hz[-1] <= 250.0
    assert 1.0 / np.std(sine.wave) < 3.5  # the crest of random phases is 4 and more


def test_the_reference_is_the_triangle_and_its_acceleration_the_torque() -> None:
    """However the time is rounded; and the acceleration is that times the inertia, in every cycle."""
    made = plan()
    table = excitation_table(made, 2.0, T)
    constants = new(TrajectoryConstants)[0]
    constants.kind, constants.table_rows = TrajectoryKind.TABLE, len(table)
    position_rad = 0.0
    for cycle in range(len(made.legs.velocity_radps) - 1):
        velocity = made.legs.velocity_radps[cycle]
        if cycle:
            position_rad += 0.5 * (velocity + made.legs.velocity_radps[cycle - 1]) * T
        if cycle % 97:
            continue
        for rounding in (-1e-10, 1e-10):
            reference = new(Reference)[0]
            reference_at(constants, table, cycle, cycle * T + rounding, reference)
            if cycle == 0:
                continue
            assert reference.position_rad == pytest.approx(position_rad, abs=1e-9)
            assert reference.velocity_radps == pytest.approx(velocity, abs=1e-8)
    start = made.legs.starts[0]
    wave = 2.0 * 2.0 * table[start : start + made.samples - 1, 3]  # behind the last one the leg is braked
    expected = np.roll(made.peak_Nm * made.sine.wave, -start)[:-1]
    assert wave == pytest.approx(expected, abs=1e-9)


def test_every_leg_holds_one_period_at_constant_speed_within_the_travel() -> None:
    made, config = plan(pairs=6), config_of_response(shipped("precise"), None)
    velocity = made.legs.velocity_radps
    assert np.max(np.cumsum(velocity) * T) <= room_rad(config)
    assert np.min(np.cumsum(velocity) * T) >= -1e-9
    assert abs(np.sum(velocity) * T) < 1e-9
    speeds = set()
    for start in made.legs.starts:
        leg = velocity[start : start + made.samples]
        assert np.ptp(leg) == 0.0
        speeds.add(round(abs(float(leg[0])), 6))
    assert len(speeds) == 6
    assert np.max(np.abs(np.diff(velocity))) <= 0.51 * config.sequence.brake_radps2 * T + 1e-9


def test_a_joint_that_cannot_slide_or_has_no_torque_is_refused() -> None:
    narrow = shipped("precise", limits__position_min_rad=-0.11, limits__position_max_rad=0.11)
    with pytest.raises(UsageError, match=r"the travel \(=0.02 rad\) must be at least"):
        speed_and_period(narrow)
    with pytest.raises(UsageError, match=r"limits.velocity_max_radps \(=0.008 rad/s\) at least 0.01"):
        speed_and_period(shipped("precise", limits__velocity_max_radps=0.02))
    with pytest.raises(UsageError, match=r"--torque \(=61\) must be in \(0..60\]"):
        config_of_response(shipped("precise"), 61.0)
    weak = config_of_response(shipped("precise"), 15.0)
    assert weak.limits.torque_max_Nm == 15.0
    with pytest.raises(UsageError, match=r"the torque \(=15 Nm\) must be more than"):
        largest_peak_Nm(weak)


def records_of(made: ResponsePlan, joint: TwoMasses, gravity_Nm: float = 0.0) -> np.ndarray:
    """A log of a joint that the excitation moves about its triangle; friction and gravity are in the command."""
    rows = len(made.legs.velocity_radps)
    log = new(LogRecord, rows)
    triangle = np.cumsum(made.legs.velocity_radps) * T
    excitation = made.peak_Nm * np.resize(made.sine.wave, rows)
    frequency = np.fft.rfftfreq(made.samples, T)[1:-1]
    both = sampled_joint(T, 1.2e-3, 0.5e-3, joint, Encoders.BOTH).response(np.exp(2j * math.pi * frequency * T))
    spectrum = np.fft.rfft(made.peak_Nm * made.sine.wave)
    log.phase, log.trajectory_s = AxisPhase.TRACKING, np.arange(rows) * T
    log.desired_position_rad, log.desired_velocity_radps = triangle, made.legs.velocity_radps
    for name, column in (("position_rad", 1), ("second_position_rad", 0)):
        answer = np.zeros(len(spectrum), dtype=np.complex128)
        answer[1:-1] = spectrum[1:-1] * both[:, column, 0]
        setattr(log, name, triangle + np.resize(np.fft.irfft(answer, made.samples), rows))
    log.command_torque_Nm = excitation + 20.0 * np.sign(made.legs.velocity_radps) + gravity_Nm * np.sin(triangle - 0.1)
    return log


def test_the_response_is_that_of_the_joint_in_spite_of_a_leg_that_is_disturbed() -> None:
    made = plan(pairs=4)
    log = records_of(made, SOFT)
    start = made.legs.starts[3]
    log.position_rad[start : start + made.samples] += 1e-3 * np.sin(40.0 * np.arange(made.samples) * T)
    config = config_of_response(shipped("realistic"), None)
    found = response_of(config, made, log)
    frequency = found.frequency_Hz
    true = sampled_joint(T, 1.2e-3, 0.5e-3, SOFT, Encoders.BOTH).response(np.exp(2j * math.pi * frequency * T))
    assert found.motor.response == pytest.approx(true[:, 1, 0], rel=0.01)
    assert found.link.response == pytest.approx(true[:, 0, 0], rel=0.01)
    assert found.coherence > 0.99
    again = from_dict(found.to_dict())
    assert again.motor.response == pytest.approx(found.motor.response)
    assert grown(found, again) == pytest.approx(1.0)


def test_the_bends_of_a_reference_that_is_between_its_rows_are_no_motion_of_the_joint() -> None:
    """An approach ends anywhere within a cycle: until the next row the reference follows the excitation."""
    made, joint = plan(pairs=4), RIGID
    log = records_of(made, joint)
    table, reference = excitation_table(made, 2.1, T), new(Reference)
    constants = new(TrajectoryConstants)[0]
    constants.kind, constants.table_rows = TrajectoryKind.TABLE, len(table)
    row = 0
    for i in range(len(log)):
        row = reference_at(constants, table, row, (i + 0.35) * T, reference[0])
        log.desired_position_rad[i] = reference[0].position_rad
    found = response_of(config_of_response(shipped("precise"), None), made, log)
    frequency = found.frequency_Hz
    true = sampled_joint(T, 1.2e-3, 0.5e-3, joint, Encoders.BOTH).response(np.exp(2j * math.pi * frequency * T))
    assert found.fed.response == pytest.approx(true[:, 1, 0], rel=0.01)


def test_a_resonance_that_comes_down_does_not_grow_and_one_that_grows_does() -> None:
    before = made_response(SOFT, (1e-3, 5e-4))
    lower = made_response(TwoMasses(0.9, 1.3, 2.0e4, 15.0, (0.0, 0.0), (12.0, 0.0)), (1e-3, 5e-4))
    assert grown(before, lower) < 1.3
    undamped = made_response(TwoMasses(0.9, 1.3, 2.4e4, 2.0, (0.0, 0.0), (0.0, 0.0)), (1e-3, 5e-4))
    assert grown(before, undamped) > 2.5


@pytest.mark.parametrize(("half", "counts"), [(11.0, False), (0.3, True)])
def test_a_line_that_is_hardly_known_does_not_grow(half: float, counts: bool) -> None:
    """The lowest line of a rigid joint: coherence 0.98 by chance, four times the others, and an interval of that."""
    before = made_response(RIGID, (1e-3, 5e-4))
    after = made_response(RIGID, (1e-3, 5e-4), seed=2)
    after.fed.response[0] *= 4.0
    after.fed.half[0] = half
    assert (grown(before, after) > 2.5) is counts


def test_legs_that_were_lost_do_not_count_and_too_few_are_refused() -> None:
    made = plan(pairs=3)
    log = records_of(made, RIGID)
    config = config_of_response(shipped("precise"), None)
    kept = log[np.arange(len(log)) < made.legs.starts[4] + made.samples]
    assert response_of(config, made, kept).legs == 5
    with pytest.raises(DataError, match=r"legs that were measured \(=2\) must be at least 4"):
        response_of(config, made, log[np.arange(len(log)) < made.legs.starts[1] + made.samples])


@pytest.mark.parametrize("gravity_Nm", [0.0, 6.0, -4.0])
def test_gravity_is_what_both_directions_have_in_common(gravity_Nm: float) -> None:
    made = plan(pairs=4)
    found = gravity_of(made, records_of(made, RIGID, gravity_Nm), T, 0.1)
    assert found.torque_Nm == pytest.approx(gravity_Nm, abs=0.1)
    assert found.found == (gravity_Nm != 0.0)
    assert found.zero_rad == pytest.approx(0.1)


@pytest.mark.parametrize("held_Nm", [0.0, 3.0])
def test_a_way_too_short_to_tell_gravity_has_none_and_friction_without_what_is_believed(held_Nm: float) -> None:
    """80 Nm were found on a joint of 30 Nm that has none: friction that goes with the angle looks like gravity."""
    config = shipped("precise", limits__position_min_rad=-0.2, limits__position_max_rad=0.2)
    made = ResponsePlan(legs_of(config, 4), multisine(1.0 / T, SHORT_PERIOD_s), 1.0)
    log = records_of(made, RIGID)
    log.command_torque_Nm = 2.0 * np.sign(made.legs.velocity_radps) + held_Nm + 0.3 * np.sin(18.0 * log.position_rad)
    log.gravity_torque_Nm = held_Nm
    found = gravity_of(made, log, T, 0.1)
    assert (found.found, found.torque_Nm, found.zero_rad) == (False, 0.0, 0.1)
    assert found.sliding_Nm == pytest.approx((2.0, -2.0), abs=0.3)


@pytest.mark.parametrize("size", [1.0, 0.01, 40.0])
def test_a_light_joint_has_gravity_too(size: float) -> None:
    """What may be friction goes with the friction."""
    assert Gravity(1.6 * size, 0.3 * size, 0.0, (19.0 * size, -18.0 * size)).found
    assert not Gravity(0.4 * size, 0.1 * size, 0.0, (19.0 * size, -18.0 * size)).found


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_two_masses_are_found_with_intervals_from_a_wrong_guess(seed: int) -> None:
    fit = fit_joint(made_response(SOFT, (1.3e-3, 0.6e-3), seed), 5.0)
    assert fit.flexible
    for name, true in (
        ("inertia_kgm2", 2.2), ("link_kgm2", 1.3), ("stiffness_Nmprad", 2.4e4), ("resonance_Hz", SOFT.resonance_Hz),
    ):  # fmt: skip
        one = fit.values[name]
        assert one.value == pytest.approx(true, rel=0.03)
        assert abs(one.value - true) < 2.0 * one.half
    assert fit.late_s.value == pytest.approx(1.9e-3, abs=0.05e-3)
    again = fit_from_dict(fit.to_dict())
    frequency = np.array([5.0, 30.0, 100.0])
    assert again.response(frequency, "link") == pytest.approx(fit.response(frequency, "link"))


@pytest.mark.parametrize("motor", [True, False])
@pytest.mark.parametrize("share", [0.5, 2.0])
@pytest.mark.parametrize(
    ("name", "joint"),
    [
        ("finger", TwoMasses(1.5e-3, 5e-4, 100.0, 0.015, (0.0, 0.0), (0.01, 0.0))),
        ("stiff wrist", TwoMasses(0.02, 0.03, 1.2e4, 1.0, (0.0, 0.0), (0.3, 0.0))),
        ("belt", TwoMasses(0.3, 0.7, 829.0, 1.1, (0.0, 0.0), (2.0, 0.0))),
        ("series elastic", TwoMasses(0.35, 0.25, 144.0, 0.37, (0.0, 0.0), (1.5, 0.0))),
        ("base", TwoMasses(60.0, 190.0, 4.5e5, 360.0, (0.0, 0.0), (90.0, 0.0))),
    ],
)
def test_two_masses_of_any_size_are_found(name: str, joint: TwoMasses, share: float, motor: bool) -> None:
    """From 5 to 160 Hz.  Below most lines a rigid joint fits the motor alone, and no start was near both masses."""
    whole_kgm2 = joint.motor_kgm2 + joint.link_kgm2
    found = made_response(joint, (1e-3, 0.5e-3))
    fit = fit_joint(found if motor else replace(found, link=None), share * whole_kgm2)
    assert fit.flexible
    assert fit.resonance_Hz.value == pytest.approx(joint.resonance_Hz, rel=0.03)
    assert fit.inertia_kgm2.value == pytest.approx(whole_kgm2, rel=0.06)
    assert fit.link_kgm2.value == pytest.approx(joint.link_kgm2, rel=0.1)


@pytest.mark.parametrize(
    ("rate_Hz", "highest_Hz"), [(200.0, 80.0), (250.0, 100.0), (500.0, 200.0), (1000.0, 250.0), (2000.0, 500.0)]
)
def test_the_highest_line_of_a_slow_loop_is_a_larger_share_of_its_rate(rate_Hz: float, highest_Hz: float) -> None:
    """At 500 Hz a resonance of 123 to 174 Hz was not seen, and the law for a rigid joint was unstable on that joint."""
    frequency_Hz = multisine(rate_Hz, 4.0).frequency_Hz
    assert 0.97 * highest_Hz <= frequency_Hz[-1] <= highest_Hz


@pytest.mark.parametrize(("stiffness_Nmprad", "flexible"), [(3.4e4, True), (7e4, True), (2e5, False)])
def test_a_resonance_just_beyond_the_highest_line_is_one_where_its_flank_is_seen(
    stiffness_Nmprad: float, flexible: bool
) -> None:
    """The last one resonates at 650 Hz."""
    joint = TwoMasses(0.02, 0.03, stiffness_Nmprad, 2.0, (0.0, 0.0), (0.3, 0.0))
    fit = fit_joint(made_response(joint, (1e-3, 0.5e-3)), 0.1)
    assert joint.resonance_Hz > 250.0
    assert fit.flexible is flexible
    assert fit.inertia_kgm2.value == pytest.approx(0.05, rel=0.06)
    if flexible:
        assert abs(fit.resonance_Hz.value - joint.resonance_Hz) < fit.resonance_Hz.half


def test_a_resonance_whose_interval_says_little_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Friction alone may look a little like one: of a light joint at 180 +- 107 Hz."""
    response = made_response(SOFT, (1.3e-3, 0.6e-3))
    assert fit_joint(response, 2.0).flexible
    known = fit_joint(response, 2.0).resonance_Hz
    monkeypatch.setattr(joint_fit, "KNOWN_RESONANCE", 0.9 * known.half / known.value)
    assert not fit_joint(response, 2.0).flexible


def test_intervals_of_a_light_joint_with_much_friction_are_wider_and_others_stay() -> None:
    fit = fit_joint(replace(made_response(RIGID, (1e-3, 5e-4)), link=None), 2.0)
    little, much = fit.beside_friction(10.0), fit.beside_friction(2.1 * 200.0)
    assert little.values == fit.values
    assert much.inertia_kgm2.half == pytest.approx(0.36 * 2.1, rel=0.05)
    assert much.late_s.half == pytest.approx(0.45e-3, rel=0.05)
    assert much.delay_s == fit.delay_s


@pytest.mark.parametrize("last", [False, True])
def test_only_a_stage_that_others_may_follow_announces_more_torque(last: bool) -> None:
    """The last one, and the short response of a later step, said the same of minutes and torque that did not come."""
    motion = response_task(shipped("precise"), None, AS_IT_FITS.legs).motion(4.5, 2, last=last)
    (line,) = (one for one in motion.placed(Mock(start_position_rad=0.0, remarks=())).lines if "excitation" in one)
    assert ("at first 4.50 Nm" in line) == ("up to 9.00 Nm" in line) == ("minutes" in line) is not last
    assert "4.50 Nm on top of what the motion takes" in line


@pytest.mark.parametrize(
    ("moved_Nm", "static_Nm"), [(math.inf, (0.214, 0.164)), (19.0, (0.165, 0.164)), (12.0, (0.139, 0.139))]
)
def test_a_static_friction_that_no_plateau_shows_is_no_more_than_what_moved_the_joint(
    monkeypatch: pytest.MonkeyPatch, moved_Nm: float, static_Nm: tuple[float, float]
) -> None:
    """Truly 0.145 and 0.158 Nm, plateaus from 2 deg/s on.  No less than those took: 0.139 Nm."""
    speeds = np.geomspace(2.0, 40.0, 17) * DEGREE
    data = paper_data(seed=4, velocity_radps=np.concatenate((-speeds[::-1], speeds)), noise_Nm=1e-3)
    monkeypatch.setattr(joint_fit, "read_friction_data", lambda *_: data)
    branches = friction_of(data.path, moved_Nm, 121.0).branches
    assert tuple(branches[side].static_Nm for side in ("positive", "negative")) == pytest.approx(static_Nm, abs=1e-3)


@pytest.mark.parametrize(("believed", "motor"), [(None, 1.1), (0.9, 0.9), (1.4, 1.4)])
def test_an_encoder_on_the_link_alone_tells_inertia_and_resonance_and_leaves_the_share(
    believed: float | None, motor: float
) -> None:
    fit = fit_joint(replace(made_response(SOFT, (1.3e-3, 0.6e-3)), motor=None), 5.0, believed)
    assert fit.flexible
    assert not fit.tells_link
    assert fit.inertia_kgm2.value == pytest.approx(2.2, rel=0.03)
    assert fit.resonance_Hz.value == pytest.approx(SOFT.resonance_Hz, rel=0.03)
    assert fit.joint().motor_kgm2 == pytest.approx(motor, rel=0.1)
    assert abs(fit.link_kgm2.value - 1.3) < fit.link_kgm2.half
    assert abs(fit.late_s.value - 1.9e-3) < fit.late_s.half
    assert not fit_from_dict(fit.to_dict()).tells_link
    assert fit_joint(made_response(SOFT, (1.3e-3, 0.6e-3)), 5.0, believed).tells_link


@pytest.mark.parametrize("loss", [0.0, 0.25])
def test_what_hysteresis_loses_is_not_taken_for_delay(loss: float) -> None:
    """A spring with hysteresis, in continuous time, against that of the sampled joint."""
    found = made_response(SOFT, (1.3e-3, 0.6e-3))

    def continuous(share: float) -> np.ndarray:
        s = 2j * math.pi * found.frequency_Hz
        stiffer = (found.frequency_Hz / SOFT.resonance_Hz) ** (share / math.pi)
        spring = SOFT.stiffness_Nmprad * stiffer * (1.0 + 1j * share) + SOFT.damping_Nmspr * s
        motor, link = (
            SOFT.motor_kgm2 * s**2 + SOFT.bristle_damping_Nmspr[0] * s + spring,
            SOFT.link_kgm2 * s**2 + spring,
        )
        both: np.ndarray = np.array((link, spring)) / (motor * link - spring**2)
        return both

    channels = [
        replace(channel, response=channel.response * factor)
        for channel, factor in zip((found.motor, found.link), continuous(loss) / continuous(0.0), strict=True)
        if channel is not None
    ]
    fit = fit_joint(replace(found, motor=channels[0], link=channels[1]), 2.0)
    assert fit.late_s.value == pytest.approx(1.9e-3, abs=0.03e-3)
    assert fit.loss_factor.value == pytest.approx(loss, abs=0.03)
    at_resonance = loss * SOFT.stiffness_Nmprad / (2.0 * math.pi * SOFT.resonance_Hz)
    assert fit.damping_Nmspr.value == pytest.approx(SOFT.damping_Nmspr + at_resonance, rel=0.15)


def test_the_model_of_the_fit_is_the_sampled_joint() -> None:
    fit = fit_joint(made_response(SOFT, (1.3e-3, 0.6e-3)), 2.0)
    plain = replace(fit, values={**fit.values, "loss_factor": Estimate(0.0, 0.0)})
    frequency = np.geomspace(1.0, 250.0, 50)
    late = (fit.delay_s.value, fit.lag_s.value)
    true = sampled_joint(T, *late, fit.joint(), Encoders.BOTH).response(np.exp(2j * math.pi * frequency * T))
    for side, column in (("motor", 1), ("link", 0)):
        assert plain.response(frequency, side) == pytest.approx(true[:, column, 0], rel=1e-3, abs=1e-12)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_rigid_joint_is_not_taken_for_two_masses(seed: int) -> None:
    found = made_response(RIGID, (1.0e-3, 0.4e-3), seed, motor=False)
    fit = fit_joint(found, 1.0)
    assert not fit.flexible
    assert fit.inertia_kgm2.value == pytest.approx(2.1, rel=0.02)
    assert fit.late_s.value == pytest.approx(1.4e-3, abs=0.05e-3)


def test_a_search_that_comes_to_a_joint_that_runs_away_turns_back() -> None:
    """Without friction, or with one that drives it, a light joint grows beyond all numbers in one period."""
    light = TwoMasses(0.0738, 0.0317, 832.0, 0.2146, (0.0, 0.0), (0.6313, 0.0))
    fit = fit_joint(made_response(light, (1.3e-3, 0.6e-3), 32), 0.21)
    assert fit.flexible
    assert fit.inertia_kgm2.value == pytest.approx(0.1055, rel=0.03)


def test_a_response_without_coherence_gives_no_model() -> None:
    found = made_response(RIGID, (1e-3, 0.0))
    blind = Channel(found.motor.response, found.motor.half, np.full(len(found.frequency_Hz), 0.1))
    with pytest.raises(DataError, match=r"lines with coherence \(=0\) must be at least 12"):
        fit_joint(FrequencyResponse(found.frequency_Hz, blind, None, 12, 5.0, T), 2.0)


@pytest.mark.parametrize("joint", [SOFT, RIGID])
def test_another_response_says_what_the_joint_weighs_now(joint: TwoMasses) -> None:
    """From where the first fit ended: the same joint, and one with a payload."""
    late = (1e-3, 5e-4)
    fit = fit_joint(made_response(joint, late, motor=joint is SOFT), 2.0)
    for payload in (0.0, 0.5):
        loaded = (
            replace(joint, link_kgm2=joint.link_kgm2 + payload) if joint is SOFT
            else replace(joint, motor_kgm2=joint.motor_kgm2 + payload)
        )  # fmt: skip
        whole = loaded.motor_kgm2 + (loaded.link_kgm2 if joint is SOFT else 0.0)
        again = fitted_again(made_response(loaded, late, seed=2, motor=joint is SOFT), fit)
        assert again.value == pytest.approx(whole, rel=0.02)
        assert again.half > 0.02 * whole  # what friction adds


def test_before_the_friction_is_known_the_reading_is_watched_by_what_moved_the_joint() -> None:
    config = with_break_away(shipped("precise"), 20.0)
    assert config.control.feed_forward == "none"
    assert static_friction_Nm(config) == pytest.approx(20.0)
    limits = axis_constants(config, np.zeros((2, 5)))[0].limits
    assert limits.frozen_torque_Nm == pytest.approx(30.0)
    assert plant_settings(config) == plant_settings(shipped("precise"))  # the joint itself is what it was
    moving = config_of_response(config, None)
    assert moving.control.feed_forward == "none"
    assert config_of_response(shipped("precise"), None).control.feed_forward == "desired"
    paired = shipped("precise", control__observer_paired=True)  # as the law of a tune is that chooses gains
    assert not config_of_response(paired, None).control.observer_paired
    assert axis_constants(without_friction(config), np.zeros((2, 5)))[0].limits.frozen_torque_Nm == 0.0


@pytest.mark.parametrize(
    ("sliding_Nm", "slope_Nmspr", "at_radps", "fed_Nm"),
    [
        ((17.0, -18.0), 16.0, (0.2, -0.2, 0.1, 0.4, 5.0, -5.0), (17.0, -18.0, 15.4, 20.2, 20.2, -21.2)),
        ((17.0, -18.0), -3.0, (0.2, -0.2, 5.0), (17.0, -18.0, 17.0)),  # a slope that falls is none
        ((4.0, -18.0), 16.0, (0.2, 0.02), (4.0, 2.2)),  # half of the friction at most is viscous
        ((30.0, 5.0), 16.0, (0.2, -0.2), (30.0, 0.0)),  # a load beyond the friction pushes in one direction alone
    ],
)
def test_after_the_response_its_friction_is_fed_forward_and_no_more(
    sliding_Nm: tuple[float, float], slope_Nmspr: float, at_radps: tuple[float, ...], fed_Nm: tuple[float, ...]
) -> None:
    config = with_sliding(shipped("precise"), 20.0, sliding_Nm, slope_Nmspr, SPEED_radps)
    assert config.friction is not None
    assert config.control.feed_forward == "desired"
    curve = friction_curve_Nm(friction_constants(config.friction, 121.0), np.array(at_radps))
    assert 121.0 * curve == pytest.approx(fed_Nm, abs=1e-6)
    assert axis_constants(config, np.zeros((2, 5)))[0].limits.frozen_torque_Nm >= 30.0
    assert plant_settings(config) == plant_settings(shipped("precise"))


@pytest.mark.parametrize(("observer_radps", "own"), [(30.0, True), (80.0, False)])
def test_a_joint_that_is_too_soft_for_the_weak_law_is_moved_by_its_own(observer_radps: float, own: bool) -> None:
    """Where the gate refuses the gains of the file too, by others of that law."""
    soft = shipped(
        "realistic", reducer__loop_stiffness_Nmprad=5.7e4, reducer__motor_inertia_kgm2=0.43, control__kp=49.0,
        control__kv=5.7, control__observer_radps=observer_radps, margin__loop_delay_s=1.9e-3,
        margin__current_lag_s=0.95e-3,
    )  # fmt: skip
    assert passes(soft) is own
    moving = response_task(soft, None, AS_IT_FITS.legs).config
    assert passes(moving)
    assert (moving.control.kind, moving.control.learning) == ("flexible_joint", None)
    assert ((moving.control.kp, moving.control.kv) == (49.0, 5.7)) is own
    weak = response_task(shipped("realistic"), None, AS_IT_FITS.legs).config  # the twin
    assert weak.control.kind == "computed_torque_observer"
    assert weak.control.kv == 20.0


def test_a_light_joint_is_not_turned_round_by_its_excitation() -> None:
    assert largest_peak_Nm(shipped("precise")) == pytest.approx(9.0)  # 15 % of the limit
    assert largest_peak_Nm(shipped("precise", joint__inertia_kgm2=0.2)) == pytest.approx(1.6)


def carrier_of(run: Any = None, note: Any = lambda _: None) -> Any:
    return SimpleNamespace(run=run, output=SimpleNamespace(note=note))


def ended(fault: Fault = Fault.FOLLOWING_ERROR, value: float = 0.1, torque_Nm: float = 0.0) -> Carried:
    """A motion that the fault has ended on the way."""
    log = new(LogRecord, 100)
    log.phase, log.command_torque_Nm = AxisPhase.TRACKING, torque_Nm
    log.desired_position_rad = np.linspace(0.0, 0.05, len(log))
    return Carried(log, fault, FaultText("happened", "cause", "next"), "", value)


@pytest.mark.parametrize(
    ("fault", "value", "torque_Nm", "weak"),
    [
        (Fault.LIMIT_CYCLE, 0.99 * HUNTING_Hz, 29.0, True),  # 1.5 times what moved it, without the excitation
        (Fault.LIMIT_CYCLE, 1.01 * HUNTING_Hz, 29.0, False),  # a resonance: a stiffer law would feed it
        (Fault.LIMIT_CYCLE, 0.99 * HUNTING_Hz, 35.0, False),  # against something, perhaps: no stiffer law may follow
        (Fault.FOLLOWING_ERROR, 0.1, 29.0, True),
        (Fault.FOLLOWING_ERROR, 0.1, 35.0, False),
        (Fault.POSITION_FROZEN, 0.05, 29.0, True),
        (Fault.POSITION_FROZEN, 0.05, 31.0, False),
        (Fault.STALE_SAMPLE, 0.1, 0.0, False),
        (Fault.VELOCITY_LIMIT, 1.0, 0.0, False),
    ],
)
def test_the_next_law_follows_on_one_that_is_too_weak_alone(
    fault: Fault, value: float, torque_Nm: float, weak: bool
) -> None:
    laws: list[Any] = []

    def run(config: Any, *_: Any, **__: Any) -> Carried:
        laws.append((config.control.kp, config.control.feed_forward))
        assert config.limits.torque_max_Nm == 55.0
        return ended(fault, value, torque_Nm)

    carrier = carrier_of(run)
    before = with_break_away(shipped("precise"), 20.0)
    with pytest.raises(TooQuick if fault == Fault.VELOCITY_LIMIT else MotionFault, match=fault.name):
        response_by_any_law(before, 8, carrier, 55.0)
    attempts = [(100.0, "none"), (100.0, "desired"), (1600.0, "desired"), (3200.0, "desired")]
    assert laws == (attempts if weak else attempts[:1])
    laws.clear()
    light = before.changed(joint__inertia_kgm2=0.5)
    with pytest.raises(MotionFault, match=fault.name):
        response_by_any_law(light, 8, carrier, 55.0)
    swung = fault == Fault.LIMIT_CYCLE  # under torque that is later than believed: not so stiff
    assert laws == ([*attempts[2:], attempts[1]] if weak else [attempts[2], attempts[1]] if swung else attempts[2:3])


@pytest.mark.parametrize(("stands", "value", "pushed_Nm"), [(True, 9.0, 0.0), (False, 9.0, 0.0), (True, 7.0, 40.0)])
def test_a_light_joint_that_swings_fast_and_then_stands_gets_the_stiffest_law(
    stands: bool, value: float, pushed_Nm: float
) -> None:
    """It stuck and slid at 9 Hz, which looked like late torque; one that swings under the weak law as well is late.

    One that was pushed hard may be against something: nothing pushes it harder.
    """
    laws: list[float] = []

    def run(config: Any, *_: Any, **__: Any) -> Carried:
        laws.append(config.control.kp)
        weak = stands and config.control.kp == 100.0
        return ended(Fault.FOLLOWING_ERROR if weak else Fault.LIMIT_CYCLE, value, 0.0 if weak else pushed_Nm)

    with pytest.raises(MotionFault, match="FOLLOWING_ERROR" if pushed_Nm else "LIMIT_CYCLE"):
        response_by_any_law(
            with_break_away(shipped("precise", joint__inertia_kgm2=0.5), 20.0), 8, carrier_of(run), 55.0
        )
    assert laws == [1600.0, 100.0, 3200.0][: 3 if stands and not pushed_Nm else 2]


def test_a_light_soft_joint_gets_gains_that_suit_its_file() -> None:
    """The gate refuses the stiffer laws; the weak one with friction fed forward swung, and nothing followed it."""
    laws: list[tuple[float, str]] = []

    def run(config: Any, *_: Any, **__: Any) -> Carried:
        laws.append((config.control.kp, config.control.feed_forward))
        assert passes(config)
        return ended()

    notes: list[str] = []
    light = shipped(
        "realistic", joint__inertia_kgm2=0.21, reducer__motor_inertia_kgm2=0.095, reducer__damping_Nmspr=2.5
    )
    with pytest.raises(TooWeak):
        response_by_any_law(with_break_away(light, 10.0), 8, carrier_of(run, notes.append))
    assert [feed for _, feed in laws] == ["desired", "desired"]
    assert laws[0][0] == 100.0
    assert laws[1][0] > 300.0  # that of the file
    assert f"  law: {SUITED}" in notes
    # and the same for the question whether it is still this joint, whichever law moved it
    assert passes(task_by(FED_STIFF, with_break_away(light, 10.0), 8).config)


def test_the_law_that_is_named_is_the_one_that_runs() -> None:
    """The stiffest law suits this light soft joint, but not for the heavier inertia that it is taken for."""
    laws: list[float] = []

    def run(config: Any, *_: Any, **__: Any) -> Carried:
        laws.append(config.control.kp)
        log = new(LogRecord, 100)
        log.phase = AxisPhase.TRACKING
        return Carried(log, Fault.FOLLOWING_ERROR, FaultText("happened", "cause", "next"), "", 0.1)

    notes: list[str] = []
    carrier: Any = SimpleNamespace(run=run, output=SimpleNamespace(note=notes.append))
    light = shipped(
        "realistic", joint__inertia_kgm2=0.2, reducer__motor_inertia_kgm2=0.09, reducer__damping_Nmspr=11.0,
        reducer__stiffness_Nmprad=4e5, reducer__loop_stiffness_Nmprad=None, reducer__knees_Nm=(),
        reducer__stiffness_beyond_Nmprad=(), joint_encoder__stiffness_Nmprad=4e5,
        margin={"loop_delay_s": 0.5e-3, "current_lag_s": 0.5e-3},
    )  # fmt: skip
    with pytest.raises(TooWeak):
        response_by_any_law(with_break_away(light, 10.0), 8, carrier)
    named = [note.removeprefix("  law: ") for note in notes if note.startswith("  law: ")]
    assert named == [FED_STIFF, SUITED, FED]
    assert [laws[0], laws[2]] == [1600.0, 100.0]
    assert laws[1] not in (1600.0, 3200.0)
    assert not any(FED_STIFFEST in note or "refuses the gains of the file" in note for note in notes)


@pytest.mark.parametrize(("name", "kps"), [("precise", [100.0, 1600.0, 3200.0]), ("realistic", [100.0])])
def test_a_stiffer_law_follows_only_where_the_gate_lets_it(name: str, kps: list[float]) -> None:
    """Without a friction nothing can be fed forward; the law of the file takes the place of the weak one alone."""
    laws: list[float] = []

    def run(config: Any, *_: Any, **__: Any) -> Carried:
        laws.append(config.control.kp)
        return ended()

    with pytest.raises(TooWeak):
        response_by_any_law(without_friction(shipped(name)), 8, carrier_of(run))
    assert laws == kps


@pytest.mark.parametrize("error", [TooWeak, TooQuick])
@pytest.mark.parametrize("coherence", [0.95, 0.85])
def test_more_torque_than_the_law_holds_ends_with_that_of_the_stage_before(
    monkeypatch: pytest.MonkeyPatch, coherence: float, error: type[MotionFault]
) -> None:
    stages: list[tuple[float, int]] = []

    def stage(_: Any, __: Any, peak_Nm: float, pairs: int, **_how: bool) -> Any:
        stages.append((peak_Nm, pairs))
        if peak_Nm > 3.0:
            raise error("it swings")
        return SimpleNamespace(coherence=coherence, peak_Nm=peak_Nm, legs=2 * pairs), "records", "plan"

    for name, fake in (("_stage", stage), ("_refuse_growth", lambda *_: None), ("_better", lambda task, _: task)):
        monkeypatch.setattr(carry_out, name, fake)
    said: list[str] = []
    carrier = carrier_of(note=said.append)
    known = coherence > GOOD_COHERENCE
    with nullcontext() if known else pytest.raises(error, match="it swings"):
        found, *_ = measured_response(response_task(shipped("precise"), None, 12), carrier)
        assert found.peak_Nm == pytest.approx(2.25)
        assert "it swings: once more, with 2.25 Nm" in "".join(said)
    assert stages == [(1.125, 2), (2.25, 2), (4.5, 2), (2.25, 6)][: 4 if known else 3]


@pytest.mark.parametrize(("lost", "measured"), [(0, 1), (1, 2), (2, 2)])
def test_a_stage_whose_legs_were_lost_is_measured_once_more(
    monkeypatch: pytest.MonkeyPatch, lost: int, measured: int
) -> None:
    """A computer that stood still for a moment does not end a tune of minutes; one that always does, does."""
    runs: list[str] = []
    said: list[str] = []

    def response_of(*_: Any) -> str:
        if len(runs) <= lost:
            raise DataError("legs that were measured (=3) must be at least 4")
        return "response"

    def run(_: Any, __: Any, title: str, *, also_faults: Any) -> Any:
        runs.append(title)
        return SimpleNamespace(records="records", text=None)

    monkeypatch.setattr(carry_out, "response_of", response_of)
    carrier = carrier_of(run, said.append)
    task = response_task(shipped("precise"), None, AS_IT_FITS.legs)
    with pytest.raises(DataError, match="must be at least 4") if lost == 2 else nullcontext():
        found, records, plan = carry_out._stage(task, carrier, 1.0, 2)
        assert (found, records, len(plan.legs.starts)) == ("response", "records", 4)
    assert len(runs) == measured
    assert len(said) == min(lost, 1)


def test_a_stage_whose_log_could_not_be_written_is_not_moved_once_more() -> None:
    """The disk was full, the joint was braked for it, and enabled again."""
    runs: list[str] = []

    def run(_: Any, __: Any, title: str, **_k: Any) -> Any:
        runs.append(title)
        raise DataError("runs: cannot be written: No space left on device")

    with pytest.raises(DataError, match="No space left"):
        carry_out._stage(response_task(shipped("precise"), None, AS_IT_FITS.legs), carrier_of(run), 1.0, 2)
    assert len(runs) == 1


def test_what_tells_delay_and_lag_apart_is_a_resonance() -> None:
    """Of 10 rigid joints in lockstep 3 lags and 2 delays were outside intervals as narrow as those of soft joints."""
    late = (1.3e-3, 0.6e-3)
    rigid, soft = fit_joint(made_response(RIGID, late, motor=False), 1.0), fit_joint(made_response(SOFT, late), 2.0)
    for name in ("delay_s", "lag_s"):
        assert rigid.values[name].half >= 2.5e-4 > 1.5 * soft.values[name].half
    assert rigid.late_s.half < 1.5e-4


@pytest.mark.parametrize("quick_Nm", [3.0, 1.0])
def test_the_question_whether_it_is_the_same_joint_is_asked_once_more_with_half_the_torque(
    monkeypatch: pytest.MonkeyPatch, quick_Nm: float
) -> None:
    """A slow joint may spring beyond its velocity limit under the torque under which it did not before."""
    peaks_Nm: list[float] = []

    def stage(_: Any, __: Any, peak_Nm: float, *___: Any, **____: Any) -> Any:
        peaks_Nm.append(peak_Nm)
        if peak_Nm > quick_Nm:
            raise TooQuick("it moved too fast")
        return "response", "records", "plan"

    monkeypatch.setattr(carry_out, "_stage", stage)
    monkeypatch.setattr(carry_out, "fitted_again", lambda found, fit: fit.inertia_kgm2)
    carrier: Any = SimpleNamespace(output=SimpleNamespace(note=lambda _: None))
    fit: Any = SimpleNamespace(inertia_kgm2=joint_fit.Estimate(2.0, 0.1))
    with nullcontext() if quick_Nm > 2.0 else pytest.raises(TooQuick):
        carry_out.require_same_joint(response_task(shipped("precise"), None, 12), carrier, 4.0, fit, "before the gains")
    assert peaks_Nm == [4.0, 2.0]
