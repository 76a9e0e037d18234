"""The law of a flexible joint with both encoders on random realistic joints: tracking of the link, |S|, stability.

    python tests/bench/flexible_study.py [--seed 52078] [--plants 40] [--csv FILE]

Joints and motions are those of `jointctl study --plants realistic` (`tools/experiments/controller_study.py`), the gains
chosen for what is believed of each, learning slowed down until it converges; simulated time, errors of the link itself
after 75 s.  |S| and stability are those
of the margin gate: the joint that is believed, stiffness +- `margin.stiffness_error`, link inertia over
`margin.payload_range`, free and held by friction; and, by itself, with half of the link's inertia.
"""

from __future__ import annotations

import argparse
import csv
import math
import os
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from jointctl.tools.analysis.linear_loop import LoopSettings, TwoMasses, loop_settings  # noqa: E402
from jointctl.tools.analysis.margins import converging, largest_sensitivity, learning_convergence  # noqa: E402
from jointctl.tools.configuration.config import Config  # noqa: E402
from jointctl.tools.configuration.conversions import law_resolution_rad  # noqa: E402
from jointctl.tools.configuration.load import load_config, shipped_config  # noqa: E402
from jointctl.tools.experiments.controller_study import EnsembleSettings, quantile, random_plant  # noqa: E402
from jointctl.tools.experiments.scenarios import (  # noqa: E402
    RANDOM_MOTIONS,
    Controller,
    ErrorFigures,
    Scenario,
    changed,
    controller_config,
    controller_constants,
    error_figures,
    random_motion,
    run_scenario,
    with_chosen_gains,
)
from jointctl.tools.lockstep import LockstepJoint  # noqa: E402

AFTER_s = 75.0
LEARNING = {"gain": 0.6, "error_gain_ps2": 300.0, "lead_cycles": 10, "half_width_cycles": 10}
ADAPTATION = {"ripple_per_motor_turn": (2.0, 10.0)}
LAWS: dict[str, dict[str, Any]] = {
    "both encoders": {},
    "learning": {"learning": LEARNING},
    "adaptation": {"adaptation": ADAPTATION},
    "learning and adaptation": {"learning": LEARNING, "adaptation": ADAPTATION},
}
MOTIONS: dict[str, tuple[Scenario, ...]] = {
    "both encoders": ("sine", "multi_sine", "point_to_point", "reversals"),
    "learning": ("sine",),
    "adaptation": ("sine", "multi_sine", "point_to_point", "reversals"),
    "learning and adaptation": ("sine",),
}


@dataclass(frozen=True)
class Row:
    """One run, and the loop that it had."""

    plant: int
    friction: str
    law: str
    motion: str
    fault: str
    rmse_mrad: float
    peak_mrad: float
    chatter_Nm: float
    largest_s: float
    convergence: float  # of learning, the worst factor of one repetition; nan without
    half_link_s: float


def _half_link(settings: LoopSettings) -> LoopSettings:
    """The joint that is believed, free of friction, with half of the link's inertia."""
    free = [one for one in settings.joints if isinstance(one, TwoMasses) and one.bristle_Nmprad == (0.0, 0.0)]
    stiffness_Nmprad = float(np.median([one.stiffness_Nmprad for one in free]))
    link_kgm2 = 0.5 * (settings.inertia_kgm2 - settings.motor_inertia_kgm2)
    return replace(settings, joints=(replace(free[0], link_kgm2=link_kgm2, stiffness_Nmprad=stiffness_Nmprad),))


