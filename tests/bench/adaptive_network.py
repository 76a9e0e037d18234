"""The paper's network with more than its weights adapted, from run to run, against the fixed one: simulated.

    python tests/bench/adaptive_network.py [--seed 90712] [--plants 20]

Random joints, 0.35 sin(0.2 pi t).  RUNS runs of LEARN_s are learned from, the next one is measured.  The law is the
kernel's own.  With s = x^T P B, P that of the fixed kp, kv and q, all integrals over a run, nothing while |e| is below
DEAD_COUNTS counts of the encoder:

    all        beta' = RATE_GAIN beta s^2 up to (1 + RATE_MOST) beta; c' = CENTRE_RATE w dh/dc s and
               b' = WIDTH_RATE w dh/db s, projected
    pairs      besides, two pairs of narrow neurons at +-c in e and in e', b = c, whose weights +-u are learned,
               u' = BETA (h+ - h-) s, projected into a set over which the margin is known, and the rate with them.  Near
               x = 0 a pair is a gain, SLOPE u, which is how it is given to the kernel
    ends       the pairs at the end of that set from the beginning: what learning them can reach

The margin is that of the linear loop near x = 0: kp + g1 / J, kv + g2 / J and integral rates, 1 ms delay, 0.5 ms lag.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from jointctl.tools.analysis.linear_loop import loop_settings  # noqa: E402
from jointctl.tools.analysis.margins import margins  # noqa: E402
from jointctl.tools.configuration.config import Config  # noqa: E402
from jointctl.tools.configuration.conversions import joint_rad_per_count  # noqa: E402
from jointctl.tools.configuration.load import load_config, shipped_config, shipped_control  # noqa: E402
from jointctl.tools.experiments.controller_study import EnsembleSettings, random_plant  # noqa: E402
from jointctl.tools.experiments.controllers import changed  # noqa: E402
from jointctl.tools.lockstep import LockstepJoint  # noqa: E402

RUN_s, FROM_s, RUNS, LEARN_s = 40.0, 20.0, 6, 20.0
DEAD_COUNTS = 2.0
RATE_GAIN, RATE_MOST = 50.0, 1.0
CENTRE_RATE, WIDTH_RATE = 1e4, 1e4
CENTRE_MOST, WIDTHS = 0.1, (0.02, 5.0)
NARROW = 0.03  # centre and width of a pair, rad and rad/s
KP_ps2, KV_ps = 2500.0, 130.0  # at the end of the set: kp + g1 / J, kv + g2 / J
BETA = np.array([4e9, 2e5])
SLOPE = 2.0 * math.exp(-0.5) / NARROW  # of a pair at x = 0
# what a case changes in [control], and how it adapts
Case = tuple[dict[str, Any], str]


def learned_pairs(x: np.ndarray, s: np.ndarray, u: np.ndarray, most: np.ndarray, step_s: float) -> np.ndarray:
    """u after a run with inputs `x` (N, 2), where `s` is zero in the dead zone."""

    def hidden(centre: np.ndarray) -> np.ndarray:
        return np.exp(-0.5 * np.sum((x - centre) ** 2, axis=1) / NARROW**2)

    pair = np.stack([hidden(side) - hidden(-side) for side in NARROW * np.eye(2)])
    u = u + BETA * (pair @ s) * step_s
    damping = min(max(float(u[1]), 0.0), float(most[1]))
    stiffness = min(max(float(u[0]), 0.0), float(most[0]) * damping / float(most[1]))  # none without its damping
    return np.array([stiffness, damping])


def adapt_all(network: Any, x: np.ndarray, s: np.ndarray, weights: np.ndarray, step_s: float, beta: float) -> None:
    """Rate, centres and widths after a run; `weights` (N, neurons)."""
    width = 1.0 / np.sqrt(2.0 * network.inverse_width)
    way = x[:, None, :] - network.centres
    size = np.sum(way**2, axis=2)
    common = step_s * s[:, None] * weights * np.exp(-0.5 * size / width**2)
    rate = network.learning_rate + step_s * RATE_GAIN * beta * float(s @ s)
    network.learning_rate = min(rate, (1.0 + RATE_MOST) * beta)
    moved = CENTRE_RATE * np.einsum("ni,nik->ik", common, way) / (width**2)[:, None]
    network.centres[:] = np.clip(network.centres + moved, -CENTRE_MOST, CENTRE_MOST)
    new = np.clip(width + WIDTH_RATE * np.sum(common * size, axis=0) / width**3, *WIDTHS)
    network.inverse_width[:] = 0.5 / new**2


def margin_deg(config: Config, g: tuple[float, float], rate: float) -> float:
    """Phase margin with `g` [Nm/rad, Nm s/rad] on top and the rate times `rate`."""
    settings = loop_settings(config)[0]
    kp, kv = settings.kp, settings.kv
    p12, p22 = settings.q[0] / (2.0 * kp) * rate, (settings.q[1] + settings.q[0] / kp) / (2.0 * kv) * rate
    kp, kv = kp + g[0] / settings.inertia_kgm2, kv + g[1] / settings.inertia_kgm2
    q = (2.0 * kp * p12, 2.0 * kv * p22 - 2.0 * p12)
    return margins(replace(settings, kp=kp, kv=kv, q=q, delay_s=1e-3, lag_s=5e-4)).phase_margin_deg


def least_margin_deg(config: Config) -> float:
    """Over the whole set into which the pairs are projected: whatever they learn, the loop has that much."""
    inertia, control = config.joint.inertia_kgm2, config.control
    most = inertia * (KP_ps2 - control.kp), inertia * (KV_ps - control.kv)
    shares = np.linspace(0.0, 1.0, 6)
    return min(
        margin_deg(config, (float(most[0] * stiffness * damping), float(most[1] * damping)), 1.0 + RATE_MOST * damping)
        for damping in shares
        for stiffness in shares
    )


def run(config: Config, kind: str) -> tuple[float, float]:
    """(RMSE as the encoder shows it [mrad], nan where a fault ended it; phase margin in the end [deg])."""
    control, inertia = config.control, config.joint.inertia_kgm2
    most = inertia * np.array([KP_ps2 - control.kp, KV_ps - control.kv]) / SLOPE
    u = most.copy() if kind == "ends" else np.zeros(2)
    joint = LockstepJoint(config)
    network = joint.constants()[0].law.network.copy()
    beta, p_b = float(network.learning_rate), np.array(network.p_b)
    dead_rad = DEAD_COUNTS * abs(joint_rad_per_count(config))
    rmse, step_s, weight = math.nan, 1.0 / config.loop.rate_Hz, np.zeros(2)
    for number in range(RUNS + 1 if kind in ("all", "pairs") else 1):
        last = number == RUNS or kind not in ("all", "pairs")
        constants = joint.constants()
        law = constants[0].law
        constants[0].trajectory.duration_s = RUN_s if last else LEARN_s
        law.kp, law.kv = control.kp + SLOPE * u[0] / inertia, control.kv + SLOPE * u[1] / inertia
        if kind == "all":
            law.network.centres[:], law.network.inverse_width[:] = network.centres, network.inverse_width
            law.network.learning_rate = network.learning_rate
        elif kind in ("pairs", "ends"):
            law.network.learning_rate = beta * (1.0 + RATE_MOST * u[1] / most[1])
        done = joint.run(constants)
        if done.fault:
            return math.nan, math.nan
        records = done.log[done.tracking]
        rate = float(law.network.learning_rate) / beta
        x = np.stack((records.error_rad, records.error_rate_radps), axis=1)
        s = np.where(np.abs(records.error_rad) > dead_rad, x @ p_b, 0.0)
        if last:
            rmse = 1e3 * float(np.sqrt(np.mean(records.error_rad[records.trajectory_s >= FROM_s] ** 2)))
        elif kind == "pairs":
            u = learned_pairs(x, s, u, most, step_s)
        else:
            adapt_all(network, x, s, np.asarray(records.weights), step_s, beta)
        weight = records.weights[-1]
    if kind == "all":
        near = np.exp(-np.sum(network.centres**2, axis=1) * network.inverse_width) * weight
        g = (near * 2.0 * network.inverse_width) @ network.centres
    else:
        g = u * SLOPE
    return rmse, margin_deg(config, (float(g[0]), float(g[1])), rate)


CASES: dict[str, Case] = {
    "paper_lugre, fixed": ({}, "fixed"),
    "the same, rate, centres and widths adapt": ({}, "all"),
    "q = [2.99e5, 927], filtered rate, fixed": ({"lyapunov_q": (2.99e5, 927.0), "filtered_error_rate": True}, "fixed"),
    "the same with pairs that are learned": ({"lyapunov_q": (2.99e5, 927.0), "filtered_error_rate": True}, "pairs"),
    "the same with pairs at their ends": ({"lyapunov_q": (2.99e5, 927.0), "filtered_error_rate": True}, "ends"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=90712)
    parser.add_argument("--plants", type=int, default=20)
    given = parser.parse_args()
    base = load_config(shipped_config("precise"))
    first = np.empty(0)
    for name, (changes, kind) in CASES.items():
        control = changed(
            shipped_control("paper"), {"feed_forward": "lugre_desired", "zero_rule": "zero", **changes}, name
        )
        found = []
        for index in range(given.plants):
            plant = random_plant(base, EnsembleSettings(), given.seed, index)
            found.append(run(plant.model_copy(update={"control": control}), kind))
        rmse, margin = np.array(found).T
        first = rmse if not len(first) else first
        if kind == "pairs":
            least = least_margin_deg(base.model_copy(update={"control": control}))
            print(f"margin anywhere in the set of the pairs: {least:.1f} deg at least")
        better = float(np.nanmedian(first / rmse))
        print(
            f"{name}: RMSE {np.nanmedian(rmse):.4f} / {np.nanmax(rmse):.4f} mrad, {int(np.isnan(rmse).sum())} ended, "
            f"better by {better:.2f} (median), margin {np.min(margin):.1f} deg at least",
            flush=True,
        )


if __name__ == "__main__":
    main()
