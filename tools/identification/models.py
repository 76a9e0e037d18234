"""What can be identified: the friction of a sweep by several models, and the torque of any motion.

The friction models are linear regressions once Stribeck speed and knee are given.  Per direction, mirrored, with
x = u / top in (0..1] (top = highest speed measured) so that all columns are of order 1:

    multi-stage              x <= knee: tc (1 - e) + ts e + tv x,  e = exp(-x / ws);  beyond: c0 P0 + .. + c3 P3   (11)
    multi-stage-continuous   the same with c0 such that both stages meet at the knee (C0)
    stribeck                 the first stage over the whole range
    coulomb-viscous          tc + tv x
    coulomb                  tc

P0..P3 are Legendre polynomials on [knee..1].  In plain powers of the speed the columns of the cubic are nearly
parallel and a particle swarm does not find the minimum; in Legendre polynomials it does.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from jointctl.firmware_py.friction import DEGREE, PrintedBranch, branch_constants, branch_torque_Nm

MIN_PER_STAGE = 5  # points; a stage has four parameters


@dataclass(frozen=True)
class Form:
    """What a model consists of."""

    name: str
    viscous: bool
    stribeck: bool
    cubic: bool
    continuous: bool = False

    @property
    def linear_names(self) -> tuple[str, ...]:
        """The linear parameters, in the order of the columns of `basis`."""
        low = ("tc", *(("ts",) if self.stribeck else ()), *(("tv",) if self.viscous else ()))
        high = ("c1", "c2", "c3") if self.continuous else ("c0", "c1", "c2", "c3")
        return low + (high if self.cubic else ())

    @property
    def parameters(self) -> int:
        """Number of parameters of one direction, a given knee not counted."""
        return len(self.linear_names) + int(self.stribeck)


FORMS = {
    form.name: form
    for form in (
        Form("multi-stage", viscous=True, stribeck=True, cubic=True),
        Form("multi-stage-continuous", viscous=True, stribeck=True, cubic=True, continuous=True),
        Form("stribeck", viscous=True, stribeck=True, cubic=False),
        Form("coulomb-viscous", viscous=True, stribeck=False, cubic=False),
        Form("coulomb", viscous=False, stribeck=False, cubic=False),
    )
}


def legendre(x: np.ndarray, knee: float) -> np.ndarray:
    """P0..P3 on [knee..1] at x, shape (N, 4); also defined outside of the interval."""
    z = (2.0 * x - knee - 1.0) / (1.0 - knee)
    return np.column_stack([np.ones_like(z), z, 1.5 * z**2 - 0.5, 2.5 * z**3 - 1.5 * z])


def legendre_to_powers(knee: float) -> np.ndarray:
    """Matrix (4, 4) that turns Legendre coefficients on [knee..1] into a0..a3 of powers of x."""
    s = 2.0 / (1.0 - knee)
    t = -(1.0 + knee) / (1.0 - knee)  # z = t + s x
    z1 = np.array([t, s, 0.0, 0.0])
    z2 = np.array([t * t, 2.0 * t * s, s * s, 0.0])
    z3 = np.array([t**3, 3.0 * t * t * s, 3.0 * t * s * s, s**3])
    one = np.array([1.0, 0.0, 0.0, 0.0])
    return np.column_stack([one, z1, 1.5 * z2 - 0.5 * one, 2.5 * z3 - 1.5 * z1])


class Regression:
    """Columns (N, p) of the regression at places x (N,), in the order of `form.linear_names`.

    Of them ws changes two at most: the others are computed once.  ws and knee are in units of x.
    """

    def __init__(self, form: Form, x: np.ndarray, knee: float) -> None:
        self._stribeck = form.stribeck
        beyond = x > knee if form.cubic else np.zeros(len(x), bool)
        self._low = np.ones(len(x)) if form.continuous else np.where(beyond, 0.0, 1.0)  # has the terms of low speed
        self._at = np.where(beyond, knee, x) if form.continuous else x
        columns = [self._low] * (2 if form.stribeck else 1)
        if form.viscous:
            columns.append(self._low * self._at)
        if form.cubic:
            polynomials = legendre(x, knee)
            if form.continuous:
                polynomials = polynomials[:, 1:] - legendre(np.array([knee]), knee)[:, 1:]
            columns.append(np.where(beyond[:, None], polynomials, 0.0))
        self._columns = np.column_stack(columns)

    def columns(self, ws: float) -> np.ndarray:
        found = self._columns.copy()
        if self._stribeck:
            found[:, 1] = self._low * np.exp(-self._at / ws)
            found[:, 0] -= found[:, 1]
        return found


def basis(form: Form, x: np.ndarray, ws: float, knee: float) -> np.ndarray:
    """The columns of one regression."""
    return Regression(form, x, knee).columns(ws)


@dataclass(frozen=True)
class Branch:
    """One identified direction in physical units, mirrored: joint rad/s, motor Nm.

    Every model is brought into the shape of (11), so that the controller needs one expression: without a cubic
    stage the knee is the highest speed, and beyond it the last slope is held.
    """

    coulomb_Nm: float
    static_Nm: float
    stribeck_radps: float
    viscous_Nmspr: float
    cubic: tuple[float, float, float, float]  # a0..a3 [Nm s^k / rad^k]
    knee_radps: float
    max_radps: float

    def record(self) -> Any:
        """The `FrictionBranch` record."""
        printed = PrintedBranch(
            self.coulomb_Nm, self.static_Nm, self.stribeck_radps, self.viscous_Nmspr, self.cubic, self.knee_radps,
            self.max_radps,
        )  # fmt: skip
        return branch_constants(printed, negative=False, radps_per_unit=1.0)

    def torque_Nm(self, speed_radps: np.ndarray) -> np.ndarray:
        """Friction at the motor [Nm] at speeds >= 0, by the controller's own expression."""
        record = self.record()
        return np.array([branch_torque_Nm(record, float(u)) for u in speed_radps])


