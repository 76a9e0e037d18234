"""A campaign: many scenarios on all cores, and what they showed as a table, JSON with every violation, and a figure.

What is done is kept whatever ends the campaign.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.table import Column, Table

from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.arm import ArmConfig
from jointctl.tools.configuration.config import Config
from jointctl.tools.drawing import INK, MID_BLUE, MID_GREEN, MID_RED, canvas
from jointctl.tools.experiments.arm_campaign import ArmScenario, draw_arm_scenario, judge_arm, masses_of
from jointctl.tools.experiments.fault_scenarios import During, PlaceStep, Scenario, draw_scenario
from jointctl.tools.experiments.judge import Verdict, judge
from jointctl.tools.experiments.many_runs import HERE, Workers
from jointctl.tools.lockstep import LockstepArm, LockstepJoint
from jointctl.tools.sweeping.carry_out import with_mode
from jointctl.tools.written_file import replace_file

# --- the runs ---

AT_ONCE = 16  # scenarios that a worker takes at a time
_kept = threading.local()  # of a worker: the joint of the campaign that it works for


@dataclass(frozen=True)
class Campaign:
    """What its scenarios are drawn and judged by; it is sent to the workers."""

    config: Config | ArmConfig
    seed: int
    during: During = "run"
    pairs: bool = False  # two faults in each scenario
    place: PlaceStep | None = None  # during a tune

    def scenario(self, number: int) -> Scenario | ArmScenario:
        """The one with this number."""
        if isinstance(self.config, ArmConfig):
            return draw_arm_scenario(self.config, self.seed, number, pairs=self.pairs)
        return draw_scenario(self.seed, number, self.during, pairs=self.pairs)

    def judge(self) -> Callable[[Any], Verdict]:
        """What judges its scenarios, with a joint that is commissioned here."""
        if isinstance(self.config, ArmConfig):
            return partial(judge_arm, LockstepArm(self.config), masses_of(self.config))
        return partial(judge, *campaign_joint(self.config, self.during), place=self.place)


def campaign_joint(config: Config, during: During) -> tuple[Config, LockstepJoint]:
    """The configuration in the mode of the drive that a run, a sweep or a tune uses, and its joint, commissioned."""
    if during in ("sweep", "tune"):
        config = with_mode(config, "auto" if during == "sweep" else "torque")
    return config, LockstepJoint(config)


def judge_all(task: tuple[Campaign, range]) -> list[Verdict]:
    """Scenarios of these numbers, in their order; a worker commissions its joint once."""
    campaign, numbers = task
    config = campaign.config
    key = (config.arm, config.joints) if isinstance(config, ArmConfig) else (config, campaign.during)
    if getattr(_kept, "key", None) != key:
        _kept.judge = campaign.judge()
        _kept.key = key
    return [_kept.judge(campaign.scenario(number)) for number in numbers]


def run_campaign(
    campaign: Campaign, count: int, advance: Callable[[float], None], workers: Workers = HERE
) -> tuple[list[Verdict], float, bool]:
    """(verdicts in order of their numbers, time taken [s], whether Ctrl-C ended it early)."""
    started_s = time.monotonic()
    found: list[Verdict] = []
    interrupted = False
    tasks = ((campaign, range(first, min(first + AT_ONCE, count))) for first in range(0, count, AT_ONCE))
    try:
        with closing(workers.results(judge_all, tasks)) as results:
            for verdicts in results:
                found += verdicts
                advance(float(len(found)))
    except KeyboardInterrupt:
        interrupted = True
    return sorted(found, key=lambda verdict: verdict.number), time.monotonic() - started_s, interrupted


# --- what they showed ---

MANY = 1000  # scenarios: more are drawn as specks


@dataclass(frozen=True)
class KindRow:
    """All scenarios of one kind of fault."""

    kind: str
    scenarios: int
    harmless: int
    violations: int
    causes: dict[str, int]  # reported by the loop, without the harmless twins
    peak_radps: float
    beyond_rad: float
    allowed_rad: float
    longest_off_s: float


def rows_by_kind(verdicts: Sequence[Verdict]) -> list[KindRow]:
    """One row a kind, in order of the first scenario."""
    rows = []
    for kind in dict.fromkeys(verdict.kind for verdict in verdicts):
        mine = [verdict for verdict in verdicts if verdict.kind == kind]
        off = [verdict.off_s for verdict in mine if verdict.off_s is not None]
        rows.append(
            KindRow(
                kind=kind,
                scenarios=len(mine),
                harmless=sum(verdict.harmless for verdict in mine),
                violations=sum(bool(verdict.violations) for verdict in mine),
                causes=dict(Counter(verdict.fault for verdict in mine if not verdict.harmless).most_common()),
                peak_radps=max(verdict.peak_radps for verdict in mine),
                beyond_rad=max(verdict.beyond_rad for verdict in mine),
                allowed_rad=max(verdict.allowed_rad for verdict in mine),
                longest_off_s=max(off, default=0.0),
            )
        )
    return rows


def _told(fault: str) -> str:
    return "no fault" if fault == Fault.NONE.name else fault.lower().replace("_", " ")


def table(rows: Sequence[KindRow]) -> Table:
    numbers = (
        "runs", "harmless", "violations", "speed [rad/s]", "beyond limit [rad]", "allowed [rad]", "off after [s]",
    )  # fmt: skip
    right = (Column(name, justify="right") for name in numbers)
    shown = Table("fault", *right, "reported as", title="fault campaign")
    for row in rows:
        causes = ", ".join(f"{_told(name)} {count}" for name, count in row.causes.items())
        shown.add_row(
            row.kind, str(row.scenarios), str(row.harmless), str(row.violations), f"{row.peak_radps:.2f}",
            f"{row.beyond_rad:.3f}", f"{row.allowed_rad:.2f}", f"{row.longest_off_s:.3f}", causes,
        )  # fmt: skip
    return shown


def violations(campaign: Campaign, verdicts: Sequence[Verdict]) -> list[dict[str, Any]]:
    """Everything that is needed to look at each violation again."""
    return [
        {**asdict(verdict), "scenario": campaign.scenario(verdict.number).describe()}
        for verdict in verdicts
        if verdict.violations
    ]


def write_json(
    path: Path, campaign: Campaign, verdicts: Sequence[Verdict], elapsed_s: float, found: list[dict[str, Any]]
) -> None:
    """`found`: as of `violations`."""
    content = {
        "seed": campaign.seed,
        "during": campaign.during,
        "scenarios": len(verdicts),
        "elapsed_s": round(elapsed_s, 1),
        "kinds": [asdict(row) for row in rows_by_kind(verdicts)],
        "violations": found,
    }
    text = json.dumps(content, indent=1, allow_nan=False)
    replace_file(path, f"{text}\n".encode())


def campaign_figure(verdicts: Sequence[Verdict], velocity_max_radps: float) -> Any:
    """Speed reached and time until off, a column of points for each kind; violations in red."""
    kinds = list(dict.fromkeys(verdict.kind for verdict in verdicts))
    many = len(verdicts) > MANY
    points: dict[str, list[tuple[float, float, float]]] = {MID_BLUE: [], MID_GREEN: [], MID_RED: []}
    for place, kind in enumerate(kinds):
        mine = [verdict for verdict in verdicts if verdict.kind == kind]
        for i, verdict in enumerate(mine):
            across = place - 0.3 + 0.6 * i / max(len(mine) - 1, 1)
            colour = MID_RED if verdict.violations else MID_GREEN if verdict.harmless else MID_BLUE
            off_s = math.nan if verdict.off_s is None else max(verdict.off_s, 1e-3)
            points[colour].append((across, verdict.peak_radps, off_s))
    with canvas(8.0) as figure:
        speed, off = figure.subplots(2, 1, sharex=True)
        for colour, some in points.items():  # a line object for each point would take a minute
            if some:
                across_all, speeds_radps, offs_s = zip(*some, strict=True)
                style: Any = {"color": colour, "markersize": 2.5 if many else 6.0, "rasterized": many}
                speed.plot(across_all, speeds_radps, ".", **style)
                off.plot(across_all, offs_s, ".", **style)
        speed.axhline(velocity_max_radps, color=INK, linewidth=0.8, linestyle="--", label="velocity limit")
        speed.set_ylabel("greatest speed [rad/s]")
        speed.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0))
        speed.set_xlim(-0.6, len(kinds) - 0.4)
        off.set_ylabel("off and at rest after the fault [s]")
        if any(math.isfinite(off_s) for some in points.values() for _, _, off_s in some):  # of none there is no scale
            off.set_yscale("log")
        off.set_xticks(range(len(kinds)), kinds, rotation=70, ha="right", rotation_mode="anchor", fontsize=8)
        speed.set_title("harmful faults blue, harmless twins green, violations red")
        return figure
