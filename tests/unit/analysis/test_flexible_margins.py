"""The linear loop of a joint that is not rigid, against the law's own kernel on the simulated joint."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.errors import MarginError
from jointctl.firmware_py.flexible_joint import Reading
from jointctl.firmware_py.kernel import JIT_DISABLED, kernel
from jointctl.firmware_py.law import reset_law, step_flexible_law
from jointctl.firmware_py.motion_records import Reference
from jointctl.firmware_py.observers import low_pass_gain
from jointctl.firmware_py.records import LawConstants, LawState
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import ControllerKind, Encoders, FeedForward
from jointctl.firmware_py.trajectory import NO_REPETITION
from jointctl.hil.plant import plant, step_plant
from jointctl.tools.analysis.gains import ChosenGains, LEAST_KV_1ps, gains_of_file
from jointctl.tools.analysis.linear_loop import LoopSettings, TwoMasses, linear_loop, loop_settings
from jointctl.tools.analysis.margin_gate import meets, require_margin
from jointctl.tools.analysis.margins import (
    cases,
    delay_margin_s,
    largest_sensitivity,
    margins,
    phase_margin_deg,
    worst_case,
)
from jointctl.tools.configuration.config import Config
from tests.configurations import shipped

PERIOD_s = 1e-3
SUBSTEP_s = 50e-6 if JIT_DISABLED else 20e-6
SUBSTEPS = round(PERIOD_s / SUBSTEP_s)
START_rad = 1e-6
GROWN_rad = 1e-3


def flexible_loop(joint: TwoMasses, **changes: Any) -> LoopSettings:
    """The law with its start gains, which believes what is true."""
    loop = LoopSettings(
        kind=ControllerKind.FLEXIBLE_JOINT, period_s=PERIOD_s, delay_s=1e-3, lag_s=0.5e-3,
        inertia_kgm2=joint.motor_kgm2 + joint.link_kgm2, motor_inertia_kgm2=joint.motor_kgm2, kp=300.0, kv=20.0,
        cutoff_Hz=300.0, observer_radps=80.0, observer_delay_cycles=1, twist_radps=60.0, link_cutoff_Hz=60.0,
        encoders=Encoders.BOTH, joints=(joint,),
    )  # fmt: skip
    return replace(loop, **changes)


def random_loops() -> list[LoopSettings]:
    """Seeded: joints as in the realistic ensemble, gains around those of configs/realistic.toml."""
    random = np.random.default_rng(7)
    found = []
    for i in range(20):
        inertia, ratio = 2.1 * random.uniform(0.85, 1.15), math.exp(random.uniform(math.log(0.3), math.log(5.0)))
        motor = inertia / (1.0 + ratio)
        stiffness = (1.0e4, 1.6e4, 3.1e4)[i % 3] * random.uniform(1.0, 2.0)
        damping = 2.0 * random.uniform(0.02, 0.06) * math.sqrt(stiffness * motor * (inertia - motor) / inertia)
        found.append(
            flexible_loop(
                TwoMasses(motor, inertia - motor, stiffness, damping),
                lag_s=random.uniform(0.3e-3, 1e-3),
                kp=300.0 * random.uniform(0.6, 1.6),
                kv=20.0 * random.uniform(0.8, 1.5),
                observer_radps=random.uniform(40.0, 90.0),
                twist_radps=random.uniform(30.0, 90.0),
                observer_delay_cycles=int(random.integers(0, 3)),
                encoders=list(Encoders)[(0, 0, 0, 1)[i % 4]],
            )
        )
    return found


def records_of(loop: LoopSettings) -> tuple[Any, Any]:
    """The law's constants and state, at rest."""
    constants, state = new(LawConstants), new(LawState)
    law, flexible = constants[0], constants[0].flexible
    law.kind, law.period_s, law.feed_forward = loop.kind, loop.period_s, FeedForward.NONE
    law.inertia_kgm2, law.kp, law.kv = loop.inertia_kgm2, loop.kp, loop.kv
    law.observer.bandwidth_radps, law.observer.delay_cycles = loop.observer_radps, loop.observer_delay_cycles
    flexible.encoders = loop.encoders
    flexible.motor_inertia_kgm2 = loop.motor_inertia_kgm2
    flexible.link_inertia_kgm2 = loop.inertia_kgm2 - loop.motor_inertia_kgm2
    flexible.twist_gain = -math.expm1(-loop.twist_radps * loop.period_s)
    slow_Hz = loop.link_cutoff_Hz if loop.encoders == Encoders.BOTH else loop.cutoff_Hz
    for velocity, cutoff_Hz in ((flexible.motor_velocity, loop.cutoff_Hz), (flexible.link_velocity, slow_Hz)):
        velocity.period_s, velocity.cutoff_Hz = loop.period_s, cutoff_Hz
        velocity.period_gain = low_pass_gain(cutoff_Hz, loop.period_s)
    reset_law(law, state[0])
    return constants, state


