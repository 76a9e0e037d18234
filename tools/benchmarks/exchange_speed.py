"""The loop on the virtual joint against the same exchange in C, cyclictest and Python loops; idle and under load.

The two that are close, ours and C, both keep to the last core, and the load to the first.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from tools.benchmarks.c_programs import NoCompilerError, exchange_program
from tools.benchmarks.compiled_loops import (
    at_rate,
    cyclictest_path,
    on_the_core,
    patient,
    run_c,
    run_cyclictest,
    run_ours,
    run_sleep_only,
)
from tools.benchmarks.load import LOADS, cores
from tools.benchmarks.loop_times import LoopTimes
from tools.benchmarks.paired import Row, compared, interleaved, skipped
from tools.benchmarks.python_loops import run_canopen_sync, run_python_can
from tools.configuration.config import Config
from tools.simulation.virtual_joint import separate_virtual_joint

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
_AGAINST_PYTHON = (("wake-up p50", "wake", MEDIAN, None), ("wake-up p99", "wake", HIGH, None))


def _rows(
    case: str,
    ours: list[LoopTimes],
    other: list[LoopTimes],
    name: str,
    quantities: tuple[tuple[str, str, float, float | None], ...],
    note: str = "",
) -> Iterator[Row]:
    for what, field, share, goal in quantities:
        one = [times.quantile(field, share) for times in ours]
        two = [times.quantile(field, share) for times in other]
        if not any(math.isnan(value) for value in two):
            yield compared(GROUP, f"{case}: {what}", one, two, "us", name, goal=goal, note=note)


def _case_rows(
    config: Config, program: Path | None, load_name: str, pairs: int, pairs_in_c: int, seconds: float
) -> Iterator[Row]:
    """All loops in turn, `pairs` times, under one load at one rate; `pairs_in_c` against the C loop."""
    cyclictest = cyclictest_path()
    found: dict[str, list[LoopTimes]] = {}
    order: list[tuple[str, Callable[[], LoopTimes]]] = [
        ("ours", lambda: run_ours(config, seconds, load_name)),
        ("cyclictest", lambda: run_cyclictest(str(cyclictest), config, seconds, load_name)),
        ("sleep only", lambda: run_sleep_only(config, seconds, load_name)),
        ("python-can", lambda: run_python_can(config, seconds, load_name)),
        ("canopen", lambda: run_canopen_sync(config, seconds, load_name)),
    ]
    missing = {"cyclictest", "sleep only"} if cyclictest is None else set()
    for pair in range(pairs):
        for name, measure in order if pair % 2 == 0 else reversed(order):
            if name not in missing:
                found.setdefault(name, []).append(measure())
    case = f"{config.loop.rate_Hz / 1000.0:g} kHz, {load_name}"
    ours = found["ours"]
    if program is not None:
        placed = on_the_core(config, cores()[-1])
        beside_c, in_c = interleaved(
            pairs_in_c,
            partial(run_ours, placed, seconds, load_name),
            partial(run_c, program, placed, seconds, load_name),
        )
        yield from _rows(case, beside_c, in_c, "C loop", _AGAINST_C)
    if "cyclictest" in found:
        goals = (("wake-up p50", "wake", MEDIAN, GOAL), ("wake-up p99", "wake", HIGH, None))
        yield from _rows(case, ours, found["cyclictest"], "cyclictest", goals)
        bare = (("sleep alone, p50", "wake", MEDIAN, None), ("sleep alone, p99", "wake", HIGH, None))
        yield from _rows(case, found["sleep only"], found["cyclictest"], "cyclictest", bare)
    yield from _rows(case, ours, found["python-can"], "python-can loop", _AGAINST_PYTHON)
    intervals = [LoopTimes(np.abs(np.diff(times.wake_us)), times.work_us, times.work_us) for times in ours]
    quantities = (("SYNC interval off by, p99", "wake", HIGH, None),)
    yield from _rows(case, intervals, found["canopen"], "canopen SYNC", quantities)


def exchange_rows(
    config: Config, folder: Path, *, pairs: int, pairs_in_c: int, seconds: float, quick: bool
) -> Iterator[Row]:
    """Starts a virtual joint of its own on a bus of its own; `quick`: one rate, idle and the Python thread only.

    `pairs` of what is far apart, `pairs_in_c` against the C loop, which is not: on a guest whose host takes the
    processor away a p99 of some seconds is noisy.
    """
    program: Path | None = None
    try:
        program = exchange_program(folder)
    except NoCompilerError as error:
        yield skipped(GROUP, "against a C loop", error.message)
    if cyclictest_path() is None:
        yield skipped(GROUP, "against cyclictest", "not installed (package rt-tests)")
    channel = f"bench{os.getpid()}"
    config = patient(config).model_copy(
        update={"bus": config.bus.model_copy(update={"interface": "jointctl", "channel": channel})}
    )
    with separate_virtual_joint(config.path, channel):
        for rate_Hz in RATES_Hz[:1] if quick else RATES_Hz:
            for name in LOADS[:2] if quick else LOADS:
                yield from _case_rows(at_rate(config, rate_Hz), program, name, pairs, pairs_in_c, seconds)
