"""`jointctl check CONFIG`: is the control loop stable enough, and what does the theory promise?"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from jointctl.drivers.errors import ConfigurationError, MarginError, MotionFault, UsageError, blamed, text_Nm
from jointctl.firmware_py.states import CommandKind, Encoders
from jointctl.tools.verbs.verb_options import JointOrArm, ResultOutput

if TYPE_CHECKING:
    from jointctl.tools.analysis.linear_loop import Assumption, LoopSettings
    from jointctl.tools.analysis.margin_gate import Remedy
    from jointctl.tools.analysis.margins import Convergence, Margins, Theory
    from jointctl.tools.configuration.arm import ArmConfig
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.output import Output

_INERTIA_SLACK = 0.1  # by which joint.inertia_kgm2 may be outside of what the poses give, without a warning
TOO_SMALL = "too small"  # a verdict


def check(
    config: JointOrArm,
    output: ResultOutput,
    # from the sample to the torque command taking effect
    delay_s: Annotated[float | None, typer.Option("--delay", help="measured loop delay (s)", min=0.0)] = None,
    *,
    figure: Annotated[Path | None, typer.Option("--figure", help="PNG to write: Bode, sensitivity, poles")] = None,
    allow_low_margin: Annotated[bool, typer.Option("--allow-low-margin", help="accept a stable loop below it")] = False,
    choose_gains: Annotated[bool, typer.Option("--choose-gains", help="search gains for the law of the file")] = False,
) -> int:
    """Is the control loop stable enough?  Margins, bounds and what would help; of an arm each joint over its poses."""
    from jointctl.tools.configuration.arm import ArmConfig

    if isinstance(config, ArmConfig):
        if figure is not None or choose_gains:
            raise UsageError("--figure and --choose-gains are for one joint's file, not for an arm's")
        return check_arm(config, output, delay_s, allow_low_margin=allow_low_margin)
    from jointctl.tools.drawing import require_png
    from jointctl.tools.verbs.bench_drive import bench_of

    if figure is not None:
        require_png(figure, (config.path,))
    bench_of(config).require_rate(config)
    if config.drive.own_loop() is not CommandKind.TORQUE:
        if figure is not None or choose_gains:
            raise UsageError("--figure and --choose-gains are for drive.mode cst, tq and auto")
        return check_cascade(config, output, delay_s, allow_low_margin=allow_low_margin)
    analysis = _analysed(config, delay_s, allow_low_margin=allow_low_margin)
    return _show(config, output, analysis, figure, allow_low_margin=allow_low_margin, choose_gains=choose_gains)


def _analysed(config: Config, delay_s: float | None, *, allow_low_margin: bool) -> LoopCheck:
    """Margins of the loop that is closed here, and what would help where they are too small."""
    from jointctl.tools.analysis.linear_loop import loop_settings
    from jointctl.tools.analysis.margin_gate import meets, remedies
    from jointctl.tools.analysis.margins import margins, theory

    minimum_deg = config.margin.min_phase_margin_deg
    settings, assumptions = loop_settings(config, delay_s)
    found = margins(settings)
    enough = meets(found, minimum_deg)
    accepted = found.stable and allow_low_margin
    verdict = "ok" if enough else "below the minimum, accepted" if accepted else TOO_SMALL
    changes = [] if enough else remedies(settings, minimum_deg)
    return LoopCheck(settings, assumptions, found, theory(settings), minimum_deg, verdict, changes)


def _show(
    config: Config, output: Output, analysis: LoopCheck, figure: Path | None, *, allow_low_margin: bool,
    choose_gains: bool,
) -> int:  # fmt: skip
    """The table and what it leaves out; then the refusals, as `run` has them."""
    from jointctl.tools.analysis.loop_report import not_modelled, outside_payload_range, save_loop_figure
    from jointctl.tools.analysis.margin_gate import learning_of
    from jointctl.tools.verbs.bench_drive import bench_of

    settings = analysis.settings
    learning, warnings = learning_of(config, settings), _warnings(config)
    refused = _refused(config, analysis, learning, allow_low_margin=allow_low_margin)
    if refused is not None and analysis.verdict != TOO_SMALL:
        analysis = replace(analysis, verdict=refused.message.partition(":")[0])
    table = _table(analysis)
    for row in bench_of(config).check_rows(config):
        table.add_row(*row)
    if learning is not None:
        value = f"factor {learning.worst_factor:.2f} at {learning.worst_Hz:.1f} Hz"
        value += "" if learning.worst_factor < 1.0 else ": diverges"
        table.add_row("learning", value, "what is left to learn after one repetition, below 1 it converges")
    chosen = _add_gains(table, config, settings) if choose_gains else None
    if figure is not None:
        save_loop_figure(settings, figure, config.path.name, analysis.min_phase_margin_deg)
        table.add_row("picture", str(figure), "")
    data = {
        **_data(analysis, figure),
        "learning": learning_data(learning),
        "chosen_gains": chosen,
        "warnings": warnings,
    }
    output.result(table, data, analysis)
    for text in warnings:
        output.warning(text)
    for text in not_modelled(config):
        output.note(f"not in this analysis: {text}")
    for text in outside_payload_range(config, settings):
        output.warning(text)
    if refused is not None:
        raise refused
    return 0


def _refused(
    config: Config, analysis: LoopCheck, learning: Convergence | None, *, allow_low_margin: bool
) -> MarginError | None:
    """The first reason why `run` would not enable this loop."""
    from jointctl.tools.analysis.margin_gate import refusal, refuse_chatter, refuse_diverging_learning

    settings = analysis.settings
    if analysis.verdict == TOO_SMALL:
        return refusal(settings, analysis.margins, analysis.min_phase_margin_deg, analysis.remedies)
    try:
        if not allow_low_margin:
            refuse_chatter(config, settings)
        refuse_diverging_learning(learning)
    except MarginError as error:
        return error
    return None


def _warnings(config: Config) -> list[str]:
    """Constants that contradict each other, and why `run` would refuse the motion or lack the torque for it."""
    from jointctl.firmware_py.trajectory import peak_of
    from jointctl.tools.analysis.loop_report import beyond_torque, contradictions
    from jointctl.tools.configuration.records import trajectory_constants, trajectory_table
    from jointctl.tools.session.plan import require_braking

    found = contradictions(config)
    try:
        table = trajectory_table(config)
        trajectory = trajectory_constants(config, table)
        acceleration = peak_of(trajectory, table).acceleration_radps2
        found += beyond_torque(config, "the trajectory's largest acceleration", acceleration)
        require_braking(config, trajectory, table)
    except ConfigurationError as error:
        found.append(error.message.replace(f"{config.path}: ", "") + (f"; {error.hint}" if error.hint else ""))
    except MotionFault as error:
        found.append(f"{error.message}; {error.hint}")
    return found


def check_cascade(
    config: Config, output: Output, delay_s: float | None = None, *, allow_low_margin: bool = False
) -> int:
    """Of a drive that closes its own loops: what is known of them, and when what is sent takes effect."""
    from jointctl.drivers.canopen.eds import read_eds
    from jointctl.tools.analysis.linear_loop import loop_settings
    from jointctl.tools.analysis.margin_gate import cascade_margins, cascade_of, cascade_unknowns, require_cascade
    from jointctl.tools.configuration.canopen import canopen_section, eds_path
    from jointctl.tools.verbs.bench_drive import bench_of

    section, cascade = canopen_section(config), cascade_of(config)
    delay = next(a for a in loop_settings(config, delay_s)[1] if a.name == "loop delay")
    title = f"The drive closes the loop ({section.mode})"
    table = Table("quantity", "value", "note", title=title, title_justify="left")
    table.add_row(delay.name, f"{delay.value:g} {delay.unit}", delay.origin)
    with_target = section.sent_with_target(config.loop.rate_Hz)
    lead = with_target.lead_s if with_target is not None else 0.0
    table.add_row("lead", f"{lead * 1e3:g} ms", "by which the motion is sent ahead (drive.cascade.lead_s)")
    offsets = {0x60B2: ("torque offset", cascade.torque_offset),
               0x60B1: ("velocity offset", cascade.velocity_offset and section.mode == "csp")}  # fmt: skip
    known = read_eds(eds_path(config), section.node).dictionary
    sent = [f"{what} ({index:X})" for index, (what, on) in offsets.items() if on and index in known]
    missing = [f"{index:X}" for index, (_, on) in offsets.items() if on and index not in known]
    note = f"{section.eds} has no {' and no '.join(missing)}" if missing else ""
    table.add_row("sent besides the target", ", ".join(sent) or "nothing", note)
    table.add_section()
    found = cascade_margins(config, delay.value)
    for loop in found:
        notes = [f"worst case: {loop.joint}"] if loop.joint else []
        if loop.stable:
            where = [] if math.isnan(loop.crossover_Hz) else [f"at {loop.crossover_Hz:.1f} Hz"]
            notes = [*where, f"gain margin x {loop.gain_margin_up:.3g}", *notes]
        value = loop.phase_text(1) if loop.stable else "UNSTABLE"
        table.add_row(loop.name, value, "; ".join(notes))
    for row in bench_of(config).check_rows(config):
        table.add_row(*row)
    wanted_deg = config.margin.min_phase_margin_deg
    if found:
        enough = all(loop.stable and loop.phase_margin_deg >= wanted_deg for loop in found)
        wanted = f"at least {wanted_deg:g} deg wanted (margin.min_phase_margin_deg)"
        table.add_row("verdict", "ok" if enough else TOO_SMALL, wanted)
    warnings = _warnings(config)
    data = {
        "mode": section.mode, "lead_s": lead, "loops": [asdict(loop) for loop in found],
        "min_phase_margin_deg": wanted_deg, "warnings": warnings,
    }  # fmt: skip
    output.result(table, data)
    for text in warnings:
        output.warning(text)
    for text in cascade_unknowns(config):
        output.note(f"not in this analysis: {text}")
    require_cascade(config, delay.value, allow_low_margin=allow_low_margin)
    return 0


def check_arm(arm: ArmConfig, output: Output, delay_s: float | None = None, *, allow_low_margin: bool = False) -> int:
    """The bus budget of each bus, and each joint's margins over the inertias that the arm's poses give."""
    from jointctl.tools.analysis.arm_check import HIGHEST_LOAD, joint_loops, require_budgets
    from jointctl.tools.analysis.loop_report import contradictions
    from jointctl.tools.analysis.margin_gate import require_loop
    from jointctl.tools.session.canopen_drive import require_buses
    from jointctl.tools.session.plan import resolve_arm

    require_buses(arm.joints)
    budgets, loops = require_budgets(arm), joint_loops(arm, delay_s)
    warnings = [f"{config.path}: {line}" for config in arm.joints for line in contradictions(config)]
    table = Table("joint or bus", "value", "note", title=f"Arm of {len(loops)} joints", title_justify="left")
    for budget in budgets:
        note = (
            f"{', '.join(budget.joints)}: {budget.bits} bits a cycle at {arm.rate_Hz:g} Hz, {HIGHEST_LOAD:.0%} allowed"
        )
        table.add_row(budget.channel, f"{budget.load:.1%} of the bus", note)
    for loop in loops:
        table.add_section()
        found, minimum_deg, own = loop.margins, loop.config.margin.min_phase_margin_deg, loop.config.joint.inertia_kgm2
        poses = loop.poses
        table.add_row(
            loop.name, f"{poses.least_kgm2:.3g} .. {poses.greatest_kgm2:.3g} kg m2",
            f"over the poses; joint.inertia_kgm2 = {own:g}, gravity up to {round(poses.gravity_Nm, 9):.3g} Nm",
        )  # fmt: skip
        margin = f"{found.phase_margin_deg:.1f} deg" if found.stable else "UNSTABLE"
        table.add_row("  phase margin", margin, f"worst case: {found.joint}; {minimum_deg:g} deg wanted")
        if not (1.0 - _INERTIA_SLACK) * poses.least_kgm2 <= own <= (1.0 + _INERTIA_SLACK) * poses.greatest_kgm2:
            warnings.append(
                f"{loop.config.path}: joint.inertia_kgm2 (={own:g}) should be in "
                f"[{poses.least_kgm2:.3g}..{poses.greatest_kgm2:.3g}], what the arm's poses give"
            )
    data = {
        "buses": [asdict(budget) for budget in budgets],
        "joints": [
            {"name": loop.name, "poses": asdict(loop.poses), "stable": loop.margins.stable,
             "phase_margin_deg": loop.margins.phase_margin_deg, "worst_case": loop.margins.joint}
            for loop in loops
        ],
        "warnings": [*arm.remarks, *warnings],
    }  # fmt: skip
    output.result(table, data)
    for text in warnings:
        output.warning(text)
    for loop in loops:
        with blamed(f"joint {loop.name}"):
            require_loop(loop.config, loop.settings, loop.margins, allow_low_margin=allow_low_margin)
    resolve_arm(arm)  # the motion, which a run refuses as well
    return 0


def _add_gains(table: Table, config: Config, settings: LoopSettings) -> dict[str, Any]:
    """What would suit the joint that the file describes, and what the gate makes of it; returns that for --json."""
    from jointctl.tools.analysis.gains import gains_of_file
    from jointctl.tools.analysis.margin_gate import meets
    from jointctl.tools.analysis.margins import margins

    chosen = gains_of_file(config, settings)
    gains, found = chosen.best, margins(chosen.best.settings)
    met, changes = not chosen.missed and meets(found, config.margin.min_phase_margin_deg), chosen.changes()
    learning = chosen.control.learning
    if learning != config.control.learning:  # so that it converges with these gains
        before = {} if config.control.learning is None else config.control.learning.model_dump()
        changes["learning"] = learning and {
            key: value for key, value in learning.model_dump().items() if value != before.get(key)
        }
    note = f"phase margin {found.phase_margin_deg:.1f} deg, " if found.stable else "UNSTABLE, "
    note += f"|S| {found.sensitivity_peak:.2f} at most, torque noise {text_Nm(gains.noise_Nm, 2)}"
    if not met:
        one_encoder = config.reducer is not None and settings.encoders != Encoders.BOTH
        note += ": NOT what is asked for, there are no such gains; less delay"
        note += ", or the other encoder too" if one_encoder else ""
    table.add_row("chosen gains", ", ".join(_words(changes)), note)
    return {
        "changes": changes, "met": met, "phase_margin_deg": found.phase_margin_deg,
        "largest_s": found.sensitivity_peak, "noise_Nm": gains.noise_Nm,
    }  # fmt: skip


def _words(changes: dict[str, Any]) -> Iterator[str]:
    for name, value in changes.items():
        if isinstance(value, dict):
            yield from _words({f"{name}.{key}": number for key, number in value.items()})
        else:
            shown = value[0] if isinstance(value, tuple) else value
            yield f"no {name}" if shown is None else f"{name} = {shown:g}"


def learning_data(learning: Convergence | None) -> dict[str, float] | None:
    """For --json: what is left to learn after one repetition, below 1 it converges; None without learning."""
    return None if learning is None else {"worst_factor": learning.worst_factor, "worst_Hz": learning.worst_Hz}


@dataclass(frozen=True)
class LoopCheck:
    """What the linear loop promises; margins hold for the settings and assumptions, the delay among them."""

    settings: LoopSettings
    assumptions: tuple[Assumption, ...]
    margins: Margins
    theory: Theory
    min_phase_margin_deg: float  # wanted
    verdict: str
    remedies: list[Remedy]


def _table(analysis: LoopCheck) -> Table:
    found, ideal = analysis.margins, analysis.theory
    table = Table("quantity", "value", "note", title="Linear loop", title_justify="left")
    for a in analysis.assumptions:
        table.add_row(a.name, f"{a.value:g} {a.unit}", a.origin)
    table.add_section()
    if ideal.p is not None and ideal.p_eigenvalues is not None:
        p11, p12, p22 = ideal.p
        table.add_row("P", f"{p11:.3f}  {p12:.6f}  {p22:.6f}", f"P11 P12 P22 for Q = diag{analysis.settings.q}")
        table.add_row("eigenvalues of P", "{:.3f}  {:.3f}".format(*ideal.p_eigenvalues), "")
        table.add_row("bound (30)", f"{ideal.bound_per_Nm:.4g}", "|x| for 1 Nm that the network cannot represent")
        table.add_row("bound with |P B|", f"{ideal.tight_bound_per_Nm:.4g}", "the same, tighter")
    pair = f"{ideal.natural_frequency_radps:.1f} rad/s, damping {ideal.damping:.2f}"
    table.add_row(
        "modes, no delay",
        pair if ideal.damping == ideal.damping else "none oscillates",
        "continuous time: the theory's loop, slowest mode " + f"{ideal.slowest_time_constant_s:.3g} s",
    )
    table.add_section()
    if analysis.settings.joints:
        note = (
            f"of {len(analysis.settings.joints)} joints: payload, stiffness, friction; the rest of the table is of it"
        )
        table.add_row("worst case", found.joint, note)
    table.add_row("stable", "yes" if found.stable else "NO", "with the delay, lag, filter and rate above")
    if found.stable:
        _add_margins(table, found)
    if found.oscillation_Hz == found.oscillation_Hz:
        oscillation = f"{found.oscillation_Hz:.2f} Hz, damping {found.oscillation_damping:.3f}"
        table.add_row("oscillation", oscillation, "pair of the sampled loop that decays slowest")
    table.add_section()
    wanted, keys = f"at least {analysis.min_phase_margin_deg:g} deg", "margin.min_phase_margin_deg"
    if math.isfinite(analysis.settings.largest_s):
        wanted, keys = f"{wanted}, |S| at most {analysis.settings.largest_s:g}", f"{keys}, max_sensitivity"
    table.add_row("verdict", analysis.verdict, f"{wanted} wanted ({keys})")
    return table


def _add_margins(table: Table, found: Margins) -> None:
    table.add_row("phase margin", f"{found.phase_margin_deg:.1f} deg", f"at {found.crossover_Hz:.2f} Hz")
    table.add_row(
        "gain margin up", f"x {found.gain_margin_up:.3g}", "inertia smaller, or torque constant larger, by this"
    )
    table.add_row("gain margin down", f"x {found.gain_margin_down:.3g}", "the other way")
    table.add_row("delay margin", f"{found.delay_margin_s * 1e3:.2f} ms", "in addition to the loop delay above")
    other = f"; {found.sensitivity_joint}" if found.sensitivity_joint != found.joint else ""
    note = f"at {found.sensitivity_peak_Hz:.2f} Hz{other}"
    table.add_row("sensitivity peak Ms", f"{found.sensitivity_peak:.2f}", note)
    table.add_row("slowest mode", f"{found.slowest_time_constant_s:.3g} s", "time constant")


def _data(analysis: LoopCheck, figure: Path | None) -> dict[str, Any]:
    """For --json; a complex pole is a pair [real, imaginary]."""
    measured = asdict(analysis.margins)
    measured["poles"] = [[pole.real, pole.imag] for pole in analysis.margins.poles]
    return {
        "verdict": analysis.verdict,
        "min_phase_margin_deg": analysis.min_phase_margin_deg,
        "kind": analysis.settings.kind.name.lower(),
        "assumptions": [asdict(a) for a in analysis.assumptions],
        "theory": asdict(analysis.theory),
        "margins": measured,
        "remedies": [{"change": r.text, "phase_margin_deg": r.phase_margin_deg} for r in analysis.remedies],
        "picture": None if figure is None else str(figure),
    }
