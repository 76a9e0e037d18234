"""Motions of a joint whose inertia, gravity, friction, load friction and temperature factors are known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from jointctl.tools.identification.motion_data import MotionSettings
from jointctl.tools.identification.motion_table import read_motion
from jointctl.tools.identification.tables import ForeignFormat

RATIO = 100.0
FORMAT = ForeignFormat(
    time_column="t", position_column="q", position_unit="rad", torque_column="tau", torque_side="joint", side="joint",
    ratio=RATIO,
)  # fmt: skip


@dataclass(frozen=True)
class TrueJoint:
    """At the joint."""

    inertia_kgm2: float = 2.0
    gravity_Nm: float = 12.0
    gravity_zero_rad: float = 0.4
    coulomb_Nm: tuple[float, float] = (6.0, 5.0)  # positive, negative direction
    rise_Nm: float = 3.0
    stribeck_radps: float = 0.1
    viscous_Nmspr: float = 4.0
    load_coulomb: float = 0.0
    load_viscous_spr: float = 0.0
    coulomb_perK: float = 0.0
    viscous_perK: float = 0.0

    def torque_Nm(self, q, v, a, load=None, warming_K=0.0):
        """Motor torque times ratio."""
        gravity = self.gravity_Nm * np.sin(q - self.gravity_zero_rad) if load is None else load
        tau = self.inertia_kgm2 * a + gravity
        coulomb = np.where(v > 0.0, *self.coulomb_Nm) + self.rise_Nm * np.exp(-np.abs(v) / self.stribeck_radps)
        coulomb = (coulomb + self.load_coulomb * np.abs(tau)) * np.exp(-self.coulomb_perK * warming_K)
        viscous = (self.viscous_Nmspr + self.load_viscous_spr * np.abs(tau)) * np.abs(v)
        return tau + np.sign(v) * (coulomb + viscous * np.exp(-self.viscous_perK * warming_K))


def motion_columns(joint=None, seconds=60.0, rate_Hz=200.0, noise_Nm=0.3, seed=0, warming_K=0.0, load_Nm=None):
    """Columns t, q, v, tau, warmth, load: three incommensurable sines, and coloured noise."""
    joint = joint or TrueJoint()
    t = np.arange(int(seconds * rate_Hz)) / rate_Hz
    parts = [(0.9, 0.11, 0.3), (0.25, 0.37, 1.0), (0.08, 0.83, 2.0)]
    q, v, a = np.zeros_like(t), np.zeros_like(t), np.zeros_like(t)
    for amplitude, frequency, phase in parts:
        w = 2.0 * np.pi * frequency
        q += amplitude * np.sin(w * t + phase)
        v += amplitude * w * np.cos(w * t + phase)
        a -= amplitude * w * w * np.sin(w * t + phase)
    temperature = 25.0 + warming_K * t / t[-1]
    load = None if load_Nm is None else load_Nm * np.sin(0.7 * q)
    noise = np.random.default_rng(seed).standard_normal(len(t))
    coloured = lfilter([np.sqrt(1.0 - 0.95**2)], [1.0, -0.95], noise)
    tau = joint.torque_Nm(q, v, a, load, temperature - 25.0 - 0.5 * warming_K) + noise_Nm * coloured
    columns = {"t": t, "q": q, "v": v, "tau": tau, "warmth": temperature}
    return columns if load is None else {**columns, "load": load}


def write_table(path, columns):
    rows = np.column_stack(list(columns.values()))
    lines = [",".join(columns), *(",".join(f"{value:.9g}" for value in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def read(path, columns, settings=None, **change):
    return read_motion(write_table(path, columns), replace(FORMAT, **change), settings or MotionSettings())
