"""The control tick and its parts, alone: kernel, C, numpy.

Not collected by default (its name); run `python -m pytest -n 0 --benchmark-enable tests/bench/bench_law.py`.  It needs
pytest-benchmark and a C compiler.  For paired ratios on a busy computer use `python -m tests.bench.speed --only law`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.records import AxisState, Command, LogRecord, Sample
from jointctl.firmware_py.schema import new
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.lockstep import LockstepJoint
from tests.bench.c_programs import FAST_MATH, OPTIMISED, law_library
from tests.bench.law_speed import (
    NUMPY_TICKS,
    SAME_NUMBERS,
    NumpyLaw,
    allocations,
    c_function,
    difference,
    kernel_ticks,
    run_hidden,
    sine_inputs,
)
from tests.sessions import constants_of

TICKS = 10_000


@pytest.fixture(scope="module")
def constants() -> Any:
    return constants_of(load_config(shipped_config("virtual")))


def timed(benchmark: Any, ticks: Callable[[np.ndarray, np.ndarray], None], inputs: np.ndarray) -> None:
    torque_Nm = np.zeros(len(inputs))
    benchmark.extra_info["ticks_per_round"] = len(inputs)
    benchmark.pedantic(ticks, args=(inputs, torque_Nm), rounds=20, warmup_rounds=2)
    assert np.all(np.isfinite(torque_Nm))
    assert np.any(torque_Nm != 0.0)


def test_kernel(benchmark, constants):
    timed(benchmark, kernel_ticks(constants), sine_inputs(constants[0], TICKS))


@pytest.mark.parametrize("options", [OPTIMISED, FAST_MATH], ids=["O3", "fast-math"])
def test_c(benchmark, constants, tmp_path: Path, options: tuple[str, ...]):
    ticks = c_function(law_library(tmp_path, options), "run_ticks", constants)
    timed(benchmark, ticks, sine_inputs(constants[0], TICKS))


def test_numpy(benchmark, constants):
    timed(benchmark, NumpyLaw(constants[0]).ticks, sine_inputs(constants[0], NUMPY_TICKS))


def test_network_alone(benchmark, constants):
    state = new(AxisState)
    state[0].law.network.weights[:] = 0.01
    timed(benchmark, lambda i, t: run_hidden(constants, state, i, t), sine_inputs(constants[0], TICKS))


def test_one_second_of_lockstep(benchmark):
    """Controller, codec, drive and plant: the whole tick `step_axis` is in it."""
    joint = LockstepJoint(load_config(shipped_config("virtual")))
    run = benchmark.pedantic(lambda: joint.run(longest_s=1.0, log_every=0), rounds=10, warmup_rounds=1)
    assert run.state.cycle == 1000


@pytest.mark.parametrize("options", [OPTIMISED, FAST_MATH], ids=["O3", "fast-math"])
def test_c_gives_the_same_numbers(constants, tmp_path: Path, options: tuple[str, ...]):
    library = law_library(tmp_path, options)
    inputs = sine_inputs(constants[0], TICKS)
    assert difference(kernel_ticks(constants), c_function(library, "run_ticks", constants), inputs) <= SAME_NUMBERS


def test_a_law_with_another_gain_gives_other_numbers(constants, tmp_path: Path):
    """The twin: the comparison above can fail."""
    other = constants.copy()
    other[0].law.network.learning_rate *= 1.0 + 1e-6
    library = law_library(tmp_path, OPTIMISED)
    inputs = sine_inputs(constants[0], TICKS)
    assert difference(kernel_ticks(constants), c_function(library, "run_ticks", other), inputs) > SAME_NUMBERS


def test_nothing_is_allocated_per_tick(constants):
    assert allocations(constants) == 0


def test_the_records_are_those_of_the_loop():
    """The C loop copies about as much into its log as one record of ours."""
    assert abs(new(LogRecord).itemsize - 408) < 100
    assert new(Sample).itemsize + new(Command).itemsize < 408
