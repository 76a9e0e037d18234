"""`jointctl map CONFIG`: kinematic error and torque ripple of a reducer, from one slow motion both ways."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Column, Table

from jointctl.drivers.errors import ConfigurationError, UsageError, decimals_of
from jointctl.tools.output import Output
from jointctl.tools.verbs.verb_options import AllowLowMargin, DryRun, JointOnBus, VerbOutput, Yes

if TYPE_CHECKING:
    import numpy as np

    from jointctl.tools.analysis.reducer_map import FoundMap, MapRun
    from jointctl.tools.configuration.config import Config

SPEED_radps = 0.03  # where limits.velocity_max_radps allows it
LONGEST_rad = 0.7  # of the travel, unless more is asked for, or that is less than LEAST_TURNS of the motor
LEAST_TURNS = 4.0
SPEED_SHARE = 0.5  # of limits.velocity_max_radps
ACCELERATION_SHARE = 0.5  # of sequence.brake_radps2
_DWELL_S = 0.5
_LONGEST_LEG_s = 3600.0
_NEAR = 0.05  # share of the speed over which the slope of the friction is taken


@dataclass(frozen=True)
class MapOptions:
    """The motion; None = what fits the joint."""

    travel_rad: Annotated[
        float | None,
        typer.Option("--travel", metavar="RAD", help="about the middle of the limits (0.7, or what these allow)"),
    ] = None
    speed_radps: Annotated[
        float | None,
        typer.Option("--speed", metavar="RAD/S", help="slow, but faster than the joint sticks (0.03, or less)"),
    ] = None
    lockstep: Annotated[bool, typer.Option("--lockstep", help="virtual joint in simulated time: seconds")] = False


def config_of_map(config: Config, options: MapOptions) -> Config:
    """The configuration with one slow motion both ways, and nothing that learns; `UsageError` where it does not fit."""
    from jointctl.tools.configuration.sections import Trapezoid
    from jointctl.tools.sweeping.carry_out import with_mode, with_tracking_law
    from jointctl.tools.sweeping.plan import position_margin_rad

    torque = with_tracking_law(with_mode(config, "torque"))  # refuses first: no limit helps in another mode
    limits = config.limits
    margin_rad = position_margin_rad(config)
    width_rad = limits.position_max_rad - limits.position_min_rad - 2.0 * margin_rad
    turn_rad = math.tau / config.joint.reduction_ratio
    longest_rad = max(LONGEST_rad, LEAST_TURNS * turn_rad)
    travel_rad = min(width_rad, longest_rad) if options.travel_rad is None else options.travel_rad
    if width_rad < LEAST_TURNS * turn_rad:
        raise UsageError(
            f"limits.position_min_rad and position_max_rad leave {max(width_rad, 0.0):.4g} rad for the motion: a map "
            f"takes {LEAST_TURNS * turn_rad:.4g} rad, {LEAST_TURNS:g} motor turns"
        )
    if not LEAST_TURNS * turn_rad <= travel_rad <= width_rad:
        raise UsageError(
            f"--travel (={travel_rad:.4g}) must be in [{LEAST_TURNS * turn_rad:.4g}..{width_rad:.4g}] rad: "
            f"{LEAST_TURNS:g} motor turns, and what the limits allow"
        )
    fastest = SPEED_SHARE * limits.velocity_max_radps
    slowest = travel_rad / _LONGEST_LEG_s
    speed_radps = speeds_in_turn(config)[0] if options.speed_radps is None else options.speed_radps
    if not slowest <= speed_radps <= fastest:
        raise UsageError(f"--speed (={speed_radps:g}) must be in [{slowest:.3g}..{fastest:g}] rad/s")
    middle = 0.5 * (limits.position_min_rad + limits.position_max_rad)
    acceleration = ACCELERATION_SHARE * config.sequence.brake_radps2
    leg_s = travel_rad / speed_radps + speed_radps / acceleration + _DWELL_S
    motion = Trapezoid(
        kind="trapezoid", duration_s=round(2.0 * leg_s, 3), start_rad=middle - 0.5 * travel_rad,
        target_rad=middle + 0.5 * travel_rad, speed_radps=speed_radps, acceleration_radps2=acceleration,
        dwell_s=_DWELL_S, repeat=True,
    )  # fmt: skip
    return torque.changed(trajectory=motion)


def speeds_in_turn(config: Config) -> list[float]:
    """[rad/s] for a map that nobody chose a speed for: the next where the joint swings at one."""
    fastest = SPEED_SHARE * config.limits.velocity_max_radps
    return [speed for speed in (SPEED_radps, 2.0 * SPEED_radps, 4.0 * SPEED_radps) if speed <= fastest] or [fastest]


def map_run(config: Config, records: np.recarray, late_s: float) -> MapRun:
    """What the log of such a motion says; `late_s`: from a command to its torque."""
    from jointctl.tools.analysis.reducer_map import MapRun, late_torque_Nm, tracked

    rows = tracked(records)
    position, other = rows.position_rad.copy(), rows.second_position_rad.copy()
    second = config.joint_encoder
    if second is not None and second.law == "joint_encoder":
        position, other = other, position
    # without a reducer the joint is one mass
    motor_kgm2 = config.joint.inertia_kgm2 if config.reducer is None else config.reducer.motor_inertia_kgm2
    return MapRun(
        position, other if second is not None else None,
        late_torque_Nm(rows.command_torque_Nm, 1.0 / config.loop.rate_Hz, late_s), rows.desired_velocity_radps.copy(),
        config.joint.reduction_ratio, motor_kgm2, config.joint.inertia_kgm2 - motor_kgm2,
        (_friction_slope(config, 1.0), _friction_slope(config, -1.0)),
        math.inf if config.reducer is None else config.reducer.loop_stiffness_Nmprad or config.reducer.stiffness_Nmprad,
    )  # fmt: skip


def _friction_slope(config: Config, side: float) -> float:
    """Of [friction] against the speed at that of the motion [Nm s/rad], in the direction of `side`."""
    import numpy as np

    from jointctl.firmware_py.friction import friction_curve_Nm
    from jointctl.tools.configuration.conversions import friction_constants

    if config.friction is None or config.trajectory.kind != "trapezoid":
        return 0.0
    ratio = config.joint.reduction_ratio
    around_radps = side * config.trajectory.speed_radps * np.array([1.0 - _NEAR, 1.0 + _NEAR])
    low, high = ratio * friction_curve_Nm(friction_constants(config.friction, ratio), around_radps)
    return float((high - low) / (around_radps[1] - around_radps[0]))


def map_verb(
    config: JointOnBus,
    output: VerbOutput,
    *,
    options: MapOptions = MapOptions(),
    write: Annotated[
        bool, typer.Option("--write", help="section reducer.map, or ripple, into CONFIG; comments stay")
    ] = False,
    figure: Annotated[Path | None, typer.Option("--figure", help="PNG with both series (CONFIG.map.png)")] = None,
    assume_yes: Yes = False,
    dry_run: DryRun = False,
    allow_low_margin: AllowLowMargin = False,
) -> int:
    """Measure kinematic error and torque ripple of the reducer: one slow motion both ways, Fourier series, picture."""
    from jointctl.tools.analysis.reducer_map import found_map, map_figure
    from jointctl.tools.configuration.config import refuse_shipped
    from jointctl.tools.configuration.found_values import with_map, write_changed
    from jointctl.tools.drawing import require_png, save_png
    from jointctl.tools.session.plan import require_terminal

    if write:
        refuse_shipped(config)
    if write and config.reducer is not None and config.encoder.side != "motor":
        raise ConfigurationError(
            f"{config.path}: --write makes a [reducer.map], which is of the motor's angle: encoder.side "
            f"(={config.encoder.side}) must be motor",
            "without --write the ripple is shown",
        )
    picture = figure or Path(f"{config.path.stem}.map.png")
    require_png(picture, [config.path])
    if not (assume_yes or dry_run or options.lockstep):
        require_terminal()
    moving = config_of_map(config, options)
    measured = _measured(
        moving, output, lockstep=options.lockstep, allow_low_margin=allow_low_margin,
        assume_yes=assume_yes or options.lockstep, dry_run=dry_run,
    )  # fmt: skip
    if isinstance(measured, int):
        return measured
    found = found_map(map_run(moving, *measured))
    mounting = config.encoder.direction, config.encoder.zero_counts
    values = found.values(*mounting) if config.reducer is not None else found.ripple_values(*mounting)
    output.result(_table(found), {**asdict(found), "map": values}, found)
    save_png(map_figure(found, f"{config.path.stem}: map of the reducer"), picture)
    output.note(f"written: {picture}")
    if not found.kinematic_rad:
        output.warning("only one encoder: the kinematic error cannot be seen, only the torque ripple")
        if config.reducer is not None and config.reducer.map is not None:
            for key in ("kinematic_error_rad", "kinematic_error_per_motor_turn", "kinematic_error_phase_rad"):
                values[key] = list(getattr(config.reducer.map, key))
    if write:
        turns = f"{found.turns[0]} motor turns forwards, {found.turns[1]} backwards"
        write_changed(
            config.path, lambda text: with_map(text, values, f"map of {turns} at {found.speed_radps:g} rad/s")
        )
        output.note(f"written: {config.path}")
    return 0


def _measured(
    config: Config, output: Output, *, lockstep: bool, allow_low_margin: bool, **how: bool
) -> tuple[Any, float] | int:
    """(records, time from a command to its torque) of a run, or the exit code without one."""
    from jointctl.tools.analysis.linear_loop import loop_settings
    from jointctl.tools.recording.run_log_reader import read_run_log
    from jointctl.tools.session.plan import TerminalConsent, configured, resolve
    from jointctl.tools.sweeping.carry_out import carried_out, simulated_run

    if lockstep:
        consent = TerminalConsent(output, **how)
        done = simulated_run(config, configured(config), consent, "map", allow_low_margin=allow_low_margin)
        if done is None:
            output.note("dry run: nothing moved")
            return 0
        records = done[1].log
    else:
        result = carried_out(resolve(config, allow_low_margin=allow_low_margin), output, "map", **how)
        if isinstance(result, int):
            return result
        records = read_run_log(result.log_path).records
    settings = loop_settings(config)[0]
    return records, settings.delay_s + settings.lag_s


def _table(found: FoundMap) -> Table:
    from jointctl.tools.analysis.reducer_map import kept_waves

    table = Table(
        "series",
        *(Column(name, justify="right") for name in ("a motor turn", "amplitude", "+-", "phase [rad]", "+-")),
        title=f"Map of {sum(found.turns)} motor turns at {found.speed_radps:g} rad/s",
        caption="+-: intervals of 95 %; once a motor turn: eccentricity of the motor's encoder is part of it",
        title_justify="left",
        caption_justify="left",
    )
    for name, waves, scale, least in (
        ("kinematic error [mrad]", found.kinematic_rad, 1e3, 4), ("torque ripple [Nm]", found.ripple_Nm, 1.0, 3),
    ):  # fmt: skip
        for wave in kept_waves(waves):
            digits = decimals_of(scale * wave.amplitude_half, least)
            table.add_row(
                name, str(wave.per_motor_turn), f"{scale * wave.amplitude:.{digits}f}",
                f"{scale * wave.amplitude_half:.{digits}f}", f"{wave.phase_rad:+.3f}", f"{wave.phase_half_rad:.3f}",
            )  # fmt: skip
    return table
