"""The position loop linearised around x = 0, as an exact discrete-time model at the controller's rate.

    controller (period T) -> delay d -> zero-order hold -> current lag 1/(lag s + 1) -> joint 1/(J s^2) -> sampler

The plant is discretised exactly for any delay d >= 0: the command of sample k acts from kT + d on, and the part of d
inside a period splits that period in two (Astrom and Wittenmark, Computer-Controlled Systems, section 2.6).
The controller is what the kernels compute: the difference quotient and low-pass of `firmware_py.axis`, law (29),
and the network evaluated with the old weights before its Euler step (24).  For a constant reference the filtered q' and
the filtered e' are the same signal, so that both velocity paths have this loop.

Sign: u = -C(z) q [Nm at the joint], q = P(z) u, and L = P C is the loop that is broken at the torque: a factor on L is
a wrong torque constant, or the inverse of a wrong inertia.

The network around x = 0, weights w_i: fhat = sum h_i0 dw_i + (sum w_i h_i0 c_i / b_i^2) x, and every weight moves along
h_i0, so that one state is exact: s = sum h_i0 dw_i, s <- (1 - leakage T) s + beta T sum h_i0^2 (x^T P B).

Neglected, because it is of second order in x or not linear: the change of h during adaptation, dead zone, projection,
limits of torque, rate and integral, encoder quantisation, lost samples.  Iterative learning acts from one repetition to
the next, outside this loop.  Not modelled: sliding friction, gravity and Coriolis torque together with their
compensation (friction damps the joint; feed-forward on the measured velocity takes damping back).

A joint whose reducer is not rigid is two masses with a spring and a damper between them; friction that holds is a
bristle from either mass to the ground.  The law of a flexible joint reads two positions: P is then a column, C a row,
and L = P C still one number, because there is one torque.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.kernel import plain
from jointctl.firmware_py.law import solve_lyapunov_p
from jointctl.firmware_py.observers import kalman_gains, low_pass_gain
from jointctl.firmware_py.states import ControllerKind, Encoders
from jointctl.tools.configuration.records import encoders_of_law, hidden_layer

if TYPE_CHECKING:
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.configuration.sections import Reducer


# --- the plant between two samples ---

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class StateSpace:
    """x <- a x + b input, output = c x + d input; a (n, n), b (n, inputs), c (outputs, n), d (outputs, inputs)."""

    a: Array
    b: Array
    c: Array
    d: Array

    def response(self, z: ComplexArray) -> ComplexArray:
        """Transfer matrices at the points z (N,), shape (N, outputs, inputs).

        `scipy.signal.dfreqresp` gives the same margins to eight digits; but its import takes several times as long as
        all margins together, which every start of a motion would wait for, and below 1 mHz it is badly conditioned.
        """
        n = len(self.a)
        matrices = np.tile(-self.a.ravel().astype(np.complex128), (len(z), 1))
        matrices[:, :: n + 1] += z[:, None]  # the diagonals
        solved = np.linalg.solve(matrices.reshape(len(z), n, n), self.b)
        return np.asarray(self.c @ solved + self.d, dtype=np.complex128)


def _hold_step(step_s: float, lag_s: float, inertia_kgm2: float) -> tuple[Array, Array]:
    """(phi, gamma) of x = (q [rad], q' [rad/s], torque [Nm]) over `step_s` under a constant command, in closed form."""
    if step_s == 0.0:
        return np.eye(3), np.zeros(3)
    rest = math.exp(-step_s / lag_s) if lag_s > 0.0 else 0.0
    impulse = lag_s * (1.0 - rest)  # integral of what is left of the old torque
    travel = lag_s * (step_s - impulse)  # integral of that
    phi = np.array(
        [[1.0, step_s, travel / inertia_kgm2], [0.0, 1.0, impulse / inertia_kgm2], [0.0, 0.0, rest]], dtype=np.float64
    )
    gamma = np.array(
        [(0.5 * step_s**2 - travel) / inertia_kgm2, (step_s - impulse) / inertia_kgm2, 1.0 - rest], dtype=np.float64
    )
    return phi, gamma


@dataclass(frozen=True)
class TwoMasses:
    """Motor and link with the reducer between them, as they truly are; every value at the joint."""

    motor_kgm2: float
    link_kgm2: float
    stiffness_Nmprad: float  # of a small motion
    damping_Nmspr: float
    bristle_Nmprad: tuple[float, float] = (0.0, 0.0)  # of friction that holds motor and link
    bristle_damping_Nmspr: tuple[float, float] = (0.0, 0.0)
    name: str = ""  # in what it differs from the configured joint

    @property
    def resonance_Hz(self) -> float:
        return math.sqrt(self.stiffness_Nmprad * (1.0 / self.motor_kgm2 + 1.0 / self.link_kgm2)) / math.tau

    @property
    def critical_Nmspr(self) -> float:
        """The damping with which both masses would come to rest without a swing."""
        reduced = self.motor_kgm2 * self.link_kgm2 / (self.motor_kgm2 + self.link_kgm2)
        return 2.0 * math.sqrt(self.stiffness_Nmprad * reduced)


@dataclass(frozen=True)
class RigidJoint:
    """A joint whose inertia is not the one that the law believes: in an arm it goes with the pose."""

    inertia_kgm2: float
    name: str = ""  # in what it differs from the configured joint


@lru_cache(maxsize=256)  # gains are changed far more often than joints
def _hold_step_of_two(joint: TwoMasses, step_s: float, lag_s: float) -> tuple[Array, Array]:
    """(phi, gamma) of x = (motor, its rate, link, its rate, torque), as `_hold_step`."""
    from scipy.linalg import expm  # here: a start with a rigid joint would wait for it

    k, d = joint.stiffness_Nmprad, joint.damping_Nmspr
    matrix = np.zeros((6, 6))
    matrix[0, 1] = matrix[2, 3] = 1.0
    for row, inertia, own, other, held, held_d in (
        (1, joint.motor_kgm2, 0, 2, joint.bristle_Nmprad[0], joint.bristle_damping_Nmspr[0]),
        (3, joint.link_kgm2, 2, 0, joint.bristle_Nmprad[1], joint.bristle_damping_Nmspr[1]),
    ):
        matrix[row, own], matrix[row, own + 1] = -(k + held) / inertia, -(d + held_d) / inertia
        matrix[row, other], matrix[row, other + 1] = k / inertia, d / inertia
    matrix[1, 4] = 1.0 / joint.motor_kgm2
    lag_s = max(lag_s, 1e-4 * step_s, 1e-12)  # as good as none
    matrix[4, 4], matrix[4, 5] = -1.0 / lag_s, 1.0 / lag_s
    moved = np.asarray(expm(matrix * step_s), dtype=np.float64)
    return moved[:5, :5], moved[:5, 5]


@dataclass(frozen=True)
class SampledJoint:
    """x(k+1) = phi x(k) + late u(k - whole) + early u(k - whole - 1), positions = seen x."""

    phi: Array
    late: Array
    early: Array
    whole: int  # whole periods of delay
    seen: Array  # (positions that the law reads, states)

    def response(self, z: ComplexArray) -> ComplexArray:
        """Positions over u [rad/Nm] at the points z, (N, positions, 1).

        The delay line is a power of z, so that it costs nothing.
        """
        taps = np.column_stack((self.late, self.early))
        both = StateSpace(self.phi, taps, self.seen, np.zeros((len(self.seen), 2))).response(z)
        delayed = z[:, None]
        response: ComplexArray = (both[:, :, 0] + both[:, :, 1] / delayed) / delayed**self.whole
        return response[:, :, None]

    def state_space(self) -> StateSpace:
        """The same with the delay line as states: x, u(k-1), u(k-2), ..."""
        line = self.whole + (1 if np.any(self.early) else 0)
        n = len(self.phi)
        size = n + line
        a, b = np.zeros((size, size)), np.zeros((size, 1))
        a[:n, :n] = self.phi
        for taps, back in ((self.late, self.whole), (self.early, self.whole + 1)):
            if back == 0:
                b[:n, 0] += taps
            elif back <= line:
                a[:n, n - 1 + back] += taps
        if line:
            b[n, 0] = 1.0
            for i in range(1, line):
                a[n + i, n - 1 + i] = 1.0
        seen = np.hstack((self.seen, np.zeros((len(self.seen), line))))
        return StateSpace(a, b, seen, np.zeros((len(self.seen), 1)))


_MOTOR, _LINK = np.eye(5)[0], np.eye(5)[2]
_SEEN = {
    Encoders.BOTH: np.array([_LINK, _MOTOR]),
    Encoders.MOTOR: _MOTOR[None, :],
    Encoders.LINK: _LINK[None, :],
}


def sampled_joint(
    period_s: float, delay_s: float, lag_s: float, joint: float | TwoMasses, encoders: Encoders = Encoders.LINK
) -> SampledJoint:
    """Delay, hold, lag and joint over one period, exactly; a rigid `joint` is its inertia."""
    whole = math.floor(delay_s / period_s + 1e-9)  # 0.003 / 0.001 is a little below 3
    fraction_s = max(delay_s - whole * period_s, 0.0)
    if fraction_s < 1e-9 * period_s:
        fraction_s = 0.0

    def hold_step(step_s: float) -> tuple[Array, Array]:
        if isinstance(joint, TwoMasses):
            return _hold_step_of_two(joint, step_s, lag_s)
        return _hold_step(step_s, lag_s, joint)

    phi_old, gamma_old = hold_step(fraction_s)
    phi_new, gamma_new = hold_step(period_s - fraction_s)
    seen = _SEEN[encoders] if isinstance(joint, TwoMasses) else np.eye(1, 3)
    return SampledJoint(phi_new @ phi_old, gamma_new, phi_new @ gamma_old, whole, seen)


# --- what decides the loop ---

_POSITIVE = ("period_s", "inertia_kgm2", "kp", "kv")
_NOT_NEGATIVE = (
    "delay_s", "lag_s", "cutoff_Hz", "learning_rate", "leakage_1ps", "ki", "observer_radps", "observer_delay_cycles",
    "motor_inertia_kgm2", "twist_radps", "link_cutoff_Hz",
)  # fmt: skip
MAX_DELAY_PERIODS = 500  # one state each


@dataclass(frozen=True, kw_only=True)
class LoopSettings:
    """Everything that decides the linear loop; `loop_settings` makes it from a configuration."""

    kind: ControllerKind
    period_s: float
    delay_s: float  # from the sample to the torque command taking effect, ahead of the lag
    lag_s: float  # of the current loop, first order
    inertia_kgm2: float  # J at the joint, true and modelled
    kp: float  # [1/s^2]
    kv: float  # [1/s]
    cutoff_Hz: float  # of the velocity's low-pass, 0 = none
    ki: float = 0.0  # [1/s^3], PID only
    observer_radps: float = 0.0  # disturbance observer only
    observer_delay_cycles: int = 0
    kalman: bool = False  # velocity and disturbance by the Kalman filter
    # the network; without effect for other kinds
    q: tuple[float, float] = (1.0, 1.0)  # Q = diag(q1, q2)
    learning_rate: float = 0.0  # beta
    leakage_1ps: float = 0.0
    centres: tuple[tuple[float, float], ...] = ()  # [rad, rad/s]
    widths: tuple[float, ...] = ()  # b, one for each centre
    weight_Nm: float = 0.0  # of every neuron at the point of linearisation
    # the joints that the loop must bear, of which the worst counts; none = a rigid one, true to `inertia_kgm2`
    joints: tuple[TwoMasses | RigidJoint, ...] = ()
    largest_s: float = math.inf  # peak of |S| that is accepted, of each joint
    encoders: Encoders = Encoders.LINK
    motor_inertia_kgm2: float = 0.0  # of `inertia_kgm2`, as the law of a flexible joint believes
    twist_radps: float = 0.0
    link_cutoff_Hz: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "largest_s" and isinstance(value, (int, float)) and not math.isfinite(value):
                raise ValueError(f"{field.name} (={value}) must be finite")
        for name in _POSITIVE:
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} (={getattr(self, name):g}) must be > 0")
        for name in _NOT_NEGATIVE:
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name} (={getattr(self, name):g}) must be >= 0")
        if self.delay_s > MAX_DELAY_PERIODS * self.period_s:
            longest_s = MAX_DELAY_PERIODS * self.period_s
            raise ValueError(f"delay_s (={self.delay_s:g}) must be in [0..{longest_s:g}], {MAX_DELAY_PERIODS} periods")
        if self.kind not in CONTROLLERS:
            known = ", ".join(kind.name for kind in CONTROLLERS)
            raise ValueError(f"kind (={self.kind!r}) must be one of {known}")
        if len(self.widths) != len(self.centres) or not all(width > 0.0 for width in self.widths):
            raise ValueError(f"widths (={self.widths}) must be > 0 and as many as centres ({len(self.centres)})")


