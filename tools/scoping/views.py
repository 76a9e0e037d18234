"""What the scope's picture can show of the chosen signals: over time, one against another, or as spectra.

A view is columns of numbers: the picture draws few of its points, cursors and CSV take all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from jointctl.tools.recording.run_summary import drawn_indices
from jointctl.tools.scoping.history import POINTS, GAP_s, History

TIME, AGAINST, SPECTRUM = "time", "x-y", "spectrum"
TIME_NAME = "time [s]"
VIEWS = (TIME, AGAINST, SPECTRUM)
LEAST_SAMPLES = 16  # of a spectrum
LEAST_AMPLITUDE = 1e-8  # a logarithmic axis has no zero


@dataclass(frozen=True)
class Seen:
    """`x`, shape (N,), and one column of that length for each signal; nan where a signal has no meaning."""

    x_name: str
    x: np.ndarray
    columns: Mapping[str, np.ndarray]

    def drawn(self, name: str) -> list[list[float]]:
        """[x, value] of a signal, at most about POINTS: the least and the greatest of each stretch."""
        values = self.columns[name]
        keep = drawn_indices(values, POINTS)
        keep = keep[np.isfinite(values[keep]) & np.isfinite(self.x[keep])]
        pairs: list[list[float]] = np.stack([self.x[keep], values[keep]], axis=1).tolist()
        return pairs

    def at(self, x: float, name: str) -> float:
        """A signal's value there, between two samples on the line through them; nan outside of them."""
        if len(self.x) == 0:
            return float("nan")
        return float(np.interp(x, self.x, self.columns[name], left=np.nan, right=np.nan))

    def csv(self, low: float, high: float) -> str:
        """Rows with x from `low` to `high`, under the names of the columns; nothing where there is no value."""
        chosen = (self.x >= low) & (self.x <= high)
        table = np.column_stack([self.x, *self.columns.values()])[chosen]
        rows = (",".join("" if np.isnan(value) else f"{value:.9g}" for value in row) for row in table)
        return "\n".join([",".join([self.x_name, *self.columns]), *rows, ""])


def seen(view: str, history: History, rows: np.ndarray, names: Sequence[str]) -> Seen:
    """The records as a view shows them."""
    columns = {name: history.values(rows, name) for name in names}
    time_s = history.seconds(rows)
    if view == AGAINST and len(names) > 1:
        first = names[0]
        return Seen(first, columns.pop(first), columns)
    if view == SPECTRUM:
        return spectra(time_s, columns)
    return Seen(TIME_NAME, time_s, columns)


def spectra(time_s: np.ndarray, columns: Mapping[str, np.ndarray]) -> Seen:
    """Amplitudes over frequency [Hz], without the mean: a sine's peak is its amplitude (Hann window).

    Of the longest stretch without a gap in which every signal has a meaning; frequencies up to half the mean rate.
    """
    fine = np.all([np.ones(len(time_s), bool), *(np.isfinite(values) for values in columns.values())], axis=0)
    changes = np.flatnonzero((np.diff(time_s) > GAP_s) | (fine[1:] != fine[:-1])) + 1
    ends = [0, *changes.tolist(), len(time_s)]
    stretches = [slice(a, b) for a, b in pairwise(ends) if b > a and fine[a]]
    chosen = max(stretches, key=lambda part: part.stop - part.start, default=slice(0, 0))
    time_s = time_s[chosen]
    count = len(time_s)
    if count < LEAST_SAMPLES:
        return Seen("frequency [Hz]", np.zeros(0), {name: np.zeros(0) for name in columns})
    even_s = np.linspace(time_s[0], time_s[-1], count)  # a skipped cycle is bridged
    window = np.hanning(count)
    scale = 2.0 / np.sum(window)

    def amplitudes(values: np.ndarray) -> np.ndarray:
        even = np.interp(even_s, time_s, values[chosen])
        return np.maximum(np.abs(np.fft.rfft((even - even.mean()) * window)) * scale, LEAST_AMPLITUDE)

    frequency_Hz = np.fft.rfftfreq(count, (even_s[-1] - even_s[0]) / (count - 1))
    return Seen("frequency [Hz]", frequency_Hz, {name: amplitudes(values) for name, values in columns.items()})


def readings(found: Seen, a: float, b: float) -> str:
    """Both cursors and their difference in each signal, as lines of a table."""
    unit = found.x_name[found.x_name.index("[") + 1 : -1]
    inverse = f"   1/(B - A) = {1.0 / (b - a):.5g} Hz" if unit == "s" and a != b else ""
    lines = [f"{'':28}{'A':>12}{'B':>12}{'B - A':>12}", f"{found.x_name:28}{a:12.5g}{b:12.5g}{b - a:12.5g}{inverse}"]
    for name in found.columns:
        at_a, at_b = found.at(a, name), found.at(b, name)
        lines.append(f"{name:28}{_shown(at_a)}{_shown(at_b)}{_shown(at_b - at_a)}")
    return "\n".join(lines)


def _shown(value: float) -> str:
    return f"{'-':>12}" if np.isnan(value) else f"{value:12.5g}"
