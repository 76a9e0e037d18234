"""What the user asks of a sweep, checked against the joint, and the plan that follows from it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from jointctl.drivers.errors import DataError, UsageError
from jointctl.tools.configuration.config import Config
from jointctl.tools.sweeping.carry_out import position_margin_rad
from jointctl.tools.sweeping.checks import measuring_constants
from jointctl.tools.sweeping.grid import (
    DEFAULT_POINTS,
    MOST_POINTS,
    SPEED_RATIO,
    SweepPoint,
    both_directions,
    check_range,
    grid_speeds,
    listed_velocities,
    ordered_points,
    plan_hash,
)
from jointctl.tools.sweeping.plan import PlanSettings, SweepMotion, fastest_radps, plan_motion
from jointctl.tools.sweeping.statistics import LEAST_SAMPLES
from jointctl.tools.written_file import require_target

SPEED_SHARE = 0.9  # of limits.velocity_max_radps that the fastest plateau may have
ACCELERATION_SHARE = 0.8  # of sequence.brake_radps2: braking must always be possible
TRANSIT_SHARE = 0.5  # of the fastest plateau, for ways without measuring
SETTLE_S = 0.3
QUICK_S = 450.0
QUICK_MOST, QUICK_LEAST = 120, 24
QUICK_DWELL_S = 0.5
SAMPLES_SPARE = 1.7  # windows are rounded to whole ripple periods, down to two thirds; 0.5 s at 125 Hz were too few
QUICK_RATIO = 500.0


@dataclass(frozen=True)
class SweepOptions:
    """The options of the command line; None = the default that fits the joint."""

    points: int | None = None
    grid: str = "near-zero"
    speeds: Path | None = None  # of --grid list
    max_speed_radps: float | None = None
    min_speed_radps: float | None = None
    quick: bool = False
    warm_up_turns: float = 1.0
    shuffle_seed: int | None = None
    passes: int = 1
    dwell_s: float | None = None
    mode: str = "auto"
    resume: bool = False
    dry_run: bool = False
    assume_yes: bool = False
    lockstep: bool = False
    allow_low_margin: bool = False
    report: Path | None = None  # HTML page to write as well


@dataclass(frozen=True)
class SweepPlan:
    """Points, motion settings and identity of one sweep."""

    points: list[SweepPoint]
    settings: PlanSettings
    hash: str

    def motion(self, points: list[SweepPoint], warm_up_turns: float, dwell_factor: float = 1.0) -> SweepMotion:
        values = {**asdict(self.settings), "dwell_s": self.settings.dwell_s * dwell_factor}
        return plan_motion(points, PlanSettings(**values), warm_up_turns)


def make_plan(config: Config, options: SweepOptions) -> SweepPlan:
    """Check the options against the joint and plan; `UsageError` in one line."""
    _check_options(options)
    limits = config.limits
    width = limits.position_max_rad - limits.position_min_rad - 2.0 * position_margin_rad(config)
    wanted_s = options.dwell_s or (QUICK_DWELL_S if options.quick else 1.0)
    dwell_s = max(wanted_s, SAMPLES_SPARE * LEAST_SAMPLES / config.loop.rate_Hz)
    allowed = SPEED_SHARE * limits.velocity_max_radps

    def settings(transit_radps: float) -> PlanSettings:
        return PlanSettings(
            width, ACCELERATION_SHARE * config.sequence.brake_radps2, transit_radps, dwell_s, SETTLE_S,
            config.joint.reduction_ratio,
        )  # fmt: skip

    reachable = min(allowed, fastest_radps(settings(allowed)))
    if options.grid == "list":
        assert options.speeds is not None
        velocities = listed_velocities(options.speeds)
        fastest = max(abs(v) for v in velocities)
        _check_fastest(f"fastest speed of {options.speeds}", fastest, reachable, allowed)
    else:
        fastest = options.max_speed_radps or reachable
        _check_fastest("--max-speed", fastest, reachable, allowed)
        slowest = options.min_speed_radps or fastest / (QUICK_RATIO if options.quick else SPEED_RATIO)
        if not slowest < fastest:
            raise UsageError(f"--min-speed (={slowest:g}) must be less than --max-speed, {fastest:g} rad/s")

        def grid(count: int) -> list[float]:
            return both_directions(grid_speeds(options.grid, (count + 1) // 2, slowest, fastest), count)

        velocities = grid(options.points or (QUICK_MOST if options.quick else DEFAULT_POINTS))
    chosen = settings(TRANSIT_SHARE * fastest)
    points = ordered_points(velocities, options.passes, options.shuffle_seed)
    if options.quick:
        count = QUICK_MOST
        while plan_motion(points, chosen, options.warm_up_turns).duration_s > QUICK_S and count > QUICK_LEAST:
            count -= 4
            points = ordered_points(grid(count), options.passes, options.shuffle_seed)
    return SweepPlan(points, chosen, plan_hash(points, asdict(chosen) | measuring_constants(config)))


def _check_options(options: SweepOptions) -> None:
    if options.points is not None:
        check_range("--points", options.points, 2, MOST_POINTS)
    check_range("--passes", options.passes, 1, 100)
    check_range("--warm-up", options.warm_up_turns, 0.0, 1000.0)
    for name, value in (("--max-speed", options.max_speed_radps), ("--min-speed", options.min_speed_radps)):
        if value is not None:
            check_range(name, value, 1e-5, 1000.0)
    if options.dwell_s is not None:
        check_range("--dwell", options.dwell_s, 0.1, 600.0)
    if (options.grid == "list") != (options.speeds is not None):
        raise UsageError(f"--speeds FILE goes with --grid list (={options.grid}), and --grid list with --speeds")
    if options.grid == "list" and (options.points or options.max_speed_radps or options.min_speed_radps):
        raise UsageError("--points, --max-speed and --min-speed do not go with --grid list: the list says it all")
    if options.quick and (options.points is not None or options.grid == "list"):
        raise UsageError("--quick chooses the number of points: it does not go with --points and --grid list")


def _check_fastest(name: str, fastest: float, reachable: float, allowed: float) -> None:
    if fastest > reachable * (1.0 + 1e-9):
        why = f"{SPEED_SHARE:.0%} of limits.velocity_max_radps" if reachable == allowed else "what the travel allows"
        raise UsageError(f"{name} (={fastest:g}) must be at most {reachable:.4g} rad/s, {why}")


def check_files(out: Path, resume: bool) -> None:
    if out.suffix != ".csv":
        raise UsageError(f"-o (={out}) must end in .csv; its sidecar gets the same name with .json")
    require_target(out)
    for file in (out, out.with_suffix(".json")):
        if file.exists() and not resume:
            raise DataError(f"{file}: exists already", "--resume goes on with it, -o gives another name")
