"""Gains for a joint, identified or believed: the least modelled error that keeps the margins wherever it may be.

    phase margin >= 35 deg, gain margin >= 2, |S| <= 2      inertias, stiffness at the ends of their intervals, delay
    (|S| <= 2.4 of a soft joint with both encoders;         and lag at the late end, link at both ends of the payload
    25, 1.7 and 3 where friction rules the joint)
    phase margin >= margin.min_phase_margin_deg,            every joint of the gate of `run`, one as stiff as under a
    |S| <= margin.max_sensitivity of a soft joint           steady torque, and hardly damped ones: without hysteresis
    torque noise of the encoders' counts <= a share of limits.torque_max_Nm, and what a count does to the torque <= what
                                        friction and gravity leave of it

The error is that after a step of friction, |G S / w| over all frequencies, and under ripple, which has any frequency as
the speed changes: |G S / ripple_radps|.  A grid over kv, the observer's bandwidth (or the network's q) and the velocity
filters, then Nelder and Mead from its best points; kp follows from kv.  A joint that is late beside its resonance bears
two to seven times the kv behind a filter far below that; the link's speed, which the observer reads, is then filtered
as well, since it drives a resonance that is hardly damped.  By this error a quick observer and a stiff loop look alike;
on the simulated joints the quick one tracks two to three times worse, so it costs beyond a limit, and a little far from
the usual bandwidth.  A goal that is missed costs in proportion, so that the result of a joint that does not allow all
of them is the nearest one, and says so.  A light joint with much friction sticks and slides by turns under a soft loop,
which no margin shows, and its wide intervals are those of friction that looks like inertia: it keeps less there.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from jointctl.drivers.errors import ConfigurationError, text_Nm
from jointctl.firmware_py.states import Encoders
from jointctl.tools.analysis.linear_loop import (
    CONTROLLERS,
    Array,
    LoopSettings,
    StateSpace,
    TwoMasses,
    closed_loop,
    come_to_rest,
    linear_loop,
    loop_settings,
    poles_of,
    sampled_joint,
    two_masses,
)
from jointctl.tools.analysis.margins import at_rate, cases, converging, margins_on_grid, row_response
from jointctl.tools.configuration.checks import OBSERVING
from jointctl.tools.configuration.config import Adaptation, Config, Control
from jointctl.tools.configuration.conversions import (
    free_torque_Nm,
    friction_fall_Nmspr,
    joint_rad_per_count,
    law_resolution_rad,
    static_friction_Nm,
)
from jointctl.tools.configuration.load import shipped_control

PHASE_MARGIN_deg, GAIN_MARGIN, SENSITIVITY = 35.0, 2.0, 2.0
STICKY = (25.0, 1.7, 3.0)  # the same of a joint that friction rules
STICKY_radps2 = (45.0, 70.0)  # static friction over the inertia: up to the former those above, from the latter on these
SLIPS = 5.0  # times what kv damps: friction that falls so steeply makes a joint stick and slip at low speed
NOISE_SHARE, SOFT_NOISE_SHARE = 0.03, 0.55 / 60.0  # of limits.torque_max_Nm; of a soft joint
QUIET_ERROR = 2.0  # times the least error: what a quiet loop may have
PENALTY = 30.0  # for each share by which a goal is missed
UNSTABLE = 1e3
KP_OF_KV, LATE_KP_OF_KV = 1.5, 3.0  # of kv^2, for the law of a flexible joint; the latter where late torque limits kv
LARGEST_OBSERVER_radps = 110.0  # of that law, for the same reason
LEAST_KV_1ps = 3.0  # softer loops bear anything and are of no use
LEAST_OBSERVER_radps = 0.1  # a slower one is none, and its pole cannot be distinguished from an unstable one
LEAST_INERTIA_SHARE = 0.03  # by which an inertia may be wrong however narrow its interval: friction is no viscous one
LEAST_STIFFNESS_SHARE, LEAST_LATE_s = 0.1, 0.1e-3
GRID_SPARE = 0.97  # of the gate's margins: the gate looks between the frequencies of the grid
OF_RIGID = {"computed_torque_observer": "precise", "computed_torque_rbf": "paper"}  # control.kind and its law
NEEDED = {
    Encoders.BOTH: "[joint_encoder] beside an encoder on the motor",
    Encoders.LINK: 'encoder.side = "joint" and no [joint_encoder]',
}
SOFTEST = 0.5  # of the stiffness of a small motion: hysteresis doubles it at most
LEAST_DAMPING = 0.02  # of the critical one: of a strain wave gear without its hysteresis, 0.02 to 0.06
EASED = 2.0  # share of margins that the encoder on the link alone need not keep there: it would be left with few gains
LINK_CUTOFF = 4.0  # times the velocity filter: that of the link's velocity, at most
USUAL_LINK_CUTOFF_Hz = 60.0  # at most as well: a lower one is quieter, and the observer damps less with it
HIGHEST_CUTOFF = 0.45  # of the velocity filter, of loop.rate_Hz
QUICKEST_OBSERVER_radps = 45.0  # of the precise law
USUAL_OBSERVER_radps = 20.0  # of the precise law, where nothing speaks for another
UNUSUAL = 0.15  # in the logarithm of the error, at e times that bandwidth or 1/e of it; of the link's filter as well
RIPPLE_radps = 5.0  # beyond it ripple counts more than the step
RIPPLE_OF_TWO_radps = 100.0  # docs/law-measured.md: what disturbs such a joint falls with the frequency up to there
Q_INERTIA_kgm2 = 2.1  # of the joint that the values of lyapunov_q suit
_LOWEST_Hz, _POINTS = 0.3, 240
_NEAR = (0.65, 1.3, 120)  # times the believed resonance: from the steady stiffness to the stiffest joint of the gate
_STARTS, _EVALUATIONS = 3, 90
_AGAIN = (0.3, -0.2, 0.2)  # from the best one


@dataclass(frozen=True)
class Intervals:
    """By what share that which a configuration says of its joint may be wrong; the last three of a soft reducer."""

    inertia: float
    late_s: float = 0.0  # of delay and lag together
    stiffness: float = 0.0
    link: float = 0.0  # of its inertia
    tells_link: bool = True  # False: its share of the inertia is a guess, at the same resonance
    friction_radps2: float = 0.0  # no interval: static friction over the inertia, see STICKY_radps2


BELIEVED = Intervals(0.1)  # of a file that nothing was measured for


@dataclass(frozen=True)
class Law:
    """A law to choose: the [control] that it starts from, and what the search turns."""

    name: str
    control: Callable[[], Control]
    keys: tuple[str, ...]  # of LoopSettings, positive
    spans: tuple[tuple[float, float, int], ...]  # of each key, and how many values of it the grid has
    kp_of_kv: tuple[float, ...]  # with each the search goes on from the best gains found with those before
    most_observer_radps: float = math.inf
    usual_observer_radps: float | None = None
    noise_share: float = NOISE_SHARE
    ripple_radps: float = RIPPLE_radps
    sensitivity: float = SENSITIVITY
    encoders: Encoders | None = None  # of a soft joint, which alone has such a law; None: any joint
    of_soft: tuple[tuple[float, float, int], ...] | None = None  # `spans` of a soft joint, where they are others

    def spans_for(self, config: Config) -> list[tuple[float, float, int]]:
        """For this joint: what the network adds to the acceleration goes with q over its inertia squared."""
        spans = self.spans if config.reducer is None or self.of_soft is None else self.of_soft
        scale = (config.joint.inertia_kgm2 / Q_INERTIA_kgm2) ** 2
        sizes = [scale if key == "q" else 1.0 for key in self.keys]
        return [(low * size, high * size, n) for size, (low, high, n) in zip(sizes, spans, strict=True)]

    def beyond(self, settings: LoopSettings) -> float:
        """Share by which the observer is quicker than this law bears on a joint a little different from the model."""
        return max(settings.observer_radps / self.most_observer_radps - 1.0, 0.0)

    def unusual(self, settings: LoopSettings) -> float:
        """What values far from the usual ones cost, in the logarithm of the error."""
        far = 0.0
        if self.usual_observer_radps is not None:
            far += math.log(settings.observer_radps / self.usual_observer_radps) ** 2
        if "link_cutoff_Hz" in self.keys:
            far += math.log(settings.link_cutoff_Hz / _highest_link_cutoff_Hz(settings.cutoff_Hz)) ** 2
        return UNUSUAL * far

    def settings(self, settings: LoopSettings, logarithms: Array, kp_of_kv: float) -> LoopSettings:
        """With these values, to three digits."""
        values: dict[str, Any] = {
            key: float(f"{math.exp(x):.3g}") for key, x in zip(self.keys, logarithms, strict=True)
        }
        if "cutoff_Hz" in values:
            values["cutoff_Hz"] = min(values["cutoff_Hz"], float(f"{HIGHEST_CUTOFF / settings.period_s:.3g}"))
            highest_Hz = _highest_link_cutoff_Hz(values["cutoff_Hz"])
            values["link_cutoff_Hz"] = min(values.get("link_cutoff_Hz", math.inf), highest_Hz)
        values["kp"] = float(f"{kp_of_kv * values['kv'] ** 2:.3g}")
        if "observer_radps" in values:
            values["observer_radps"] = max(values["observer_radps"], LEAST_OBSERVER_radps)
        if "q" in values:
            values["q"] = (values["q"], values["q"])
        return replace(settings, **values)

    def logarithms(self, settings: LoopSettings) -> Array:
        """What `settings` takes; of a filter of the link that is as high as the velocity's allows, the usual one."""
        values = {key: np.max(getattr(settings, key)) for key in self.keys}
        if values.get("link_cutoff_Hz", 0.0) >= _highest_link_cutoff_Hz(settings.cutoff_Hz):
            values["link_cutoff_Hz"] = USUAL_LINK_CUTOFF_Hz
        return np.log(list(values.values()))

    def free(self, logarithms: Array) -> Array:
        """Indices of the values that count there: the link's filter does not behind a lower one of all velocity."""
        low = _highest_link_cutoff_Hz(math.exp(logarithms[-1])) < USUAL_LINK_CUTOFF_Hz
        return np.array([i for i, key in enumerate(self.keys) if not (low and key == "link_cutoff_Hz")])

    def starts(self, best_first: list[Judged]) -> list[Array]:
        """Where to search: the best ones, each in a valley of its own, since a filter far lower bears other gains."""
        found: list[Array] = []
        for one in best_first:
            x = self.logarithms(one.settings)
            if all(abs(x[-1] - other[-1]) > 1.0 for other in found):
                found.append(x)
        return found[:_STARTS]


