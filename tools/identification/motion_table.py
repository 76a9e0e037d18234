"""A table of others as a motion: which columns there are, in which units, of which side, one motion or several.

`ForeignFormat` says all of that; of the numbers only what cannot be otherwise is concluded: an angle that stays within
one turn of its shaft and jumps by nearly all of it goes on, and so does a counter that runs over.  A sample without a
value is left out.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from jointctl.drivers.errors import DataError, UsageError
from jointctl.tools.identification.friction_data import (
    DEGC_OF_UNIT,
    SECONDS_PER_UNIT,
    check_given,
    chosen_lines,
    motor_torque_Nm,
    rad_per_unit,
    refuse_unused_format,
    require_stated,
    require_units_of_heading,
    velocity_radps,
)
from jointctl.tools.identification.motion_data import (
    LEAST_SAMPLES,
    Motion,
    MotionSettings,
    RawMotion,
    clock_step_s,
    filtered_motion,
    joined,
    prepared_motion,
    require_motion,
)
from jointctl.tools.identification.tables import ForeignFormat, TableFile, read_table

_JUMP = 0.5  # of a period from one sample to the next: the angle has begun anew
_COUNTER_BITS = (16, 32)


def read_motion(path: Path, given: ForeignFormat, settings: MotionSettings) -> Motion:
    """A table: read, check, filter; several motions in it one after the other."""
    settings.check()
    check_given(given)
    table = chosen_lines(read_table(path, given.delimiter), given)
    _check_mapped(table, given)
    if given.motion_column is None:
        return prepared_motion(_series(table, given), settings)
    parts, notes, longest = [], list(table.notes), 0
    for name, lines in _parts(table, given):
        longest = max(longest, int(np.count_nonzero(lines)))
        if np.count_nonzero(lines) <= LEAST_SAMPLES:
            notes.append(f"{name}: {np.count_nonzero(lines)} samples: too few, left out")
            continue
        raw = _series(replace(table.only(lines), notes=()), given)
        parts.append((name, raw, clock_step_s(raw)))
    if not parts:
        most = f"the longest motion has {longest} samples: more than {LEAST_SAMPLES} are needed"
        raise DataError(f"{path}: {given.motion_column}: {most}")
    step_s = float(np.median([step for *_, step in parts]))
    motions = []
    for name, raw, _ in parts:
        motion = filtered_motion(raw, settings, step_s)
        if np.count_nonzero(motion.used(settings)) < LEAST_SAMPLES:
            notes.append(f"{name}: does not move faster than {settings.speed_min_radps:g} rad/s for long: left out")
        else:
            require_motion(raw, motion, settings)
            motions.append(replace(motion, notes=tuple(f"{name}: {note}" for note in motion.notes)))
    if not motions:
        raise DataError(f"{path}: {given.motion_column}: none of {len(parts)} motions is fast enough", "--speed-min")
    notes.insert(0, f"{len(motions)} motions by {given.motion_column}")
    whole = joined(motions, named=False)
    return replace(whole, notes=(*notes, *whole.notes))


def _parts(table: TableFile, given: ForeignFormat) -> list[tuple[str, np.ndarray]]:
    """(name, lines (N,) bool) of each motion: where a column changes, or, if it is that of the time, goes back."""
    assert given.motion_column is not None
    if given.time_column is not None and table.column(given.motion_column) == table.column(given.time_column):
        stamps_s = table.timestamps_s(given.time_column)
        begins = np.diff(table.numbers(given.time_column) if stamps_s is None else stamps_s) < 0.0
        labels: Sequence[object] = range(1, np.count_nonzero(begins) + 2)
    else:
        texts = table.texts(given.motion_column)
        begins = np.array([one != two for one, two in itertools.pairwise(texts)], bool)
        labels = [texts[0], *(texts[at + 1] for at in np.flatnonzero(begins))]
    part = np.concatenate([[0], np.cumsum(begins)])
    return [(f"motion {label}", part == number) for number, label in enumerate(labels)]


def _series(table: TableFile, given: ForeignFormat) -> RawMotion:
    """The columns of a table of one motion, without the samples that have no value."""
    assert given.ratio is not None
    ratio = given.ratio
    names = {"torque": given.torque_column or given.current_column or ""}
    torque = motor_torque_Nm(table, given, gaps=True) * ratio
    if given.time_column is not None:
        names["time"] = given.time_column
        stamps_s = table.timestamps_s(given.time_column)
        if stamps_s is not None and given.time_unit != "s":
            what = f"{given.time_column} has dates or times of day"
            raise UsageError(f"--time-unit (={given.time_unit}) is for numbers: {what}", "leave it away")
        time_s = table.numbers(given.time_column, gaps=True) if stamps_s is None else stamps_s
        known = time_s[np.isfinite(time_s)]
        time_s = (time_s - (known[0] if len(known) else 0.0)) * (
            SECONDS_PER_UNIT[given.time_unit] if stamps_s is None else 1.0
        )
    else:
        assert given.sample_rate_Hz is not None
        names["time"] = "--sample-rate"
        time_s = np.arange(len(torque)) / given.sample_rate_Hz
    raw = RawMotion(table.path, table.sha256, time_s, torque, ratio, names, notes=list(table.notes))
    if given.position_column:
        assert given.position_unit is not None
        names["position"] = given.position_column
        turns = table.numbers(given.position_column, gaps=True) * rad_per_unit(given, given.position_unit) / math.tau
        to_joint = math.tau / (ratio if (given.position_side or given.side) == "motor" else 1.0)
        raw.position_rad = _unwrapped(turns, given, raw) * to_joint * given.sign("position")
    if given.velocity_column:
        names["velocity"] = given.velocity_column
        raw.velocity_radps = velocity_radps(table, given, gaps=True)
    if given.load_column:
        names["load"] = given.load_column
        raw.load_Nm = table.numbers(given.load_column, gaps=True) * given.sign("load")
    if given.temperature_column:
        names["temperature"] = given.temperature_column
        scale, offset = DEGC_OF_UNIT[given.temperature_unit]
        raw.temperature_degC = table.numbers(given.temperature_column, gaps=True) * scale + offset
    raw.keep_known()
    raw.in_order()
    raw.keep_near()
    return raw


def _unwrapped(turns: np.ndarray, given: ForeignFormat, raw: RawMotion) -> np.ndarray:
    """An angle that stays within one turn, or a counter within its bits, and jumps by nearly all of that: continued."""
    periods = [1.0]
    if given.position_unit == "count":
        assert given.counts_per_turn is not None
        periods += [2.0**bits / given.counts_per_turn for bits in _COUNTER_BITS]
    known = np.flatnonzero(np.isfinite(turns))
    seen = turns[known]
    for period in periods:
        jumps = np.abs(np.diff(seen)) > _JUMP * period
        if len(seen) and float(np.ptp(seen)) <= period * (1.0 + 1e-6) and jumps.any():
            raw.notes.append(
                f"{raw.names['position']}: {np.count_nonzero(jumps)} jumps of a period ({period:.6g} turns): continued"
            )
            turns = turns.copy()
            turns[known] = np.unwrap(seen, period=period)
            return turns
    return turns


def _check_mapped(table: TableFile, given: ForeignFormat) -> None:
    """`UsageError` where something that a table does not tell was not given."""
    if not (given.position_column or given.velocity_column):
        missing = "--position-column or --velocity-column is missing"
        raise UsageError(missing, f"the file has: {', '.join(table.columns)}")
    side = given.side or (None if given.velocity_column else given.position_side)
    needed: list[tuple[str, object]] = [("--side", side), ("--ratio", given.ratio)]
    needed += [("--position-unit", given.position_unit)] if given.position_column else []
    needed += [("--velocity-unit", given.velocity_unit)] if given.velocity_column else []
    require_stated(table, given, needed)
    refuse_unused_format(given, timed=True)
    require_units_of_heading(table, given)
