"""The drive's temperature during a run: readings into the log, the newest one for whoever watches."""

from __future__ import annotations

import time

from jointctl.drivers.drive import Thermometer
from jointctl.tools.recording.run_log import WARNING, RunLogWriter

STALE_S = 3.0  # three requests without a reading: what was read before is not the temperature any more


class TemperatureWatch:
    """`poll` it with the supervisor's other watches; a temperature that cannot be read is no reason to stop."""

    def __init__(self, thermometer: Thermometer | None = None, log: RunLogWriter | None = None) -> None:
        self._thermometer, self._log = thermometer, log
        self._told: set[str] = set()
        self.readings: list[tuple[int, float]] = []  # (CLOCK_MONOTONIC in ns, degC) of the whole run

    def poll(self) -> None:
        """Take what is new; why there is none goes into the log, each reason once."""
        reading = self._thermometer.poll() if self._thermometer is not None else None
        if reading is None:
            return
        if reading.temperature_degC is not None:
            self.readings.append((reading.time_ns, reading.temperature_degC))
            if self._log is not None:
                self._log.write_temperature(reading.time_ns, reading.temperature_degC)
        elif reading.problem not in self._told and self._log is not None:
            self._told.add(reading.problem)
            self._log.write_event(WARNING, "drive", reading.problem, reading.time_ns)

    @property
    def values_degC(self) -> list[float]:
        """All readings of the run."""
        return [value for _, value in self.readings]

    @property
    def newest_degC(self) -> float | None:
        """The newest reading, unless it is stale."""
        if not self.readings or time.monotonic_ns() - self.readings[-1][0] > STALE_S * 1e9:
            return None
        return self.readings[-1][1]