def _highest_link_cutoff_Hz(cutoff_Hz: float) -> float:
    """Of the filter of the link's velocity behind one of `cutoff_Hz` of all velocity; to three digits."""
    return float(f"{min(USUAL_LINK_CUTOFF_Hz, LINK_CUTOFF * cutoff_Hz):.3g}")


_MOTOR_ENCODER = Law(
    "motor_encoder", lambda: shipped_control("realistic"), ("kv", "observer_radps", "cutoff_Hz"),
    ((4.0, 60.0, 6), (12.0, 110.0, 6), (8.0, 450.0, 3)), (KP_OF_KV,), LARGEST_OBSERVER_radps,
    noise_share=SOFT_NOISE_SHARE, ripple_radps=RIPPLE_OF_TWO_radps, encoders=Encoders.MOTOR,
)  # fmt: skip
LAWS = {
    "precise": Law(
        "precise", lambda: shipped_control("precise"), ("kv", "observer_radps", "cutoff_Hz"),
        ((15.0, 300.0, 6), (6.0, 45.0, 6), (80.0, 450.0, 6)), (0.25,), QUICKEST_OBSERVER_radps, USUAL_OBSERVER_radps,
        of_soft=((4.0, 300.0, 8), (6.0, 45.0, 5), (5.0, 450.0, 6)),
    ),
    "paper": Law(
        "paper", lambda: shipped_control("paper"), ("kv", "q"), ((12.0, 120.0, 6), (60.0, 6000.0, 6)), (0.25,),
    ),
    "two_encoders": replace(
        _MOTOR_ENCODER, name="two_encoders", keys=("kv", "observer_radps", "link_cutoff_Hz", "cutoff_Hz"),
        spans=((4.0, 60.0, 6), (12.0, 110.0, 6), (30.0, USUAL_LINK_CUTOFF_Hz, 2), (8.0, 450.0, 3)),
        kp_of_kv=(KP_OF_KV, LATE_KP_OF_KV), sensitivity=2.4, encoders=Encoders.BOTH,  # 2 is far too soft if late
    ),
    "link_encoder": Law(
        "link_encoder", lambda: shipped_control("realistic"), ("kv", "observer_radps", "cutoff_Hz"),
        ((3.0, 40.0, 7), (4.0, 60.0, 6), (5.0, 80.0, 4)), (KP_OF_KV,), LARGEST_OBSERVER_radps,
        noise_share=SOFT_NOISE_SHARE, encoders=Encoders.LINK,
    ),
}  # fmt: skip
_FLEXIBLE = {  # by what the law of a flexible joint reads
    Encoders.BOTH: LAWS["two_encoders"],
    Encoders.LINK: LAWS["link_encoder"],
    Encoders.MOTOR: _MOTOR_ENCODER,
}


