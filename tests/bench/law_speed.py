"""The control law: our kernel, the same law in C, and the same law in numpy, tick by tick on the same inputs.

A tick is here: velocity filter, law, finite check, torque limit and rate limit, on one thread and from warm memory.
`step_cycle`, the whole tick with phases and supervision, is timed in the lockstep simulation.
"""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numba.core import runtime

from jointctl.firmware_py.axis import law_torque_Nm
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.law import network_torque_Nm, reset_law, step_law
from jointctl.firmware_py.observers import step_velocity
from jointctl.firmware_py.records import AxisConstants, AxisState
from jointctl.firmware_py.safety import limited_torque_Nm
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.trajectory import NO_REPETITION, repetition
from tests.bench.c_programs import (
    FAST_MATH,
    OPTIMISED,
    STATE_DOUBLES,
    NoCompilerError,
    law_doubles,
    law_library,
    require_comparable,
    state_doubles,
)
from tests.bench.paired import Row, compared, interleaved, measured, skipped

# --- in numpy: what one would write without a compiler, vectorised over the neurons ---


class NumpyLaw:
    """Computed torque, LuGre on the desired velocity, network; SI units, torques at the joint.

    The constants are copied out of the records first, since reading a field of a record costs more than the law.
    """

    def __init__(self, axis: Any) -> None:
        law, network = axis.law, axis.law.network
        self.period_s, self.inertia_kgm2 = float(law.period_s), float(law.inertia_kgm2)
        self.kp, self.kv, self.ratio = float(law.kp), float(law.kv), float(law.reduction_ratio)
        self.coriolis_Nmspr, self.gravity_Nm = float(law.coriolis_Nmspr), float(law.gravity_Nm)
        self.gravity_zero_rad = float(law.gravity_zero_rad)
        self.stiffness_Nmprad, self.damping_Nmspr = float(law.lugre.stiffness_Nmprad), float(law.lugre.damping_Nmspr)
        self.branches = [self._branch(law.friction.positive), self._branch(law.friction.negative)]
        self.centres = np.array(network.centres)
        self.inverse_width = np.array(network.inverse_width)
        self.p_b = np.array(network.p_b)
        self.learning_rate, self.leakage = float(network.learning_rate), float(network.leakage)
        self.weight_limit, self.dead_zone_rad = float(network.weight_limit), float(network.dead_zone_rad)
        self.gain = float(axis.velocity.period_gain)
        self.torque_max_Nm = float(axis.limits.torque_max_Nm)
        self.torque_step_Nm = float(axis.limits.torque_rate_max_Nmps) * self.period_s
        self.weights = np.full(len(self.centres), float(network.initial_weight))
        self.last: tuple[float, float] | None = None
        self.velocity_radps = self.error_rate_radps = self.deflection_rad = self.sent_Nm = 0.0

    @staticmethod
    def _branch(branch: Any) -> tuple[Any, ...]:
        return (
            float(branch.coulomb_Nm), float(branch.static_Nm), float(branch.stribeck_speed_radps),
            float(branch.viscous_Nmspr), [float(a) for a in branch.cubic], float(branch.knee_radps),
            float(branch.max_radps),
        )  # fmt: skip

    def _sliding_Nm(self, velocity_radps: float) -> float:
        tc, ts, ws, tv, a, knee, most = self.branches[0 if velocity_radps > 0.0 else 1]
        speed = abs(velocity_radps)
        if speed <= knee:
            return self.ratio * (tc + (ts - tc) * math.exp(-speed / ws) + tv * speed)
        u = min(speed, most)
        torque = a[0] + u * (a[1] + u * (a[2] + u * a[3]))
        return self.ratio * (torque + (speed - u) * (a[1] + u * (2.0 * a[2] + 3.0 * u * a[3])))

    def _friction_Nm(self, velocity_radps: float) -> float:
        speed = abs(velocity_radps)
        if speed == 0.0:
            return self.stiffness_Nmprad * self.deflection_rad
        sliding = self._sliding_Nm(velocity_radps)
        settled = math.copysign(sliding / self.stiffness_Nmprad, velocity_radps)
        moved = settled + (self.deflection_rad - settled) * math.exp(
            -speed * self.period_s * self.stiffness_Nmprad / sliding
        )
        rate = (moved - self.deflection_rad) / self.period_s
        self.deflection_rad = moved
        return self.stiffness_Nmprad * moved + self.damping_Nmspr * rate

    def _network_Nm(self, x: np.ndarray) -> float:
        hidden = np.exp(-np.sum((x - self.centres) ** 2, axis=1) * self.inverse_width)
        output = float(self.weights @ hidden)
        if abs(x[0]) >= self.dead_zone_rad:
            self.weights = (1.0 - self.leakage * self.period_s) * self.weights
            self.weights += self.learning_rate * float(x @ self.p_b) * self.period_s * hidden
            if self.weight_limit > 0.0:
                self.weights = np.clip(self.weights, -self.weight_limit, self.weight_limit)
        return output

    def tick(self, position: float, desired: float, desired_velocity: float, desired_acceleration: float) -> float:
        """The limited torque [Nm]."""
        error = position - desired
        if self.last is not None:
            velocity = (position - self.last[0]) / self.period_s
            rate = (error - self.last[1]) / self.period_s
            self.velocity_radps += self.gain * (velocity - self.velocity_radps)
            self.error_rate_radps += self.gain * (rate - self.error_rate_radps)
        self.last = (position, error)
        torque = self.inertia_kgm2 * (desired_acceleration - self.kv * self.error_rate_radps - self.kp * error)
        torque += self.coriolis_Nmspr * self.velocity_radps
        torque += self.gravity_Nm * math.sin(position - self.gravity_zero_rad)
        torque += self._friction_Nm(desired_velocity)
        torque -= self._network_Nm(np.array((error, self.error_rate_radps)))
        if not math.isfinite(torque):
            torque = 0.0
        torque = min(max(torque, -self.torque_max_Nm), self.torque_max_Nm)
        self.sent_Nm = min(max(torque, self.sent_Nm - self.torque_step_Nm), self.sent_Nm + self.torque_step_Nm)
        return self.sent_Nm

    def ticks(self, inputs: np.ndarray, torque_Nm: np.ndarray) -> None:
        """One tick after another: rows [position, desired position, velocity, acceleration]."""
        for i, row in enumerate(inputs.tolist()):
            torque_Nm[i] = self.tick(*row)


