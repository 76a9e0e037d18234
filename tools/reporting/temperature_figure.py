"""The drive's temperature over a run, where it tells one."""

from __future__ import annotations

from typing import Any

from jointctl.tools.drawing import RED
from jointctl.tools.recording.run_log_reader import RunLog
from jointctl.tools.reporting.figure import draw
from jointctl.tools.reporting.page import Figure

LEAST_READINGS = 10  # fewer are told by the table


def temperature_figure(log: RunLog) -> list[Figure]:
    """One figure, or none."""
    if len(log.temperatures) < LEAST_READINGS:
        return []
    time_s = (log.temperatures["time_ns"] - log.records["time_ns"][0]) * 1e-9

    def paint(figure: Any) -> None:
        axes = figure.subplots()
        axes.plot(time_s, log.temperatures["temperature_degC"], color=RED, drawstyle="steps-post")
        axes.set_ylabel("temperature [°C]")
        axes.set_xlabel("time [s]")

    return [draw(2.2, paint, "Temperature of the drive over time", "As the drive tells it, once a second.")]
