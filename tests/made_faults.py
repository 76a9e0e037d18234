"""Faults of the virtual joint as records."""

from __future__ import annotations

from typing import Any

from jointctl.firmware_py.schema import new
from jointctl.hil.faults import FaultConstants, FaultKind


def one_fault(
    kind: FaultKind, at_s: float = 0.0, duration_s: float = 1e6, magnitude: float = 1.0, seed: int = 1
) -> Any:
    """`FaultConstants`, a record array of one."""
    return faults_of((kind, at_s, duration_s, magnitude), seed=seed)


def faults_of(*chosen: tuple[FaultKind, float, float, float], seed: int = 1) -> Any:
    """(kind, start [s], duration [s], magnitude) of each."""
    faults = new(FaultConstants, len(chosen))
    for record, (kind, at_s, duration_s, magnitude) in zip(faults, chosen, strict=True):
        record.kind, record.start_s, record.duration_s, record.magnitude = kind, at_s, duration_s, magnitude
        record.seed = seed
    return faults