def plant_of(loop: LoopSettings, delay_substeps: int) -> tuple[Any, Any]:
    """The same joint, without friction and hysteresis; it takes a torque at the end of a substep for all of it."""
    joint = loop.joints[0]
    return plant(
        step_s=SUBSTEP_s, inertia_kgm2=joint.motor_kgm2 + joint.link_kgm2, flexible=True,
        motor_side_inertia_kgm2=joint.motor_kgm2, reducer_stiffness_Nmprad=joint.stiffness_Nmprad,
        reducer_damping_Nmspr=joint.damping_Nmspr, current_limit_A=1e4, current_lag_s=loop.lag_s,
        command_delay_s=delay_substeps * SUBSTEP_s,
    )  # fmt: skip


@kernel
def run_loop(law_c, law_s, reference, plant_c, plant_s, motor_feeds, substeps, injected_Nm, commands, torques):
    """The closed loop; `injected_Nm` is added behind the law: what the law asks for, and what the joint is given."""
    torque = 0.0
    for k in range(len(injected_Nm)):
        position = plant_s.motor_position_rad if motor_feeds else plant_s.joint_position_rad
        reading = Reading(position, plant_s.motor_position_rad, 1)
        torque = step_flexible_law(law_c, law_s, reading, reference, torque, NO_REPETITION)
        commands[k] = torque
        torques[k] = torque + injected_Nm[k]
        for _ in range(substeps):
            step_plant(plant_c, plant_s, torques[k])
        if not abs(plant_s.joint_position_rad) < GROWN_rad:
            return k
    return len(injected_Nm)