# --- the comparison ---

GROUP = "control law"
SAME_NUMBERS = 1e-12  # of the largest torque
GOAL_TO_C = 1.3
GOAL_TO_RIGID = 2.0
CHUNK_TICKS = 20_000
NUMPY_TICKS = 500

Ticks = Callable[[np.ndarray, np.ndarray], None]


@kernel
def run_ticks(constants: np.ndarray, state: np.ndarray, inputs: np.ndarray, torque_Nm: np.ndarray) -> None:
    """`inputs` float64[N, 4]: position, desired position, velocity, acceleration; writes float64[N] torques [Nm]."""
    axis: AxisConstants = constants[0]
    now: AxisState = state[0]
    for i in range(len(torque_Nm)):
        now.reference.position_rad = inputs[i, 1]
        now.reference.velocity_radps = inputs[i, 2]
        now.reference.acceleration_radps2 = inputs[i, 3]
        position_rad = inputs[i, 0]
        step_velocity(axis.velocity, now.velocity, position_rad, position_rad - inputs[i, 1], 1)
        unlimited = step_law(
            axis.law, now.law, position_rad, now.velocity, now.reference, now.command_torque_Nm, NO_REPETITION
        )
        limited, _ = limited_torque_Nm(axis.limits, unlimited, now.command_torque_Nm, axis.law.period_s)
        now.command_torque_Nm = limited
        torque_Nm[i] = limited