# --- the controllers: one function for each kind, from the measured q to the torque u (reference zero) ---


def network_gains(settings: LoopSettings) -> tuple[float, float, float, float]:
    """(a1, a2, g1, g2): s' = a1 e + a2 e' [Nm/s], and g1 e + g2 e' [Nm] of the weights present at x = 0."""
    _, p12, p22 = solve_lyapunov_p(settings.kp, settings.kv, *settings.q)
    centres = np.array(settings.centres, dtype=np.float64).reshape(-1, 2)
    widths = np.array(settings.widths, dtype=np.float64)
    hidden = np.exp(-np.sum(centres**2, axis=1) / (2.0 * widths**2))
    adaptation = settings.learning_rate * float(hidden @ hidden) / settings.inertia_kgm2
    gradient = settings.weight_Nm * (hidden / widths**2) @ centres
    return adaptation * p12, adaptation * p22, float(gradient[0]), float(gradient[1])


@dataclass(frozen=True)
class _Rows:
    """Linear forms of (states, inputs), each an array of that size; the first two states are last error and rate."""

    size: int
    inputs: int = 1

    def state(self, index: int) -> Array:
        return np.eye(self.size + self.inputs)[index]

    def input(self, index: int) -> Array:
        return self.state(self.size + index)

    @property
    def error(self) -> Array:
        """e = q - q_d, the input [rad]."""
        return self.input(0)

    def filtered(self, error: Array, first: int, cutoff_Hz: float, period_s: float) -> Array:
        """Rate of an error in this period [rad/s]; the states from `first` on are the last error and rate."""
        gain = plain(low_pass_gain)(cutoff_Hz, period_s)
        return (1.0 - gain) * self.state(first + 1) + gain / period_s * (error - self.state(first))

    def rate(self, settings: LoopSettings) -> Array:
        """e' of this period: low-pass of the difference quotient [rad/s]."""
        return self.filtered(self.error, 0, settings.cutoff_Hz, settings.period_s)

    def feedback(self, settings: LoopSettings) -> Array:
        """-J (kv e' + kp e) [Nm]."""
        return -settings.inertia_kgm2 * (settings.kv * self.rate(settings) + settings.kp * self.error)

    def state_space(self, settings: LoopSettings, following: list[Array], output: Array) -> StateSpace:
        """`following`: next values of the states from the third on."""
        return self.of_rows([self.error, self.rate(settings), *following], output)

    def of_rows(self, following: list[Array], output: Array) -> StateSpace:
        """`following`: next values of all states."""
        rows, n = np.array(following), self.size
        return StateSpace(rows[:, :n], rows[:, n:], output[None, :n], output[None, n:])


