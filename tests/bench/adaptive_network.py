"""The paper's network with more than its weights adapted, against the fixed one: random joints, simulated.

    python tests/bench/adaptive_network.py [--seed 90712] [--plants 20]

The law is the kernel's own; rate, centres and widths of its constants, and weights of its state, are changed every
STEP cycles between two cycles.  With s = x^T P B, P that of the fixed kp, kv and q:

    all        beta' = RATE_GAIN s^2 up to RATE_MOST; c' = CENTRE_RATE w dh/dc s, b' = WIDTH_RATE w dh/db s, projected
    pairs      11 wide neurons as they are; two pairs of narrow ones at +-c in e and in e', whose weights +-u are
               learned, u' = BETA (h+ - h-) s, with c and b, all projected into a set over which the margin is known
    pairs, fixed    the pairs at the end of that set from the beginning: what learning them can reach

Nothing is learned while |e| is below DEAD_COUNTS counts of the encoder.  The margin of a network is that of the linear
loop near x = 0: kp + g1 / J, kv + g2 / J and integral rates, 1 ms delay, 0.5 ms lag.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from jointctl.firmware_py.states import AxisPhase  # noqa: E402
from jointctl.tools.analysis.loop_settings import loop_settings  # noqa: E402
from jointctl.tools.analysis.margins import margins  # noqa: E402
from jointctl.tools.configuration.config import Config  # noqa: E402
from jointctl.tools.configuration.conversions import joint_rad_per_count  # noqa: E402
from jointctl.tools.configuration.load import load_config, shipped_config  # noqa: E402
from jointctl.tools.experiments.controller_study import EnsembleSettings, random_plant  # noqa: E402
from jointctl.tools.experiments.controllers import changed, paper_control  # noqa: E402
from jointctl.tools.lockstep import LockstepJoint  # noqa: E402

RUN_s, FROM_s, STEP = 40.0, 20.0, 5
DEAD_COUNTS = 2.0
RATE_GAIN, RATE_MOST = 50.0, 1.0  # of beta, relative to the configured one: RATE_MOST times more at most
CENTRE_RATE, WIDTH_RATE = 1e4, 1e4
CENTRE_MOST, WIDTHS = 0.1, (0.02, 5.0)
NARROW = 0.03  # centre and width of a pair, rad and rad/s
PAIRS = ((0, 1), (2, 3))  # neurons of the pair in e, and in e'
KP_ps2, KV_ps = 2500.0, 130.0  # at the end of the set: kp + g1 / J, kv + g2 / J
BETA = (4e9, 2e5)
SLOPE = 2.0 * math.exp(-0.5) / NARROW  # of a pair at x = 0, for c = b


@dataclass
class Adapting:
    """What is changed between the cycles; `kind` as in the module."""

    kind: str
    constants: Any
    state: Any
    count_rad: float
    u: np.ndarray
    most: np.ndarray  # of u
    beta: float

    def step(self, error_rad: float, rate_radps: float, step_s: float) -> None:
        network, weights = self.constants.law.network, self.state.law.network.weights
        x = np.array([error_rad, rate_radps])
        s = float(network.p_b @ x)
        learns = abs(error_rad) > DEAD_COUNTS * self.count_rad
        way, width = x - network.centres, 1.0 / np.sqrt(2.0 * network.inverse_width)
        hidden = np.exp(-np.sum(way**2, axis=1) / (2.0 * width**2))
        if self.kind == "all":
            if learns:
                common = step_s * s * weights * hidden
                most = (1.0 + RATE_MOST) * self.beta
                network.learning_rate = min(network.learning_rate + step_s * RATE_GAIN * self.beta * s * s, most)
                network.centres[:] = np.clip(
                    network.centres + CENTRE_RATE * (common / width**2)[:, None] * way, -CENTRE_MOST, CENTRE_MOST
                )
                new = np.clip(width + WIDTH_RATE * common * np.sum(way**2, axis=1) / width**3, *WIDTHS)
                network.inverse_width[:] = 0.5 / new**2
            return
        if learns and self.kind == "pairs":
            pair = np.array([hidden[one] - hidden[other] for one, other in PAIRS])
            u = self.u + step_s * np.array(BETA) * pair * s
            u[1] = min(max(u[1], 0.0), self.most[1])
            u[0] = min(max(u[0], 0.0), self.most[0] * u[1] / self.most[1])  # no stiffness without its damping
            self.u = u
            network.learning_rate = max(network.learning_rate, self.beta * (1.0 + RATE_MOST * u[1] / self.most[1]))
        for k, (one, other) in enumerate(PAIRS):
            weights[one], weights[other] = self.u[k], -self.u[k]


def margin_deg(config: Config, g: tuple[float, float], rate: float) -> float:
    """Phase margin with `g` [Nm/rad, Nm s/rad] on top and the rate times `rate`."""
    settings = loop_settings(config)[0]
    kp, kv = settings.kp, settings.kv
    p12, p22 = settings.q[0] / (2.0 * kp) * rate, (settings.q[1] + settings.q[0] / kp) / (2.0 * kv) * rate
    kp, kv = kp + g[0] / settings.inertia_kgm2, kv + g[1] / settings.inertia_kgm2
    q = (2.0 * kp * p12, 2.0 * kv * p22 - 2.0 * p12)
    return margins(replace(settings, kp=kp, kv=kv, q=q, delay_s=1e-3, lag_s=5e-4)).phase_margin_deg


def run(config: Config, kind: str) -> tuple[float, float]:
    """(RMSE as the encoder shows it [mrad], phase margin at the end [deg])."""
    trajectory = config.trajectory.model_copy(update={"duration_s": RUN_s})
    config = config.model_copy(update={"trajectory": trajectory})
    joint = LockstepJoint(config)
    stepped = joint.stepped(joint.constants(), joint.table)
    constants, state = stepped.memory.constants[0], stepped.memory.state[0]
    inertia = config.joint.inertia_kgm2
    g = np.array([inertia * (KP_ps2 - config.control.kp), inertia * (KV_ps - config.control.kv)])
    most = g / SLOPE
    adapting = Adapting(
        kind, constants, state, abs(joint_rad_per_count(config)), np.zeros(2), most,
        float(constants.law.network.learning_rate),
    )  # fmt: skip
    if kind.startswith("pairs"):
        adapting.beta *= 15.0 / 11.0  # of the wide neurons that are left
        constants.law.network.learning_rate = adapting.beta
        for axis, (one, other) in enumerate(PAIRS):
            constants.law.network.centres[[one, other]] = 0.0
            constants.law.network.centres[one, axis], constants.law.network.centres[other, axis] = NARROW, -NARROW
            constants.law.network.inverse_width[[one, other]] = 0.5 / NARROW**2
        if kind == "pairs, fixed":
            adapting.u = most.copy()
            constants.law.network.learning_rate = adapting.beta * (1.0 + RATE_MOST)
    step_s = STEP / config.loop.rate_Hz
    for _ in range(round((RUN_s + 15.0) / step_s)):
        stepped.step(STEP)
        newest = stepped.newest()
        if newest["phase"] == AxisPhase.TRACKING and kind != "fixed":
            rate = float(newest["velocity_radps"] - newest["desired_velocity_radps"])
            adapting.step(float(newest["error_rad"]), rate, step_s)
        if newest["phase"] > AxisPhase.TRACKING:
            break
    records = stepped.records()
    rows = (records.phase == AxisPhase.TRACKING) & (records.trajectory_s >= FROM_s)
    late = float(records.trajectory_s[records.phase == AxisPhase.TRACKING][-1])
    rmse = 1e3 * float(np.sqrt(np.mean(records.error_rad[rows] ** 2))) if late > RUN_s - 1.0 else math.nan
    network = constants.law.network
    if kind.startswith("pairs"):
        found = tuple(float(value) for value in adapting.u * SLOPE)
    else:
        x0 = np.exp(-np.sum(network.centres**2, axis=1) * network.inverse_width) * state.law.network.weights
        found = tuple(float(value) for value in (x0 * 2.0 * network.inverse_width) @ network.centres)
    return rmse, margin_deg(config, (found[0], found[1]), float(network.learning_rate) / adapting.beta)


CASES: dict[str, tuple[dict[str, Any], str]] = {
    "paper_lugre, fixed": ({}, "fixed"),
    "the same, rate, centres and widths adapt": ({}, "all"),
    "q = [2.99e5, 927], filtered rate, fixed": ({"lyapunov_q": (2.99e5, 927.0), "filtered_error_rate": True}, "fixed"),
    "the same with pairs that are learned": ({"lyapunov_q": (2.99e5, 927.0), "filtered_error_rate": True}, "pairs"),
    "the same with pairs at their ends": ({"lyapunov_q": (2.99e5, 927.0), "filtered_error_rate": True}, "pairs, fixed"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=90712)
    parser.add_argument("--plants", type=int, default=20)
    given = parser.parse_args()
    base = load_config(shipped_config("precise"))
    first = np.empty(0)
    for name, (changes, kind) in CASES.items():
        control = changed(paper_control(), {"feed_forward": "lugre_desired", "zero_rule": "zero", **changes}, name)
        found = []
        for index in range(given.plants):
            plant = random_plant(base, EnsembleSettings(), given.seed, index)
            found.append(run(plant.model_copy(update={"control": control}), kind))
        rmse, margin = np.array(found).T
        first = rmse if not len(first) else first
        better = float(np.nanmedian(first / rmse))
        print(
            f"{name}: RMSE {np.nanmedian(rmse):.4f} / {np.nanmax(rmse):.4f} mrad, {int(np.isnan(rmse).sum())} ended, "
            f"better by {better:.2f} (median), margin {np.min(margin):.1f} deg at least",
            flush=True,
        )


if __name__ == "__main__":
    main()
