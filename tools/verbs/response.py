"""`jointctl response CONFIG`: frequency response of a joint, and the model with one or two masses that fits it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Column, Table

from jointctl.drivers.errors import INTERRUPTED, DataError, text_Nm
from jointctl.tools.verbs.verb_options import AllowLowMargin, DryRun, JointOnBus, VerbOutput, Yes

if TYPE_CHECKING:
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.tuning.frequency_response import FrequencyResponse
    from jointctl.tools.tuning.joint_fit import JointFit

ROWS = (
    ("inertia_kgm2", "total inertia [kg m^2]", 1.0, ""),
    ("link_kgm2", "link inertia [kg m^2]", 1.0, ""),
    ("resonance_Hz", "resonance [Hz]", 1.0, "of a small motion"),
    ("stiffness_Nmprad", "stiffness [Nm/rad]", 1.0, "of a small motion"),
    ("damping_Nmspr", "damping of the reducer [Nm s/rad]", 1.0, "at the resonance"),
    ("loss_factor", "loss factor of the reducer", 1.0, "hysteresis, at every frequency"),
    ("friction_Nmspr", "slope of the friction [Nm s/rad]", 1.0, "at the speed of the triangle"),
    ("late_s", "delay and lag together [ms]", 1e3, "from a position sample to its torque"),
    ("delay_s", "of it delay [ms]", 1e3, ""),
    ("lag_s", "of it lag of the current [ms]", 1e3, ""),
)  # fmt: skip
OF_A_REDUCER = ("link_kgm2", "resonance_Hz", "stiffness_Nmprad", "damping_Nmspr", "loss_factor")


@dataclass(frozen=True)
class ResponseOptions:
    """None = what fits the joint."""

    torque_Nm: Annotated[
        float | None,
        typer.Option("--torque", metavar="NM", help="at the joint at most, friction included (limits.torque_max_Nm)"),
    ] = None
    legs: Annotated[int, typer.Option("--legs", help="of the triangle, each with one period of the multisine")] = 12
    lockstep: Annotated[bool, typer.Option("--lockstep", help="virtual joint in simulated time: seconds")] = False


AS_IT_FITS = ResponseOptions()


def response(
    config: JointOnBus,
    output: VerbOutput,
    *,
    options: ResponseOptions = AS_IT_FITS,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="JSON file with the response and the fit (CONFIG.response.json)")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option("--figure", help="PNG with the Bode plot (CONFIG.response.png)")
    ] = None,
    assume_yes: Yes = False,
    dry_run: DryRun = False,
    allow_low_margin: AllowLowMargin = False,
) -> int:
    """Frequency response by a multisine on a slow triangle in torque; inertias, resonance, stiffness, delay and lag."""
    import contextlib

    from jointctl.tools.configuration.conversions import static_friction_Nm
    from jointctl.tools.configuration.found_values import with_break_away, without_friction
    from jointctl.tools.drawing import require_png, save_png
    from jointctl.tools.session.control import in_control
    from jointctl.tools.session.plan import require_terminal
    from jointctl.tools.session.result import never_begun, require_off
    from jointctl.tools.tuning.carry_out import Carrier, NotCarriedOut, ShownConsent, response_by_any_law, response_task
    from jointctl.tools.tuning.frequency_response import bode_figure
    from jointctl.tools.tuning.joint_fit import fit_of
    from jointctl.tools.written_file import replace_file, require_target

    picture, file = figure or Path(f"{config.path.stem}.response.png"), out or Path(f"{config.path.stem}.response.json")
    if file.suffix != ".json":
        raise DataError(f"-o (={file}) must end in .json")
    require_png(picture, [config.path])
    require_target(file, [config.path])
    static_Nm = static_friction_Nm(config) or 0.0
    before = with_break_away(config, static_Nm) if static_Nm > 0.0 else without_friction(config)
    task = response_task(before, options.torque_Nm, options.legs)
    if not (assume_yes or dry_run or options.lockstep):
        require_terminal()
    consent = ShownConsent(output, assume_yes=assume_yes or options.lockstep, dry_run=dry_run)
    with contextlib.ExitStack() as stack:
        control = None if options.lockstep else stack.enter_context(in_control(task.config, output))
        try:
            carrier = Carrier(output, consent, control, allow_low_margin)
            found = response_by_any_law(before, options.legs, carrier, options.torque_Nm)[-1][0]
        except NotCarriedOut as ended:
            if ended.stopped_by:
                output.note(f"stopped by {ended.stopped_by}; no response")
                require_off(ended.drive_state)
                return INTERRUPTED
            return never_begun(ended.drive_state, output, dry_run=dry_run)
    result, fit = found.to_dict(), None
    try:
        fit = fit_of(found, config, static_Nm)
        result["fit"] = fit.to_dict()
    finally:  # what was measured is kept where no model fits
        replace_file(file, json.dumps(result, indent=1).encode())
        save_png(bode_figure(found, f"{config.path.stem}: frequency response", fit), picture)
        output.note(f"written: {file}, {picture}")
    output.result(fit_table(config, found, fit), result, (found, fit))
    return 0


def fit_table(config: Config, found: FrequencyResponse, fit: JointFit) -> Table:
    """What was found beside what the configuration says."""
    table = Table(
        "quantity", *(Column(name, justify="right") for name in ("found", "+-", "configured")), "",
        title=f"{'Two masses' if fit.flexible else 'Rigid joint'}, {found.legs} legs, {text_Nm(found.peak_Nm, 2)}, "
        f"coherence {found.coherence:.3f}",
        caption="+-: intervals of 95 %; docs/tune.md says what is in them", title_justify="left",
        caption_justify="left",
    )  # fmt: skip
    reducer, margin = config.reducer, config.margin
    link = None if reducer is None else config.link_kgm2
    known = {
        "inertia_kgm2": config.joint.inertia_kgm2, "link_kgm2": link, "lag_s": margin.current_lag_s,
        "delay_s": margin.loop_delay_s,
        "stiffness_Nmprad": None if reducer is None else reducer.loop_stiffness_Nmprad or reducer.stiffness_Nmprad,
    }  # fmt: skip
    for name, label, scale, remark in ROWS:
        one = fit.values[name]
        if not fit.flexible and name in OF_A_REDUCER:
            continue
        configured = known.get(name)
        if name == "link_kgm2" and not fit.tells_link:
            remark = "believed: not seen from the link"
        table.add_row(
            label, f"{scale * one.value:.4g}", f"{scale * one.half:.2g}",
            "" if configured is None else f"{scale * configured:.4g}", remark,
        )  # fmt: skip
    return table
