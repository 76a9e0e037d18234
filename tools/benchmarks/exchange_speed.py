"""The loop on the virtual joint against the same exchange in C, cyclictest and Python loops; idle and under load.

Ours, C and cyclictest all keep to the last core, and the load to the first.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from jointctl.tools.benchmarks.c_programs import NoCompilerError, exchange_program
from jointctl.tools.benchmarks.compiled_loops import (
    at_rate,
    cyclictest_path,
    on_the_core,
    patient,
    run_c,
    run_cyclictest,
    run_ours,
    run_sleep_only,
)
from jointctl.tools.benchmarks.load import LOADS, cores
from jointctl.tools.benchmarks.loop_times import LoopTimes
from jointctl.tools.benchmarks.paired import Row, compared, interleaved, skipped
from jointctl.tools.benchmarks.python_loops import run_canopen_sync, run_python_can
from jointctl.tools.configuration.config import Config
from jointctl.tools.simulation.virtual_joint import separate_virtual_joint

Loop = Callable[[Config, float, str], LoopTimes]  # one segment: joint, seconds, name of the load
GROUP = "loop"
RATES_Hz = (1000.0, 2000.0)
GOAL = 1.2
MEDIAN, HIGH = 0.5, 0.99
_AGAINST_C = (
    ("wake-up p50", "wake", MEDIAN, None),
    ("wake-up p99", "wake", HIGH, GOAL),
    ("work p50", "work", MEDIAN, None),
    ("work p99", "work", HIGH, GOAL),
    ("round trip p50", "round_trip", MEDIAN, None),
    ("round trip p99", "round_trip", HIGH, None),
)
_AGAINST_CYCLICTEST = (("wake-up p50", "wake", MEDIAN, GOAL), ("wake-up p99", "wake", HIGH, None))
_BARE = (("sleep alone, p50", "wake", MEDIAN, None), ("sleep alone, p99", "wake", HIGH, None))
_AGAINST_PYTHON = (("wake-up p50", "wake", MEDIAN, None), ("wake-up p99", "wake", HIGH, None))
_INTERVALS = (("SYNC interval off by, p99", "wake", HIGH, None),)


@dataclass(frozen=True)
class Rounds:
    """How often each comparison is measured: what is close, more often, for the p99 of some seconds is noisy."""

    in_c: int
    cyclictest: int
    in_python: int


@dataclass(frozen=True)
class Case:
    """One rate and one load; a segment lasts `seconds`."""

    config: Config
    load_name: str
    seconds: float

    @property
    def name(self) -> str:
        """As the table has it."""
        return f"{self.config.loop.rate_Hz / 1000.0:g} kHz, {self.load_name}"


def _rows(
    case: str,
    ours: list[LoopTimes],
    other: list[LoopTimes],
    name: str,
    quantities: tuple[tuple[str, str, float, float | None], ...],
) -> Iterator[Row]:
    for what, field, share, goal in quantities:
        one = [times.quantile(field, share) for times in ours]
        two = [times.quantile(field, share) for times in other]
        if not any(math.isnan(value) for value in two):
            yield compared(GROUP, f"{case}: {what}", one, two, "us", name, goal=goal)


def _in_turn(case: Case, rounds: int, *loops: Loop) -> list[list[LoopTimes]]:
    return interleaved(rounds, *(partial(loop, case.config, case.seconds, case.load_name) for loop in loops))


def _against_c(case: Case, program: Path, rounds: int) -> Iterator[Row]:
    ours, theirs = _in_turn(case, rounds, run_ours, partial(run_c, program))
    yield from _rows(case.name, ours, theirs, "C loop", _AGAINST_C)


def _against_cyclictest(case: Case, path: str, rounds: int) -> Iterator[Row]:
    ours, theirs, bare = _in_turn(case, rounds, run_ours, partial(run_cyclictest, path), run_sleep_only)
    yield from _rows(case.name, ours, theirs, "cyclictest", _AGAINST_CYCLICTEST)
    yield from _rows(case.name, bare, theirs, "cyclictest", _BARE)


def _against_python(case: Case, rounds: int) -> Iterator[Row]:
    ours, python_can, canopen = _in_turn(case, rounds, run_ours, run_python_can, run_canopen_sync)
    yield from _rows(case.name, ours, python_can, "python-can loop", _AGAINST_PYTHON)
    intervals = [LoopTimes(np.abs(np.diff(times.wake_us)), times.work_us, times.work_us) for times in ours]
    yield from _rows(case.name, intervals, canopen, "canopen SYNC", _INTERVALS)


def exchange_rows(config: Config, folder: Path, *, rounds: Rounds, seconds: float, quick: bool) -> Iterator[Row]:
    """Starts a virtual joint of its own on a bus of its own; `quick`: one rate, idle and the Python thread only."""
    program: Path | None = None
    try:
        program = exchange_program(folder)
    except NoCompilerError as error:
        yield skipped(GROUP, "against a C loop", error.message)
    cyclictest = cyclictest_path()
    if cyclictest is None:
        yield skipped(GROUP, "against cyclictest", "not installed (package rt-tests)")
    channel = f"bench{os.getpid()}"
    config = patient(config).model_copy(
        update={"bus": config.bus.model_copy(update={"interface": "jointctl", "channel": channel})}
    )
    with separate_virtual_joint(config.path, channel):
        for rate_Hz in RATES_Hz[:1] if quick else RATES_Hz:
            for name in LOADS[:2] if quick else LOADS:
                case = Case(on_the_core(at_rate(config, rate_Hz), cores()[-1]), name, seconds)
                if program is not None:
                    yield from _against_c(case, program, rounds.in_c)
                if cyclictest is not None:
                    yield from _against_cyclictest(case, cyclictest, rounds.cyclictest)
                yield from _against_python(case, rounds.in_python)
