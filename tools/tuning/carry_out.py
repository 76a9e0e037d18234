"""Carrying out the motions of one command, one after the other: on the drive, each as a session, or in lockstep.

One yes is for all of them, and one control of the joint.  The margin gate judges every loop before it is closed, in
simulated time as well.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import ConfigurationError, DataError, LimitCycle, MotionFault, UsageError, text_Nm
from jointctl.firmware_py.states import AxisPhase, Fault, in_words
from jointctl.firmware_py.trajectory import peak_of, quintic_s
from jointctl.hil.canopen.records import PowerState
from jointctl.tools.analysis.gains import BELIEVED, Intervals, latest_s
from jointctl.tools.analysis.linear_loop import loop_settings
from jointctl.tools.analysis.margin_gate import meets, passes
from jointctl.tools.analysis.margins import margins
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import static_friction_Nm
from jointctl.tools.configuration.found_values import Found, rounded, with_sliding, with_values
from jointctl.tools.configuration.records import axis_constants, trajectory_constants, trajectory_table
from jointctl.tools.configuration.sections import MinJerk, Trajectory
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import log_path
from jointctl.tools.recording.run_log_reader import read_run_log
from jointctl.tools.recording.run_summary import learning_factor
from jointctl.tools.session.control import Control
from jointctl.tools.session.display import run_display
from jointctl.tools.session.fault_words import FaultText, ended_by
from jointctl.tools.session.plan import ConfiguredMotion, Motion, Placed, RunPlan, TerminalConsent, require_approach
from jointctl.tools.session.result import require_off
from jointctl.tools.session.session import Session
from jointctl.tools.session.session_drive import latched_text
from jointctl.tools.sweeping.carry_out import simulated
from jointctl.tools.tuning.frequency_response import (
    GOOD_COHERENCE,
    LEAST_SHARE,
    STIFF,
    STIFFEST,
    WEAK,
    FrequencyResponse,
    Multisine,
    ResponseLaw,
    ResponseMotion,
    ResponsePlan,
    config_of_response,
    grown,
    largest_peak_Nm,
    legs_of,
    multisine,
    response_of,
    speed_and_period,
)
from jointctl.tools.tuning.joint_fit import Estimate, JointFit, fit_joint, fitted_again

SLOW_OBSERVERS = 8  # that are tried, from the slowest on
SLOW_OBSERVER_radps = 50.0  # at most, where the gate allows it, while the friction is not known: a quicker one hunts


class TooWeak(MotionFault):
    """A joint that stood, stayed behind or swung slowly, hardly pushed: the law is too weak for its friction."""


class TooQuick(MotionFault):
    """A joint that moved too fast: by less torque it may be measured, by a stiffer law it would move no slower."""


class LearningSwings(LimitCycle):
    """Torque or error swung while iterative learning added torque, which need not be the cause."""


class TooStiff(MotionFault):
    """A joint that swung fast: its torque is later than is known yet, or its reducer softer."""


class Pushed(TooStiff):
    """A joint that swung slowly, pushed hard: it may be against something, and no stiffer law may follow."""


class NotCarriedOut(Exception):
    """A motion that was declined or only shown (`stopped_by` ""), or stopped by the user; the drive is off."""

    def __init__(self, drive_state: str, stopped_by: str = "") -> None:
        super().__init__(stopped_by)
        self.drive_state, self.stopped_by = drive_state, stopped_by


@dataclass(frozen=True)
class Carried:
    """What a motion left."""

    records: Any  # of the whole log
    fault: Fault
    text: FaultText | None
    log: str  # "" in simulated time
    value: float = 0.0  # that tripped the limit of the fault


def _ended(title: str, carried: Carried) -> MotionFault:
    assert carried.text is not None
    error = ended_by(carried.fault, carried.text, before=f"{title}: ")
    if carried.fault is Fault.LIMIT_CYCLE and np.any(carried.records.learned_torque_Nm != 0.0):
        return LearningSwings(error.message, error.hint)
    return error


@dataclass
class Carrier:
    """For all motions of one command; `control` is None in lockstep."""

    output: Output
    consent: TerminalConsent
    control: Control | None
    allow_low_margin: bool = False
    drive_state: str = ""

    @property
    def drives(self) -> list[str]:
        """See `StopSignals.drives`; none in lockstep."""
        return [] if self.control is None else self.control.signals.drives

    @drives.setter
    def drives(self, drives: list[str]) -> None:
        if self.control is not None:
            self.control.signals.drives = drives

    def quietly(self) -> Output:
        """For a part whose result is not that of the command; in simulated time without its progress."""
        quiet = self.output.quiet or self.control is None
        return replace(self.output, quiet=quiet, json=False, taken=lambda _: None)

    def run(self, config: Config, motion: Motion, title: str, *, also_faults: Container[Fault] = ()) -> Carried:
        """The records; `MotionFault` after any other fault than these, `NotCarriedOut` where it was not begun."""
        carried = self._simulated(config, motion) if self.control is None else self._moved(config, motion, title)
        if carried.text is not None and carried.fault not in also_faults:
            if carried.log:
                self.output.note(f"log: {carried.log}")
            raise _ended(title, carried)
        return carried

    def _simulated(self, config: Config, motion: Motion) -> Carried:
        consent = self.consent if self.consent.dry_run else TerminalConsent(self.quietly(), assume_yes=True)
        begun = simulated(config, motion, consent, allow_low_margin=self.allow_low_margin)
        if begun is None:
            raise NotCarriedOut("")
        joint, placed = begun
        run = joint.run_as_configured(placed.constants, placed.table)
        self.drive_state = in_words(PowerState(int(run.device.state)))
        return Carried(run.log, run.fault, latched_text(config, run.state), "", float(run.state.fault_value))

    def _moved(self, config: Config, motion: Motion, title: str) -> Carried:
        assert self.control is not None
        plan = RunPlan(config, motion, log_path(config), self.allow_low_margin)
        session = Session(plan, self.consent, self.output, self.control, run_display(self.output, title))
        try:
            result = session.run()
        except KeyboardInterrupt:
            raise NotCarriedOut(session.drive_state, self.control.signals.stopped_by) from None
        finally:
            self.drive_state = session.drive_state
        if result is None:
            raise NotCarriedOut(session.drive_state)
        require_off(session.drive_state)
        if by := result.stopped_by or self.control.signals.name:  # a stop may have come after the result
            raise NotCarriedOut(session.drive_state, by)
        if result.lost_records:
            self.output.warning(f"{result.lost_records} log records were lost: the supervisor was too slow")
        records = read_run_log(result.log_path).records
        return Carried(records, result.fault, result.fault_text, str(result.log_path), result.fault_value)


class ShownConsent(TerminalConsent):
    """One yes for all motions of a command; the envelope of each is shown all the same."""

    def show(self, lines: Sequence[str]) -> None:
        for line in lines:
            self._output.note(f"  {line}") if self._given else self._output.fact(line)


# --- The motion that shows what was found ---


VERIFY_s, LEAST_VERIFY_s = 30.0, 0.5
VERIFY_FROM_s = 5.0
SWEEP_SHARE = 0.7  # of limits.velocity_max_radps, in the friction step: a soft reducer swings about the speed


def with_motion(config: Config, motion: Trajectory) -> Config:
    """With an approach from wherever the step before has left the joint."""
    return config.changed(trajectory=motion, sequence__approach_s="auto")


@dataclass(frozen=True)
class VerifyingMotion(ConfiguredMotion):
    """Its reading is watched with the friction that was found: that of the file as it was may be far too small."""

    found: Config

    def placed(self, report: CommissioningReport) -> Placed:
        placed = super().placed(report)
        known = axis_constants(self.found, self.table, start_position_rad=report.start_position_rad)[0].limits
        limits = placed.constants[0].limits
        limits.frozen_torque_Nm, limits.frozen_cycles = known.frozen_torque_Nm, known.frozen_cycles
        return placed


def verifying_motion(config: Config) -> Trajectory:
    """That of the configuration, `VERIFY_s` at most; `UsageError` for one that is over before it is seen.

    Where its approach would leave the limits from one of their ends: back and forth over its range, as fast, at rest at
    both ends, which the approach from wherever the joint stands does not pass.
    """
    limits, table = config.limits, trajectory_table(config)
    seconds = min(config.trajectory.duration_s or VERIFY_s, VERIFY_s)
    if seconds < LEAST_VERIFY_s:
        raise UsageError(
            f"trajectory.duration_s (={seconds:g}) must be 0 or at least {LEAST_VERIFY_s:g}, for the run that verifies"
        )
    motion = config.trajectory.model_copy(update={"duration_s": seconds})
    moving = with_motion(config, motion)
    try:
        for start_rad in (limits.position_min_rad, limits.position_max_rad):
            (axis,) = axis_constants(moving, table, start_position_rad=start_rad)
            require_approach(limits, axis, table, start_rad)
    except (ConfigurationError, MotionFault):
        low, high, speed, acceleration = peak_of(trajectory_constants(config, table), table)
        way = high - low
        move_s = quintic_s(way, speed, acceleration)
        return MinJerk(
            kind="min_jerk", duration_s=seconds, start_rad=low, target_rad=high, move_s=move_s, repeat=True
        )  # fmt: skip
    return motion


def verified(
    carrier: Carrier, config: Config, verifying: Trajectory, found: Config, title: str, also_faults: Container[Fault]
) -> dict[str, Any]:
    """Error and chatter of that motion, "learning" as `learning_factor` has it; "fault" after one of `also_faults`.

    Other faults as `Carrier.run` has them.
    """
    moving = with_motion(config, verifying)
    table = trajectory_table(moving)
    carried = carrier.run(moving, VerifyingMotion(moving, table, found), title, also_faults=also_faults)
    rows = carried.records[carried.records.phase == AxisPhase.TRACKING]
    later = rows[rows.trajectory_s >= min(VERIFY_FROM_s, 0.5 * verifying.duration_s)]
    if carried.text is not None or not len(later):
        return {"fault": carried.fault.name}
    error = 1e3 * np.asarray(later.error_rad)
    return {
        "rmse_mrad": float(np.sqrt(np.mean(error**2))), "peak_mrad": float(np.max(np.abs(error))),
        "chatter_Nm": float(np.mean(np.abs(np.diff(later.command_torque_Nm)))), "log": carried.log,
        "seconds": verifying.duration_s, "learning": learning_factor(trajectory_constants(moving, table), table, rows),
    }  # fmt: skip


# --- The frequency response: short stages that begin small and grow, then the whole one ---
# A stage with more torque follows while the coherence is low and the torque is not yet the largest allowed one.  It
# ends where the joint answers a greater torque with more than its share, which is what a loop on its way to a limit
# cycle does; limit cycles themselves, and encoders that disagree, end a run as they end every other one.
#
# The joint must stay the same: the first half of the legs is compared with the second one, and later steps measure
# once more what it weighs.


LEAST_LEGS, MOST_LEGS = 8, 100
STAGE_PAIRS = 2  # of legs in a stage that only looks for the torque
GROWTH = 2.0  # of the torque from stage to stage
ENOUGH_COHERENCE = 0.98  # median over the lines
HUNTING_Hz = 8.0  # between sticking and sliding, below it; a resonance swings above, and a stiffer law would feed it
PUSHED_s = 0.5  # before the end, in which no torque was more
STANDS_SHARE = 0.1  # of the way of the reference: what the other encoder may show of a joint that stands
TOO_WEAK = "the law may be too weak for the friction where joint.inertia_kgm2 (={:g}) is too small"
MOST_OF_MOTOR = 0.95  # of the whole inertia
RESONANCE_GROWTH = 2.5  # of the highest peak from stage to stage
LEAST_CHANGE = 0.1  # of the inertia: a payload; what both intervals allow is none


@dataclass(frozen=True)
class ResponseTask:
    """What is to be measured, resolved before anything moves; `config` is that of `config_of_response`."""

    config: Config
    sine: Multisine
    pairs: int
    largest_Nm: float
    gains: str = ""  # OF_FILE or OF_JOINT, where they took the place of the law that was asked for

    def motion(self, peak_Nm: float, pairs: int, *, last: bool = False) -> ResponseMotion:
        plan = ResponsePlan(legs_of(self.config, pairs), self.sine, peak_Nm)
        return ResponseMotion(self.config, plan, peak_Nm if last else self.largest_Nm)


def response_task(config: Config, torque_Nm: float | None, legs: int, law: ResponseLaw | None = WEAK) -> ResponseTask:
    """`torque_Nm` at most, None: what fits the joint; `UsageError` where they or the limits do not fit.

    With that law, or with that of the configuration where the gate refuses the weak one: on a joint that is known to
    be soft, with a light motor and a long delay.  Where it refuses the gains of the file too, or `law` is None, with
    those that suit the joint which the file describes; also instead of a stiffer law on a joint that is known to be
    soft.  On a rigid one that is as much slower as the gate asks for.
    """
    if not LEAST_LEGS <= legs <= MOST_LEGS:
        raise UsageError(f"--legs (={legs}) must be in [{LEAST_LEGS}..{MOST_LEGS}]")
    if law is not None and law is not WEAK:
        law = _bearable(config, torque_Nm, law) or (law if config.reducer is None else None)
    moving, gains = config_of_response(config, torque_Nm, law), ""
    if law is WEAK and not _passes(moving):
        moving, gains = config_of_response(config, torque_Nm, None), OF_FILE
    if law is None or (law is WEAK and not _passes(moving)):
        suited = _with_chosen_gains(config)
        gains = OF_FILE if suited is config else OF_JOINT
        if law is None:
            suited = with_slow_observer(suited, BELIEVED, SLOW_OBSERVER_radps)
        moving = config_of_response(suited, torque_Nm, None)
    _, length_s = speed_and_period(moving)
    sine = multisine(moving.loop.rate_Hz, length_s)
    return ResponseTask(moving, sine, legs // 2, largest_peak_Nm(moving), gains)


@functools.lru_cache(maxsize=4)  # of one command, which asks before and after its question
def _with_chosen_gains(config: Config) -> Config:
    """Of the law of the configuration; as it was where none of them are what is wanted, or it has no such law."""
    from jointctl.tools.analysis.gains import gains_of_file  # here: hardly any response needs a search

    with contextlib.suppress(ConfigurationError):
        chosen = gains_of_file(config, loop_settings(config)[0])
        if chosen.best.stable and not chosen.missed:
            return config.changed(control=chosen.control)
    return config


def _passes(config: Config) -> bool:
    """See `margin_gate.passes`; True where margins are not known, as the gate says itself."""
    with contextlib.suppress(ConfigurationError):
        return passes(config)
    return True


def measured_response(task: ResponseTask, carrier: Carrier) -> tuple[FrequencyResponse, Any, ResponsePlan]:
    """All stages; (response, records, plan) of the last one.  Faults as `Carrier.run` has them.

    Where more torque is more than the law holds, the last one has that of the stage before.
    """
    peak_Nm, before, weighed = LEAST_SHARE * task.largest_Nm, None, False
    try:
        while peak_Nm < task.largest_Nm:
            found, *_ = _stage(task, carrier, peak_Nm, STAGE_PAIRS)
            carrier.output.note(f"  {text_Nm(peak_Nm, 2)}: coherence {found.coherence:.3f}")
            if before is not None:
                _refuse_growth(before, found)
            if found.coherence >= GOOD_COHERENCE and not weighed:
                task, weighed = _better(task, found), True
            if found.coherence >= ENOUGH_COHERENCE and peak_Nm >= 0.5 * task.largest_Nm:
                break
            peak_Nm, before = GROWTH * peak_Nm, found
        return _whole(task, carrier, min(peak_Nm, task.largest_Nm), before)
    except (TooWeak, TooQuick) as error:
        if before is None or before.coherence < GOOD_COHERENCE:
            raise
        carrier.output.note(f"  {error.message}: once more, with {text_Nm(before.peak_Nm, 2)}")
    return _whole(task, carrier, before.peak_Nm, None)


def _whole(
    task: ResponseTask, carrier: Carrier, peak_Nm: float, before: FrequencyResponse | None
) -> tuple[FrequencyResponse, Any, ResponsePlan]:
    """Of all legs."""
    found, records, plan = _stage(task, carrier, peak_Nm, task.pairs, last=True)
    carrier.output.note(f"  {text_Nm(found.peak_Nm, 2)}: coherence {found.coherence:.3f}, {found.legs} legs")
    if before is not None:
        _refuse_growth(before, found)
    return found, records, plan


def with_slow_observer(config: Config, intervals: Intervals, most_radps: float) -> Config:
    """With an observer of at most that bandwidth, or as slow as the gate allows at the late end of delay and lag.

    With both encoders of a soft joint the observer damps the link, too: it cannot be as slow as one likes.
    """
    chosen_radps = config.control.observer_radps
    if chosen_radps <= most_radps:
        return config
    settings, _ = loop_settings(config)
    settings = replace(settings, delay_s=latest_s(settings, intervals))
    for radps in np.linspace(most_radps, chosen_radps, SLOW_OBSERVERS):
        observer_radps = float(f"{radps:.3g}")
        slower = replace(settings, observer_radps=observer_radps)
        if meets(margins(slower), config.margin.min_phase_margin_deg):
            return config.changed(control__observer_radps=observer_radps)
    return config


# --- the laws of a response whose joint has a friction that is not known yet ---
# A law for an inertia that is believed too small, or for a light joint with much friction, turns the torque round too
# late where a leg ends.

ALONE, FED, FED_STIFF = "the weak law", "a part of the friction fed forward", "a stiffer law, friction fed forward"
FED_STIFFEST = "the stiffest law, friction fed forward"
OF_FILE, OF_JOINT = "the gains of the file", "gains that suit the joint of the file"  # in place of a law
SUITED = f"{OF_JOINT}, friction fed forward"  # of a soft reducer, which bears none of these
_LAWS = {ALONE: WEAK, FED: WEAK, FED_STIFF: STIFF, FED_STIFFEST: STIFFEST, SUITED: None}
_LITTLE_FRICTION, _MUCH_FRICTION = (ALONE, FED, FED_STIFF, FED_STIFFEST), (FED_STIFF, FED_STIFFEST, FED)
MUCH_FRICTION_radps2 = 25.0  # torque to break away over the inertia that is believed
FED_SHARE = 0.7  # of the torque that began to move the joint: less than what it slides under
HEAVIER = 1.6  # times the inertia that is believed: of a joint that swung slowly under the stiffer law
SLOWER = (1.0, 0.8, 0.65, 0.5)  # times the bandwidth of a stiffer law: of a joint that is too late for it


def _bearable(config: Config, torque_Nm: float | None, law: ResponseLaw, heavier: float = 1.0) -> ResponseLaw | None:
    """That law, or a slower one that the gate bears with gains for so many times the inertia; None: none of them.

    Of a joint whose reducer is known to be soft no slower one: there are gains that suit it.
    """
    for share in SLOWER if config.reducer is None else SLOWER[:1]:
        kp_ps2, kv_ps = share**2 * law.kp_ps2, share * law.kv_ps
        slower = law._replace(kp_ps2=kp_ps2, kv_ps=kv_ps, observer_radps=share * law.observer_radps)
        judged = slower._replace(kp_ps2=heavier * kp_ps2, kv_ps=heavier * kv_ps)
        if _passes(config_of_response(config, torque_Nm, judged)):
            return slower
    return None


def task_by(
    law: str, before: Config, legs: int, torque_Nm: float | None = None, gains: ResponseLaw | None = None
) -> ResponseTask:
    """By one of these laws; `before`: with the torque to break away, of which nothing is fed forward."""
    static_Nm = static_friction_Nm(before) or 0.0
    if law != ALONE and static_Nm > 0.0:
        fed_Nm = FED_SHARE * static_Nm
        before = with_sliding(before, static_Nm, (fed_Nm, -fed_Nm), 0.0, speed_and_period(before)[0])
    return response_task(before, torque_Nm, legs, gains or _LAWS.get(law, WEAK))


def response_by_any_law(
    before: Config, legs: int, carrier: Carrier, torque_Nm: float | None = None
) -> tuple[str, ResponseTask, tuple[FrequencyResponse, Any, ResponsePlan]]:
    """(law, its task, what it measured), with the next law where one is too weak; faults as `measured_response`."""
    static_Nm = static_friction_Nm(before) or 0.0
    much = static_Nm > MUCH_FRICTION_radps2 * before.joint.inertia_kgm2
    laws = [law for law in (_MUCH_FRICTION if much else _LITTLE_FRICTION) if law != FED or static_Nm > 0.0]
    # the gate judges the joint that is believed, also under the law for a heavier one
    stiffer = {
        FED_STIFF: _bearable(before, torque_Nm, STIFF), FED_STIFFEST: _bearable(before, torque_Nm, STIFFEST, HEAVIER),
    }  # fmt: skip
    laws = [law for law in laws if stiffer.get(law, WEAK) is not None]
    if before.reducer is not None and static_Nm > 0.0 and FED_STIFF not in laws:
        laws.append(SUITED)

    def by(law: str, *others: str) -> tuple[str, ResponseTask, tuple[FrequencyResponse, Any, ResponsePlan]]:
        believed = _with_inertia(before, HEAVIER * before.joint.inertia_kgm2) if law == FED_STIFFEST else before
        task = task_by(law, believed, legs, torque_Nm, stiffer.get(law))
        task = replace(task, largest_Nm=min(task.largest_Nm, largest_peak_Nm(before)))  # which was announced
        taken = f"{task.gains}, friction fed forward" if task.gains and law != ALONE else task.gains or law
        if taken != ALONE:
            carrier.output.note(f"  law: {taken}")
        if task.gains == OF_JOINT:
            control = task.config.control
            gains = f"kp {control.kp:g}, kv {control.kv:g}, observer {control.observer_radps:g} rad/s"
            why = "the gate refuses the gains of the file; " if _LAWS[law] is WEAK else ""
            carrier.output.note(f"  {why}for the response: {gains}")
        try:
            return law, task, measured_response(task, carrier)
        except TooWeak as error:
            if not others or (others[0] == SUITED and not _passes(task_by(SUITED, before, legs, torque_Nm).config)):
                raise
            carrier.output.note(f"  {error.message}: once more")
        except TooStiff as error:
            if law not in _MUCH_FRICTION[:2] or FED not in others:
                raise
            carrier.output.note(f"  {error.message}: once more")
            stiffest = FED_STIFFEST in others and not isinstance(error, Pushed)  # it may have stuck and slid as fast
            return by(FED, *([FED_STIFFEST] if stiffest else []))
        return by(*others)

    return by(*laws)


def require_one_joint(task: ResponseTask, plan: ResponsePlan, records: np.recarray, fit: JointFit) -> None:
    """`MotionFault` where the halves of the legs are of two joints; where too few legs are left nothing is compared."""
    parts = [replace(plan, legs=replace(plan.legs, starts=starts)) for starts in np.array_split(plan.legs.starts, 2)]
    with contextlib.suppress(DataError):
        first, second = (fitted_again(response_of(task.config, part, records), fit) for part in parts)
        _refuse_another("the first half of the response", first, "in the second half", second)


def require_same_joint(task: ResponseTask, carrier: Carrier, peak_Nm: float, fit: JointFit, when: str) -> None:
    """A short response at `peak_Nm`, of a joint that was found to be `fit`; `MotionFault` where it is another one.

    Where it moved too fast, at half of that, once.
    """
    peak_Nm = min(peak_Nm, task.largest_Nm)
    try:
        found, *_ = _stage(task, carrier, peak_Nm, STAGE_PAIRS, last=True)
    except TooQuick as error:
        carrier.output.note(f"  {error.message}: once more, with {text_Nm(0.5 * peak_Nm, 2)}")
        found, *_ = _stage(task, carrier, 0.5 * peak_Nm, STAGE_PAIRS, last=True)
    inertia = fitted_again(found, fit)
    _refuse_another("the response", fit.inertia_kgm2, when, inertia)
    carrier.output.note(f"  the same joint: {inertia.value:.4g} kg m^2 {when}")


def _refuse_another(before: str, first: Estimate, after: str, second: Estimate) -> None:
    change = abs(second.value - first.value)
    if change > max(LEAST_CHANGE * first.value, first.half + second.half):
        raise MotionFault(
            f"the joint is another one: {first.value:.3g} kg m^2 in {before}, {second.value:.3g} {after}",
            "nothing may be put on the joint or taken off during a tune",
        )


def _better(task: ResponseTask, found: FrequencyResponse) -> ResponseTask:
    """With the inertia that the first stage tells: the weak law of one that is too light is too weak for friction."""
    try:
        inertia = fit_joint(found, task.config.joint.inertia_kgm2).inertia_kgm2.value
    except DataError:
        return task
    config = _with_inertia(task.config, inertia)
    if _passes(task.config) and not _passes(config):
        return task
    shown_Nm = task.largest_Nm
    return replace(task, config=config, largest_Nm=min(shown_Nm, largest_peak_Nm(config)))


def _with_inertia(config: Config, inertia_kgm2: float) -> Config:
    """A motor that would weigh more than all of it, by its file, keeps its share."""
    values, reducer = [Found(("joint",), "inertia_kgm2", rounded(inertia_kgm2), "")], config.reducer
    if reducer is not None and reducer.motor_inertia_kgm2 > MOST_OF_MOTOR * inertia_kgm2:
        motor_kgm2 = reducer.motor_inertia_kgm2 * inertia_kgm2 / config.joint.inertia_kgm2
        values.append(Found(("reducer",), "motor_inertia_kgm2", rounded(motor_kgm2), ""))
    return with_values(config, values)


def _refuse_growth(before: FrequencyResponse, after: FrequencyResponse) -> None:
    factor = grown(before, after)
    if factor > RESONANCE_GROWTH:
        raise MotionFault(
            f"the joint answers {after.peak_Nm:.2g} Nm with {factor:.1f} times its share of what it does at "
            f"{before.peak_Nm:.2g} Nm: a resonance grows",
            "less torque: --torque",
        )


def _too_weak(config: Config, carried: Carried, peak_Nm: float) -> bool:
    """Whether it stood, stayed behind or swung as friction does, under no more torque than a joint may stand under.

    Under more it is against something, and a stiffer law would push it harder; `peak_Nm` of the excitation.
    """
    phase = carried.records.phase
    rows = carried.records[(phase >= AxisPhase.APPROACH) & (phase <= AxisPhase.TRACKING)]
    if not len(rows):
        return False
    limits, torque_Nm = axis_constants(config, trajectory_table(config))[0].limits, np.abs(rows.command_torque_Nm)
    if carried.fault == Fault.POSITION_FROZEN:
        moved = np.abs(rows.position_rad - rows.position_rad[-1]) > limits.frozen_tolerance_rad
        stands = rows[np.flatnonzero(moved)[-1] + 1 :] if np.any(moved) else rows
        way_rad = np.ptp(stands.desired_position_rad)
        other_rad = 0.0 if config.joint_encoder is None else np.ptp(stands.second_position_rad)
        return bool(other_rad < STANDS_SHARE * way_rad and torque_Nm[-1] < limits.frozen_torque_Nm)
    slow = carried.fault == Fault.LIMIT_CYCLE and carried.value < HUNTING_Hz
    pushed_Nm = np.max(torque_Nm[-round(PUSHED_s * config.loop.rate_Hz) :]) - peak_Nm
    return bool((slow or carried.fault == Fault.FOLLOWING_ERROR) and pushed_Nm < limits.frozen_torque_Nm)


def _stage(
    task: ResponseTask, carrier: Carrier, peak_Nm: float, pairs: int, *, last: bool = False
) -> tuple[FrequencyResponse, Any, ResponsePlan]:
    """Once more where legs were lost to a computer that stood still for a moment: a tune of minutes need not end."""
    motion = task.motion(peak_Nm, pairs, last=last)

    def moved() -> Any:
        title = f"{task.config.path.stem}: response, {text_Nm(peak_Nm, 2)}"
        carried = carrier.run(task.config, motion, title, also_faults=tuple(Fault))
        if carried.text is not None:
            ended = _ended(title, carried)
            if _too_weak(task.config, carried, peak_Nm):
                raise TooWeak(ended.message, f"{TOO_WEAK.format(task.config.joint.inertia_kgm2)}; {ended.hint}")
            if carried.fault == Fault.LIMIT_CYCLE:
                raise (TooStiff if carried.value >= HUNTING_Hz else Pushed)(ended.message, ended.hint)
            raise TooQuick(ended.message, ended.hint) if carried.fault == Fault.VELOCITY_LIMIT else ended
        return carried.records

    records = moved()
    try:
        return response_of(task.config, motion.plan, records), records, motion.plan
    except DataError as error:
        carrier.output.note(f"  {error.message}: once more")
    records = moved()
    return response_of(task.config, motion.plan, records), records, motion.plan
