"""Torque of a joint in any motion: inertia, gravity, and friction with its load and temperature.

At the joint, with the speed v, the torque tau that the reducer transmits, and the temperature T:

    tau = J a + gs sin q + gc cos q                 without a known load, else  J a + (1 + s) load
    motor torque times ratio = tau - r(q) + sign(v) (C fc + V fv) (1 + f(q))
    C = tc + (ts - tc) exp(-|v| / ws) + kc |tau|            fc = exp(-bc (T - T0))
    V = (11) less its Coulomb and Stribeck part + kv |tau| |v|        fv = exp(-bv (T - T0))

r and f are sines of the motor's angle (1, 2 and 4 a turn) and of the joint's (1 and 2): ripple, which goes with the
angle alone, and the share of the friction that goes with the angle and turns round with the motion.  Both pass through
the filter of the torque.  tc, ts, ws and V belong to a direction, the rest to both.  Friction that goes with |tau| and
always opposes the motion is that of the load-dependent models of Rhoban's BAM; beside it, a gear that loses more in one
direction of power than in the other looks like an error s of the known load, as sign(v) |tau| and tau span both.  Not
modelled: hysteresis, backlash, other periods.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from jointctl.firmware_py.friction import DEGREE
from jointctl.tools.identification.models import Form, basis

WS_MAX_radps = 20.0 * DEGREE
SIGNS = {"positive": 1, "negative": -1}
FORM_STEPS = {
    "coulomb": ("coulomb-viscous", "stribeck"),
    "coulomb-viscous": ("stribeck",),
    "stribeck": ("multi-stage-continuous",),
    "multi-stage-continuous": (),
}
ORDERS = {
    "m1": (1.0, True),
    "m2": (2.0, True),
    "m4": (4.0, True),
    "j1": (1.0, False),
    "j2": (2.0, False),
}  # of the motor
TERMS = {
    "inertia": ("inertia",),
    "gravity": ("gravity_sin", "gravity_cos"),
    "load-scale": ("load_scale",),
    "load-coulomb": ("load_coulomb",),
    "load-viscous": ("load_viscous",),
    "temperature-coulomb": ("temperature_coulomb",),
    "temperature-viscous": ("temperature_viscous",),
    **{f"{kind}-{order}": (f"{kind}_sin {order}", f"{kind}_cos {order}")
       for kind in ("ripple", "angle") for order in ORDERS},
}  # fmt: skip
UNITS = {
    "inertia": "kg m2", "gravity_sin": "Nm", "gravity_cos": "Nm", "load_scale": "", "load_coulomb": "Nm/Nm",
    "load_viscous": "s/rad", "ripple_sin": "Nm", "ripple_cos": "Nm", "angle_sin": "", "angle_cos": "",
    "temperature_coulomb": "1/K", "temperature_viscous": "1/K",
    "tc": "Nm", "rise": "Nm", "tv": "Nm s/rad", "ws": "rad/s", "c1": "Nm", "c2": "Nm", "c3": "Nm",
}  # fmt: skip
BOUNDS = {
    "tc": (0.0, np.inf), "tv": (0.0, np.inf), "rise": (0.0, np.inf),
    "load_coulomb": (0.0, 2.0), "load_viscous": (0.0, 2.0),
    "temperature_coulomb": (-0.2, 0.2), "temperature_viscous": (-0.2, 0.2),
    "angle_sin": (-0.9, 0.9), "angle_cos": (-0.9, 0.9),
}  # fmt: skip

EXPERIMENTS = {  # which would tell a parameter that the data leave open
    "inertia": "accelerate more",
    "gravity_sin": "move over a larger angle",
    "gravity_cos": "move over a larger angle",
    "load_scale": "move under two known loads, both ways",
    "load_coulomb": "move both ways under two loads or more",
    "load_viscous": "move at several speeds under two loads or more",
    "temperature_coulomb": "measure slow motion cold and warm",
    "temperature_viscous": "measure fast motion cold and warm",
    "tc": "measure longer, and more speeds",
    "rise": "move more slowly (near standstill, above --speed-min)",
    "ws": "move more slowly (near standstill, above --speed-min)",
    "tv": "move at more speeds, farther apart",
}


@dataclass(frozen=True)
class Samples:
    """What the model is computed from, (N,) each."""

    velocity_radps: np.ndarray
    acceleration_radps2: np.ndarray
    position_rad: np.ndarray
    load_Nm: np.ndarray | None
    warming_K: np.ndarray | None  # above T0
    waves: np.ndarray | None = None  # (N, 2 len(ORDERS)): sine and cosine of each order, filtered

    def part(self, chosen: np.ndarray | slice) -> Samples:
        load, warming, waves = (None if v is None else v[chosen] for v in (self.load_Nm, self.warming_K, self.waves))
        moved = self.velocity_radps[chosen], self.acceleration_radps2[chosen], self.position_rad[chosen]
        return Samples(*moved, load, warming, waves)


@dataclass(frozen=True)
class Model:
    """Which terms there are, and the constants that they need."""

    form: Form
    terms: frozenset[str]
    directions: tuple[str, ...]  # of the data; a missing one is mirrored
    top_radps: float
    knee: float  # of the top speed

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters in the order of the vector; those of a direction as `tc positive`."""
        shared = [name for term, names in TERMS.items() if term in self.terms for name in names]
        own = ["rise" if name == "ts" else name for name in self.form.linear_names]
        own += ["log_ws"] if self.form.stribeck else []
        return (*shared, *(f"{name} {word}" for word in self.directions for name in own))

    def bounds(self, speed_min_radps: float) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limit of each parameter."""
        ws = (np.log(max(speed_min_radps, 1e-4) / 3.0), np.log(max(WS_MAX_radps, speed_min_radps)))
        pairs = [ws if n.startswith("log_ws") else BOUNDS.get(n.split()[0], (-np.inf, np.inf)) for n in self.names]
        return np.array([low for low, _ in pairs]), np.array([high for _, high in pairs])

    def transmitted_Nm(self, value: Mapping[str, float], s: Samples) -> np.ndarray:
        """tau: what the joint needs without friction."""
        tau = value.get("inertia", 0.0) * s.acceleration_radps2
        if s.load_Nm is not None:
            tau = tau + (1.0 + value.get("load_scale", 0.0)) * s.load_Nm
        elif "gravity" in self.terms:
            tau = tau + value["gravity_sin"] * np.sin(s.position_rad) + value["gravity_cos"] * np.cos(s.position_rad)
        return np.asarray(tau)

    def friction_Nm(self, value: Mapping[str, float], s: Samples, tau_Nm: np.ndarray) -> np.ndarray:
        """Opposing the motion: positive for a positive speed."""
        speed = np.abs(s.velocity_radps)
        x = speed / self.top_radps
        coulomb, rest = np.zeros(len(x)), np.zeros(len(x))
        for word, sign in SIGNS.items():
            chosen = sign * s.velocity_radps > 0.0
            beta, ws = self.own(value, word)
            decay = np.exp(-x[chosen] / ws) if self.form.stribeck else 0.0
            coulomb[chosen] = beta[0] + (beta[1] - beta[0]) * decay if self.form.stribeck else beta[0]
            rest[chosen] = basis(self.form, x[chosen], ws, self.knee) @ beta - coulomb[chosen]
        coulomb = coulomb + value.get("load_coulomb", 0.0) * np.abs(tau_Nm)
        rest = rest + value.get("load_viscous", 0.0) * np.abs(tau_Nm) * speed
        if s.warming_K is not None:
            coulomb = coulomb * np.exp(-value.get("temperature_coulomb", 0.0) * s.warming_K)
            rest = rest * np.exp(-value.get("temperature_viscous", 0.0) * s.warming_K)
        return np.asarray(np.sign(s.velocity_radps) * (coulomb + rest) * (1.0 + self.of_angle("angle", value, s)))

    def of_angle(self, kind: str, value: Mapping[str, float], s: Samples) -> np.ndarray | float:
        """Sum of the sines of ripple [Nm] or angle (share of the friction)."""
        if s.waves is None:
            return 0.0
        weights = [value.get(f"{kind}_{wave} {order}", 0.0) for order in ORDERS for wave in ("sin", "cos")]
        return np.asarray(s.waves @ np.array(weights)) if any(weights) else 0.0

    def own(self, value: Mapping[str, float], word: str) -> tuple[np.ndarray, float]:
        """(linear parameters of a direction in the order of its form, ws of the top speed)."""
        word = word if word in self.directions else self.directions[0]
        ws = float(np.exp(value[f"log_ws {word}"])) / self.top_radps if self.form.stribeck else 1.0
        beta = [value[f"{'rise' if name == 'ts' else name} {word}"] for name in self.form.linear_names]
        if self.form.stribeck:
            beta[1] += beta[0]
        return np.array(beta), ws

    def torque_Nm(self, vector: np.ndarray, s: Samples) -> np.ndarray:
        """Motor torque times ratio (N,)."""
        value = dict(zip(self.names, vector, strict=True))
        tau = self.transmitted_Nm(value, s)
        return tau + self.friction_Nm(value, s, tau) - self.of_angle("ripple", value, s)

    def waves(self, value: Mapping[str, float], kind: str, ratio: float) -> list[tuple[float, float, float]]:
        """(amplitude, periods a motor turn, phase [rad]) of each sine of ripple or angle, the largest first."""
        found = []
        for order, (count, of_motor) in ORDERS.items():
            sine, cosine = (value.get(f"{kind}_{wave} {order}", 0.0) for wave in ("sin", "cos"))
            if f"{kind}-{order}" in self.terms:
                periods = count if of_motor else count / ratio
                found.append((float(np.hypot(sine, cosine)), periods, float(np.arctan2(cosine, sine))))
        return sorted(found, reverse=True)


def jacobian(model: Model, vector: np.ndarray, samples: Samples) -> np.ndarray:
    """Slopes (N, p) of the torque against each parameter."""
    step = 1e-6 * np.maximum(np.abs(vector), 1e-2)
    return np.column_stack([
        (model.torque_Nm(vector + d, samples) - model.torque_Nm(vector - d, samples)) / (2.0 * d[k])
        for k, d in enumerate(np.diag(step))
    ])  # fmt: skip


def unit_of(name: str) -> str:
    return UNITS[name.split()[0]]
