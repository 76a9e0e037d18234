"""Section [control] with [control.learning] and [control.adaptation]: the law and its gains; docs/law.md."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

from jointctl.firmware_py.records import NEURONS, RIPPLES
from jointctl.tools.configuration.sections import Rule, Section, auto_or_number, between, is_number, numbers

CENTRES = "15 numbers or 15 pairs [rad, rad/s], each in [-100..100]"


def _centres(value: object) -> Any:
    """15 numbers, taken for both inputs as the paper does, or 15 pairs [rad, rad/s]."""

    def number(x: object) -> bool:
        return is_number(x) and abs(x) <= 100.0

    if isinstance(value, (list, tuple)) and len(value) == NEURONS:
        if all(number(x) for x in value):
            return tuple((float(x), float(x)) for x in value)
        if all(isinstance(x, (list, tuple)) and len(x) == 2 and all(number(y) for y in x) for x in value):
            return tuple((float(x[0]), float(x[1])) for x in value)
    raise PydanticCustomError("centres", "must be {allowed}", {"allowed": CENTRES})


class Learning(Section):
    """Iterative learning on a repeating trajectory, on top of computed_torque_observer or flexible_joint."""

    # share of the remaining error torque taken over in each repetition
    gain: Annotated[float, between(0.0, 1.0, open_low=True)]
    error_gain_ps2: Annotated[float, between(0.0, 1e6)] = 0.0  # weight of the error itself
    lead_cycles: Annotated[int, between(0, 100)]  # delay from command to measured effect
    half_width_cycles: Annotated[int, between(0, 100)]  # of the smoothing
    blend_s: Annotated[float, between(0.001, 100.0)] = 0.5  # over which what has been learned comes in


class Adaptation(Section):
    """Friction feed-forward that adapts to the joint whatever the motion; needs an observer and lugre_desired."""

    # of the share of each kind of bristles, at first: how far the configured friction may be off
    friction_error: Annotated[float, between(0.0, 1.0, open_low=True)] = 0.15
    # by which the whole friction of a direction may leave the configured one
    reach: Annotated[float, between(0.0, 1.0)] = 0.3
    # torque ripple to find: periods a motor turn, two at most
    ripple_per_motor_turn: Annotated[tuple[float, ...], numbers("numbers", 0, 1, RIPPLES, low=0.0, high=1000.0)] = ()
    ripple_Nm: Annotated[float, between(0.0, 1e4, open_low=True)] = (
        0.7  # expected of it, at the joint; four times at most
    )


class Control(Section):
    # docs/law.md
    kind: Literal["computed_torque", "computed_torque_rbf", "computed_torque_observer", "pid", "flexible_joint"]
    kp: Annotated[float, between(0.0, 1e6, open_low=True)]  # [1/s²] of the position error
    kv: Annotated[float, between(0.0, 1e4, open_low=True)]  # [1/s] of the velocity error
    ki: Annotated[float, between(0.0, 1e8)] = 0.0  # [1/s³] of the error's integral, pid only
    integral_limit_rads: Annotated[float, between(0.0, 1e3)] = 0.0  # pid only, 0 = none
    # bandwidth, computed_torque_observer and flexible_joint only
    observer_radps: Annotated[float, between(0.0, 2000.0)] = 0.0
    observer_delay_cycles: Annotated[int, between(0, 15)] = 1  # from a command to its torque
    # compare what was fed forward with the torque of its own command: for motions without rests, docs/law.md
    observer_paired: bool = False
    # of the Lyapunov equation: Q = q I, or diag(q1, q2)
    lyapunov_q: Annotated[tuple[float, ...], numbers("numbers", 1, 2, low=0.0, high=1e12)]
    learning_rate: Annotated[float, between(0.0, 1e9)]  # of the network's weights
    initial_weight_Nm: Annotated[float, between(-1000.0, 1000.0)]  # of each of the 15 neurons
    widths: Annotated[tuple[float, ...], numbers("widths", 1, NEURONS, low=0.0, high=1e4)]  # of the Gaussians
    centres: Annotated[tuple[tuple[float, float], ...], BeforeValidator(Rule(CENTRES, _centres))] | None = (
        None  # none = the paper's
    )
    leakage_1ps: Annotated[float, between(0.0, 100.0)] = 0.0  # pulls the weights to zero: bounded under noise
    weight_limit_Nm: Annotated[float, between(0.0, 1e6)] = 0.0  # of each weight; 0 = none
    dead_zone_rad: Annotated[float, between(0.0, 1.0)] = 0.0  # no learning at smaller errors
    # friction compensation by measured or desired velocity
    feed_forward: Literal["none", "measured", "desired", "lugre_desired"]
    zero_rule: Literal["zero", "paper", "linear"]  # friction compensation at exactly zero velocity
    zero_band_radps: Annotated[float, between(0.0, 10.0)] = 0.0  # half width of the linear zero rule
    velocity_cutoff_Hz: Annotated[float, between(0.0, 2000.0)]  # 0 = no filter
    # kalman: position, velocity and disturbance from a model, for coarse encoders; computed_torque_observer only
    velocity_filter: Literal["low_pass", "kalman"] = "low_pass"
    filtered_error_rate: bool  # filter the velocity error as a whole: no bias from the filter's lag
    # with which the link's encoder corrects the expected twist, flexible_joint with both encoders only
    twist_radps: Annotated[float, between(0.0, 1000.0, open_low=True)] = 60.0
    link_cutoff_Hz: Annotated[float, between(0.0, 2000.0)] = 60.0  # of the link's velocity there; 0 = no filter
    # of the feed-forward: the motion desired so much later, as torque is late; auto: loop delay, half a period, lag
    feed_forward_lead_s: Annotated[float | Literal["auto"], auto_or_number(0.0, 0.02)] = 0.0
    adaptation: Adaptation | None = None
    learning: Learning | None = None
