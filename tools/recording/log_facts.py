"""What a run log tells about itself: when it began, what happened, whether records are missing."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np

from jointctl.tools.recording.log_export import calendar_offset_ns
from jointctl.tools.recording.run_log import ERROR, THINNING, WARNING, Event
from jointctl.tools.recording.run_log_reader import RunLog

_LEVELS = ((ERROR, "error"), (WARNING, "warning"), (20, "information"), (0, "debug"))


def missing_records(records: Any) -> int:
    """Cycles that the loop executed but the log does not hold: the cycle counter jumps by more than was skipped."""
    if len(records) < 2:
        return 0
    jumps = np.diff(np.asarray(records["cycle"], np.int64)) - 1 - np.asarray(records["skipped"][1:], np.int64)
    return int(np.sum(np.maximum(jumps, 0)))


def missing_in(log: RunLog) -> int | None:
    """`missing_records` of a log; None where records were left out on purpose, so that nobody can tell."""
    return None if THINNING in log.metadata else missing_records(log.records)


def kept_share(log: RunLog) -> str:
    """Which records a thinned log holds, in words; "" for one that holds all."""
    thinning = log.metadata.get(THINNING)
    return f"every {thinning['every']}th, the last {thinning['whole_s']} s whole" if thinning else ""


def began_at(log: RunLog) -> str:
    """Local time of the first record; "" if the log does not tell."""
    offset_ns = calendar_offset_ns(log)
    if not offset_ns or not len(log.records):
        return ""
    at = datetime.fromtimestamp((int(log.records["time_ns"][0]) + offset_ns) * 1e-9, UTC)
    return at.astimezone().isoformat(sep=" ", timespec="seconds")


def event_rows(log: RunLog) -> list[tuple[str, str, str, str]]:
    """(seconds since the first record, level, source, text) of every event."""
    start_ns = int(log.records["time_ns"][0]) if len(log.records) else log.events[0].time_ns if log.events else 0
    return [
        (f"{(event.time_ns - start_ns) * 1e-9:.3f}", level_name(event), event.source, event.text)
        for event in sorted(log.events, key=lambda event: event.time_ns)
    ]


def level_name(event: Event) -> str:
    return next(name for level, name in _LEVELS if event.level >= level)
