"""Gains for the law of a flexible joint, chosen for what is believed of it.

The least error of the link after a step of friction at the motor, subject to

    |S| <= LARGEST_S with the joint as it is believed, <= LARGEST_S_ANYWHERE with every one of `LoopSettings.joints`
    torque noise of the encoders' counts <= LARGEST_NOISE_Nm
    phase margin and |S| as the margin gate asks for, of the joints that are free of friction

Searched by Nelder and Mead over kv and the observer's bandwidth; with the link's encoder alone, where the resonance
lies between torque and encoder, over the velocity's cut-off too, and so where both encoders are read but bear only a
soft loop, below SOFT_KV_1ps: what is late beside the resonance of a light motor may bear so much more behind a filter
far below it that it is WORTH_A_FILTER.  kp is KP_OF_KV kv^2: with less damping the search
finds loops that a joint a little different from what is believed makes unstable, and so does an observer above
LARGEST_OBSERVER_radps.  A constraint that is not met costs in proportion.  The motor's inertia may be wrong by
MOTOR_ERROR besides.  The joints held by friction are left to the margin gate: what holds takes the resonance away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.states import ControllerKind, Encoders
from jointctl.tools.analysis.linear_loop import Array, ComplexArray, LinearLoop, LoopSettings, TwoMasses, linear_loop
from jointctl.tools.analysis.margins import phase_on_grid_rad
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import joint_rad_per_count, law_resolution_rad

LARGEST_S = 1.8
LARGEST_S_ANYWHERE = 2.5
LARGEST_NOISE_Nm = 0.6
LARGEST_OBSERVER_radps = 110.0
LEAST_OBSERVER_radps = 0.1  # a slower one is none, and its pole cannot be distinguished from an unstable one
LEAST_KV_1ps = 3.0  # softer loops bear anything and are of no use
SOFT_KV_1ps = 12.0
WORTH_A_FILTER = 1.35  # by how much smaller the error must be: what repeats is learned badly behind one
KP_OF_KV = 1.5
MOTOR_ERROR = 0.15
GATE_SLACK = 1.03  # by which more is searched for than the gate asks for, whose frequencies are closer
ROUNDED = 1.02  # by which a constraint may be missed, as the search ends near it
HIGHEST_CUTOFF = 0.45  # of the rate
PENALTY = 20.0  # on the logarithm of the error, for each unit by which a constraint is missed
UNSTABLE = 1e3
# kv [1/s], observer [rad/s], and where it is searched the cut-off [Hz]
_START = {
    Encoders.BOTH: np.log([20.0, 80.0]),
    Encoders.MOTOR: np.log([20.0, 80.0]),
    Encoders.LINK: np.log([10.0, 30.0, 15.0]),
}
_START_FILTERED = np.log([6.0, 25.0, 12.0])  # with both encoders
_COLUMNS = {Encoders.BOTH: [0, 1], Encoders.MOTOR: [1], Encoders.LINK: [0]}  # of link and motor, what the law reads
_LOWEST_Hz = {Encoders.BOTH: 0.3, Encoders.MOTOR: 0.3, Encoders.LINK: 0.1}  # of the error that counts
_POINTS = 250
_SOFTER = 4  # times that the start is halved
_EVALUATIONS = {2: 80, 3: 160}  # by how many are searched


@dataclass(frozen=True)
class FlexibleGains:
    """What the search found; `largest_s` is that of all joints."""

    kp: float
    kv: float
    observer_radps: float
    largest_s: float
    noise_Nm: float
    cutoff_Hz: float | None = None  # where it was searched

    @property
    def met(self) -> bool:
        """Whether there are gains that keep what was asked for."""
        stiff = self.kv * ROUNDED >= LEAST_KV_1ps
        return stiff and max(self.largest_s / LARGEST_S_ANYWHERE, self.noise_Nm / LARGEST_NOISE_Nm) <= ROUNDED

    def changes(self) -> dict[str, float]:
        """Keys of [control]."""
        gains = {"kp": self.kp, "kv": self.kv, "observer_radps": self.observer_radps}
        return gains if self.cutoff_Hz is None else {**gains, "velocity_cutoff_Hz": self.cutoff_Hz}

    def loop(self, settings: LoopSettings) -> LoopSettings:
        """The loop with them."""
        cutoff_Hz = settings.cutoff_Hz if self.cutoff_Hz is None else self.cutoff_Hz
        return replace(settings, kp=self.kp, kv=self.kv, observer_radps=self.observer_radps, cutoff_Hz=cutoff_Hz)


@dataclass(frozen=True)
class _Judged:
    error: float  # of the link, in any unit
    s: float  # max |S| of the believed joint
    s_anywhere: float
    noise_Nm: float
    beyond: float  # logarithm of the observer's bandwidth over the largest one, or of the least kv over kv
    refused: float  # by which share the gate misses phase margin or sensitivity

    @property
    def cost(self) -> float:
        missed = max(self.s - LARGEST_S, 0.0) + max(self.s_anywhere - LARGEST_S_ANYWHERE, 0.0) + self.beyond
        missed += self.refused
        return math.log(self.error) + PENALTY * (missed + max(self.noise_Nm / LARGEST_NOISE_Nm - 1.0, 0.0))

    @property
    def kept(self) -> bool:
        """Whether the constraints are, but for where the search ends."""
        shares = self.s / LARGEST_S, self.s_anywhere / LARGEST_S_ANYWHERE, self.noise_Nm / LARGEST_NOISE_Nm
        return max(*shares, math.exp(self.beyond), 1.0 + self.refused) <= ROUNDED

    def gain_on(self, other: _Judged) -> float:
        """By how much the error of `other` is greater; what it misses counts where one of them misses anything."""
        return other.error / self.error if self.kept and other.kept else math.exp(min(other.cost - self.cost, 100.0))


def _with_gains(settings: LoopSettings, logarithms: Array) -> LoopSettings:
    """The loop with these logarithms of kv, of the observer's bandwidth and perhaps of the cut-off, to three digits."""
    kv, observer, *cutoff = (float(f"{math.exp(x):.3g}") for x in logarithms)
    observer, highest = max(observer, LEAST_OBSERVER_radps), HIGHEST_CUTOFF / settings.period_s
    cutoff_Hz = min(cutoff[0], highest) if cutoff else settings.cutoff_Hz
    kp = float(f"{KP_OF_KV * kv * kv:.3g}")
    return replace(settings, kp=kp, kv=kv, observer_radps=observer, cutoff_Hz=cutoff_Hz)


