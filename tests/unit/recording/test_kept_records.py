"""Records of a run stay whole and in order, in memory or in a file."""

from __future__ import annotations

import numpy as np
import pytest

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.tools.recording.kept_records import KeptRecords


def numbered(first: int, count: int) -> np.ndarray:
    records = np.zeros(count, dtype_of(LogRecord))
    records["cycle"] = np.arange(first, first + count)
    records["error_rad"] = records["cycle"] * 1e-3
    return records


def is_in_file(records: np.ndarray) -> bool:
    return isinstance(records.base, np.memmap)


@pytest.mark.parametrize(("last", "in_file"), [(60, False), (61, True), (500, True)])
def test_all_records_come_back_in_order(tmp_path, last, in_file):
    with KeptRecords(tmp_path, in_memory=100) as kept:
        kept.append(numbered(0, 40))
        kept.append(numbered(40, last))
        assert is_in_file(kept.records()) is in_file
        kept.append(numbered(40 + last, 0))
        records = kept.records()
        assert is_in_file(records) is in_file
        assert len(records) == len(kept)
        assert np.array_equal(records.cycle, np.arange(len(kept)))
    assert records.error_rad[-1] == records.cycle[-1] * 1e-3  # still readable
    assert list(tmp_path.iterdir()) == []  # the file never had a name, or has lost it


def test_what_was_kept_may_be_asked_for_before_the_end(tmp_path):
    with KeptRecords(tmp_path, in_memory=10) as kept:
        kept.append(numbered(0, 20))
        assert len(kept.records()) == 20
        kept.append(numbered(20, 5))
        assert list(kept.records().cycle[-2:]) == [23, 24]


def test_a_run_without_records_has_none(tmp_path):
    with KeptRecords(tmp_path) as kept:
        assert len(kept) == len(kept.records()) == 0


def test_every_second_record_of_a_chunk_is_kept_as_it_is(tmp_path):
    with KeptRecords(tmp_path, in_memory=3) as kept:
        kept.append(numbered(0, 20)[::2])
        assert list(kept.records().cycle) == list(range(0, 20, 2))