def require_encoders(config: Config, wanted: str) -> None:
    """`ConfigurationError` where the law that is `wanted` is for other encoders than there are."""
    law = LAWS.get(wanted)
    if law is not None and law.encoders not in (None, _encoders_of(config)):
        raise ConfigurationError(f"{config.path}: --law (={wanted}) needs {NEEDED[law.encoders]}")


def _encoders_of(config: Config) -> Encoders:
    if config.encoder.side == "joint":
        return Encoders.LINK
    return Encoders.MOTOR if config.joint_encoder is None else Encoders.BOTH


def chosen_law(config: Config, wanted: str) -> Law:
    """`wanted` "auto": that of the encoders where the reducer is soft and one of them sees the link, else precise."""
    if wanted == "auto":
        there = None if config.reducer is None else _encoders_of(config)
        fitting = (name for name, law in LAWS.items() if there is not None and law.encoders == there)
        return LAWS[next(fitting, "precise")]
    require_encoders(config, wanted)
    if LAWS[wanted].encoders is not None and config.reducer is None:
        raise ConfigurationError(f"--law (={wanted}) needs a reducer that is seen to be soft")
    return LAWS[wanted]


@dataclass(frozen=True, eq=False)
class Judged:
    """One choice of gains; margins are those of the worst joint in the intervals."""

    settings: LoopSettings
    error: float  # of tracking, in any unit
    phase_margin_deg: float
    gain_margin: float
    sensitivity: float
    noise_Nm: float
    step_Nm: float  # of the torque, when an encoder counts one on
    gate_deg: float  # least phase margin of the joints of the gate
    gate_sensitivity: float  # and their largest |S|
    believed: Array = field(repr=False)  # closed loop of the joint as it is believed, (states, states)

    @property
    def settling_s(self) -> float:  # of its slowest mode
        return -self.settings.period_s / math.log(np.max(np.abs(poles_of(self.believed))))

    @property
    def stable(self) -> bool:
        return self.error < UNSTABLE