class _Search:
    """Responses of the joints, which no gain changes."""

    def __init__(self, settings: LoopSettings, count_rad: Array, least_phase_deg: float) -> None:
        self._settings, self._count_rad = settings, count_rad
        self._least_phase_rad = math.radians(least_phase_deg * GATE_SLACK)
        self._omega = np.geomspace(math.tau * _LOWEST_Hz[settings.encoders], math.pi / settings.period_s, _POINTS)
        self._z = np.exp(1j * self._omega * settings.period_s)
        masses = [joint for joint in settings.joints if isinstance(joint, TwoMasses)]
        free = [joint for joint in masses if joint.bristle_Nmprad == (0.0, 0.0)]
        self._of_gate = len(free)
        wrong = (1.0 - MOTOR_ERROR, 1.0 + MOTOR_ERROR)
        free += [replace(joint, motor_kgm2=factor * joint.motor_kgm2) for joint in free for factor in wrong]
        self._joints = [linear_loop(replace(settings, joints=(joint,))).joint for joint in free]
        # link and motor of each, of which the law reads one or both
        seen = [linear_loop(replace(settings, joints=(joint,), encoders=Encoders.BOTH)).joint for joint in free]
        self._positions = [joint.response(self._z) for joint in seen]
        self._responses = [positions[:, _COLUMNS[settings.encoders]] for positions in self._positions]
        size = [joint.stiffness_Nmprad * joint.link_kgm2 * joint.motor_kgm2 for joint in free]
        self._believed = int(np.argsort(size)[len(size) // 2])

    def judged(self, settings: LoopSettings) -> _Judged:
        controller = linear_loop(settings).controller
        law = controller.response(self._z)
        largest = []
        for joint, response in zip(self._joints, self._responses, strict=True):
            radius = float(np.max(np.abs(LinearLoop(settings, joint, controller).closed_loop_poles())))
            if radius >= 1.0:
                return _Judged(UNSTABLE, UNSTABLE * radius, UNSTABLE * radius, 0.0, 0.0, 0.0)
            largest.append(float(np.max(np.abs(self._sensitivity(law, response)))))
        phase_rad = min(phase_on_grid_rad(-(law @ response)[:, 0, 0]) for response in self._responses[: self._of_gate])
        response = self._responses[self._believed]
        sensitivity = self._sensitivity(law, response)
        link = self._positions[self._believed][:, 0, 0]
        error = link * sensitivity / self._omega  # of a step of torque
        noise = np.abs(law[:, 0, :] * sensitivity[:, None]) ** 2 @ (self._count_rad**2 / 12.0)
        return _Judged(
            error=math.sqrt(np.trapezoid(np.abs(error) ** 2, self._omega)),
            s=largest[self._believed],
            s_anywhere=max(largest),
            noise_Nm=math.sqrt(np.trapezoid(noise, self._omega) * settings.period_s / math.pi),
            beyond=max(
                math.log(settings.observer_radps / LARGEST_OBSERVER_radps), math.log(LEAST_KV_1ps / settings.kv), 0.0
            ),
            refused=max(
                self._least_phase_rad / max(phase_rad, 1e-9),
                max(largest[: self._of_gate]) * GATE_SLACK / settings.largest_s,
                1.0,
            )
            - 1.0,
        )

    def best_from(self, start: Array) -> LoopSettings:
        """The least cost near these logarithms of what `_with_gains` takes."""
        from scipy.optimize import minimize  # here: only this search waits for it

        for _ in range(_SOFTER):  # where no joint of the simplex is stable, the search would learn nothing
            if self.judged(_with_gains(self._settings, start)).s_anywhere < UNSTABLE:
                break
            start = start - math.log(2.0)
        steps = 0.4 * np.vstack((np.zeros(len(start)), -np.eye(len(start))))
        found = minimize(
            lambda x: self.judged(_with_gains(self._settings, x)).cost, start, method="Nelder-Mead",
            options={"maxfev": _EVALUATIONS[len(start)], "initial_simplex": start + steps},
        )  # fmt: skip
        return _with_gains(self._settings, found.x)

    @staticmethod
    def _sensitivity(law: ComplexArray, response: ComplexArray) -> ComplexArray:
        sensitivity: ComplexArray = 1.0 / (1.0 - (law @ response)[:, 0, 0])
        return sensitivity


def chosen_gains(config: Config, settings: LoopSettings) -> FlexibleGains:
    """For the loop of `loop_settings(config)`; about half a second, three times that where the cut-off is searched."""
    if settings.kind != ControllerKind.FLEXIBLE_JOINT:
        raise ConfigurationError(
            f'{config.path}: gains are chosen for control.kind = "flexible_joint" (={config.control.kind}) only'
        )
    counts_rad = np.array([law_resolution_rad(config), abs(joint_rad_per_count(config))])  # link, motor
    search = _Search(settings, counts_rad[_COLUMNS[settings.encoders]], config.margin.min_phase_margin_deg)
    found = search.best_from(_START[settings.encoders])
    if settings.encoders == Encoders.BOTH and found.kv < SOFT_KV_1ps:
        filtered = search.best_from(_START_FILTERED)
        if search.judged(filtered).gain_on(search.judged(found)) > WORTH_A_FILTER:
            found = filtered
    judged = search.judged(found)
    cutoff_Hz = found.cutoff_Hz if found.cutoff_Hz != settings.cutoff_Hz else None
    return FlexibleGains(found.kp, found.kv, found.observer_radps, judged.s_anywhere, judged.noise_Nm, cutoff_Hz)
