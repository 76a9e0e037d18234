"""Records of the sequence that its tests begin with."""

from __future__ import annotations

from typing import Any

from jointctl.firmware_py.records import Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import DriveState


def sample_of(drive_state: DriveState) -> Any:
    sample = new(Sample)[0]
    sample.drive_state, sample.status_word, sample.drive_error = drive_state, 0x1237, 0x3310
    return sample