def runs_of(
    config: Config, chosen: Controller, seed: int, index: int
) -> Iterator[tuple[str, Scenario, ErrorFigures, float]]:
    """(law, motion, errors after 75 s, worst factor of one repetition of learning or nan) of one joint, each law."""
    joint = LockstepJoint(config)
    settings = loop_settings(controller_config(config, chosen))[0]
    for name, changes in LAWS.items():
        control, convergence = changed(chosen.control, changes, name), math.nan
        if control.learning is not None:
            control = control.model_copy(update={"learning": converging(settings, control.learning)})
        if control.learning is not None:
            convergence = learning_convergence(settings, control.learning).worst_factor
        constants = controller_constants(
            config, Controller(name, control, chosen.friction), joint.report.start_position_rad
        )
        for scenario in MOTIONS[name]:
            motion = None
            if scenario in RANDOM_MOTIONS:
                motion = random_motion(scenario, seed, index, config.trajectory.duration_s)
            run = run_scenario(joint, constants, scenario, motion=motion)
            yield name, scenario, error_figures(run, AFTER_s, motion, law_resolution_rad(config)), convergence


def rows_of(seed: int, index: int) -> list[Row]:
    """All runs of one joint."""
    base = load_config(shipped_config("realistic"))
    config = random_plant(base, EnsembleSettings(flexible=True), seed, index)
    assert config.virtual is not None
    control = changed(base.control, {"feed_forward_lead_s": "auto"}, "realistic")
    chosen = with_chosen_gains(config, Controller("both encoders", control, base.friction))
    settings = loop_settings(controller_config(config, chosen))[0]
    largest_s, half_link_s = largest_sensitivity(settings)[0], largest_sensitivity(_half_link(settings))[0]
    return [
        Row(index, config.virtual.friction_kind, name, scenario, figures.fault, figures.true_rmse_mrad,
            figures.true_peak_mrad, figures.chatter_Nm, largest_s, convergence, half_link_s)
        for name, scenario, figures, convergence in runs_of(config, chosen, seed, index)
    ]  # fmt: skip


def _text(values: list[float]) -> str:
    return f"{quantile(np.array(values), 0.5):.3f} / {max(values):.3f}" if values else "-"


def table(rows: list[Row]) -> None:
    """The table of docs/law-measured.md."""
    print(
        "| law, motion | RMSE, LuGre | stick-slip | peak | chatter [Nm a cycle] | faults |\n|---|---|---|---|---|---|"
    )
    for name, motions in MOTIONS.items():
        for motion in motions:
            own = [row for row in rows if (row.law, row.motion) == (name, motion)]
            sticks = [row.rmse_mrad for row in own if row.friction == "stick_slip"]
            lugre = [row.rmse_mrad for row in own if row.friction != "stick_slip"]
            peaks, chatter = [row.peak_mrad for row in own], [row.chatter_Nm for row in own]
            cells = [_text(values) for values in (lugre, sticks, peaks, chatter)]
            faults = sum(1 for row in own if row.fault)
            print("|", " | ".join([f"{name}, {motion}", *cells, str(faults)]), "|")


def report(rows: list[Row]) -> None:
    """The table, and what the loops are like."""
    table(rows)
    first = {row.plant: row for row in rows}.values()
    print(f"\n{len(first)} joints, {sum(1 for row in first if row.friction == 'stick_slip')} with stick-slip")
    print("largest |S|:", _text([row.largest_s for row in first]))
    stable = sum(1 for row in first if math.isfinite(row.half_link_s))
    print(f"stable with half of the link's inertia: {stable}")
    print("learning, factor of a repetition:", _text([row.convergence for row in rows if "learning" in row.law]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=52078)
    parser.add_argument("--plants", type=int, default=40)
    parser.add_argument("--csv", type=Path, default=None)
    options = parser.parse_args()
    rows: list[Row] = []
    for index in range(options.plants):
        rows += rows_of(options.seed, index)
        print(f"{index + 1} of {options.plants}", file=sys.stderr, flush=True)
        if options.csv is not None:  # after each joint: what is interrupted is not lost
            with options.csv.open("w", newline="", encoding="utf-8") as file:
                writer = csv.writer(file)
                writer.writerow([field.name for field in fields(Row)])
                writer.writerows(list(asdict(row).values()) for row in rows)
    report(rows)


if __name__ == "__main__":
    main()
