"""What a tune leaves for its user: the values of the file, the tables of the terminal, and the report of one page."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.table import Column, Table

from jointctl.drivers.errors import ConfigurationError, JointctlError, LimitCycle, StoodStill, text_Nm, text_radps
from jointctl.tools.analysis.gains import ChosenGains
from jointctl.tools.analysis.linear_loop import loop_settings
from jointctl.tools.analysis.margins import Margins, margins
from jointctl.tools.analysis.reducer_map import map_figure
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import friction_fall_Nmspr
from jointctl.tools.configuration.found_values import Found, rounded
from jointctl.tools.drawing import BLUE, GREY, ORANGE, RED, canvas
from jointctl.tools.identification.identification_report import fit_figure
from jointctl.tools.recording.report_page import Paragraph, Section, from_terminal, svg_figure, write_verb_page
from jointctl.tools.recording.report_page import Table as PageTable
from jointctl.tools.tuning.carry_out import SWEEP_SHARE, response_task
from jointctl.tools.tuning.frequency_response import bode_figure, speed_and_period
from jointctl.tools.tuning.joint_fit import values_of_fit, values_of_gravity
from jointctl.tools.tuning.presliding import bristle_values, bristles_text
from jointctl.tools.verbs.map import speeds_in_turn
from jointctl.tools.verbs.response import AS_IT_FITS, fit_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jointctl.tools.verbs.tune_steps import Tune

GAINS = ("kp", "kv", "observer_radps", "velocity_cutoff_Hz", "link_cutoff_Hz")  # that are shown


def too_soft(job: Tune, error: JointctlError) -> str:
    """What sticking and slipping may be due to where a soft joint has an encoder on the link alone; else ""."""
    config, fit = job.config, job.fit
    behind = fit is not None and fit.flexible and config.encoder.side == "joint"
    if fit is None or not behind or not isinstance(error, (LimitCycle, StoodStill)):
        return ""
    resonance_Hz, kv_1ps = fit.resonance_Hz.value, config.control.kv
    late_deg, fall_Nmspr = 360.0 * fit.late_s.value * resonance_Hz, friction_fall_Nmspr(config)
    falls = f", and friction falls by {fall_Nmspr:.3g}" if "friction" in job.state else ""
    return (
        f": the encoder on the link alone, behind a resonance at {resonance_Hz:.3g} Hz that is {late_deg:.2g} deg "
        f"late, leaves kv {kv_1ps:.3g}, which damps {config.joint.inertia_kgm2 * kv_1ps:.3g} Nm s/rad{falls}: so soft "
        "a loop may stick and slip; an encoder on the motor besides, or a stiffer reducer, allows a stiffer one"
    )


def fitted_values(job: Tune) -> list[Found]:
    """What the response has found, with where it comes from."""
    assert job.fit is not None
    assert job.response is not None
    source = f"95 %, response of {job.response.legs} legs at {job.response.peak_Nm:.2g} Nm"
    return values_of_fit(job.original, job.fit, source)


def envelope(job: Tune) -> list[str]:
    """Every motion, in its order."""
    limits, output = job.config.limits, job.config.path
    low, high = limits.position_min_rad, limits.position_max_rad
    task = response_task(job.config, None, AS_IT_FITS.legs)
    top_radps = SWEEP_SHARE * limits.velocity_max_radps
    inside, slowly = f"{low:+.3f} .. {high:+.3f} rad", speeds_in_turn(job.config)
    verified = f"{job.verifying.kind} of the configuration"
    if job.verifying.kind != job.config.trajectory.kind:
        verified = f"{job.verifying.kind} over the range of the configured motion, whose approach may swing far"
    return [
        f"tune       {output}, law {job.options.law}, objective {job.options.objective}",
        "direction  a soft spring pulls the joint a little to both sides, with more torque while it stands",
        f"response   triangle at {text_radps(speed_and_period(task.config)[0], 1)} within {inside}, "
        f"multisine up to {text_Nm(task.largest_Nm)}, 2 minutes",
        f"friction   plateaus of constant speed within {inside}, up to {text_radps(top_radps)}, about 4 minutes",
        "bristles   a soft spring pushes the joint to and fro while it stands, at places within 0.2 rad, about a "
        "minute, where the joint is rigid",
        f"map        once back and forth at {slowly[0]:g} rad/s, where the reducer is soft"
        + (f"; at up to {slowly[-1]:g} where it swings" if slowly[1:] else ""),
        f"verify     {verified}, {job.verifying.duration_s:.3g} s, with the new and the old gains; before "
        "and after it half a minute of the response, for a joint that has changed",
        f"limits     {inside}, {text_radps(limits.velocity_max_radps)}, {text_Nm(limits.torque_max_Nm)} in every "
        "step; keep the joint free and unloaded, a hand on the emergency stop",
    ]


def values_of(job: Tune) -> list[Found]:
    """Everything that the file gets."""
    assert job.fit is not None
    gains = job.state["gains"]
    objective = f"{job.options.objective}, law {gains['law']}, worst phase margin {gains['phase_margin_deg']:.0f} deg"
    values = [*fitted_values(job), *values_of_gravity(job.state["gravity"])]
    before, after = job.original.control.model_dump(), job.config.control.model_dump()
    for key, value in after.items():
        if key not in ("learning", "adaptation") and value != before[key]:
            source = f"{value}, {objective}"
            values.append(Found(("control",), key, value[0] if key == "lyapunov_q" else value, source))
    if before["learning"] != after["learning"]:
        if after["learning"] is None:
            values.append(
                Found(("control",), "learning", None, "none: it would not converge, does not help, or the law has none")
            )
        for key, value in (after["learning"] or {}).items():
            values.append(Found(("control", "learning"), key, value, ""))
    if before["adaptation"] != after["adaptation"]:
        if after["adaptation"] is None:
            values.append(Found(("control",), "adaptation", None, "none"))
        for key, value in (after["adaptation"] or {}).items():
            source = f"{value}, of friction that adapts to the joint, with the law {gains['law']}"
            values.append(Found(("control", "adaptation"), key, value, source if key == "reach" else ""))
    friction = job.state["friction"]
    for key, value in friction["section"].items():
        if isinstance(value, dict):
            values += [Found(("friction", key), name, number, "") for name, number in value.items()]
        else:
            values.append(Found(("friction",), key, value, ""))
    values += bristle_values(job.state["bristles"])
    values += [Found(("reducer", "map"), key, value, "") for key, value in job.state["map"].items()]
    second, chosen = job.original.joint_encoder, job.config.joint_encoder
    if second is not None and chosen is not None and second.law != chosen.law:
        values.append(Found(("joint_encoder",), "law", chosen.law, f"{chosen.law}, of the law {gains['law']}"))
    virtual = job.config.virtual
    if virtual is not None and virtual != job.original.virtual:
        kept = "the virtual joint stays what it was"
        values.append(Found(("virtual",), "inertia_scale", rounded(virtual.inertia_scale), kept))
        if job.original.virtual is not None and job.original.virtual.friction is None and virtual.friction:
            values += _nested(("virtual", "friction"), virtual.friction.model_dump(exclude_none=True))
    return values


def _nested(section: tuple[str, ...], values: dict[str, Any]) -> list[Found]:
    found: list[Found] = []
    for key, value in values.items():
        if isinstance(value, dict):
            found += _nested((*section, key), value)
        else:
            found.append(Found(section, key, value, ""))
    return found


def _tables(job: Tune) -> tuple[Table, Table]:
    """What was found, and loop and tracking before and after."""
    assert job.fit is not None
    assert job.response is not None
    gains, verified = job.state["gains"], job.state["verification"]
    table = Table(
        "", *(Column(name, justify="right") for name in ("before", "after")), title="Loop and tracking",
        title_justify="left", caption_justify="left",
        caption="margins of the joint that was found, as `check` has them; error from 5 s on, as the encoder shows it",
    )  # fmt: skip
    both = [_margins_or_none(config) for config in (job.before_on_found(), job.config)]
    for name, key, form in (
        ("phase margin [deg]", "phase_margin_deg", ".1f"), ("gain margin up", "gain_margin_up", ".2f"),
        ("largest |S|", "sensitivity_peak", ".2f"),
    ):  # fmt: skip
        table.add_row(name, *(_shown(one, key, form) for one in both))
    before, after = verified.get("before", {}), verified["after"]
    for name, key in (("RMSE [mrad]", "rmse_mrad"), ("peak [mrad]", "peak_mrad"), ("chatter [Nm]", "chatter_Nm")):
        shown = [f"{one[key]:.4g}" if key in one else one.get("fault", "refused") for one in (before, after)]
        table.add_row(name, *shown)
    for key in GAINS:
        pair = [getattr(config.control, key) for config in (job.original, job.config)]
        if any(pair) and (key != "link_cutoff_Hz" or job.config.joint_encoder is not None):
            table.add_row(key, *(f"{value:g}" for value in pair))
    for name in gains["missed"]:
        table.add_row("missed", "", name)
    return fit_table(job.original, job.response, job.fit), table


def write_report(job: Tune, values: list[list[Any]]) -> None:
    """The page, and the tables on the terminal; `values` are those that the file got."""
    fitted, loop = _tables(job)
    output = job.carrier.output
    data = {**job.state, "values": values}
    output.result(fitted)
    output.result(loop, data)
    measured = job.found_friction
    assert job.response is not None
    assert measured is not None
    gains = job.gains or job.chosen_gains(job.options.law, job.options.objective)
    used = {word: direction.index for word, direction in measured.directions.items()}
    curve = fit_figure(measured.data, measured.branches, used, "Friction at the motor", identified=measured)
    pictures: list[Any] = [
        svg_figure(bode_figure(job.response, "Frequency response", job.fit), "Bode plot with coherence"),
        svg_figure(curve, "Friction: plateaus and curve with its band of 95 %"),
        svg_figure(trade_off_figure(gains, "Error against margin"), "Every choice of gains that was tried"),
    ]
    if job.found_map is not None:
        pictures.append(svg_figure(map_figure(job.found_map, "Map of the reducer"), "Kinematic error and ripple"))
    moved = [line.split(maxsplit=1) for line in envelope(job)]
    sections = [
        Section("Moved", [PageTable(["step", "motion"], moved)]),
        Section("Found", [from_terminal(fitted), *_other_findings(job)]),
        Section("Loop and tracking", [from_terminal(loop)]), Section("Figures", pictures),
    ]  # fmt: skip
    write_verb_page(job.folder / "report.html", f"Tune of {job.original.path.stem}", sections, output)


def _other_findings(job: Tune) -> list[Paragraph]:
    friction, gravity = job.state["friction"], job.state["gravity"]
    lines = [
        f"Friction: {friction['points']} plateaus in friction.csv, the curve misses them by "
        f"{1e3 * friction['rmse_Nm']:.3g} mNm (RMSE) at the motor."
    ]
    lines.append(f"Bristles: {bristles_text(job.state['bristles'])}.")
    if gravity["found"]:
        lines.append(f"Gravity: {gravity['torque_Nm']:.3g} +- {gravity['half_Nm']:.2g} Nm.")
    if job.state["map"]:
        lines.append("Map of the reducer: in the figure, and in [reducer.map].")
    return [Paragraph(line) for line in lines]


def _margins_or_none(config: Config) -> Margins | None:
    try:
        return margins(loop_settings(config)[0])
    except ConfigurationError:
        return None


def _shown(found: Margins | None, key: str, form: str) -> str:
    if found is None:
        return "-"
    return format(getattr(found, key), form) if found.stable else "unstable"


def trade_off_figure(found: ChosenGains, title: str) -> Figure:
    """Error against phase margin of everything that was tried; what keeps the margins is blue."""
    stable = [one for one in found.tried if one.stable]
    with canvas(4.2, title) as figure:
        axis = figure.subplots()
        for colour, label, chosen in (
            (GREY, "misses a goal", [one for one in stable if not found.allows(one)]),
            (BLUE, "meets all goals", [one for one in stable if found.allows(one)]),
            (ORANGE, "chosen", [found.best]),
        ):
            size = 60 if label == "chosen" else 10
            axis.scatter(
                [one.phase_margin_deg for one in chosen], [one.error / found.best.error for one in chosen], s=size,
                color=colour, label=label, zorder=3 if label == "chosen" else 2,
            )  # fmt: skip
        axis.axvline(found.goals.phase_margin_deg, color=RED, linewidth=0.8)
        axis.set_yscale("log")
        axis.set_ylim(0.3, 30.0)
        axis.set_xmargin(0.03)
        axis.set_xlabel("phase margin of the worst joint in the intervals [deg]")
        axis.set_ylabel("modelled error / that of the chosen point")
        axis.legend()
        return figure