@dataclass(frozen=True)
class Goals:
    noise_Nm: float
    step_Nm: float
    gate_deg: float
    gate_sensitivity: float
    phase_margin_deg: float
    gain_margin: float
    sensitivity: float

    def missed(self, one: Judged) -> dict[str, float]:
        """By what share each goal is missed; empty if none is."""
        shares = {
            f"phase margin {one.phase_margin_deg:.1f} of {self.phase_margin_deg:.3g} deg":
                1.0 - one.phase_margin_deg / self.phase_margin_deg,
            f"gain margin {one.gain_margin:.2f} of {self.gain_margin:.3g}": 1.0 - one.gain_margin / self.gain_margin,
            f"|S| {one.sensitivity:.2f}, {self.sensitivity:.3g} at most": one.sensitivity / self.sensitivity - 1.0,
            f"kv {one.settings.kv:.2g}, {LEAST_KV_1ps:g} 1/s at least":
                math.log(max(LEAST_KV_1ps / one.settings.kv, 1.0)),
            f"torque noise {text_Nm(one.noise_Nm, 2)}, {self.noise_Nm:.2g} at most": one.noise_Nm / self.noise_Nm - 1.0,
            f"one count moves the torque by {text_Nm(one.step_Nm, 2)}, {text_Nm(self.step_Nm, 2)} at most":
                one.step_Nm / self.step_Nm - 1.0,
            f"phase margin of the gate {one.gate_deg:.1f} of {GRID_SPARE * self.gate_deg:.3g} deg and 3 % to spare":
                1.0 - one.gate_deg / self.gate_deg if self.gate_deg > 0.0 else 0.0,
            f"|S| of the gate {one.gate_sensitivity:.2f}, {self.gate_sensitivity / GRID_SPARE:.3g} less 3 % at most":
                one.gate_sensitivity / self.gate_sensitivity - 1.0,
        }  # fmt: skip
        return {name: share for name, share in shares.items() if share > 1e-3}