def computed_torque(settings: LoopSettings) -> StateSpace:
    """The law without anything that learns."""
    rows = _Rows(2)
    return rows.state_space(settings, [], rows.feedback(settings))


def computed_torque_rbf(settings: LoopSettings) -> StateSpace:
    """The law with its adaptive network, which around x = 0 is one (leaky) integrator s [Nm]."""
    a1, a2, g1, g2 = network_gains(settings)
    adapts = (a1, a2) != (0.0, 0.0)  # an integrator that nothing drives is no part of the loop
    rows = _Rows(3 if adapts else 2)
    rate = rows.rate(settings)
    output = rows.feedback(settings) - g1 * rows.error - g2 * rate
    if not adapts:
        return rows.state_space(settings, [], output)
    s, period_s = rows.state(2), settings.period_s
    following = (1.0 - settings.leakage_1ps * period_s) * s + period_s * (a1 * rows.error + a2 * rate)
    return rows.state_space(settings, [following], output - s)


def computed_torque_observer(settings: LoopSettings) -> StateSpace:
    """The law with the disturbance observer: states z [Nms], r [Nm] and the commands that are not yet applied [Nm]."""
    if settings.kalman:
        return kalman_observer(settings)
    waiting = settings.observer_delay_cycles + 1  # the newest command known is that of the cycle before
    rows = _Rows(4 + waiting)
    momentum = settings.inertia_kgm2 * rows.rate(settings)
    integral = rows.state(2) + settings.period_s * (rows.state(3 + waiting) - rows.state(3))
    disturbance = settings.observer_radps * (integral - momentum)
    output = rows.feedback(settings) + disturbance
    sent = [output, *(rows.state(4 + i) for i in range(waiting - 1))]
    return rows.state_space(settings, [integral, disturbance, *sent], output)