@kernel
def run_any_law(
    constants: np.ndarray, state: np.ndarray, table: np.ndarray, inputs: np.ndarray, torque_Nm: np.ndarray
) -> None:
    """As `run_ticks`, for any kind of law, learning included; both encoders show the same position."""
    axis: AxisConstants = constants[0]
    now: AxisState = state[0]
    for i in range(len(torque_Nm)):
        now.reference.position_rad = inputs[i, 1]
        now.reference.velocity_radps = inputs[i, 2]
        now.reference.acceleration_radps2 = inputs[i, 3]
        now.measured_position_rad = now.second_position_rad = inputs[i, 0]
        step_velocity(axis.velocity, now.velocity, inputs[i, 0], inputs[i, 0] - inputs[i, 1], 1)
        where = repetition(axis.trajectory, table, i * axis.law.period_s)
        now.gap_cycles = 1
        unlimited = law_torque_Nm(axis, now, now.reference, where)
        limited, _ = limited_torque_Nm(axis.limits, unlimited, now.command_torque_Nm, axis.law.period_s)
        now.command_torque_Nm = limited
        torque_Nm[i] = limited


@kernel
def run_hidden(constants: np.ndarray, state: np.ndarray, inputs: np.ndarray, torque_Nm: np.ndarray) -> None:
    """The network's output alone, the same arguments: 15 exponentials a tick."""
    axis: AxisConstants = constants[0]
    now: AxisState = state[0]
    for i in range(len(torque_Nm)):
        torque_Nm[i] = network_torque_Nm(axis.law.network, now.law.network, inputs[i, 0] - inputs[i, 1], inputs[i, 2])


def sine_inputs(axis: Any, ticks: int) -> np.ndarray:
    """Desired motion 0.35 sin(0.2 pi t) and a position that follows it with a small error, (ticks, 4)."""
    t = np.arange(ticks) * axis.law.period_s
    w = 0.2 * math.pi
    inputs = np.empty((ticks, 4))
    inputs[:, 1] = 0.35 * np.sin(w * t)
    inputs[:, 2] = 0.35 * w * np.cos(w * t)
    inputs[:, 3] = -0.35 * w**2 * np.sin(w * t)
    inputs[:, 0] = inputs[:, 1] + 1e-3 * np.sin(7.0 * t) * np.cos(0.3 * t)
    return inputs


def kernel_ticks(constants: Any) -> Ticks:
    """Our kernel, from a fresh state."""
    state = new(AxisState)
    reset_law(constants[0].law, state[0].law)
    return lambda inputs, torque_Nm: run_ticks(constants, state, inputs, torque_Nm)


def c_function(library: ctypes.CDLL, name: str, constants: Any) -> Ticks:
    """One function of the C library, from a fresh state."""
    law, state = law_doubles(constants[0]), state_doubles(constants[0])
    if library.law_doubles() != len(law) or library.state_doubles() != STATE_DOUBLES:
        raise NoCompilerError("law_tick.h and c_programs.py disagree about the structures")
    function = getattr(library, name)

    def ticks(inputs: np.ndarray, torque_Nm: np.ndarray) -> None:
        function(law.ctypes.data, state.ctypes.data, inputs.ctypes.data, torque_Nm.ctypes.data, len(torque_Nm))

    return ticks


def difference(one: Ticks, other: Ticks, inputs: np.ndarray) -> float:
    """Largest difference of two laws' torques over the inputs, relative to the largest torque."""
    torque, other_torque = np.zeros(len(inputs)), np.zeros(len(inputs))
    one(inputs, torque)
    other(inputs, other_torque)
    return float(np.max(np.abs(torque - other_torque)) / np.max(np.abs(torque)))


