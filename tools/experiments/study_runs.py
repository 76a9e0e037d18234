"""Run every controller on every plant of a study, in as many processes as there are processors.

A plant is commissioned once and then run under each controller.  The result does not depend on the number of
processes: each plant is drawn from its own seed and simulated by itself.
"""

from __future__ import annotations

import csv
import math
import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from jointctl.drivers.errors import ConfigurationError
from jointctl.tools.configuration.config import Config
from jointctl.tools.experiments.controllers import Controller, controller_constants
from jointctl.tools.experiments.ensemble import EnsembleSettings, random_plant
from jointctl.tools.experiments.error_figures import ErrorFigures, error_figures
from jointctl.tools.experiments.scenarios import Scenario, run_scenario
from jointctl.tools.simulation.child_process import interrupts_left_to_the_parent
from jointctl.tools.simulation.lockstep import LockstepJoint
from jointctl.tools.written_file import writing

Progress = Callable[[float], None]


@dataclass(frozen=True)
class PlantTask:
    """One plant of the study, and what to run on it; it is sent to a process."""

    base: Config
    plant: EnsembleSettings
    seed: int
    index: int
    controllers: tuple[Controller, ...]
    scenario: Scenario
    after_s: float


@dataclass(frozen=True)
class PlantResult:
    """Figures of one plant under each controller, in their order."""

    index: int
    friction_kind: str
    encoder_bits: int
    figures: tuple[ErrorFigures, ...]


@dataclass(frozen=True)
class StudyResult:
    """All plants that were finished, in the order of their index."""

    controllers: tuple[str, ...]
    plants: tuple[PlantResult, ...]
    interrupted: bool

    def values(self, controller: str, figure: str) -> np.ndarray:
        """One figure of one controller over the plants, shape (plants,); inf where a fault ended the run."""
        column = self.controllers.index(controller)
        return np.array([float(getattr(plant.figures[column], figure)) for plant in self.plants])

    def faults(self, controller: str) -> int:
        column = self.controllers.index(controller)
        return sum(1 for plant in self.plants if plant.figures[column].fault)


def quantile(values: np.ndarray, share: float) -> float:
    """Linear between two values; with infinite ones among them the upper of the two, since inf - inf is nothing."""
    method = "linear" if np.all(np.isfinite(values)) else "higher"
    return float(np.quantile(values, share, method=method))  # type: ignore[call-overload]


def run_plant(task: PlantTask) -> PlantResult:
    """Commission the plant and run every controller on it."""
    config = random_plant(task.base, task.plant, task.seed, task.index)
    joint = LockstepJoint(config)
    figures = []
    for controller in task.controllers:
        constants = controller_constants(config, controller, joint.report.start_position_rad)
        figures.append(error_figures(run_scenario(joint, constants, task.scenario), task.after_s))
    assert config.virtual is not None
    bits = round(math.log2(config.encoder.counts_per_turn))
    return PlantResult(task.index, config.virtual.friction_kind, bits, tuple(figures))


def run_study(
    base: Config,
    controllers: list[Controller],
    *,
    plants: int,
    seed: int,
    settings: EnsembleSettings | None = None,
    scenario: Scenario = "sine",
    after_s: float = 75.0,
    workers: int | None = None,
    progress: Progress | None = None,
) -> StudyResult:
    """All runs; `progress` hears how many plants are done.  Ctrl-C ends it early and keeps what is there.

    `workers` None takes every processor that this process may use; 1 stays in this process.
    """
    if not 0.0 <= after_s < base.trajectory.duration_s:
        raise ConfigurationError(f"after_s (={after_s:g}) must be in [0..{base.trajectory.duration_s:g}), the run")
    settings = EnsembleSettings() if settings is None else settings
    order = tuple(controllers)
    tasks = [PlantTask(base, settings, seed, index, order, scenario, after_s) for index in range(plants)]
    workers = min(plants, workers or len(os.sched_getaffinity(0)))
    done: list[PlantResult] = []
    interrupted = False

    def take(result: PlantResult) -> None:
        done.append(result)
        if progress is not None:
            progress(float(len(done)))

    try:
        if workers == 1:
            for task in tasks:
                take(run_plant(task))
        else:
            _run_in_processes(tasks, workers, take)
    except KeyboardInterrupt:
        interrupted = True
    done.sort(key=lambda result: result.index)
    return StudyResult(tuple(c.name for c in order), tuple(done), interrupted)


def _run_in_processes(tasks: list[PlantTask], workers: int, take: Callable[[PlantResult], None]) -> None:
    """Spawned, not forked: nothing of this process (threads, open buses) is to be inherited."""
    before = set(multiprocessing.active_children())
    executor = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
    ended = False
    try:
        with interrupts_left_to_the_parent():
            pending: set[Future[PlantResult]] = {executor.submit(run_plant, task) for task in tasks}
        while pending:
            finished, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in finished:
                take(future.result())
        ended = True
    finally:
        # after an interruption or an error nobody wants the plants that are still being simulated
        executor.shutdown(wait=ended, cancel_futures=True)
        if not ended:
            for process in set(multiprocessing.active_children()) - before:
                process.terminate()


def write_csv(result: StudyResult, path: Path) -> None:
    """One line for each run."""
    names = [field.name for field in fields(ErrorFigures)]
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["plant", "friction_kind", "encoder_bits", "controller", *names])
            for plant in result.plants:
                for name, figures in zip(result.controllers, plant.figures, strict=True):
                    writer.writerow(
                        [plant.index, plant.friction_kind, plant.encoder_bits, name, *asdict(figures).values()]
                    )
