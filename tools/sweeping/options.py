"""What the user asks of a sweep: the options of the command line, and whether they go together.

`--help` loads this: what takes its time is in `plan`.
"""

from __future__ import annotations

import hashlib
import json
import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from jointctl.drivers.errors import DataError, UsageError
from jointctl.firmware_py.input_file import number_from, read_input
from jointctl.tools.written_file import require_target

# --- Which speeds a sweep visits: the grid, both directions, the order ---
# Speeds are joint speeds [rad/s] > 0; a point is one plateau, its velocity signed.  An odd number of points is kept to
# the letter (the paper has 225): the slowest speed is then visited in the positive direction only.


GRIDS = ("near-zero", "linear", "log", "list")
DEFAULT_POINTS = 225
SPEED_RATIO = 1000.0  # default: the slowest speed is this many times slower than the fastest
MOST_POINTS = 5000
_GRID_POWER = 2.0  # near-zero: speeds go with this power of their number


@dataclass(frozen=True)
class Condition:
    """Under which a whole pass is measured."""

    load_Nm: float = 0.0  # known constant load at the joint, positive where it needs a positive motor torque
    place_rad: float | None = None  # middle of the motion; None: about where the joint stands


UNLOADED = Condition()


@dataclass(frozen=True)
class SweepPoint:
    """One plateau of the grid; `index` is its place in the plan and never changes."""

    index: int
    velocity_radps: float
    pass_number: int
    condition: Condition = UNLOADED

    @property
    def direction(self) -> int:
        return 1 if self.velocity_radps > 0.0 else -1


def check_range(name: str, value: float, low: float, high: float) -> None:
    """`UsageError` unless low <= value <= high."""
    if not low <= value <= high:
        raise UsageError(f"{name} (={value:g}) must be in [{low:g}..{high:g}]")


def grid_speeds(grid: str, count: int, slowest_radps: float, fastest_radps: float) -> list[float]:
    """`count` ascending speeds from the slowest to the fastest; linear is the paper's k/count of the fastest."""
    if grid not in GRIDS[:3]:
        raise UsageError(f"--grid (={grid}) must be one of {', '.join(GRIDS)}")
    if count == 1:
        return [fastest_radps]
    if grid == "linear":
        step = fastest_radps / count
        return [max(slowest_radps, step * (k + 1)) for k in range(count)]
    shares = [k / (count - 1) for k in range(count)]
    if grid == "log":
        return [slowest_radps * (fastest_radps / slowest_radps) ** u for u in shares]
    return [slowest_radps + (fastest_radps - slowest_radps) * u**_GRID_POWER for u in shares]


def listed_velocities(path: Path) -> list[float]:
    """Velocities [rad/s] of a file, one a line; `#` comments and the heading velocity_radps are allowed."""
    try:
        text = read_input(path).decode("utf-8-sig")
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: byte {error.start} is not UTF-8 text") from None
    found: list[float] = []
    for number, line in enumerate(text.splitlines(), start=1):
        word = line.split("#")[0].strip()
        if not word or word == "velocity_radps":
            continue
        try:
            value = number_from(word)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or value == 0.0:
            raise DataError(f"{path}: line {number} (={word[:40]}) must be a velocity in rad/s, finite and not zero")
        if value in found:
            raise DataError(f"{path}: line {number} (={word[:40]}) is a velocity that the list already has")
        found.append(value)
    if not found:
        raise DataError(f"{path}: holds no velocities; one a line, in rad/s")
    return found


def both_directions(speeds: list[float], points: int) -> list[float]:
    """Each speed forwards and backwards, slowest first; the slowest only forwards where `points` is odd."""
    velocities = [signed for speed in speeds for signed in (speed, -speed)]
    if points % 2:
        del velocities[1]
    return velocities


def ordered_points(
    velocities: list[float], passes: int, shuffle_seed: int | None, conditions: Sequence[Condition] = (UNLOADED,)
) -> list[SweepPoint]:
    """All points in the order of measuring: pass by pass, both directions of a speed one after the other.

    A shuffled order is another one in each pass, so that drift does not look like a property of the speed.
    """
    random_order = None if shuffle_seed is None else random.Random(shuffle_seed)
    points: list[SweepPoint] = []
    for number, condition in enumerate(each for each in conditions for _ in range(passes)):
        speeds = list(dict.fromkeys(abs(v) for v in velocities))
        if random_order is not None:
            random_order.shuffle(speeds)
        for speed in speeds:
            pair = sorted((v for v in velocities if abs(v) == speed), reverse=True)
            points += [SweepPoint(len(points) + k, velocity, number, condition) for k, velocity in enumerate(pair)]
    return points


def plan_hash(points: list[SweepPoint], more: dict[str, float]) -> str:
    """Identifies a plan: its points in their order, and what else decides about the measurement."""
    content = [
        [f"{p.velocity_radps:.9g}", p.pass_number, *([] if p.condition == UNLOADED else [repr(p.condition)])]
        for p in points
    ]
    text = json.dumps([content, {key: f"{value:.9g}" for key, value in sorted(more.items())}])
    return hashlib.sha256(text.encode("ascii")).hexdigest()[:16]