def kalman_observer(settings: LoopSettings) -> StateSpace:
    """The same law by the Kalman filter: states e, e', d [Nm] as corrected, and the commands not yet applied [Nm]."""
    waiting, period_s, inertia = settings.observer_delay_cycles + 1, settings.period_s, settings.inertia_kgm2
    rows = _Rows(3 + waiting)
    g1, g2, g3 = plain(kalman_gains)(settings.cutoff_Hz, settings.observer_radps, period_s)
    acceleration = (rows.state(2 + waiting) - rows.state(2)) / inertia
    expected = rows.state(0) + period_s * (rows.state(1) + 0.5 * period_s * acceleration)
    apart = rows.error - expected
    error, rate = expected + g1 * apart, rows.state(1) + period_s * acceleration + g2 * apart
    disturbance = rows.state(2) - inertia * g3 * apart
    output = disturbance - inertia * (settings.kp * error + settings.kv * rate)
    sent = [output, *(rows.state(3 + i) for i in range(waiting - 1))]
    return rows.of_rows([error, rate, disturbance, *sent], output)


def pid(settings: LoopSettings) -> StateSpace:
    """PID on the inertia: state int(e) dt [rad s], updated before its use."""
    adapts = settings.ki != 0.0
    rows = _Rows(3 if adapts else 2)
    output = rows.feedback(settings)
    if not adapts:
        return rows.state_space(settings, [], output)
    integral = rows.state(2) + settings.period_s * rows.error
    return rows.state_space(settings, [integral], output - settings.inertia_kgm2 * settings.ki * integral)