def allocations(constants: Any) -> int:
    """Memory allocations of 20 000 ticks more than of one: those of the call itself cancel out."""
    counts = []
    numba_runtime: Any = runtime  # untyped, and the switch is not exported
    switch, system = numba_runtime.nrt._nrt, numba_runtime.rtsys
    was_counting = switch.memsys_stats_enabled()
    switch.memsys_enable_stats()
    try:
        for ticks in (1, CHUNK_TICKS):
            inputs, torque_Nm = sine_inputs(constants[0], ticks), np.zeros(ticks)
            run = kernel_ticks(constants)
            run(inputs, torque_Nm)
            before = system.get_allocation_stats()
            run(inputs, torque_Nm)
            counts.append(system.get_allocation_stats().alloc - before.alloc)
    finally:
        if not was_counting:
            switch.memsys_disable_stats()
    return int(counts[1] - counts[0])


def _timer(ticks: Ticks, inputs: np.ndarray) -> Callable[[], float]:
    torque_Nm = np.zeros(len(inputs))
    ticks(inputs, torque_Nm)  # compiles, warms

    def measure() -> float:
        begin_ns = time.perf_counter_ns()
        ticks(inputs, torque_Nm)
        return (time.perf_counter_ns() - begin_ns) / len(inputs)

    return measure


def _apart_text(apart: float) -> str:
    return f"torques differ by {apart:.1e}" + ("" if apart <= SAME_NUMBERS else ": MORE THAN ALLOWED")


def _versus_c(constants: Any, folder: Path, pairs: int) -> Iterator[Row]:
    inputs = sine_inputs(constants[0], CHUNK_TICKS)
    ours = _timer(kernel_ticks(constants), inputs)
    for options, goal in ((OPTIMISED, GOAL_TO_C), (FAST_MATH, None)):
        name = f"gcc {' '.join(options)}"
        library = law_library(folder, options)
        apart = difference(kernel_ticks(constants), c_function(library, "run_ticks", constants), inputs)
        values = interleaved(pairs, ours, _timer(c_function(library, "run_ticks", constants), inputs))
        yield compared(GROUP, "tick", values[0], values[1], "ns", name, goal=goal, note=_apart_text(apart))
        state = new(AxisState)
        hidden = _timer(lambda i, t, state=state: run_hidden(constants, state, i, t), inputs)  # type: ignore[misc]
        values = interleaved(pairs, hidden, _timer(c_function(library, "run_hidden", constants), inputs))
        yield compared(GROUP, "of it: the network's 15 exponentials", values[0], values[1], "ns", name)


def flexible_rows(flexible: Any, rigid: Any, *, pairs: int) -> Iterator[Row]:
    """The law of a flexible joint against the one of a rigid joint; `AxisConstants` arrays of one."""
    timers = []
    for constants in (flexible, rigid):
        state = new(AxisState)
        reset_law(constants[0].law, state[0].law)
        inputs = sine_inputs(constants[0], CHUNK_TICKS)
        run = partial(run_any_law, constants, state, np.zeros((0, 5)))
        timers.append(_timer(run, inputs))
    values = interleaved(pairs, *timers)
    name = "that of precise.toml"
    yield compared(GROUP, "tick for a flexible joint", values[0], values[1], "ns", name, goal=GOAL_TO_RIGID)


def law_rows(constants: Any, folder: Path, *, pairs: int) -> Iterator[Row]:
    """`constants` AxisConstants array of one; `folder` takes what is compiled."""
    require_comparable(constants[0])
    try:
        yield from _versus_c(constants, folder, pairs)
    except NoCompilerError as error:
        yield skipped(GROUP, "tick against C", error.message)
    count = float(allocations(constants))
    yield measured(GROUP, f"memory allocations in {CHUNK_TICKS} ticks", [count], "", goal=0.0)
    inputs = sine_inputs(constants[0], NUMPY_TICKS)
    apart = difference(kernel_ticks(constants), NumpyLaw(constants[0]).ticks, inputs)
    values = interleaved(
        max(3, pairs // 3), _timer(kernel_ticks(constants), inputs), _timer(NumpyLaw(constants[0]).ticks, inputs)
    )
    yield compared(GROUP, "tick", values[0], values[1], "ns", "numpy", note=_apart_text(apart))
