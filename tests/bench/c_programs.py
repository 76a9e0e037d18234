"""The C sources for comparison, compiled for this very computer, and the constants as the flat arrays that they take.

Without a compiler the comparisons with C are skipped.  The order of the arrays is that of the structures in
c/law_tick.h and c/arm_model.h, float64 throughout.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.errors import ConfigurationError, JointctlError
from jointctl.firmware_py.records import NEURONS
from jointctl.firmware_py.states import ControllerKind, FeedForward

# --- the programs ---

SOURCES = Path(__file__).resolve().parent / "c"
OPTIMISED = ("-O3", "-march=native")
FAST_MATH = (*OPTIMISED, "-ffast-math")


class NoCompilerError(JointctlError):
    """There is nothing to compile with."""


def compiler() -> str:
    """Path of the C compiler; `NoCompilerError` in one line."""

    for name in ("gcc", "cc"):
        found = shutil.which(name)
        if found:
            return found
    raise NoCompilerError("no C compiler on this computer")


def _compile(source: str | Path, target: Path, options: tuple[str, ...]) -> None:
    command = [compiler(), *options, str(SOURCES / source), "-o", str(target), "-lm"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        first = (result.stderr.strip().splitlines() or ["no message"])[0]
        raise NoCompilerError(f"{Path(source).name} does not compile: {first}")


def law_library(folder: Path, options: tuple[str, ...]) -> ctypes.CDLL:
    """law_tick.c as a library with the given optimisation."""
    target = folder / f"law{'-'.join(options).replace('=', '-')}.so"
    compiled = target.with_suffix(".o")
    _compile("law_tick.c", compiled, (*options, "-fPIC", "-c"))
    # linked without -ffast-math: a library that is linked with it makes the whole process flush denormals to zero
    _compile(compiled, target, ("-shared",))
    library = ctypes.CDLL(str(target))
    for name in ("run_ticks", "run_hidden", "arm_torques"):
        getattr(library, name).argtypes = [ctypes.c_void_p] * (3 if name == "arm_torques" else 4) + [ctypes.c_long]
        getattr(library, name).restype = None
    for name in ("law_doubles", "state_doubles", "link_doubles"):
        getattr(library, name).restype = ctypes.c_long
    return library


def exchange_program(folder: Path) -> Path:
    """exchange_loop.c as a program."""
    target = folder / "exchange_loop"
    _compile("exchange_loop.c", target, OPTIMISED)
    return target


# --- their memory ---

STATE_DOUBLES = 12 + 2 * NEURONS
FIRST_WEIGHT = 12  # struct law_state: twelve scalars, then weights, then hidden


def require_comparable(axis: Any) -> None:
    """The C source knows one law: computed torque with network, LuGre on the desired velocity, matched filter."""
    wanted = (ControllerKind.COMPUTED_TORQUE_RBF, FeedForward.LUGRE_DESIRED, 1, 0.0)
    law = axis.law
    if (law.kind, law.feed_forward, law.filtered_error_rate, law.learning.gain) != wanted:
        raise ConfigurationError(
            "bench needs control.kind = computed_torque_rbf, feed_forward = lugre_desired, filtered_error_rate = true "
            "and no learning: the C source knows no other law"
        )


def _branch(branch: Any) -> list[float]:
    return [
        branch.coulomb_Nm, branch.static_Nm, branch.stribeck_speed_radps, branch.viscous_Nmspr,
        *branch.cubic, branch.knee_radps, branch.max_radps,
    ]  # fmt: skip


def law_doubles(axis: Any) -> np.ndarray:
    """`struct law` of an `AxisConstants` record."""
    require_comparable(axis)
    law, network, limits = axis.law, axis.law.network, axis.limits
    values = [
        law.period_s, law.inertia_kgm2, law.coriolis_Nmspr, law.gravity_Nm, law.gravity_zero_rad, law.kp, law.kv,
        law.reduction_ratio, law.lugre.stiffness_Nmprad, law.lugre.damping_Nmspr,
        axis.velocity.period_gain, network.learning_rate, network.leakage, network.weight_limit, network.dead_zone_rad,
        limits.torque_max_Nm, limits.torque_rate_max_Nmps, *network.p_b,
        *_branch(law.friction.positive), *_branch(law.friction.negative),
        *np.ravel(network.centres), *network.inverse_width,
    ]  # fmt: skip
    return np.array(values, float)


def state_doubles(axis: Any) -> np.ndarray:
    """`struct law_state` before the first tick."""
    state = np.zeros(STATE_DOUBLES)
    state[FIRST_WEIGHT : FIRST_WEIGHT + NEURONS] = axis.law.network.initial_weight
    return state


def setting_doubles(axis: Any, port: Any) -> np.ndarray:
    """`struct setting` of exchange_loop.c: identifiers and layout of a `CanopenPort` record, then the law."""
    names = (
        "sync_id", "tpdo_id", "rpdo_id", "own_heartbeat_id", "heartbeat_cycles", "status_at", "position_at",
        "control_at", "target_at", "rpdo_length", "position_radpcount", "torque_Nmppermille", "max_permille",
    )  # fmt: skip
    return np.concatenate([[float(port[name]) for name in names], law_doubles(axis)])


LINK_FIELDS = (
    "parent", "kind", "rotation", "offset_m", "mass_kg", "moment_kgm", "inertia_kgm2", "motor_inertia_kgm2",
)  # fmt: skip


def link_doubles(links: Any) -> np.ndarray:
    """`struct link` of each `ArmLink` record, one after the other."""
    return np.array([np.concatenate([np.ravel(link[name]) for name in LINK_FIELDS]) for link in links], float)