@dataclass(frozen=True)
class ChosenGains:
    """What the search found, and everything it tried."""

    law: Law
    objective: str
    best: Judged
    missed: dict[str, float]
    tried: tuple[Judged, ...]
    goals: Goals
    control: Control

    def allows(self, one: Judged) -> bool:
        """Whether it could have been chosen: every goal is met, and the observer is no quicker than the law bears."""
        return not self.goals.missed(one) and self.law.beyond(one.settings) == 0.0

    def with_gains(self, one: Judged) -> Control:
        """[control] with the gains of another choice."""
        learning = converging(one.settings, self.control.learning)
        return self.control.model_copy(update={**_changes(one.settings, self.law), "learning": learning})

    def changes(self) -> dict[str, Any]:
        """Keys of [control]: gains and filters of the best one."""
        return _changes(self.best.settings, self.law)


def joints_within(config: Config, intervals: Intervals) -> list[float | TwoMasses]:
    """The joint as it is believed, first, then at the ends of its intervals and of the payload."""
    inertia = max(intervals.inertia, LEAST_INERTIA_SHARE)
    payload = sorted({1.0, *config.margin.payload_range})
    ends = (1.0, 1.0 - inertia, 1.0 + inertia)
    if config.reducer is None:
        if "payload_range" not in config.margin.model_fields_set:  # that by itself is of a link behind a soft reducer
            payload = [1.0]
        return [config.joint.inertia_kgm2 * factor for factor in (1.0, *(p * end for p in payload for end in ends))]
    stiffness = max(intervals.stiffness, LEAST_STIFFNESS_SHARE)
    believed = two_masses(config, config.reducer, 1.0, 1.0, False)
    found = [believed, *(replace(believed, motor_kgm2=end * believed.motor_kgm2) for end in ends[1:])]
    sides = (-1.0, 1.0)
    if intervals.tells_link:
        link = max(intervals.link, LEAST_INERTIA_SHARE)
        shares = [replace(believed, link_kgm2=(1.0 + side * link) * believed.link_kgm2) for side in sides]
    else:
        half = min(intervals.link * believed.link_kgm2, 0.9 * min(believed.link_kgm2, believed.motor_kgm2))
        shares = [_with_link(believed, believed.link_kgm2 + side * half) for side in sides]
    found += [
        replace(one, link_kgm2=p * one.link_kgm2, stiffness_Nmprad=(1.0 + side * stiffness) * one.stiffness_Nmprad)
        for p in payload
        for one in shares
        for side in sides
    ]
    return list(found)


def _with_link(joint: TwoMasses, link_kgm2: float) -> TwoMasses:
    """With another share of the link, the same resonance and damping of it."""
    motor_kgm2 = joint.motor_kgm2 + joint.link_kgm2 - link_kgm2
    factor = motor_kgm2 * link_kgm2 / (joint.motor_kgm2 * joint.link_kgm2)
    return TwoMasses(motor_kgm2, link_kgm2, factor * joint.stiffness_Nmprad, factor * joint.damping_Nmspr)


def steady_joints(config: Config) -> list[TwoMasses]:
    """As stiff as under a steady torque, at both ends of the payload: hysteresis adds nothing to a large motion."""
    reducer = config.reducer
    if reducer is None or reducer.loop_stiffness_Nmprad is None:
        return []
    softer = min(max(reducer.stiffness_Nmprad / reducer.loop_stiffness_Nmprad, SOFTEST), 1.0)  # it may be a guess
    return [two_masses(config, reducer, payload, softer, False) for payload in config.margin.payload_range]