def flexible_joint(settings: LoopSettings) -> StateSpace:
    """The law for two masses: (last e_m, v_m, last e_l, v_l, b, z [Nms], d [Nm], commands that are not yet applied).

    Its inputs are link and motor; with one encoder e_l is e_m.
    """
    waiting, period_s = settings.observer_delay_cycles + 1, settings.period_s
    both = settings.encoders == Encoders.BOTH
    rows = _Rows(7 + waiting, 2 if both else 1)
    link, motor = rows.input(0), rows.input(1 if both else 0)
    motor_rate = rows.filtered(motor, 0, settings.cutoff_Hz, period_s)
    link_rate = rows.filtered(link, 2, settings.link_cutoff_Hz if both else settings.cutoff_Hz, period_s)
    keep = math.exp(-settings.twist_radps * period_s)
    twist = keep * rows.state(4) + (1.0 - keep) * (link - motor)
    momentum = settings.motor_inertia_kgm2 * motor_rate
    momentum = momentum + (settings.inertia_kgm2 - settings.motor_inertia_kgm2) * link_rate
    integral = rows.state(5) + period_s * (rows.state(6 + waiting) - rows.state(6))
    disturbance = settings.observer_radps * (integral - momentum)
    output = disturbance - settings.inertia_kgm2 * (settings.kp * (motor + twist) + settings.kv * motor_rate)
    sent = [output, *(rows.state(7 + i) for i in range(waiting - 1))]
    return rows.of_rows([motor, motor_rate, link, link_rate, twist, integral, disturbance, *sent], output)


CONTROLLERS: dict[ControllerKind, Callable[[LoopSettings], StateSpace]] = {
    ControllerKind.COMPUTED_TORQUE: computed_torque,
    ControllerKind.COMPUTED_TORQUE_RBF: computed_torque_rbf,
    ControllerKind.COMPUTED_TORQUE_OBSERVER: computed_torque_observer,
    ControllerKind.PID: pid,
    ControllerKind.FLEXIBLE_JOINT: flexible_joint,
}