# --- Options ---


@dataclass(frozen=True)
class SweepOptions:
    """None = the default that fits the joint."""

    points: Annotated[int | None, typer.Option("--points", help="plateaus in both directions together (225)")] = None
    grid: Annotated[str, typer.Option("--grid", help="near-zero, linear, log, or list")] = "near-zero"
    speeds: Annotated[
        Path | None, typer.Option("--speeds", metavar="FILE", help="of --grid list: velocities in rad/s, one a line")
    ] = None
    max_speed_radps: Annotated[
        float | None,
        typer.Option("--max-speed", metavar="RAD/S", help="fastest plateau (what limits and travel allow)"),
    ] = None
    min_speed_radps: Annotated[
        float | None, typer.Option("--min-speed", metavar="RAD/S", help="slowest plateau (a thousandth of the fastest)")
    ] = None
    quick: Annotated[bool, typer.Option("--quick", help="as many points as fit into 8 minutes, 120 at most")] = False
    warm_up_turns: Annotated[
        float, typer.Option("--warm-up", metavar="TURNS", help="of the joint, before measuring")
    ] = 1.0
    shuffle_seed: Annotated[
        int | None, typer.Option("--shuffle", metavar="SEED", help="speeds in random order, against drift")
    ] = None
    passes: Annotated[int, typer.Option("--passes", help="times that the whole grid is measured")] = 1
    loads_Nm: Annotated[
        list[float] | None,
        typer.Option("--load-Nm", metavar="NM", help="known constant load at the joint; one each for further passes"),
    ] = None
    places_rad: Annotated[
        list[float] | None,
        typer.Option("--at", metavar="RAD", help="middle of the motion, of a pendulum; one each for further passes"),
    ] = None
    warm_between_turns: Annotated[
        float, typer.Option("--warm-between", metavar="TURNS", help="of the joint before each further pass: warms it")
    ] = 0.0
    dwell_s: Annotated[
        float | None, typer.Option("--dwell", metavar="S", help="wanted measuring time per point (1, quick 0.5)")
    ] = None
    mode: Annotated[str, typer.Option("--mode", help="auto, csv, pv or speed (the drive's velocity loop), torque")] = (
        "auto"
    )
    resume: Annotated[bool, typer.Option("--resume", help="measure what is missing in an interrupted sweep")] = False
    dry_run: Annotated[bool, typer.Option("--dry-run", help="commission, show the motion envelope, move nothing")] = (
        False
    )
    assume_yes: Annotated[bool, typer.Option("-y", "--yes", help="move without asking")] = False
    lockstep: Annotated[bool, typer.Option("--lockstep", help="virtual joint in simulated time: seconds")] = False
    allow_low_margin: Annotated[
        bool, typer.Option("--allow-low-margin", help="torque mode: run a stable loop below the wanted phase margin")
    ] = False
    report: Annotated[
        Path | None, typer.Option("--report", metavar="FILE.html", help="the result as one self-contained page as well")
    ] = None

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """Of the passes: each load at each place."""
        places: list[float] | list[None] = self.places_rad or [None]
        return tuple(Condition(load, place) for load in self.loads_Nm or [0.0] for place in places)

    @property
    def conditioned(self) -> bool:
        """Whether friction is measured under more than one load or temperature: the data then tell the load."""
        return bool(self.loads_Nm or self.places_rad or self.warm_between_turns)


AS_IT_FITS = SweepOptions()


def check_options(options: SweepOptions) -> None:
    """`UsageError` for what no joint can have, and for what contradicts itself."""
    if options.points is not None:
        check_range("--points", options.points, 2, MOST_POINTS)
    check_range("--passes", options.passes, 1, 100)
    check_range("--warm-up", options.warm_up_turns, 0.0, 1000.0)
    check_range("--warm-between", options.warm_between_turns, 0.0, 1000.0)
    if options.warm_between_turns and options.passes * len(options.conditions) == 1:
        raise UsageError(f"--warm-between (={options.warm_between_turns:g}) needs --passes of 2 or more, or loads")
    for name, values in (("--load-Nm", options.loads_Nm), ("--at", options.places_rad)):
        for number in values or ():
            check_range(name, number, -1e5, 1e5)
        if values and len(set(values)) < len(values):
            raise UsageError(f"{name} (={', '.join(f'{value:g}' for value in values)}) must differ")
    if options.loads_Nm and len(options.loads_Nm) > 1 and options.assume_yes and not options.lockstep:
        raise UsageError("-y does not go with --load-Nm of several loads: each must be attached, and confirmed")
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


def check_files(out: Path, resume: bool) -> None:
    if out.suffix != ".csv":
        raise UsageError(f"-o (={out}) must end in .csv; its sidecar gets the same name with .json")
    require_target(out)
    for file in (out, out.with_suffix(".json")):
        if file.exists() and not resume:
            raise DataError(f"{file}: exists already", "--resume goes on with it, -o gives another name")