def lossless_joints(config: Config) -> list[TwoMasses]:
    """Hardly damped, as soft and as stiff as hysteresis leaves it: the response does not tell its loss from damping."""
    reducer = config.reducer
    if reducer is None or reducer.loop_stiffness_Nmprad is None:
        return []
    joints = [two_masses(config, reducer, 1.0, stiffness, False) for stiffness in (SOFTEST, 1.0)]
    return [replace(one, damping_Nmspr=min(one.damping_Nmspr, LEAST_DAMPING * one.critical_Nmspr)) for one in joints]


def latest_s(settings: LoopSettings, intervals: Intervals) -> float:
    """The loop delay at the late end."""
    return settings.delay_s + max(intervals.late_s, LEAST_LATE_s)


class _Search:
    def __init__(self, config: Config, law: Law, intervals: Intervals, settings: LoopSettings) -> None:
        self.law, self.nominal, self.kp_of_kv = law, settings, law.kp_of_kv[0]
        self.tried: list[Judged] = []
        period_s = self.nominal.period_s
        self._omega = _frequencies_radps(config, period_s)
        self._z = np.exp(1j * self._omega * period_s)
        late_s = latest_s(settings, intervals)  # for all of them
        within = joints_within(config, intervals)
        joints = [sampled_joint(period_s, late_s, settings.lag_s, joint, settings.encoders) for joint in within]
        self._of_goals = len(joints)
        # the link is what is to be where it should be, whichever encoder the law reads
        link = sampled_joint(period_s, late_s, settings.lag_s, within[0], Encoders.BOTH)
        self._link = link.response(self._z)[:, 0, 0]
        joints += [linear_loop(case).joint for case in cases(settings)]
        lossless = lossless_joints(config)
        large = steady_joints(config) + lossless
        joints += [
            sampled_joint(period_s, settings.delay_s, settings.lag_s, joint, settings.encoders) for joint in large
        ]
        self._eased = np.ones(len(joints))
        if settings.encoders == Encoders.LINK:
            self._eased[len(joints) - len(lossless) :] = EASED
        self._responses = np.array([joint.response(self._z)[..., 0] for joint in joints])
        plants = [joint.state_space() for joint in joints]
        sizes = [len(plant.a) for plant in plants]  # by their delay
        self._believed = plants[0]
        self._plants = [
            StateSpace(*(np.array([getattr(plants[i], name) for i in np.flatnonzero(alike)]) for name in "abcd"))
            for alike in (np.equal(sizes, size) for size in sorted(set(sizes)))
        ]
        counts = [law_resolution_rad(config), abs(joint_rad_per_count(config))]
        self._count_rad = np.array(counts if settings.encoders == Encoders.BOTH else counts[:1])

    def judged(self, logarithms: Array) -> Judged:
        self.tried.append(self._judge(self.law.settings(self.nominal, logarithms, self.kp_of_kv)))
        return self.tried[-1]

    def _judge(self, settings: LoopSettings) -> Judged:
        controller = CONTROLLERS[settings.kind](settings)
        believed = closed_loop(self._believed, controller)
        loops = [closed_loop(plants, controller) for plants in self._plants]
        if not all(come_to_rest(alike) for alike in loops):
            worst = max(float(np.max(np.abs(poles_of(alike)))) for alike in loops)
            if worst >= 1.0:
                return Judged(settings, UNSTABLE * worst, 0.0, 1.0, UNSTABLE, 0.0, 0.0, 0.0, UNSTABLE, believed)
        law = row_response(controller, self._z)
        open_loops = -np.einsum("fe,jfe->jf", law, self._responses)  # joints, frequencies, encoders
        phases, gains, peaks = margins_on_grid(open_loops)
        phases, peaks = phases * self._eased, peaks / self._eased
        own, gate = slice(self._of_goals), slice(self._of_goals, None)
        sensitivity = 1.0 / (1.0 + open_loops[0])
        error = self._link * sensitivity * np.hypot(1.0 / self._omega, 1.0 / self.law.ripple_radps)
        noise = np.abs(law * sensitivity[:, None]) ** 2 @ (self._count_rad**2 / 12.0)
        return Judged(
            settings, math.sqrt(np.trapezoid(np.abs(error) ** 2, self._omega)),
            float(np.min(phases[own])), float(np.min(gains[own])), float(np.max(peaks[own])),
            math.sqrt(np.trapezoid(noise, self._omega) * settings.period_s / math.pi),
            float(np.max(np.abs(controller.d[0]) * self._count_rad)),
            float(np.min(phases[gate], initial=90.0)), float(np.max(peaks[gate], initial=1.0)),
            believed,
        )  # fmt: skip


