"""Readings of a drive and of an encoder node: a sample needs both positions of one cycle."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from jointctl.drivers.can.frames import Frame
from jointctl.drivers.canopen.cyclic import accept_frame, begin_cycle, centred, end_cycle
from jointctl.firmware_py.records import ENCODER_RESTARTED, Command, Sample
from jointctl.firmware_py.schema import new
from tests.two_encoders import NODE, cycle, port_of, tell


@pytest.mark.parametrize(
    ("counts", "range_counts", "result"),
    [(0, 1024, 0), (511, 1024, 511), (512, 1024, -512), (1023, 1024, -1), (-513, 1024, 511), (5 * 1024 + 3, 1024, 3)],
)
def test_centred(counts: int, range_counts: int, result: int) -> None:
    assert centred(counts, range_counts) == result


def test_a_sample_needs_both_positions_of_one_cycle(tmp_path: Path) -> None:
    port, sample = port_of(tmp_path, NODE), new(Sample)[0]
    cycle(port, sample, 0, 100_000)
    assert sample.count == 1
    cycle(port, sample, 0, None)
    cycle(port, sample, None, 100_000)
    assert sample.count == 1
    assert sample.status_word == 0x1237  # the drive is heard all the same
    cycle(port, sample, 0, 100_000)
    assert sample.count == 2


def test_of_a_burst_the_last_position_of_each_counts(tmp_path: Path) -> None:
    """The answers to two SYNCs come together, behind their cycles: the two positions are of the same one."""
    port, sample, frames = port_of(tmp_path, NODE), new(Sample)[0], new(Frame, 4)
    cycle(port, sample, 0, 100_000)
    for _ in range(2):
        begin_cycle(port[0], frames)
        end_cycle(port[0], frames, sample, new(Command)[0])
    for turns in (0.01, 0.02):
        tell(port, sample, round(turns * 121 * 65536), 100_000 + round(turns * 524288))
    assert sample.position_rad == pytest.approx(0.02 * math.tau, abs=1e-5)
    assert sample.second_position_rad == pytest.approx(0.02 * math.tau, abs=1e-5)
    assert port[0].surplus == 0


def test_a_position_after_the_answer_of_each_is_not_a_new_one(tmp_path: Path) -> None:
    port, sample, frames = port_of(tmp_path, NODE), new(Sample)[0], new(Frame, 4)
    cycle(port, sample, 0, 100_000)
    end_cycle(port[0], frames, sample, new(Command)[0])
    tell(port, sample, 1000, 100_100)
    assert (sample.count, port[0].surplus, sample.second_position_rad) == (1, 2, 0.0)


@pytest.mark.parametrize(("law", "swapped"), [("joint_encoder", True), ("encoder", False)])
def test_which_one_feeds_the_law(tmp_path: Path, law: str, swapped: bool) -> None:
    port, sample = port_of(tmp_path, {**NODE, "law": law}), new(Sample)[0]
    cycle(port, sample, 121 * 65536 // 8, 100_000 + 524288 // 4)
    found = sample.position_rad, sample.second_position_rad
    expected = (math.tau / 4, math.tau / 8) if swapped else (math.tau / 8, math.tau / 4)
    assert found == pytest.approx(expected)


def test_a_range_that_runs_over_and_a_direction_against_the_joint(tmp_path: Path) -> None:
    port, sample = port_of(tmp_path, {**NODE, "direction": -1, "zero_counts": 10}), new(Sample)[0]
    for reading, counts in ((5, -5), ((1 << 20) - 5, -15), (20, 10)):
        cycle(port, sample, 0, reading)
        assert sample.position_rad == pytest.approx(-counts * math.tau / 524288)


def test_an_incremental_one_takes_the_angle_of_the_other(tmp_path: Path) -> None:
    for encoder, changes in (
        ({**NODE, "kind": "incremental"}, {}),
        (NODE, {"encoder__kind": "incremental"}),
    ):
        port, sample = port_of(tmp_path, encoder, **changes), new(Sample)[0]
        cycle(port, sample, 1000, 90_000)
        assert sample.position_rad == pytest.approx(sample.second_position_rad)
        start_rad = 1000 * math.tau / (121 * 65536) if encoder is not NODE else -10_000 * math.tau / 524288
        assert sample.position_rad == pytest.approx(start_rad)
        cycle(port, sample, 1000, 90_100)
        assert sample.position_rad - sample.second_position_rad == pytest.approx(100 * math.tau / 524288)


@pytest.mark.parametrize(("identifier", "data"), [(0x82, b"\x00\x50\x21\0\0\0\0\0"), (0x702, b"\0")])
def test_an_encoder_with_an_error_or_restarted_is_not_believed(tmp_path: Path, identifier: int, data: bytes) -> None:
    port, sample, received = port_of(tmp_path, NODE), new(Sample)[0], new(Frame)[0]
    cycle(port, sample, 0, 100_000)
    received.can_id, received.length = identifier, len(data)
    for at, byte in enumerate(data):
        received.payload[at] = byte
    accept_frame(port[0], received, sample, 1)
    cycle(port, sample, 0, 100_000)
    assert sample.count == 1
    assert sample.encoder_error == (0x5000 if identifier == 0x82 else ENCODER_RESTARTED)
    assert sample.drive_error == 0
