"""Constants that are each in range and contradict each other: one warning, dense at its boundary."""

from __future__ import annotations

import math
from typing import Any

import pytest

from jointctl.tools.analysis.loop_report import contradictions
from jointctl.tools.configuration.conversions import law_resolution_rad, static_friction_Nm, velocity_of_a_count_radps
from tests.configurations import shipped

VIRTUAL = shipped()
NO_RATED = {"drive__rated_current_A": None, "drive__rated_torque_Nm": None}


def lines(**changes: Any) -> str:
    return "\n".join(contradictions(VIRTUAL.changed(**changes)))


@pytest.mark.parametrize("name", ["virtual", "precise", "paper", "sweep_virtual", "elmo_serial", "realistic", "csp"])
def test_what_is_shipped_contradicts_nothing(name: str) -> None:
    assert contradictions(shipped(name)) == []


def test_a_torque_constant_of_another_world() -> None:
    assert "is 0.00496 A of the motor" in lines(joint__torque_constant_NmpA=100.0, **NO_RATED)


@pytest.mark.parametrize(
    ("current_A", "rated_A", "warned"),
    [(0.0201, None, False), (0.0199, None, True), (299.0, None, False), (301.0, None, True),
     (0.101, 5.0, False), (0.099, 5.0, True), (49.9, 5.0, False), (50.1, 5.0, True)],
)  # fmt: skip
def test_the_current_that_the_torque_limit_asks_for(current_A: float, rated_A: float | None, warned: bool) -> None:
    joint = VIRTUAL.joint
    limit = current_A * joint.torque_constant_NmpA * joint.reduction_ratio
    text = lines(
        limits__torque_max_Nm=limit, drive__rated_current_A=rated_A, drive__rated_torque_Nm=None,
        joint__inertia_kgm2=1e-3 * limit, joint__gravity_Nm=0.0, sequence__brake_radps2=1e-3,
    )  # fmt: skip
    assert ("limits.torque_max_Nm" in text) is warned
    assert not warned or rated_A is None or "times drive.rated_current_A (=5)" in text


@pytest.mark.parametrize(("factor", "warned"), [(1.24, False), (1.26, True), (0.81, False), (0.79, True)])
def test_rated_values_and_torque_constant(factor: float, warned: bool) -> None:
    assert ("drive.rated_torque_Nm" in lines(drive__rated_torque_Nm=0.5 / factor)) is warned


@pytest.mark.parametrize(("share", "warned"), [(0.99, False), (1.01, True)])
def test_braking_needs_less_than_the_torque_limit(share: float, warned: bool) -> None:
    limits, sequence = VIRTUAL.limits, VIRTUAL.sequence
    heavy = share * limits.torque_max_Nm / sequence.brake_radps2
    assert ("times sequence.brake_radps2" in lines(joint__inertia_kgm2=heavy)) is warned
    text = lines(joint__inertia_kgm2=heavy, joint__gravity_Nm=-limits.torque_max_Nm * 0.02)
    assert "times sequence.brake_radps2" in text


@pytest.mark.parametrize(("share", "warned"), [(1.01, False), (0.99, True)])
def test_an_inertia_that_is_the_motors(share: float, warned: bool) -> None:
    limits = VIRTUAL.limits
    light = share * limits.torque_max_Nm / VIRTUAL.loop.rate_Hz / limits.velocity_max_radps
    assert ("without the ratio squared?" in lines(joint__inertia_kgm2=light)) is warned


@pytest.mark.parametrize(("share", "warned"), [(1.01, False), (0.99, True)])
def test_one_count_of_the_encoder_is_slower_than_standstill(share: float, warned: bool) -> None:
    """And than one count while it settles, by which a joint that flickers is told from one that moves."""
    standstill = share * velocity_of_a_count_radps(VIRTUAL)
    short = {"limits__standstill_radps": standstill, "sequence__settle_s": 0.001}
    assert ("limits.standstill_radps" in lines(**short)) is warned
    slow = share * law_resolution_rad(VIRTUAL) / VIRTUAL.sequence.settle_s
    assert ("limits.standstill_radps" in lines(limits__standstill_radps=slow)) is warned