def branch(form: Form, beta: np.ndarray, ws: float, knee: float, top_radps: float) -> Branch:
    """Physical parameters from the normalised ones."""
    value = dict(zip(form.linear_names, beta, strict=True))
    tc = value["tc"]
    ts = value.get("ts", tc)
    tv = value.get("tv", 0.0)
    if form.cubic:
        coefficients = np.array([value.get("c0", 0.0), value["c1"], value["c2"], value["c3"]])
        if form.continuous:
            meeting = float((basis(form, np.array([knee]), ws, knee) @ beta)[0])
            coefficients[0] = meeting - float(legendre(np.array([knee]), knee)[0, 1:] @ coefficients[1:])
        powers = legendre_to_powers(knee) @ coefficients
    else:
        knee = 1.0
        decay = np.exp(-1.0 / ws) if form.stribeck else 0.0
        slope = tv - (ts - tc) / ws * decay
        powers = np.array([tc + (ts - tc) * decay + tv - slope, slope, 0.0, 0.0])
    a = tuple(float(c) / top_radps**k for k, c in enumerate(powers))
    # without a Stribeck term its speed has no effect, but the configuration wants a positive one
    return Branch(
        float(tc), float(ts), float(ws) * top_radps, float(tv) / top_radps, (a[0], a[1], a[2], a[3]),
        knee * top_radps, top_radps,
    )  # fmt: skip


# --- Torque of a joint in any motion: inertia, gravity, and friction with its load and temperature ---
#
# At the joint, with the speed v, the torque tau that the reducer transmits, and the temperature T:
#
#     tau = J a + gs sin q + gc cos q                 without a known load, else  J a + (1 + s) load
#     motor torque times ratio = tau - r(q) + sign(v) (C fc + V fv) (1 + f(q))
#     C = tc + (ts - tc) exp(-|v| / ws) + kc |tau|            fc = exp(-bc (T - T0))
#     V = (11) less its Coulomb and Stribeck part + kv |tau| |v|        fv = exp(-bv (T - T0))
#
# tc, ts, ws and V belong to a direction, the rest to both.  r and f are sines of the motor's angle (1, 2 and 4 a turn)
# and of the joint's (1 and 2): ripple, which goes with the angle alone, and the share of the friction that goes with
# the angle and turns round with the motion.  Both pass through the filter of the torque.
# Friction that goes with |tau| and always opposes the motion
# is that of the load-dependent models of Rhoban's BAM; beside it, a gear that loses more in one direction of power than
# in the other looks like an error s of the known load, as sign(v) |tau| and tau span both.  Not modelled: hysteresis,
# backlash, other periods.

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


@dataclass(frozen=True, eq=False)
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

    @functools.cached_property
    def gravity(self) -> tuple[np.ndarray, np.ndarray]:
        """Sine and cosine of the position."""
        return np.sin(self.position_rad), np.cos(self.position_rad)


@functools.lru_cache(maxsize=2)  # a fit and what it is compared with ask for the same some thousand times
def _sides(samples: Samples, form: Form, top_radps: float, knee: float) -> list[tuple[str, Any, Any, Regression]]:
    """Of each direction: its word, which samples it has, their speeds over the top speed, and the regression."""
    x = np.abs(samples.velocity_radps) / top_radps
    sides = [(word, sign * samples.velocity_radps > 0.0) for word, sign in SIGNS.items()]
    return [(word, chosen, x[chosen], Regression(form, x[chosen], knee)) for word, chosen in sides]


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
            tau = tau + value["gravity_sin"] * s.gravity[0] + value["gravity_cos"] * s.gravity[1]
        return np.asarray(tau)

    def friction_Nm(self, value: Mapping[str, float], s: Samples, tau_Nm: np.ndarray) -> np.ndarray:
        """Opposing the motion: positive for a positive speed."""
        speed = np.abs(s.velocity_radps)
        coulomb, rest = np.zeros(len(speed)), np.zeros(len(speed))
        for word, chosen, x, regression in _sides(s, self.form, self.top_radps, self.knee):
            beta, ws = self.own(value, word)
            coulomb[chosen] = beta[0] + (beta[1] - beta[0]) * np.exp(-x / ws) if self.form.stribeck else beta[0]
            rest[chosen] = regression.columns(ws) @ beta - coulomb[chosen]
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