def _frequencies_radps(config: Config, period_s: float) -> Array:
    """Up to half the rate; closer about a resonance, whose peak is narrower than the other steps."""
    highest = math.pi / period_s
    omega: Array = np.geomspace(math.tau * _LOWEST_Hz, highest, _POINTS)
    if config.reducer is None:
        return omega
    near = math.tau * two_masses(config, config.reducer, 1.0, 1.0, False).resonance_Hz * np.geomspace(*_NEAR)
    return np.unique(np.concatenate((omega, near[near < highest])))


def choose_gains(
    config: Config, intervals: Intervals, wanted: str = "auto", objective: str = "tracking"
) -> ChosenGains:
    """With a law for the joint that was identified, which the configuration holds; a second.

    A joint that sticks and slips whatever is fed forward, rigid or with the encoder on the link alone, has neither
    adaptation nor pairing: what adapts takes each slip for friction, and throws the joint at the next reversal.
    """
    law = chosen_law(config, wanted)
    ready = config.model_copy(update={"control": _control(config, law.control())})
    found = _chosen(ready, law, intervals, loop_settings(ready)[0], objective)
    slips = friction_fall_Nmspr(config) > SLIPS * config.joint.inertia_kgm2 * found.best.settings.kv
    if slips and (config.reducer is None or law.encoders is Encoders.LINK):
        return replace(found, control=found.control.model_copy(update={"adaptation": None, "observer_paired": False}))
    return found


def gains_of_file(config: Config, settings: LoopSettings) -> ChosenGains:
    """For the law of a configuration, whose loop is `settings`, on the joint that it believes in; a second."""
    kind = config.control.kind
    if kind == "flexible_joint":
        law = _FLEXIBLE[settings.encoders]
    elif kind in OF_RIGID:
        law = LAWS[OF_RIGID[kind]]
    else:
        known = ", ".join(("flexible_joint", *OF_RIGID))
        raise ConfigurationError(f"{config.path}: gains are chosen for control.kind (={kind}) of {known} only")
    if kind in OBSERVING:
        settings = replace(settings, observer_delay_cycles=_observed_late(settings.delay_s + settings.lag_s, config))
    believed = replace(BELIEVED, friction_radps2=(static_friction_Nm(config) or 0.0) / config.joint.inertia_kgm2)
    return _chosen(config, law, believed, settings, "tracking")


