"""A thinned stream of records: every n-th one of the old, all of the last."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.tools.recording.thinned_records import ThinnedRecords


def numbered(count: int) -> Any:
    records = np.zeros(count, dtype_of(LogRecord)).view(np.recarray)
    records.cycle = np.arange(count)
    return records


@pytest.mark.parametrize("portions", [(100,), (1,) * 100, (7, 0, 33, 60), (99, 1)])
def test_however_they_come_the_old_ones_are_thinned_and_the_last_ones_whole(portions: tuple[int, ...]) -> None:
    records, thinned = numbered(100), ThinnedRecords(20, 30)
    ends = list(itertools.accumulate(portions))
    written = [thinned.take(records[end - count : end]).cycle for count, end in zip(portions, ends, strict=True)]
    assert list(np.concatenate(written)) == [0, 20, 40, 60]
    assert list(thinned.last().cycle) == list(range(70, 100))
    assert len(thinned.last()) == 0


def test_a_short_run_is_kept_whole() -> None:
    thinned = ThinnedRecords(20, 30)
    assert len(thinned.take(numbered(30))) == 0
    assert len(thinned.last()) == 30