def simulated(loop: LoopSettings, delay_substeps: int, injected_Nm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(what the law asks for, what the joint is given) [Nm]."""
    (law_c, law_s), (plant_c, plant_s) = records_of(loop), plant_of(loop, delay_substeps)
    plant_s[0].motor_position_rad = plant_s[0].joint_position_rad = START_rad if not injected_Nm.any() else 0.0
    commands, torques = np.zeros(len(injected_Nm)), np.zeros(len(injected_Nm))
    done = run_loop(
        law_c[0], law_s[0], new(Reference)[0], plant_c[0], plant_s[0], loop.encoders == Encoders.MOTOR, SUBSTEPS,
        injected_Nm, commands, torques,
    )  # fmt: skip
    return commands[:done], torques[:done]


LOOPS = random_loops()


@pytest.mark.parametrize("case", range(1 if JIT_DISABLED else len(LOOPS)))
def test_injected_sines_find_the_margins(case):
    loop = LOOPS[case]
    found = margins(loop)
    assert found.stable
    period = 1000
    crossover = max(round(found.crossover_Hz), 1)
    for line in sorted({crossover, max(crossover // 2, 1), 2 * crossover, round(found.sensitivity_peak_Hz), 40}):
        time = np.arange(8 * period)
        injected = 1e-4 * np.sin(math.tau * line * time / period)
        commands, torques = simulated(loop, round(loop.delay_s / SUBSTEP_s), injected)
        assert len(commands) == len(time)
        kernel_at = np.exp(-1j * math.tau * line * np.arange(period) / period)
        measured = -(commands[-period:] @ kernel_at) / (torques[-period:] @ kernel_at)
        # half a substep less lag, see `plant_of`
        omega = np.array([math.tau * line])
        expected = linear_loop(replace(loop, delay_s=loop.delay_s - 0.5 * SUBSTEP_s)).open_loop(omega)[0]
        assert abs(measured) == pytest.approx(abs(expected), rel=0.03)
        assert abs(math.degrees(np.angle(measured / expected))) < 1.0


@pytest.mark.parametrize("case", range(1 if JIT_DISABLED else len(LOOPS)))
def test_a_growing_delay_ends_stability_where_the_analysis_says(case):
    loop = replace(LOOPS[case], delay_s=0.0)
    limit = delay_margin_s(loop) / SUBSTEP_s
    quiet = np.zeros(4000 if JIT_DISABLED else 20000)

    def decays(delay_substeps: int) -> bool:
        commands, _ = simulated(loop, delay_substeps, quiet)
        if len(commands) < len(quiet):
            return False
        early, late = commands[len(quiet) // 4 : len(quiet) // 2], commands[-len(quiet) // 4 :]
        return float(np.sum(late**2)) < float(np.sum(early**2))

    tolerance = round(0.1e-3 / SUBSTEP_s)  # 0.1 ms
    assert decays(max(round(limit) - tolerance, 0))
    assert not decays(round(limit) + tolerance)


# --- several joints: the worst one counts ---
NOMINAL = TwoMasses(1.0, 1.1, 2.4e4, 7.3, name="nominal")
LIGHT = TwoMasses(1.0, 0.2, 0.9e4, 2.0, name="light")


def test_of_several_joints_the_worst_one_is_judged():
    good, bad = phase_margin_deg(flexible_loop(NOMINAL)), phase_margin_deg(flexible_loop(NOMINAL, joints=(LIGHT,)))
    assert bad < good
    loop = flexible_loop(NOMINAL, joints=(NOMINAL, LIGHT))
    assert phase_margin_deg(loop) == bad
    assert worst_case(loop).joints == (LIGHT,)
    assert margins(loop).joint == "light"


def test_without_twist_the_loop_is_that_of_the_rigid_joint():
    stiff = TwoMasses(1.0, 1.1, 1e8, 2e3)
    soft = replace(stiff, stiffness_Nmprad=1e4, damping_Nmspr=5.0)
    for encoders in Encoders:
        of_stiff = linear_loop(flexible_loop(stiff, encoders=encoders, link_cutoff_Hz=300.0))
        rigid = replace(
            of_stiff.settings, kind=ControllerKind.COMPUTED_TORQUE_OBSERVER, joints=(), observer_delay_cycles=1
        )
        omega = np.array([3.0, 30.0, 300.0])
        assert of_stiff.open_loop(omega) == pytest.approx(linear_loop(rigid).open_loop(omega), rel=2e-3)
        of_soft = linear_loop(flexible_loop(soft, encoders=encoders, link_cutoff_Hz=300.0))
        assert abs(of_soft.open_loop(omega)[2] / of_stiff.open_loop(omega)[2] - 1.0) > 0.1


def test_the_link_alone_is_not_to_be_had_with_the_gains_for_both():
    for joint in (NOMINAL, LIGHT):
        assert margins(flexible_loop(joint)).stable
        assert not margins(flexible_loop(joint, encoders=Encoders.LINK)).stable
        slow = flexible_loop(joint, encoders=Encoders.LINK, kp=36.0, kv=8.0, observer_radps=6.0, cutoff_Hz=60.0)
        assert margins(slow).stable


def test_where_no_setting_helps_the_hint_names_gains_that_the_law_has() -> None:
    """It named q, of the network; these laws have none."""
    link = with_encoders(believed(reducer__map=None), Encoders.LINK)
    rigid = link.changed(control__kind="computed_torque_observer", control__kp=3600.0, control__kv=120.0)
    for config in (link, rigid):
        with pytest.raises(MarginError, match="unstable") as caught:
            require_margin(config)
        assert caught.value.hint.endswith("--choose-gains` searches kp, kv and observer_radps together")


# --- gains for what is believed of a joint ---
def believed(**changes: Any) -> Config:
    return shipped("realistic", **changes)


def with_encoders(config: Config, encoders: Encoders) -> Config:
    """The encoder on the motor alone, or that on the link alone."""
    if encoders == Encoders.BOTH:
        return config
    counts = config.joint_encoder.counts_per_turn
    alone = config.changed(joint_encoder=None)
    if encoders == Encoders.MOTOR:
        return alone
    return alone.changed(encoder__side="joint", encoder__counts_per_turn=counts)


@cache
def chosen(encoders: Encoders, **changes: float) -> ChosenGains:
    """Searched once; several tests ask for those of the same joint."""
    config = with_encoders(believed(**changes), encoders)
    return gains_of_file(config, loop_settings(config)[0])


@pytest.mark.parametrize("encoders", list(Encoders))
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"reducer__motor_inertia_kgm2": 0.4},
        {"reducer__motor_inertia_kgm2": 1.6, "reducer__loop_stiffness_Nmprad": 1.6e4},
        {"margin__loop_delay_s": 2.5e-3},
    ],
)
def test_chosen_gains_keep_their_promise_on_every_joint(changes: dict[str, Any], encoders: Encoders) -> None:
    found = chosen(encoders, **changes)
    best = found.best
    assert found.missed == {}
    assert best.settings.encoders == encoders
    assert ("link_cutoff_Hz" in found.changes()) is (encoders == Encoders.BOTH)
    largest_s = max(best.sensitivity, best.gate_sensitivity)
    for case in cases(best.settings):
        if case.joints[0].bristle_Nmprad == (0.0, 0.0):
            judged = margins(case)
            assert judged.stable
            assert judged.sensitivity_peak <= largest_s * 1.01  # of the same joints and more
    assert phase_margin_deg(best.settings) > 29.9


@pytest.mark.parametrize(
    ("encoders", "wanted"),
    [
        (Encoders.LINK, {"margin__min_phase_margin_deg": 40.0}),
        (Encoders.BOTH, {"margin__min_phase_margin_deg": 45.0}),
        (Encoders.BOTH, {"margin__max_sensitivity": 1.6}),
    ],
)
def test_chosen_gains_are_not_refused_by_the_gate_of_the_same_file(encoders: Encoders, wanted: dict[str, Any]) -> None:
    config = with_encoders(believed(**wanted), encoders)
    minimum_deg, (settings, _) = config.margin.min_phase_margin_deg, loop_settings(config)
    assert meets(margins(chosen(encoders, **wanted).best.settings), minimum_deg)
    of_usual = replace(chosen(encoders).best.settings, largest_s=settings.largest_s)
    assert not meets(margins(of_usual), minimum_deg)


def test_where_there_are_no_gains_that_is_said_and_none_is_uselessly_soft() -> None:
    found = chosen(Encoders.MOTOR, margin__min_phase_margin_deg=80.0)
    assert found.missed
    assert found.changes()["kv"] > 0.8 * LEAST_KV_1ps
    assert not chosen(Encoders.MOTOR).missed


def test_a_light_motor_that_is_late_gets_a_filter_far_below_its_resonance() -> None:
    """It bears more behind one."""
    found = chosen(Encoders.BOTH, reducer__motor_inertia_kgm2=0.15, margin__loop_delay_s=1.7e-3)
    assert not found.missed
    assert found.changes()["velocity_cutoff_Hz"] < 20.0
    assert found.changes()["kv"] > 5.0
    assert all(margins(case).stable for case in cases(found.best.settings))
    assert not any(meets(margins(replace(found.best.settings, cutoff_Hz=Hz)), 30.0) for Hz in (50.0, 450.0))


def test_more_delay_leaves_smaller_gains() -> None:
    assert 0.5e-3 < loop_settings(believed())[0].delay_s < 2.5e-3
    delays: list[dict[str, float]] = [{"margin__loop_delay_s": 0.5e-3}, {}, {"margin__loop_delay_s": 2.5e-3}]
    found = [chosen(Encoders.BOTH, **delay).changes()["kv"] for delay in delays]
    assert found == sorted(found, reverse=True)
    assert found[-1] < 0.7 * found[0]


# --- the peak of |S| is judged of the joint that has it, besides the phase margin ---
def test_the_sensitivity_is_that_of_the_joint_with_the_highest_peak() -> None:
    found = {case.joints[0].name: margins(case).sensitivity_peak for case in cases(loop_settings(believed())[0])}
    whole = margins(loop_settings(believed())[0])
    assert whole.sensitivity_peak == pytest.approx(max(found.values()))
    assert found[whole.sensitivity_joint] == pytest.approx(whole.sensitivity_peak)
    peak, peak_Hz, case = largest_sensitivity(loop_settings(believed())[0])
    assert (peak, peak_Hz, case.joints[0].name) == (
        whole.sensitivity_peak, whole.sensitivity_peak_Hz, whole.sensitivity_joint
    )  # fmt: skip


def test_a_peak_above_the_limit_is_refused_with_remedies_that_do() -> None:
    """Enough phase margin and a resonance that is too sharp."""
    sharp = {"control__kv": 90.0, "control__kp": 1000.0, "margin__min_phase_margin_deg": 5.0}
    found = margins(loop_settings(believed(**sharp))[0])
    assert found.phase_margin_deg > 5.0
    just = {**sharp, "margin__max_sensitivity": found.sensitivity_peak * 1.001}
    assert require_margin(believed(**just)).stable
    limit = round(found.sensitivity_peak * 0.8, 2)
    config = believed(**sharp, margin__max_sensitivity=limit)
    with pytest.raises(
        MarginError, match=rf"peak of the sensitivity \|S\| \(=[\d.]+ at [\d.]+ Hz\) must be at most {limit:g}"
    ) as caught:
        require_margin(config)
    assert found.sensitivity_joint in str(caught.value)
    assert require_margin(config, allow_low_margin=True).stable
    remedy = re.search(
        r"a slower loop: control\.kp = ([\d.e+]+), kv = ([\d.]+), observer_radps = ([\d.]+)", caught.value.hint
    )
    assert remedy is not None
    kp, kv, observer = (float(number) for number in remedy.groups())
    slower = believed(**{**sharp, "control__kp": kp, "control__kv": kv, "control__observer_radps": observer})
    assert margins(loop_settings(slower)[0]).sensitivity_peak <= 1.005 * limit  # the numbers of the message are rounded


def test_of_a_rigid_joint_no_peak_is_judged() -> None:
    found = require_margin(shipped("paper", margin__max_sensitivity=1.0, margin__min_phase_margin_deg=10.0))
    assert found.sensitivity_peak > 1.0
