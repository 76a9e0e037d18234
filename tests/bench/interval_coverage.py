"""How often the 95 % intervals of `identify` hold the truth, counted over simulated sweeps of Table 3.

    python -m tests.bench.interval_coverage [--sweeps 1000] [--only 40] [--json]

Speeds as `sweep` plans them; noise of 4.6 mNm at the motor, drawn anew for each sweep: at 224 points, at 40, with
3 % of the points off by ten times as much (normal), and proportional to the friction (4.6 mNm on average).  The model
is that of the truth, multi-stage with the paper's knee; outliers and weights are found as always.  Pooled over both
directions; the band is counted at every speed of the sweep.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Column, Table

from jointctl.firmware_py.friction import DEGREE, branch_torque_Nm, friction_curve_Nm, paper_friction
from jointctl.tools.identification.fit import NAMES
from jointctl.tools.identification.friction_data import FrictionData
from jointctl.tools.identification.identification import DIRECTIONS, Options, identify_friction
from jointctl.tools.identification.swarm import SwarmSettings
from jointctl.tools.output import Output
from jointctl.tools.sweeping.options import grid_speeds

GOAL = (0.92, 0.98)
NOISE_Nm = 0.0046
FASTEST_degps, SLOWEST_degps = 200.0, 0.2
# the minimum is found by variable projection, where the swarm ends above it
QUICK = Options(model="multi-stage", folds=2, swarm=SwarmSettings(particles=2, iterations=1))


@dataclass(frozen=True)
class Condition:
    """How sweeps are simulated."""

    name: str
    points: int = 224
    outlier_share: float = 0.0
    proportional: bool = False


CONDITIONS = (
    Condition("224 points"),
    Condition("40 points", points=40),
    Condition("3 % outliers", outlier_share=0.03),
    Condition("noise ~ torque", proportional=True),
    Condition("noise ~ torque, 40 points", points=40, proportional=True),
)


def simulated_sweep(condition: Condition, random: np.random.Generator) -> FrictionData:
    """Points of Table 3 with the errors of a condition."""
    speeds = np.array(grid_speeds("near-zero", condition.points // 2, SLOWEST_degps, FASTEST_degps)) * DEGREE
    velocity = np.concatenate([-speeds[::-1], speeds])
    truth = friction_curve_Nm(paper_friction(), velocity)
    scale = np.abs(truth) / np.mean(np.abs(truth)) if condition.proportional else np.ones(len(truth))
    noise = NOISE_Nm * scale * random.standard_normal(len(truth))
    off = random.random(len(truth)) < condition.outlier_share
    noise[off] += 10.0 * NOISE_Nm * random.standard_normal(np.count_nonzero(off))
    line = np.arange(2, len(truth) + 2)
    return FrictionData(
        Path("simulated"), "", velocity, truth + noise, line, np.ones(len(truth), bool), 121.0, None
    )  # fmt: skip


def coverage(condition: Condition, sweeps: int, seed: int) -> dict[str, float]:
    """Share of the intervals that hold the truth, by parameter, and of the band's places."""
    table = paper_friction()[0]
    inside: Counter[str] = Counter()
    for number in range(sweeps):
        data = simulated_sweep(condition, np.random.default_rng([seed, number]))
        found = identify_friction(data, QUICK)
        for word, _ in DIRECTIONS:
            true, direction = getattr(table, word), found.directions[word]
            parameters = (true.coulomb_Nm, true.static_Nm, true.stribeck_speed_radps, true.viscous_Nmspr, *true.cubic)
            for name, value in zip(NAMES, parameters, strict=True):
                interval = direction.uncertainty.intervals[name]
                inside[name] += interval.low <= value <= interval.high
            x = direction.fit.problem.x
            curve = [branch_torque_Nm(true, float(u)) for u in x * direction.fit.problem.top_radps]
            low, high = direction.uncertainty.band_Nm(direction.fit, x)
            inside["band"] += float(np.mean((low <= curve) & (curve <= high)))
    return {name: inside[name] / (2 * sweeps) for name in (*NAMES, "band")}


def main(
    sweeps: Annotated[int, typer.Option("--sweeps")] = 1000,
    seed: Annotated[int, typer.Option("--seed")] = 1,
    only: Annotated[str, typer.Option("--only", help="conditions whose name has it")] = "",
    json: Annotated[bool, typer.Option("--json")] = False,
) -> None:
    """Count, print, and end with 1 where a share is outside the goal."""
    output = Output(json=json)
    shares = {}
    for condition in CONDITIONS:
        if only in condition.name:
            shares[condition.name] = coverage(condition, sweeps, seed)
            output.note(f"{condition.name}: counted")
    columns = [Column(name, justify="right") for name in (*NAMES, "band")]
    table = Table("", *columns, title=f"Shares of {sweeps} sweeps, each with two directions", title_justify="left")
    for name, found in shares.items():
        table.add_row(name, *(f"{100.0 * share:.1f}" for share in found.values()))
    output.result(table, {"sweeps": sweeps, "seed": seed, "shares": shares})
    good = all(GOAL[0] <= share <= GOAL[1] for found in shares.values() for share in found.values())
    raise typer.Exit(0 if good else 1)


if __name__ == "__main__":
    typer.run(main)
