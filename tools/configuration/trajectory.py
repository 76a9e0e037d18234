"""The [trajectory] section: one model per kind of motion; which keys exist depends on `kind`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from tools.configuration.sections import Angle, Section, between

Duration = Annotated[float, between(0.0, 1e6)]  # 0 = until stopped
Frequency = Annotated[float, between(0.0, 100.0, open_low=True)]
Time = Annotated[float, between(-1e6, 1e6)]
Move = Annotated[float, between(0.001, 1e5)]


class SineSwitch(Section):
    """The second sine, from at_s on."""

    at_s: Annotated[float, between(0.0, 1e6, open_low=True)]
    amplitude_rad: Angle
    frequency_Hz: Frequency
    shift_s: Time
    offset_rad: Angle


class Sine(Section):
    kind: Literal["sine"]
    duration_s: Duration
    amplitude_rad: Angle
    frequency_Hz: Frequency
    shift_s: Time = 0.0
    offset_rad: Angle = 0.0
    switch: SineSwitch | None = None


class MinJerk(Section):
    kind: Literal["min_jerk"]
    duration_s: Duration
    start_rad: Angle
    target_rad: Angle
    move_s: Move
    dwell_s: Annotated[float, between(0.0, 1e5)] = 0.0
    repeat: bool = False


class Trapezoid(Section):
    kind: Literal["trapezoid"]
    duration_s: Duration
    start_rad: Angle
    target_rad: Angle
    speed_radps: Annotated[float, between(0.0, 1000.0, open_low=True)]
    acceleration_radps2: Annotated[float, between(0.0, 1e5, open_low=True)]
    dwell_s: Annotated[float, between(0.0, 1e5)] = 0.0
    repeat: bool = False


class Table(Section):
    kind: Literal["table"]
    duration_s: Duration
    file: Annotated[str, Field(min_length=1)]  # CSV beside the configuration: time_s,position_rad
    repeat: bool = False


class Hold(Section):
    kind: Literal["hold"]
    duration_s: Duration
    position_rad: Angle = 0.0


Trajectory = Annotated[Sine | MinJerk | Trapezoid | Table | Hold, Field(discriminator="kind")]
