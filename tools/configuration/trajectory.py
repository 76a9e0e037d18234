"""The [trajectory] section: one model per kind of motion; which keys exist depends on `kind`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from jointctl.tools.configuration.sections import Angle, Section, between

Duration = Annotated[float, between(0.0, 1e6)]  # 0 = until stopped
Frequency = Annotated[float, between(0.0, 100.0, open_low=True)]
Time = Annotated[float, between(-1e6, 1e6)]
Move = Annotated[float, between(0.001, 1e5)]


class SineSwitch(Section):
    """The second sine, from at_s on."""

    at_s: Annotated[float, between(0.0, 1e6, open_low=True)]  # trajectory time
    amplitude_rad: Angle  # from then on
    frequency_Hz: Frequency  # from then on
    shift_s: Time  # from then on
    offset_rad: Angle  # from then on


class Sine(Section):
    kind: Literal["sine"]  # offset_rad + amplitude_rad sin(2 pi frequency_Hz (t + shift_s))
    duration_s: Duration  # 0 = until stopped
    amplitude_rad: Angle  # to each side of the offset
    frequency_Hz: Frequency  # of the sine
    shift_s: Time = 0.0  # earlier by this time
    offset_rad: Angle = 0.0  # middle of the motion
    switch: SineSwitch | None = None


class MinJerk(Section):
    kind: Literal["min_jerk"]  # from start to target without jerk at the ends
    duration_s: Duration  # 0 = until stopped
    start_rad: Angle  # where it begins
    target_rad: Angle  # where it ends
    move_s: Move  # of one move
    dwell_s: Annotated[float, between(0.0, 1e5)] = 0.0  # rest at each end
    repeat: bool = False  # back and forth


class Trapezoid(Section):
    kind: Literal["trapezoid"]  # from start to target at constant acceleration, speed, deceleration
    duration_s: Duration  # 0 = until stopped
    start_rad: Angle  # where it begins
    target_rad: Angle  # where it ends
    speed_radps: Annotated[float, between(0.0, 1000.0, open_low=True)]  # on the level part
    acceleration_radps2: Annotated[float, between(0.0, 1e5, open_low=True)]  # also of the deceleration
    dwell_s: Annotated[float, between(0.0, 1e5)] = 0.0  # rest at each end
    repeat: bool = False  # back and forth


class Table(Section):
    kind: Literal["table"]  # a cubic spline through the rows of a file
    duration_s: Duration  # 0 = until stopped
    file: Annotated[str, Field(min_length=1)]  # CSV beside the configuration: time_s,position_rad
    repeat: bool = False  # start again at the end, which must meet the beginning


class Hold(Section):
    kind: Literal["hold"]  # stand still
    duration_s: Duration  # 0 = until stopped
    position_rad: Angle = 0.0  # where to stand


Trajectory = Annotated[Sine | MinJerk | Trapezoid | Table | Hold, Field(discriminator="kind")]