@pytest.mark.parametrize(("share", "warned"), [(1.01, False), (0.99, True)])
def test_a_soft_loop_is_held_by_friction_that_is_a_little_more(share: float, warned: bool) -> None:
    soft = shipped("realistic")
    static_Nm = static_friction_Nm(soft)
    assert static_Nm is not None
    kp = share * 0.1 * static_Nm / (soft.joint.inertia_kgm2 * 0.01 * (1.0 + 0.1))
    own = soft.changed(control__kp=kp, control__observer_radps=1.0)
    assert any("(POSITION_FROZEN)" in line for line in contradictions(own)) is warned
    assert contradictions(own.changed(control__feed_forward="none")) == []


@pytest.mark.parametrize(("stiffness", "warned"), [(None, False), (1.7e4, False), (1.69e4, True)])
def test_a_small_motion_is_no_softer(stiffness: float | None, warned: bool) -> None:
    found = contradictions(shipped("realistic", reducer__loop_stiffness_Nmprad=stiffness))
    assert any("hysteresis makes a small motion stiffer" in line for line in found) is warned


def of_braking(**changes: Any) -> list[str]:
    return [line for line in contradictions(shipped("realistic", **changes)) if "sequence.brake_radps2 (=" in line]


@pytest.mark.parametrize("changes", [{}, {"margin__payload_range": (0.7, 2.0)}, {"reducer__stiffness_Nmprad": 1.2e4}])
def test_braking_twists_a_soft_reducer_by_no_more_than_its_encoders_may_differ(changes: dict[str, Any]) -> None:
    """Twice the steady twist of the heaviest link on the softest reducer, to either side of the limit."""
    config = shipped("realistic", **changes)
    assert config.reducer is not None
    heaviest_kgm2 = config.margin.payload_range[1] * config.link_kgm2
    softest = (1.0 - config.margin.stiffness_error) * config.reducer.stiffness_Nmprad
    limit_rad = 2.0 * heaviest_kgm2 * config.sequence.brake_radps2 / softest
    assert of_braking(**changes, joint_encoder__disagreement_max_rad=1.01 * limit_rad) == []
    (line,) = of_braking(**changes, joint_encoder__disagreement_max_rad=0.99 * limit_rad)
    assert f"by up to {1e3 * limit_rad:.3g} mrad" in line
    assert "POSITION_DISAGREEMENT" in line
    better_radps2 = float(line.split("POSITION_DISAGREEMENT; ")[1].split(" rad/s2")[0])
    slower = {"joint_encoder__disagreement_max_rad": 0.99 * limit_rad, "sequence__brake_radps2": better_radps2}
    assert of_braking(**changes, **slower) == []
    assert of_braking(**changes, joint_encoder=None, encoder__side="joint") == []


@pytest.mark.parametrize(("share", "warned"), [(1.01, False), (0.99, True)])
def test_a_link_that_swings_on_its_reducer_comes_to_rest_before_a_stop_ends(share: float, warned: bool) -> None:
    """A belt: 4.1 Hz, 2 % of the critical damping, with one encoder as with two."""
    belt: dict[str, Any] = {
        "reducer__stiffness_Nmprad": 1.5e3, "reducer__loop_stiffness_Nmprad": None, "reducer__knees_Nm": (),
        "reducer__stiffness_beyond_Nmprad": (), "reducer__damping_Nmspr": 0.0, "joint_encoder": None,
    }  # fmt: skip
    config = shipped("realistic", **belt)
    omega = math.sqrt(0.7 * 1.5e3 / (1.4 * config.link_kgm2))
    swings_s = math.log(2.0 / omega / config.limits.standstill_radps) / (0.02 * omega)
    timeout_s = config.limits.velocity_max_radps / config.sequence.brake_radps2 + share * swings_s
    lines = of_braking(**belt, sequence__stop_timeout_s=timeout_s)
    assert ["STOP_TIMEOUT" in line for line in lines] == [True] * warned
    assert of_braking(**belt, sequence__stop_timeout_s=timeout_s, limits__standstill_radps=2.0 / omega) == []
