"""The map of a reducer: what was put into a motion is found again, with intervals that hold."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import tomlkit

from jointctl.drivers.errors import DataError
from jointctl.tools.analysis.reducer_map import (
    FoundMap,
    MapRun,
    found_map,
    kept_waves,
    late_torque_Nm,
    map_figure,
)
from jointctl.tools.configuration.found_values import with_map

RATIO, SPEED, MOTOR, LINK = 121.0, 0.03, 0.9, 1.2
ERROR = {1: (1.5e-5, 0.3), 2: (2e-4, 0.6), 4: (5e-5, -1.1)}  # per motor turn: (rad, rad)
RIPPLE = {2: (1.0, 2.0), 10: (0.33, 0.4)}  # Nm


def series(waves: dict[int, tuple[float, float]], theta: np.ndarray) -> np.ndarray:
    return sum(
        (size * np.sin(order * RATIO * theta + phase) for order, (size, phase) in waves.items()), np.zeros_like(theta)
    )


def made_run(seed: int = 1, travel_rad: float = 0.5, swing: float = 2e-5) -> MapRun:
    """A motor that gives way to its ripple, friction and wind-up with hysteresis, encoders of 16 and 19 bit."""
    random = np.random.default_rng(seed)
    time_s = np.arange(0.0, travel_rad / SPEED, 1e-3)
    parts = []
    for side in (1.0, -1.0):
        even = side * SPEED * time_s - (side - 1.0) / 2.0 * travel_rad
        # tau + r = J q'': the joint swings by 20 urad, and so much less is to be held
        motor, holds = even.copy(), np.zeros_like(even)
        for order, (size, phase) in RIPPLE.items():
            wave = np.sin(order * RATIO * even + phase)
            motor -= swing * wave
            holds -= (size - (MOTOR + LINK) * (order * RATIO * SPEED) ** 2 * swing) * wave
        link = motor + series(ERROR, motor) - side * 1.3e-4 + 2e-5 * even
        torque = side * 18.0 + 1.5 * even + holds
        rows = [
            np.round(motor * RATIO * 65536 / math.tau) * math.tau / 65536 / RATIO,
            np.round(link * 524288 / math.tau) * math.tau / 524288,
            torque + random.normal(0.0, 0.3, len(time_s)),
            np.full_like(time_s, side * SPEED),
        ]
        parts.append(rows)
    motor, link, torque, desired = (np.concatenate(column) for column in zip(*parts, strict=True))
    return MapRun(motor, link, torque, desired, RATIO, MOTOR, LINK)


def found_of(waves: tuple[object, ...]) -> dict[int, tuple[float, float, float]]:
    return {wave.per_motor_turn: (wave.amplitude, wave.phase_rad, wave.amplitude_half) for wave in kept_waves(waves)}  # type: ignore[attr-defined, arg-type]


@pytest.mark.parametrize("swing", [0.0, 2e-5])
def test_both_series_are_found_whatever_the_joint_gives_way(swing: float) -> None:
    found = found_map(made_run(swing=swing))
    for waves, true, floor in ((found.kinematic_rad, ERROR, 2e-6), (found.ripple_Nm, RIPPLE, 0.03)):
        kept = found_of(waves)
        for order, (size, phase) in true.items():
            assert kept[order][0] == pytest.approx(size, abs=floor)
            assert kept[order][1] == pytest.approx(phase, abs=3.0 * floor / size)
        assert all(kept[order][0] < 2.0 * floor for order in kept.keys() - true.keys())


def test_intervals_hold_about_as_often_as_they_say() -> None:
    inside = []
    for seed in range(60):
        found = found_map(made_run(seed, 0.3, 0.0))
        for order, (size, _) in RIPPLE.items():
            wave = found.ripple_Nm[order - 1]
            inside.append(abs(wave.amplitude - size) <= wave.amplitude_half)
    assert 0.88 <= np.mean(inside) <= 1.0


def test_the_interval_holds_what_friction_does_alike_to_every_turn_of_a_direction() -> None:
    made = made_run(swing=0.0)
    assert made.link_rad is not None
    forwards = np.where(made.desired_radps > 0.0, 0.01, 0.0) * series({4: ERROR[4]}, made.motor_rad)
    found = found_map(replace(made, link_rad=made.link_rad + forwards)).kinematic_rad[3]
    assert abs(found.amplitude - ERROR[4][0]) <= found.amplitude_half <= 0.02 * ERROR[4][0]


def test_what_has_more_periods_than_are_looked_for_is_in_no_sine() -> None:
    """A slope in each turn took it, and all sines made up for that slope: 0.7 of it once a turn."""
    made = made_run(swing=0.0)
    assert made.link_rad is not None
    link_rad = made.link_rad + series({16: (1e-4, 1.0)}, made.motor_rad)
    cogging_Nm = series({24: (0.5, 0.5)}, made.motor_rad)
    found = found_map(replace(made, link_rad=link_rad, torque_Nm=made.torque_Nm - cogging_Nm))
    for waves, true, floor in ((found.kinematic_rad, ERROR, 2e-6), (found.ripple_Nm, RIPPLE, 0.03)):
        kept = found_of(waves)
        assert {order: wave[0] for order, wave in kept.items() if order in true} == pytest.approx(
            {order: size for order, (size, _) in true.items()}, abs=floor
        )
        assert all(kept[order][0] < 2.0 * floor for order in kept.keys() - true.keys())


def test_a_sine_within_its_own_interval_is_no_part_of_the_map() -> None:
    """Of friction: it is there in one direction only, the same in every turn."""
    made = made_run()
    assert made.link_rad is not None
    forwards = np.where(made.desired_radps > 0.0, 1e-5 * np.sin(6.0 * RATIO * made.motor_rad), 0.0)
    wave = found_map(replace(made, link_rad=made.link_rad + forwards)).kinematic_rad[5]
    assert wave.amplitude == pytest.approx(0.5e-5, rel=0.1)
    assert wave.amplitude < wave.amplitude_half
    assert not wave.found


def test_what_the_links_inertia_twists_the_reducer_is_added_and_the_interval_holds_a_stiffness_that_is_wrong() -> None:
    """A link whose swing on the reducer makes 14 % of the wave of four periods."""
    omega_radps, soft = 4.0 * RATIO * SPEED, 1.8e3
    truth, made = ERROR[4][0], made_run(swing=0.0)
    assert made.link_rad is not None
    twist = LINK * omega_radps**2 / soft
    wave = series({4: ERROR[4]}, made.motor_rad)
    run = replace(made, link_rad=made.link_rad + wave * (1.0 / (1.0 - twist) - 1.0))
    assert found_map(run).kinematic_rad[3].amplitude > 1.1 * truth
    assert found_map(replace(run, stiffness_Nmprad=soft)).kinematic_rad[3].amplitude == pytest.approx(truth, rel=0.01)
    for wrong in (0.8, 1.0, 1.2):
        found = found_map(replace(run, stiffness_Nmprad=wrong * soft)).kinematic_rad[3]
        assert abs(found.amplitude - truth) <= found.amplitude_half


def test_a_joint_with_one_encoder_has_a_map_of_ripple_alone() -> None:
    run = made_run()
    found = found_map(MapRun(run.motor_rad, None, run.torque_Nm, run.desired_radps, RATIO, MOTOR, LINK))
    assert found.kinematic_rad == ()
    assert found_of(found.ripple_Nm).keys() >= RIPPLE.keys()


def test_too_short_a_motion_is_refused() -> None:
    with pytest.raises(DataError, match=r"motor turns at constant speed \(=1 forwards, 1 backwards\)"):
        found_map(made_run(travel_rad=0.11))


def test_the_torque_is_taken_when_it_acts() -> None:
    command = np.sin(np.arange(1000) * 1e-3 * 20.0)
    late = late_torque_Nm(command, 1e-3, 1.5e-3)
    assert late[100:] == pytest.approx(np.sin((np.arange(100, 1000) - 1.5) * 1e-3 * 20.0), abs=1e-4)


def test_the_picture_shows_what_there_is() -> None:
    found = found_map(made_run())
    assert len(map_figure(found, "both").axes) == 4
    assert len(map_figure(FoundMap((), found.ripple_Nm, found.turns, SPEED), "one").axes) == 2


CONFIGURATION = """[reducer]                         # believed
motor_inertia_kgm2 = 0.95         # of the motor
{map}
[limits]                          # of the joint
position_min_rad = -0.7
"""
OLD = "\n[reducer.map]  # older\nkinematic_error_rad = [0.1]  # too much\n"


@pytest.mark.parametrize("old", ["", OLD])
def test_the_section_is_written_and_every_comment_stays(old: str) -> None:
    values = found_map(made_run()).values(1, 17)
    text = with_map(CONFIGURATION.replace("{map}", old), values, "map of 4 turns")
    again = tomlkit.parse(text).unwrap()
    assert again["reducer"]["map"] == values
    assert again["limits"] == {"position_min_rad": -0.7}
    for comment in ("# believed", "# of the motor", "# of the joint", "map of 4 turns"):
        assert comment in text
    assert with_map(text, values, "map of 5 turns").count("map of") == 1


def test_without_a_reducer_the_ripple_has_a_section_of_its_own() -> None:
    assert tomlkit.parse(with_map("[limits]\n", {"torque_ripple_Nm": 0.1}, "")).unwrap()["ripple"] == {
        "torque_ripple_Nm": 0.1
    }
