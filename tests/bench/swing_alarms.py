"""False alarms of the limit-cycle monitor: runs of `study` on joints that are well, none of which may swing or warn.

    python tests/bench/swing_alarms.py [--seed 1 --seed 2] [--plants 40] [--runs 200] [--controllers paper,precise,pid]
        [--base precise] [--with-stop] [--workers 2]

Each seed draws another ensemble (`tools/experiments/controller_study.py`); each of its joints runs each motion of
`study` (`tools/experiments/scenarios.py`) under each controller, to the end of the trajectory.  `--runs` takes so many
of all these runs by chance, `--with-stop` goes on through the controlled stop.  Prints a row for each controller, ends
with 1 if a run was ended by the monitor, was told to be noisy, or lost its learning.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from jointctl.firmware_py.states import Fault, Notice  # noqa: E402
from jointctl.tools.configuration.load import load_config, shipped_config  # noqa: E402
from jointctl.tools.experiments.controller_study import EnsembleSettings, random_plant  # noqa: E402
from jointctl.tools.experiments.many_runs import Workers  # noqa: E402
from jointctl.tools.experiments.scenarios import Change, Scenario, controller_constants, named, run_scenario  # noqa: E402
from jointctl.tools.lockstep import LockstepJoint  # noqa: E402

MOTIONS: tuple[Scenario, ...] = get_args(Change)
CONTROLLERS = ("paper", "precise", "pid")


@dataclass(frozen=True)
class Task:
    """The runs of one joint: (motion, controller) each."""

    base: str
    seed: int
    plant: int
    runs: tuple[tuple[Scenario, str], ...]
    with_stop: bool = False


@dataclass(frozen=True)
class Outcome:
    """How one run ended."""

    seed: int
    plant: int
    motion: Scenario
    controller: str
    fault: str
    noisy: bool
    learning_off: bool
    noise_Nm: float  # mean change of the command from cycle to cycle at the end

    @property
    def alarm(self) -> bool:
        """Whether the monitor found something."""
        return self.fault == Fault.LIMIT_CYCLE.name or self.noisy or self.learning_off


def tasks(
    seeds: Sequence[int],
    plants: int,
    controllers: Sequence[str] = CONTROLLERS,
    *,
    runs: int = 0,
    base: str = "precise",
    with_stop: bool = False,
) -> list[Task]:
    """All runs of each joint, or `runs` of them by chance; the first seed decides which."""
    every = [(s, p, (m, c)) for s in seeds for p in range(plants) for m in MOTIONS for c in controllers]
    if 0 < runs < len(every):
        chosen = np.random.default_rng(seeds[0]).permutation(len(every))[:runs]
        every = [every[i] for i in sorted(chosen.tolist())]
    joints = dict.fromkeys((s, p) for s, p, _ in every)
    return [Task(base, s, p, tuple(run for t, q, run in every if (t, q) == (s, p)), with_stop) for s, p in joints]


def outcomes(task: Task) -> list[Outcome]:
    """Commission the joint and carry out its runs."""
    path = Path(task.base)
    base = load_config(path if path.exists() else shipped_config(task.base))
    config = random_plant(base, EnsembleSettings(), task.seed, task.plant)
    joint = LockstepJoint(config)
    laws = {name: named((name,))[0] for name in dict.fromkeys(name for _, name in task.runs)}
    found = []
    for motion, name in task.runs:
        constants = controller_constants(config, laws[name], joint.report.start_position_rad)
        run = joint.run(constants) if task.with_stop and motion == "sine" else run_scenario(joint, constants, motion)
        notices = int(run.state.notices)
        found.append(
            Outcome(
                task.seed,
                task.plant,
                motion,
                name,
                run.fault.name,
                bool(notices & Notice.TORQUE_NOISE),
                bool(notices & Notice.LEARNING_OFF),
                float(run.state.swing.noise_Nm),
            )
        )
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seed", type=int, action="append")
    parser.add_argument("--plants", type=int, default=40)
    parser.add_argument("--runs", type=int, default=0, help="so many of all runs, by chance; 0 = all")
    parser.add_argument("--controllers", default=",".join(CONTROLLERS))
    parser.add_argument("--base", default="precise")
    parser.add_argument("--with-stop", action="store_true")
    parser.add_argument("--workers", type=int, help="processes; default: one a core")
    chosen = parser.parse_args()
    controllers = chosen.controllers.split(",")
    began_s = time.monotonic()
    work = tasks(
        chosen.seed or [1], chosen.plants, controllers, runs=chosen.runs, base=chosen.base, with_stop=chosen.with_stop
    )
    found = [outcome for some in Workers(chosen.workers).results(outcomes, work) for outcome in some]
    for name in controllers:
        mine = [outcome for outcome in found if outcome.controller == name]
        faults = sorted({outcome.fault for outcome in mine} - {Fault.NONE.name})
        print(
            f"{name}: {len(mine)} runs, {sum(o.fault == Fault.LIMIT_CYCLE.name for o in mine)} limit cycles, "
            f"{sum(o.noisy for o in mine)} noisy, {sum(o.learning_off for o in mine)} without learning; "
            f"faults: {', '.join(f'{fault} {sum(o.fault == fault for o in mine)}' for fault in faults) or 'none'}"
        )
    alarms = [outcome for outcome in found if outcome.alarm]
    for outcome in alarms:
        print(outcome)
    print(f"{len(found)} runs, {len(alarms)} alarms, {time.monotonic() - began_s:.0f} s")
    return 1 if alarms else 0


if __name__ == "__main__":
    sys.exit(main())