# --- the loop ---


def closed_loop(plant: StateSpace, law: StateSpace) -> Array:
    """x <- this x, (..., states, states); `plant` may be many, its arrays stacked along the first axis."""
    upper = np.concatenate((plant.a + plant.b @ law.d @ plant.c, plant.b @ law.c), axis=-1)
    own = np.broadcast_to(law.a, (*plant.a.shape[:-2], *law.a.shape))
    lower = np.concatenate((law.b @ plant.c, own), axis=-1)
    result: Array = np.concatenate((upper, lower), axis=-2)
    return result


def poles_of(loop: Array) -> ComplexArray:
    """Eigenvalues z of closed loops (..., states, states), shape (..., states)."""
    return np.asarray(np.linalg.eigvals(loop), dtype=np.complex128)


_SQUARED = 18  # times: 262 s at 1 kHz


def come_to_rest(loops: Array) -> bool:
    """Whether all closed loops (n, states, states) are seen to be stable: some power of each is less than 1.

    That takes a quarter of the time of eigenvalues, which tell where the answer is no: of a slow loop it may be.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_SQUARED):
            loops = loops @ loops
        return bool(np.all(np.sum(np.abs(loops), axis=-1) < 1.0))  # a norm; NaN is no


@dataclass(frozen=True)
class LinearLoop:
    """Plant and controller of one setting."""

    settings: LoopSettings
    joint: SampledJoint
    controller: StateSpace

    def open_loop(self, omega_radps: Array) -> ComplexArray:
        """L at these frequencies, shape (N,), each in (0..pi/T]."""
        z = np.exp(1j * np.asarray(omega_radps, dtype=np.float64) * self.settings.period_s)
        response: ComplexArray = -(self.controller.response(z) @ self.joint.response(z))[:, 0, 0]
        return response

    def closed_loop_poles(self, gain: float = 1.0) -> ComplexArray:
        """Eigenvalues z of the closed loop with L times `gain`; stable where all |z| < 1."""
        plant = self.joint.state_space()
        return poles_of(closed_loop(replace(plant, b=gain * plant.b), self.controller))

    def is_stable(self, gain: float = 1.0) -> bool:
        return bool(np.max(np.abs(self.closed_loop_poles(gain))) < 1.0)


def linear_loop(settings: LoopSettings) -> LinearLoop:
    """The loop of these settings; of several joints with the first."""
    true = settings.joints[0] if settings.joints else settings.inertia_kgm2
    if isinstance(true, RigidJoint):
        true = true.inertia_kgm2
    joint = sampled_joint(settings.period_s, settings.delay_s, settings.lag_s, true, settings.encoders)
    return LinearLoop(settings, joint, CONTROLLERS[settings.kind](settings))


# --- From a configuration to the linear loop, with the origin of every assumption ---
#
# The delay counts from the instant at which the drive takes the position sample (SYNC) to the one at which the torque
# command enters its current loop.  A synchronous RPDO takes effect with the next SYNC, one period after the sample that
# it was computed from; an asynchronous one takes effect within the period, for which one period is an upper bound.
# What the drive adds inside is not visible on the bus: `margin.loop_delay_s` or a measured delay must contain it.

_SAME_IN_CONTROL = {"kp", "kv", "ki", "observer_radps", "observer_delay_cycles", "learning_rate", "leakage_1ps"}


@dataclass(frozen=True)
class Assumption:
    """A value of the analysis and where it comes from."""

    name: str
    value: float
    unit: str
    origin: str


def _delay(config: Config, measured_s: float | None) -> tuple[float, str]:
    if measured_s is not None:
        return measured_s, "measured"
    if config.margin.loop_delay_s is not None:
        return config.margin.loop_delay_s, "margin.loop_delay_s"
    return config.drive.assumed_delay(config)


def loop_settings(config: Config, delay_s: float | None = None) -> tuple[LoopSettings, tuple[Assumption, ...]]:
    """The loop of this configuration; `delay_s` is a measured loop delay, which beats the configured one."""
    control, current_lag_s = config.control, config.margin.current_lag_s
    delay_s, delay_origin = _delay(config, delay_s)
    centres, widths = hidden_layer(control)
    try:
        settings = LoopSettings(
            kind=ControllerKind[control.kind.upper()],
            period_s=1.0 / config.loop.rate_Hz,
            delay_s=delay_s,
            lag_s=current_lag_s,
            inertia_kgm2=config.joint.inertia_kgm2,
            cutoff_Hz=control.velocity_cutoff_Hz,
            kalman=control.velocity_filter == "kalman",
            q=(control.lyapunov_q[0], control.lyapunov_q[-1]),
            **control.model_dump(include=_SAME_IN_CONTROL),
            centres=centres,
            widths=widths,
            weight_Nm=control.initial_weight_Nm,
            **_two_masses(config),
        )
    except ValueError as error:
        raise ConfigurationError(f"{config.path}: {error}") from None
    filtered = "Kalman filter" if settings.kalman else "0 = none"
    assumptions: tuple[Assumption, ...] = (
        Assumption("loop rate", config.loop.rate_Hz, "Hz", "loop.rate_Hz"),
        Assumption("loop delay", delay_s, "s", delay_origin),
        Assumption("current lag", current_lag_s, "s", "margin.current_lag_s"),
        Assumption("velocity filter", control.velocity_cutoff_Hz, "Hz", f"control.velocity_cutoff_Hz ({filtered})"),
        Assumption("joint inertia", config.joint.inertia_kgm2, "kg m^2", "joint.inertia_kgm2"),
    )
    if config.reducer is not None:
        resonance_Hz = two_masses(config, config.reducer, 1.0, 1.0, False).resonance_Hz
        assumptions += (
            Assumption("motor inertia", config.reducer.motor_inertia_kgm2, "kg m^2", "reducer.motor_inertia_kgm2"),
            Assumption("resonance", round(resonance_Hz, 1), "Hz", "of both masses on reducer.loop_stiffness_Nmprad"),
        )
    return settings, assumptions


def _two_masses(config: Config) -> dict[str, Any]:
    """Fields of `LoopSettings` for a joint whose reducer is not rigid."""
    reducer, margin, control = config.reducer, config.margin, config.control
    if reducer is None:
        return {}
    encoders = encoders_of_law(config)
    if control.kind != "flexible_joint" and encoders == Encoders.BOTH:
        encoders = Encoders.LINK  # the others read that alone
    error = margin.stiffness_error
    joints = [
        two_masses(config, reducer, payload, stiffness, held)
        for payload in sorted({1.0, *margin.payload_range})
        for stiffness in sorted({1.0 - error, 1.0, 1.0 + error})
        for held in (False, True)
        if not held or (config.friction is not None and config.friction.lugre is not None)
    ]
    return {
        "joints": tuple(joints),
        "largest_s": margin.max_sensitivity,
        "encoders": encoders,
        "motor_inertia_kgm2": reducer.motor_inertia_kgm2,
        "twist_radps": control.twist_radps,
        "link_cutoff_Hz": control.link_cutoff_Hz,
    }


def two_masses(config: Config, reducer: Reducer, payload: float, stiffness: float, held: bool) -> TwoMasses:
    """The joint with these factors on link inertia and stiffness, at rest (`held` by friction) or free of friction."""
    share, lugre = reducer.link_friction_share, config.friction.lugre if config.friction is not None else None
    bristles = damping = (0.0, 0.0)
    if held and lugre is not None:
        bristles = (1.0 - share) * lugre.stiffness_Nmprad, share * lugre.stiffness_Nmprad
        damping = (1.0 - share) * lugre.damping_Nmspr, share * lugre.damping_Nmspr
    words = [f"link inertia x {payload:g}"] if payload != 1.0 else []
    words += [f"stiffness x {stiffness:g}"] if stiffness != 1.0 else []
    words += ["held by friction" if held else "without friction"]
    return TwoMasses(
        reducer.motor_inertia_kgm2,
        payload * config.link_kgm2,
        stiffness * (reducer.loop_stiffness_Nmprad or reducer.stiffness_Nmprad),
        reducer.damping_Nmspr,
        bristles,
        damping,
        ", ".join(words),
    )
