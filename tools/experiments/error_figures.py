"""Figures of one run: how large the error was, and how long it took to become small."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from jointctl.firmware_py.states import Fault
from jointctl.tools.simulation.lockstep import LockstepRun

SETTLED_rad = 1e-3
_STILL_OUTSIDE = 0.9  # outside the band in the last tenth of the trajectory: not settled at all


@dataclass(frozen=True)
class ErrorFigures:
    """Errors from `after_s` of the trajectory on [mrad]; a run that was ended by a fault has infinite errors.

    `peak_mrad`, `rmse_mrad`, `lowest_mrad` and `highest_mrad` are of the measured error, encoder steps included, as a
    real joint would report them; `true_*` are of the joint itself, which only a simulation knows.
    """

    fault: str  # "" = none
    peak_mrad: float
    rmse_mrad: float
    lowest_mrad: float
    highest_mrad: float
    true_peak_mrad: float
    true_rmse_mrad: float
    settling_s: float  # until the measured error stays within 1 mrad; inf = it never does
    torque_peak_Nm: float  # of the command, after `after_s`


FAILED = (math.inf, math.inf, -math.inf, math.inf, math.inf, math.inf, math.inf, math.inf)


def settling_s(time_s: np.ndarray, error_rad: np.ndarray, within_rad: float = SETTLED_rad) -> float:
    """Time after which |error| stays within the band; inf if it leaves it in the last tenth; arrays (N,)."""
    outside = np.flatnonzero(np.abs(error_rad) > within_rad)
    if not len(outside):
        return 0.0
    last_s = float(time_s[outside[-1]])
    return math.inf if last_s > _STILL_OUTSIDE * float(time_s[-1]) else last_s


def error_figures(run: LockstepRun, after_s: float) -> ErrorFigures:
    """The figures of a run whose log has every cycle."""
    if run.fault is not Fault.NONE:
        return ErrorFigures(run.fault.name.lower(), *FAILED)
    tracking = run.tracking
    time_s = run.log.trajectory_s[tracking]
    error = run.log.error_rad[tracking]
    late = time_s >= after_s
    measured = error[late] * 1e3
    true = run.true_error_rad[tracking][late] * 1e3
    return ErrorFigures(
        fault="",
        peak_mrad=float(np.max(np.abs(measured))),
        rmse_mrad=float(np.sqrt(np.mean(measured**2))),
        lowest_mrad=float(np.min(measured)),
        highest_mrad=float(np.max(measured)),
        true_peak_mrad=float(np.max(np.abs(true))),
        true_rmse_mrad=float(np.sqrt(np.mean(true**2))),
        settling_s=settling_s(time_s, error),
        torque_peak_Nm=float(np.max(np.abs(run.log.command_torque_Nm[tracking][late]))),
    )