def _chosen(config: Config, law: Law, intervals: Intervals, settings: LoopSettings, objective: str) -> ChosenGains:
    """The search, from the [control] of the configuration."""
    from scipy.optimize import minimize  # here: only a search waits for it

    limit_Nm, left_Nm = config.limits.torque_max_Nm, free_torque_Nm(config)
    ends = zip((PHASE_MARGIN_deg, GAIN_MARGIN, law.sensitivity), STICKY, strict=True)
    wanted = (float(np.interp(intervals.friction_radps2, STICKY_radps2, pair)) for pair in ends)
    gate_deg, gate_s = config.margin.min_phase_margin_deg / GRID_SPARE, GRID_SPARE * settings.largest_s
    step_Nm = GRID_SPARE * (left_Nm if left_Nm > 0.0 else limit_Nm)  # the gate refuses a joint that leaves nothing
    goals = Goals(law.noise_share * limit_Nm, step_Nm, gate_deg, gate_s, *wanted)
    search = _Search(config, law, intervals, settings)
    spans = law.spans_for(config)

    def cost(one: Judged, least_error: float | None) -> float:
        if not one.stable:
            return 100.0 + math.log(one.error)
        missed = PENALTY * (sum(goals.missed(one).values()) + law.beyond(one.settings)) + law.unusual(one.settings)
        if objective == "settling":
            return math.log(one.settling_s) + 0.2 * math.log(one.error) + missed
        if least_error is not None:
            allowed = QUIET_ERROR * least_error
            return math.log(one.noise_Nm) + PENALTY * max(math.log(one.error / allowed), 0.0) + missed
        return math.log(one.error) + missed

    def best_of(least_error: float | None) -> Judged:
        search.kp_of_kv = law.kp_of_kv[0]
        if not search.tried:
            for point in product(*(np.geomspace(*span) for span in spans)):
                search.judged(np.log(point))

        of = functools.cache(functools.partial(cost, least_error=least_error))

        def lowest_from(x: Array, step: float) -> Judged:
            free = law.free(x)

            def near(values: Array) -> float:
                there = x.copy()
                there[free] = values
                return of(search.judged(there))

            options = {"maxfev": _EVALUATIONS, "xatol": 0.01, "fatol": 0.01,
                       "initial_simplex": x[free] + step * np.eye(len(free) + 1, len(free), -1)}  # fmt: skip
            minimize(near, x[free], method="Nelder-Mead", options=options)
            return min(search.tried, key=of)

        for x in law.starts(sorted(search.tried, key=of)):
            best = lowest_from(x, -0.3)
        for kp_of_kv, step in product(law.kp_of_kv, _AGAIN):
            search.kp_of_kv = kp_of_kv
            best = lowest_from(law.logarithms(best.settings), step)  # a simplex that shrank in a curved valley
        return best

    best = best_of(None)
    if objective == "quiet" and best.stable:
        best = best_of(best.error)
    chosen = config.control.model_copy(update=_changes(best.settings, law))
    return ChosenGains(
        law, objective, best, goals.missed(best), tuple(search.tried), goals,
        chosen.model_copy(update={"learning": converging(best.settings, chosen.learning)}),
    )  # fmt: skip


def _control(config: Config, control: Control) -> Control:
    """The law's own [control] for this joint: what is late, and the friction that is known."""
    late_s = (config.margin.loop_delay_s or 0.0) + config.margin.current_lag_s
    feed_forward = control.feed_forward
    if config.friction is None:
        feed_forward = "none"
    elif config.friction.lugre is None and feed_forward == "lugre_desired":
        feed_forward = "desired"
    adaptation, paired = None, False
    observes = control.kind in OBSERVING
    if observes and feed_forward == "lugre_desired":
        adaptation = config.control.adaptation or Adaptation()
        paired = control.kind != "flexible_joint"  # which pairs anyway
    update: dict[str, Any] = {
        "feed_forward": feed_forward, "feed_forward_lead_s": 0.0 if feed_forward == "none" else round(late_s, 6),
        "adaptation": adaptation, "observer_paired": paired,
    }  # fmt: skip
    if observes:
        update["observer_delay_cycles"] = _observed_late(late_s, config)
        update["learning"] = at_rate(control.learning, config.loop.rate_Hz) or config.control.learning
    return control.model_copy(update=update)


def _observed_late(late_s: float, config: Config) -> int:
    """control.observer_delay_cycles for that much of delay and lag."""
    return min(max(round(late_s * config.loop.rate_Hz), 1), 15)


def _changes(settings: LoopSettings, law: Law) -> dict[str, Any]:
    """Keys of [control]."""
    names = {"cutoff_Hz": "velocity_cutoff_Hz", "q": "lyapunov_q"}
    named: dict[str, Any] = {"kp": settings.kp}
    for key in law.keys:
        named[names.get(key, key)] = getattr(settings, key)
        if key == "observer_radps":
            named["observer_delay_cycles"] = settings.observer_delay_cycles
    return named


def apart(one: LoopSettings, other: LoopSettings) -> float:
    """Greatest difference of the gains, of their logarithms."""
    pairs = [(getattr(one, key), getattr(other, key)) for key in ("kv", "observer_radps", "cutoff_Hz")]
    return max((abs(math.log(a / b)) for a, b in pairs if a > 0.0 and b > 0.0), default=0.0)
