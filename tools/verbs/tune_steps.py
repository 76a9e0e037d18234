"""The steps of `tune`, one after the other: each leaves its data in the folder of the tune and can be resumed from.

The order differs from that of a commissioning by hand in one place: the frequency response comes before the friction,
because its weak law needs neither the inertia nor the friction, and every law after it does.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass, field, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

from jointctl.drivers.errors import (
    ConfigurationError,
    DataError,
    JointctlError,
    LimitCycle,
    MarginError,
    MotionFault,
    StoodStill,
    TooFewPoints,
    UsageError,
    one_line,
    text_Nm,
)
from jointctl.firmware_py.input_file import parse_json, read_input
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.tools.analysis.gains import ChosenGains, apart, choose_gains, require_encoders
from jointctl.tools.analysis.linear_loop import loop_settings, two_masses
from jointctl.tools.analysis.margin_gate import require_margin
from jointctl.tools.analysis.reducer_map import FoundMap, found_map
from jointctl.tools.configuration.checks import problems_between_sections
from jointctl.tools.configuration.config import Config, Control
from jointctl.tools.configuration.conversions import period_s, static_friction_Nm
from jointctl.tools.configuration.found_values import (
    with_break_away,
    with_friction,
    with_sliding,
    with_tuned,
    with_values,
    without_friction,
)
from jointctl.tools.configuration.load import load_config, read_text
from jointctl.tools.configuration.records import trajectory_table
from jointctl.tools.configuration.sections import LuGre, ReducerMap, Trajectory
from jointctl.tools.identification.identification import Identification
from jointctl.tools.identification.identification_report import section_values
from jointctl.tools.inspection.health import PROBLEM
from jointctl.tools.inspection.motion_check import CheckMotion, config_of_check, make_plan, motion_findings
from jointctl.tools.recording.run_summary import learning_harms
from jointctl.tools.session.plan import ConfiguredMotion
from jointctl.tools.sweeping.data_file import measured_before
from jointctl.tools.sweeping.options import SweepOptions
from jointctl.tools.sweeping.plan import make_plan as sweep_plan
from jointctl.tools.sweeping.plan import refuse_constants
from jointctl.tools.tuning.carry_out import (
    ALONE,
    LEAST_LEGS,
    SWEEP_SHARE,
    Carrier,
    LearningSwings,
    NotCarriedOut,
    SLOW_OBSERVER_radps,
    TooWeak,
    require_one_joint,
    require_same_joint,
    response_by_any_law,
    response_task,
    task_by,
    verified,
    verifying_motion,
    with_slow_observer,
)
from jointctl.tools.tuning.frequency_response import (
    FrequencyResponse,
    from_dict,
    motor_fed,
    speed_and_period,
    with_torque_limit,
)
from jointctl.tools.tuning.joint_fit import (
    JointFit,
    fit_from_dict,
    fit_of,
    friction_of,
    gravity_of,
    values_of_gravity,
)
from jointctl.tools.tuning.presliding import bristle_values, bristles_text, measured_bristles
from jointctl.tools.verbs.map import MapOptions, config_of_map, map_run, speeds_in_turn
from jointctl.tools.verbs.response import AS_IT_FITS
from jointctl.tools.verbs.sweep import Sweep
from jointctl.tools.verbs.tune import TuneOptions
from jointctl.tools.verbs.tune_report import fitted_values, too_soft, values_of, write_report
from jointctl.tools.written_file import prepare_folder, replace_file

STEPS = ("direction", "response", "gravity", "friction", "bristles", "map", "gains", "verification")
STATE, ANEW = "steps.json", "without --resume it begins anew"
OTHER = "of another drive, or of a simulated joint instead of a real one"
FRICTION_SHARE = 0.75  # of the torque that gravity leaves: more friction leaves nothing to move with
OF_GAINS = (Fault.LIMIT_CYCLE, Fault.FOLLOWING_ERROR, Fault.VELOCITY_LIMIT, Fault.TORQUE_SATURATED)
ALLOWED_FAULTS = {"the same before": (*OF_GAINS, Fault.POSITION_FROZEN), "refinement": OF_GAINS}  # by motion
MOVES_WRONGLY = (Fault.POSITION_FROZEN, Fault.POSITION_LIMIT, *OF_GAINS[1:])
SOFTER = ("the step pulls with a law of its own, as stiff as the static friction of [friction] asks for: a "
          "greater loop.rate_Hz, less friction where [friction] has too much, wider limits.position_*")  # fmt: skip
STRONGER = 2.0  # of the check of the direction, as long as the joint stands still
SWEEP_POINTS, SWEEP_DWELL_s, WARM_UP_TURNS = 36, 0.5, 0.1
SWEEP_RATIOS = (100.0, 25.0, 8.0)  # of the fastest plateau to the slowest: the next where the slow ones swing
WORSE = 1.5  # times the error with the gains as they were
REFINE_RUNS = 4
REFINE_BETTER = 0.97  # of the error: less is noise of the measurement
REFINE_APART = 0.15  # share by which gains that are tried must differ


@dataclass
class Tune:
    """One tune of one joint; `config` is the one in use, which each step improves."""

    original: Config
    options: TuneOptions
    carrier: Carrier
    folder: Path
    config: Config = field(init=False)
    verifying: Trajectory = field(init=False)
    state: dict[str, Any] = field(init=False, default_factory=dict)  # results by step, as JSON holds them
    fit: JointFit | None = field(init=False, default=None)
    response: FrequencyResponse | None = field(init=False, default=None)
    found_friction: Identification | None = field(init=False, default=None)
    found_map: FoundMap | None = field(init=False, default=None)
    gains: ChosenGains | None = field(init=False, default=None)
    _about: dict[str, Any] = field(init=False, default_factory=dict)  # what the steps are of

    def __post_init__(self) -> None:
        require_encoders(self.original, self.options.law)
        refuse_constants(self.original)
        self.config = with_torque_limit(self.original, self.options.torque_Nm)
        response_task(self.config, None, AS_IT_FITS.legs)  # what does not fit is refused before anything moves
        self.verifying = verifying_motion(self.config)

    # --- the chain ---

    def run(self) -> int:
        """All steps that are not done yet; then the file and the report."""
        self.carry_out()
        self._write()
        return 0

    def carry_out(self) -> None:
        """The steps alone."""
        self._open()
        for name in STEPS:
            done = name in self.state
            self.carrier.output.note(f"{name}: done before" if done else name)
            try:
                if not done:
                    self.state[name] = getattr(self, f"_step_{name}")()
                    self._save()
                getattr(self, f"_take_{name}", lambda _: None)(self.state[name])
            except JointctlError as error:
                before = f", {self.folder} has the steps before" if self.state else ""
                kept = one_line(f"{self.original.path} is as it was{before}")
                seen = error.message.removeprefix(f"{name}: ") + too_soft(self, error)
                error.message = f"{name}: {seen}; {kept}"
                if done and isinstance(error, DataError):
                    error.hint = ANEW
                raise
            except (LookupError, TypeError, ValueError, AttributeError) as error:
                if not done:
                    raise
                why = f"the step {name} cannot be read: {one_line(repr(error))[:120]}"
                raise DataError(f"{self.folder / STATE}: {why}", ANEW) from error
        if self.options.refine:
            self._refine()

    def _open(self) -> None:
        prepare_folder(self.folder)
        path, original, asked = self.folder / STATE, self.original, [self.options.law, self.options.objective]
        about = {
            "configuration": hashlib.sha256(original.text.encode()).hexdigest(),
            "torque_Nm": self.config.limits.torque_max_Nm, "simulated": self.options.lockstep,
            "bus": original.bus.model_dump(mode="json"), "drive": original.drive.model_dump(mode="json"),
        }  # fmt: skip
        if self.options.resume:
            try:
                kept = dict(parse_json(read_input(path)))
                own = dict(kept.get("about", {}))
                self.carrier.drives = [str(drive) for drive in kept.get("drives", [])]  # whose steps these are
            except (OSError, ValueError, TypeError) as error:
                raise DataError(f"{path}: cannot be read: {getattr(error, 'strerror', '') or error}", ANEW) from None
            if about not in (own, {**own, "configuration": kept.get("written")}):
                raise DataError(f"{path}: is of another configuration or torque than {original.path}, {OTHER}", ANEW)
            steps = STEPS if kept.get("asked") == asked else STEPS[: STEPS.index("gains")]  # another law or objective
            known = takewhile(kept.__contains__, steps)  # one that is missing is made, and what follows anew
            self.state = {name: kept[name] for name in known}
        elif not self.carrier.consent.dry_run:
            path.unlink(missing_ok=True)  # a later --resume must not go on with an older tune's steps
        self._about = {"about": about, "asked": asked}

    @property
    def written(self) -> bool:
        """Whether the file has what was found."""
        path = self.original.path
        return path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == self._about.get("written")

    def _save(self) -> None:
        kept = {**self._about, "drives": self.carrier.drives, **self.state}
        replace_file(self.folder / STATE, json.dumps(kept, indent=1).encode())

    # --- 1. direction and counts ---

    def _step_direction(self) -> list[dict[str, Any]]:
        """As `doctor --motion`, with twice the torque while the joint stands still."""
        config = motor_fed(self.config)  # a loop over the link is the one that a soft reducer makes unstable
        torque_Nm = make_plan(config, None).torque_Nm
        while True:
            plan = make_plan(config, min(torque_Nm, config.limits.torque_max_Nm))
            inner = config_of_check(config, plan)
            try:
                carried = self.carrier.run(inner, CheckMotion(inner, plan), "direction", also_faults=tuple(Fault))
            except MarginError as error:  # gains of the file are none of the check
                raise MarginError(error.message, SOFTER) from None
            findings = list(motion_findings(config, plan, carried.records, carried.fault, carried.text))
            bad = [finding for finding in findings if finding.status == PROBLEM]
            # it stands, or comes to stand again, under a torque that is too small for it
            stands = bool(bad) and all(finding.topic in ("motion", "load", "check") for finding in bad)
            stands = stands and carried.fault in (Fault.NONE, Fault.POSITION_FROZEN, Fault.TORQUE_SATURATED)
            if not (stands and plan.torque_Nm < self.config.limits.torque_max_Nm):
                break
            torque_Nm = STRONGER * plan.torque_Nm
        if bad:
            # a reading that stands still because its frames stay away is no joint that does
            why = bad[-1] if carried.fault not in (Fault.NONE, *MOVES_WRONGLY) and bad[-1].topic == "check" else bad[0]
            raise MotionFault(why.text, why.remedy)
        for finding in findings:
            self.carrier.output.note(f"  {finding.topic}: {finding.text}")
        friction_Nm = max((finding.numbers.get("break_away_Nm", 0.0) for finding in findings), default=0.0)
        gravity_Nm, allowed_Nm = abs(config.joint.gravity_Nm), self.config.limits.torque_max_Nm
        needed_Nm = friction_Nm / FRICTION_SHARE + gravity_Nm
        if needed_Nm > allowed_Nm:
            beside = f" beside gravity (={gravity_Nm:g} Nm at most)" if gravity_Nm else ""
            raise MotionFault(
                f"the joint began to move at {text_Nm(friction_Nm)}{beside}, and the torque (={allowed_Nm:g} Nm) must "
                f"be more than {text_Nm(needed_Nm)} for the rest",
                "--torque, limits.torque_max_Nm; or the brake is closed",
            )
        return [asdict(finding) for finding in findings]

    # --- 2. frequency response and the model that fits it ---

    def _step_response(self) -> dict[str, Any]:
        law, task, (found, records, plan) = response_by_any_law(self._before_friction(), AS_IT_FITS.legs, self.carrier)
        config = task.config
        tracked = records[records.phase == AxisPhase.TRACKING]
        gravity = gravity_of(plan, tracked, period_s(config), config.joint.gravity_zero_rad)
        fit = fit_of(found, config, self._break_away_Nm())
        require_one_joint(task, plan, records, fit)
        return {
            **found.to_dict(), "fit": fit.to_dict(), "gravity": asdict(gravity), "sure": gravity.found, "law": law,
        }  # fmt: skip

    def _break_away_Nm(self) -> float:
        return max(finding["numbers"].get("break_away_Nm", 0.0) for finding in self.state["direction"])

    def _before_friction(self) -> Config:
        """A friction that may be wrong by any factor is no help: what is known is the torque that moved the joint."""
        torque_Nm = self._break_away_Nm()
        return with_break_away(self.config, torque_Nm) if torque_Nm > 0.0 else without_friction(self.config)

    def _sliding(self) -> Config:
        """With what the legs of the response say of the friction: at low speed a soft law sticks without it.

        And a quick observer hunts there.
        """
        config, fit = self._before_friction(), self.fit
        if fit is None:
            return config
        config = with_slow_observer(config, fit.intervals(), SLOW_OBSERVER_radps)
        static_Nm, kept = static_friction_Nm(config), self.state["response"]["gravity"]
        if static_Nm is None or "sliding_Nm" not in kept:
            return config
        (positive_Nm, negative_Nm), (speed_radps, _) = kept["sliding_Nm"], speed_and_period(config)
        return with_sliding(config, static_Nm, (positive_Nm, negative_Nm), fit.friction_Nmspr.value, speed_radps)

    def _take_response(self, kept: dict[str, Any]) -> None:
        self.response, self.fit = from_dict(kept), fit_from_dict(kept["fit"])
        self.config = with_values(self.config, fitted_values(self))
        self.carrier.output.note(
            f"  {'two masses' if self.fit.flexible else 'rigid'}, {self.fit.inertia_kgm2.value:.4g} kg m^2, "
            f"{1e3 * self.fit.late_s.value:.2f} ms of delay and lag"
        )
        self._require_reducer()
        # for the motions that measure: at low speed a softer law sticks, and no plateau settles
        self.config = self._with_control(self.chosen_gains(self.options.law, "tracking").control)
        problems = problems_between_sections(self.config)
        if problems:  # the file could not be written at the end
            hint = "the joint is another one than the file says: correct that section, or take it out"
            raise ConfigurationError(f"{self.original.path}: {problems[0]}", hint)

    def _require_reducer(self) -> None:
        """`ConfigurationError` where [reducer] is of another joint than the one that answered."""
        reducer = self.original.reducer
        if self.fit is not None and not self.fit.flexible and reducer is not None:
            resonance_Hz = two_masses(self.original, reducer, 1.0, 1.0, False).resonance_Hz
            message = f"[reducer] has a resonance at {resonance_Hz:.0f} Hz, and the response shows none"
            raise ConfigurationError(f"{self.original.path}: {message}", "correct [reducer], or take it out")

    def _with_control(self, control: Control) -> Config:
        config = self.config.changed(control=control)
        if config.joint_encoder is not None and config.encoder.side == "motor":
            law = "joint_encoder" if control.kind == "flexible_joint" else "encoder"
            config = config.changed(joint_encoder__law=law)
        return config

    def chosen_gains(self, law: str, objective: str) -> ChosenGains:
        """Those of the joint that was found; `MarginError` where none are stable."""
        assert self.fit is not None
        # a choice before this one may have left out what adapts, for another friction
        config = self.config.changed(control__adaptation=self.original.control.adaptation)
        gains = choose_gains(config, self.fit.intervals(), law, objective)
        if not gains.best.stable:
            raise MarginError(
                f"no gains of the law {gains.law.name} are stable over the intervals of this joint",
                "--law; a shorter loop delay; the encoder on the motor",
            )
        return gains

    # --- 3. gravity, of the same motion ---

    def _step_gravity(self) -> dict[str, Any]:
        return {**self.state["response"]["gravity"], "found": self.state["response"]["sure"]}

    def _take_gravity(self, kept: dict[str, Any]) -> None:
        none = "none that is certain" if kept["half_Nm"] else "not looked for: the legs of the response are too short"
        found = f"{kept['torque_Nm']:.3g} +- {kept['half_Nm']:.2g} Nm"
        self.carrier.output.note(f"  {found if kept['found'] else none}")
        if kept["found"]:
            self.config = with_values(self.config, values_of_gravity(kept))

    # --- 4. friction ---

    def _step_friction(self) -> dict[str, Any]:
        path = self.folder / "friction.csv"
        options = SweepOptions(
            points=SWEEP_POINTS, dwell_s=SWEEP_DWELL_s, warm_up_turns=WARM_UP_TURNS,
            mode="torque", assume_yes=True, lockstep=self.options.lockstep, grid="log",
        )  # fmt: skip
        top_radps = max(abs(point.velocity_radps) for point in sweep_plan(self.config, options).points)
        top_radps = min(top_radps, SWEEP_SHARE * self.config.limits.velocity_max_radps)
        commands, config, seconds = [], self._sliding(), 0.0
        for ratio in SWEEP_RATIOS:
            fitting = replace(options, max_speed_radps=top_radps, min_speed_radps=top_radps / ratio)
            commands.append(Sweep(config, self.carrier.quietly(), path, fitting))
        if self.options.resume:
            begun = [k for k, one in enumerate(commands) if measured_before(path, one.plan.hash)]
            commands = commands[max(begun, default=0) :]
        for command in commands:
            try:
                self._sweep(command)
                found = self.found_friction = self.identified()
                break
            except (LimitCycle, StoodStill, TooFewPoints) as error:
                done, last = command.file.done if command.file is not None else (), command is commands[-1]
                if isinstance(error, StoodStill) and not self._sticks(command, len(done)):
                    raise
                if last and (isinstance(error, TooFewPoints) or len(done) < len(command.plan.points)):
                    raise
                what = "what was measured counts" if last else "once more without the slowest plateaus"
                self.carrier.output.note(f"  {error.message}: {what}")
                if last:  # it was at what had not settled once more
                    found = self.found_friction = self.identified()
            finally:
                seconds += command.file.elapsed_s if command.file is not None else 0.0
        return {
            "section": section_values(found.branches["positive"], found.branches["negative"]),
            "rmse_Nm": found.rmse_Nm, "points": len(found.measured_Nm), "model": found.model,
            "static_before": static_friction_Nm(self.config), "seconds": seconds,
        }  # fmt: skip

    def _sticks(self, command: Sweep, done: int) -> bool:
        """Whether a reading that stands is a soft joint's behind its link's encoder, which has slid in this sweep."""
        soft = self.config.reducer is not None and self.config.encoder.side == "joint"
        return soft and done > 0 and not command.options.resume

    def _sweep(self, command: Sweep) -> None:
        """Measure what is not measured yet; `NotCarriedOut` where somebody stopped it."""
        path = command.out
        if self.options.resume and measured_before(path, command.plan.hash):
            command.options = replace(command.options, resume=True)
        else:
            for old in (path, path.with_suffix(".json")):
                old.unlink(missing_ok=True)
        command.control = control = self.carrier.control
        if control is not None:
            command.consent = self.carrier.consent
        try:
            ended = command.run()
        finally:
            self.carrier.drive_state = command.drive_state or self.carrier.drive_state
        if ended:
            raise NotCarriedOut(command.drive_state, "" if control is None else control.signals.stopped_by)

    def identified(self) -> Identification:
        pushed = [finding["numbers"].get("torque_max_Nm", 0.0) for finding in self.state["direction"]]
        moved_Nm = (max(pushed, default=0.0) or math.inf) + abs(self.config.joint.gravity_Nm)  # which may hold it
        return friction_of(self.folder / "friction.csv", moved_Nm, self.config.joint.reduction_ratio)

    def _take_friction(self, kept: dict[str, Any]) -> None:
        self.found_friction = self.found_friction or self.identified()  # for the report
        self.carrier.output.note(f"  {kept['points']} plateaus, RMSE {1e3 * kept['rmse_Nm']:.3g} mNm at the motor")
        self.config = with_friction(self.config, kept["section"])

    # --- 5. bristles of the friction ---

    def _step_bristles(self) -> dict[str, Any]:
        """Of a rigid joint: one whose reducer is soft twists by more."""
        assert self.fit is not None
        if self.fit.flexible or self.config.reducer is not None:
            return {"why": "the reducer is soft, and twists by more than they bend"}
        return measured_bristles(self.config, self.carrier)

    def _take_bristles(self, kept: dict[str, Any]) -> None:
        self.carrier.output.note(f"  {bristles_text(kept)}")
        if values := bristle_values(kept):
            self.config = self.config.changed(friction__lugre=LuGre(**{one.key: one.value for one in values}))

    # --- 6. map of the reducer ---

    def _step_map(self) -> dict[str, Any]:
        """Of a joint with two encoders and a soft reducer; nothing else has a use for it."""
        if self.config.reducer is None or self.config.joint_encoder is None:
            return {}
        unmapped = self.config.changed(reducer__map=None)
        try:
            motions = [config_of_map(unmapped, MapOptions(speed_radps=one)) for one in speeds_in_turn(self.config)]
        except UsageError:  # too short a travel
            return {}
        for moving in motions:
            try:
                carried = self.carrier.run(moving, ConfiguredMotion(moving, trajectory_table(moving)), "map")
                break
            except LimitCycle as error:
                if moving is motions[-1]:
                    raise
                self.carrier.output.note(f"  {error.message}: once more, faster")
        loop, _ = loop_settings(moving)
        self.found_map = found_map(map_run(moving, carried.records, loop.delay_s + loop.lag_s))
        return self.found_map.values(self.config.encoder.direction, self.config.encoder.zero_counts)

    def _take_map(self, kept: dict[str, Any]) -> None:
        self.carrier.output.note("  measured" if kept else "  none: for a soft reducer, two encoders and 4 motor turns")
        if kept and self.config.reducer is not None:
            values: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in kept.items()}
            self.config = self.config.changed(reducer__map=ReducerMap(**values))

    # --- 7. gains ---

    def _step_gains(self) -> dict[str, Any]:
        self._require_same_joint("before the gains")  # a law that is chosen for another joint may swing
        self.gains = self.chosen_gains(self.options.law, self.options.objective)
        return self._kept(self.gains)

    def _require_same_joint(self, when: str) -> None:
        assert self.fit is not None
        assert self.response is not None
        law = self.state["response"].get("law", ALONE)
        task = task_by(law, self._before_friction(), LEAST_LEGS)
        try:
            require_same_joint(task, self.carrier, self.response.peak_Nm, self.fit, when)
        except (MarginError, TooWeak) as error:  # the law of the response, on the joint that is known now
            self.carrier.output.warning(f"whether it is the same joint {when} is not measured: {error.message}")

    @staticmethod
    def _kept(gains: ChosenGains) -> dict[str, Any]:
        best = gains.best
        return {
            "law": gains.law.name, "control": gains.control.model_dump(mode="json", exclude_none=True),
            "missed": gains.missed, "phase_margin_deg": best.phase_margin_deg, "gain_margin": best.gain_margin,
            "sensitivity": best.sensitivity, "noise_Nm": best.noise_Nm,
        }  # fmt: skip

    def _take_gains(self, kept: dict[str, Any]) -> None:
        self.config = self._with_control(Control.model_validate_json(json.dumps(kept["control"])))
        control = self.config.control
        self.carrier.output.note(
            f"  law {kept['law']}, kp {control.kp:g}, kv {control.kv:g}, "
            f"phase margin {kept['phase_margin_deg']:.1f} deg at the worst ends of the intervals"
        )
        for name in kept["missed"]:
            self.carrier.output.warning(f"this joint does not allow all: {name}")

    # --- 8. the run that shows it ---

    def _step_verification(self) -> dict[str, Any]:
        found = {"after": self._verified_with_what_helps()}
        self._require_same_joint("after the verification")
        before = self._before()
        try:
            require_margin(self.before_on_found())  # the file as it was may know of no soft reducer
            require_margin(before)
        except JointctlError as error:
            return {**found, "before_refused": error.message}
        found["before"] = self._verified(before, "the same before")
        if found["before"].get("fault") == Fault.POSITION_FROZEN.name:  # by a wrong friction, or by a dead encoder
            self._verified(self.config, "verification once more")
        return found

    def _verified_with_what_helps(self) -> dict[str, Any]:
        """Of the new gains; once more, and for good, without learning where it does not make the error smaller."""
        try:
            found = self._verified(self.config, "verification")
            if not learning_harms(found.get("learning")):
                return found
            harm = f"the error that repeats was {found['learning']:.2f} times that of the first period"
        except LearningSwings as error:
            harm = error.message.removeprefix("verification: ")
        self.carrier.output.warning(f"iterative learning is left out: with it {harm}")
        self.config = self.config.changed(control__learning=None)
        self.state["gains"]["control"] = self.config.control.model_dump(mode="json", exclude_none=True)
        return self._verified(self.config, "verification without learning")

    def _take_verification(self, kept: dict[str, Any]) -> None:
        before, after = kept.get("before", {}), kept["after"]
        rmse = {when: one["rmse_mrad"] for when, one in (("before", before), ("after", after)) if "rmse_mrad" in one}
        ended = f"; the file as it was: {before['fault']}" if "fault" in before else ""
        self.carrier.output.note(f"  RMSE {', '.join(f'{when} {one:.4f} mrad' for when, one in rmse.items())}{ended}")
        if self.config.control.learning is not None and after.get("learning") is None:
            self.carrier.output.note("  whether iterative learning helps was not seen: no repetition in time")
        if rmse.get("after", 0.0) > WORSE * rmse.get("before", math.inf):
            self.carrier.output.warning(f"the old gains track better; {self.folder / 'before.toml'} has them")

    def _before(self) -> Config:
        """The configuration as it was, on the joint that was found."""
        names = ("control", "joint", "friction", "reducer", "joint_encoder")
        found = self.config.changed(**{name: getattr(self.original, name) for name in names})
        virtual = self.config.virtual
        if virtual is not None:
            scale = virtual.inertia_scale * self.config.joint.inertia_kgm2 / found.joint.inertia_kgm2
            found = found.changed(virtual__inertia_scale=scale)
        return found

    def before_on_found(self) -> Config:
        """The law as it was, on everything that was found."""
        return self.config.changed(control=self.original.control, joint_encoder=self.original.joint_encoder)

    def _verified(self, config: Config, title: str) -> dict[str, Any]:
        return verified(self.carrier, config, self.verifying, self.config, title, ALLOWED_FAULTS.get(title, ()))

    # --- 9. refinement ---

    def _refine(self) -> None:
        """Runs with other gains that meet every goal, the most promising first; what measures better stays."""
        gains = self.gains or self.chosen_gains(self.options.law, self.options.objective)
        gains = replace(gains, control=self.config.control)  # without learning where that did not help
        error = self.state["verification"]["after"]["rmse_mrad"]
        allowed = [one for one in gains.tried if one.stable and not gains.goals.missed(one)]
        tried, runs = [gains.best], list[dict[str, Any]]()
        for one in sorted(allowed, key=lambda one: one.error):
            if len(runs) == REFINE_RUNS:
                break
            if all(apart(one.settings, other.settings) > REFINE_APART for other in tried):
                tried.append(one)
                control = gains.with_gains(one)
                found = self._verified(self._with_control(control), "refinement")
                runs.append({"kp": one.settings.kp, "kv": one.settings.kv, **found})
                self.carrier.output.note(f"  kv {one.settings.kv:g}: {found.get('rmse_mrad', math.inf):.4f} mrad")
                better = found.get("rmse_mrad", math.inf) < REFINE_BETTER * error
                if better and not learning_harms(found.get("learning")):
                    error, self.config = found["rmse_mrad"], self._with_control(control)
                    self.gains = replace(gains, best=one, missed={}, control=control)
                    self.state["gains"] = self._kept(self.gains)
                    self.state["verification"]["after"] = found
        self.state["refinement"] = {"runs": runs}
        self._save()

    # --- 10. what is written ---

    def _write(self) -> None:
        values, path, text = values_of(self), self.original.path, self.original.text
        friction = self.state["friction"]
        sources: dict[str, list[str]] = {}
        for one in filter(lambda one: one.source, values):
            sources.setdefault(".".join(one.section), []).append(f"{one.key} = {one.source}")
        sources["friction"] = [f"{friction['points']} points, RMSE {friction['rmse_Nm']:.2g} Nm at the motor"]
        if self.state["map"]:
            sources["reducer.map"] = ["one motion both ways"]
        content = with_tuned(text, values, sources).encode()
        if read_text(path) != text:  # a limit that was narrowed in these minutes must not be as wide again
            kept = self.folder / "tuned.toml"
            replace_file(kept, content)
            raise DataError(f"{path}: was changed during the tune, and is left as it is", f"{kept} has what was found")
        replace_file(self.folder / "before.toml", text.encode())
        self._about["written"] = hashlib.sha256(content).hexdigest()
        self._save()
        replace_file(path, content, load_config)
        self.carrier.output.note(f"written: {path}; as it was: {self.folder / 'before.toml'}")
        write_report(self, [[".".join(one.section), one.key, one.value] for one in values])
