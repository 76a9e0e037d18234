"""A run with two encoders: configuration, commissioning, readings, and the loop that holds both positions."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.can.frames import Frame
from jointctl.drivers.canopen.cyclic import begin_cycle, centred, end_cycle
from jointctl.drivers.canopen.drive import CanopenDrive
from jointctl.drivers.canopen.pdo import joint_angle_per_count_rad
from jointctl.drivers.errors import ConfigurationError, DeviceError
from jointctl.firmware_py.records import ENCODER_RESTARTED, Command, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.hil.faults import FaultConstants, FaultKind
from jointctl.tools.configuration.canopen import canopen_settings, cyclic_bus_load
from jointctl.tools.configuration.load import load_config
from jointctl.tools.inspection.health import bus_budget
from jointctl.tools.lockstep import DirectBus, LockstepJoint
from jointctl.tools.session.session_drive import session_drive
from jointctl.tools.virtual_joint import new_device
from tests.places import CONFIGS
from tests.two_encoders import NODE, cycle, hear, port_of, short_run, tell


# --- Readings of a drive and of an encoder node: a sample needs both positions of one cycle ---
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
    for encoder, changes in (({**NODE, "kind": "incremental"}, {}), (NODE, {"encoder__kind": "incremental"})):
        port, sample = port_of(tmp_path, encoder, **changes), new(Sample)[0]
        cycle(port, sample, 1000, 90_000)
        assert sample.position_rad == pytest.approx(sample.second_position_rad)
        start_rad = 1000 * math.tau / (121 * 65536) if encoder is not NODE else -10_000 * math.tau / 524288
        assert sample.position_rad == pytest.approx(start_rad)
        cycle(port, sample, 1000, 90_100)
        assert sample.position_rad - sample.second_position_rad == pytest.approx(100 * math.tau / 524288)


@pytest.mark.parametrize(
    ("frames", "error"),
    [
        ([(0x82, "0050210000000000")], 0x5000),
        ([(0x702, "00")], ENCODER_RESTARTED),
        ([(0x82, "0050210000000000"), (0x82, "0000000000000000")], 0),
    ],
)
def test_an_encoder_with_an_error_or_restarted_is_not_believed(
    tmp_path: Path, frames: list[tuple[int, str]], error: int
) -> None:
    """Until the error is cleared; it was taken for the drive's, even 200 cycles after that."""
    port, sample = port_of(tmp_path, NODE), new(Sample)[0]
    cycle(port, sample, 0, 100_000)
    for identifier, text in frames:
        hear(port, sample, identifier, bytes.fromhex(text))
    cycle(port, sample, 0, 100_000)
    assert (sample.count, sample.encoder_error, sample.drive_error) == (1 if error else 2, error, 0)


# --- A run with two encoders: configuration, commissioning, and the loop that finds the one that is wrong ---
DRIVE = {**{k: v for k, v in NODE.items() if k != "node"}, "source": "drive"}


# --- commissioning and runs in lockstep ---
@pytest.mark.parametrize("encoder", [NODE, DRIVE, {**NODE, "law": "encoder"}, {**NODE, "kind": "incremental"}])
def test_a_run_with_two_encoders(tmp_path: Path, encoder: dict[str, Any]) -> None:
    joint = LockstepJoint(short_run(tmp_path, encoder, virtual__initial_position_rad=0.1))
    assert joint.report.start_position_rad == pytest.approx(0.1, abs=1e-4)
    assert ("524288" if "node" in encoder else "60E4:1") in joint.report.settings["joint encoder"]
    run = joint.run()
    assert run.fault is Fault.NONE
    tracked = run.log[run.tracking]
    assert np.abs(tracked.position_rad - tracked.second_position_rad).max() < 1e-4
    assert np.abs(run.true_error_rad[run.tracking]).max() < 0.02


@contextmanager
def on_the_bus(folder: Path, **changes: Any) -> Iterator[tuple[Any, CanopenDrive, DirectBus]]:
    """The virtual drive of a good configuration, and the driver with an encoder that is configured otherwise."""
    device = new_device(short_run(folder, NODE))
    bus = DirectBus(device)
    drive = CanopenDrive(bus, canopen_settings(short_run(folder, {**NODE, **changes})), sleep=bus.sleep)
    yield device.device[0], drive, bus
    drive.close()


@pytest.mark.parametrize(
    ("change", "error_code", "message"),
    [
        ({"counts_per_turn": 4096}, 0,
         r"joint_encoder.counts_per_turn (=4096) differs from the encoder's 6001, 524288"),
        ({"eds": "virtual_joint.eds"}, 0, "EDS virtual_joint.eds has no object 6001"),
        ({}, 0x5000, "node 2: the encoder reports alarms"),
    ],
)  # fmt: skip
def test_commissioning_refuses(tmp_path: Path, change: dict[str, Any], error_code: int, message: str) -> None:
    with on_the_bus(tmp_path, **change) as (device, drive, _):
        device.encoder.error_code = error_code
        with pytest.raises(DeviceError, match=re.escape(message)):
            drive.commission()
    assert device.state == 1


@pytest.mark.parametrize("alarm", [True, False])
def test_an_alarm_that_comes_while_the_question_is_open_is_refused(tmp_path: Path, alarm: bool) -> None:
    """Its EMCY comes while nobody listens."""
    with on_the_bus(tmp_path) as (device, drive, bus):
        drive.commission()
        device.encoder.error_code = 0x5000 * alarm
        bus.sleep(0.05)
        words = re.escape("node 2: the encoder reports alarms (6503 = 0001h)")
        with pytest.raises(DeviceError, match=words) if alarm else nullcontext():
            drive.start_cyclic()


def drift(rate_radps: float) -> Any:
    faults = new(FaultConstants, 1)
    faults[0].kind, faults[0].start_s, faults[0].duration_s = FaultKind.ENCODER_DRIFT, 1.5, 100.0
    faults[0].magnitude = rate_radps
    return faults


@pytest.mark.parametrize(("rate_radps", "fault"), [(0.02, Fault.POSITION_DISAGREEMENT), (0.002, Fault.NONE)])
def test_an_encoder_that_drifts_is_found_by_the_other_one(tmp_path: Path, rate_radps: float, fault: Fault) -> None:
    """The drive's encoder drifts for 1.5 s or so: by 30 mrad, or by 3 of the 5 that are allowed."""
    joint = LockstepJoint(short_run(tmp_path, NODE, trajectory__duration_s=2.0))
    run = joint.run_with_faults(drift(rate_radps), tail_s=0.1)
    assert run.fault is fault
    if fault is not Fault.NONE:
        assert abs(run.state.fault_value) == pytest.approx(0.005, abs=1e-3)
        assert AxisPhase.QUICK_STOPPING in run.log.phase
        assert run.device.state in (1, 7)


@pytest.mark.parametrize(("key", "value"), [("encoder__direction", -1), ("encoder__counts_per_turn", 32768)])
def test_a_configuration_that_is_wrong_about_one_encoder(tmp_path: Path, key: str, value: int) -> None:
    """The joint is what the file says; the controller is told otherwise."""
    good = LockstepJoint(short_run(tmp_path, NODE, virtual__initial_position_rad=0.1))
    wrong = canopen_settings(short_run(tmp_path, NODE, virtual__initial_position_rad=0.1, **{key: value}))
    good._port[0].position_radpcount = joint_angle_per_count_rad(wrong) * wrong.encoder_direction
    run = good.run()
    assert run.fault is Fault.POSITION_DISAGREEMENT
    assert not (run.log.drive_state == 3).any()  # found before the drive was enabled


def test_losing_the_encoder_node_ends_the_run(tmp_path: Path) -> None:
    joint = LockstepJoint(short_run(tmp_path, NODE))
    joint._virtual.device[0].encoder.node_id = 0
    assert joint.run().fault is Fault.NO_SAMPLES


@pytest.mark.parametrize("code", [0x5000, 0])
def test_a_run_that_the_encoder_ends_says_so(tmp_path: Path, code: int) -> None:
    config = short_run(tmp_path, NODE)
    joint = LockstepJoint(config)
    joint._virtual.device[0].encoder.error_code = code
    run = joint.run()
    assert run.fault is (Fault.NO_SAMPLES if code else Fault.NONE)
    errors = int(run.state.fault_drive_error), int(run.state.fault_encoder_error)
    assert errors == (0, code)
    if code:
        told = session_drive("canopen").fault_text(config, run.fault, float(run.state.fault_value), *errors)
        assert "from both encoders of the joint; the encoder node's error code is 5000h" in told.happened
        assert "not believed" in told.cause


# --- configuration ---
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"node": 1}, "joint_encoder.node (=1) must differ from drive.node"),
        ({"source": "drive"}, 'joint_encoder.node must be given with source = "node", and only then'),
        ({"eds": "missing.eds"}, "joint_encoder.eds (=missing.eds) must name a file"),
        ({"object": "60E"}, "joint_encoder.object"),
        ({"disagreement_max_rad": 0.0}, "joint_encoder.disagreement_max_rad (=0) must be in (0..1]"),
        ({"disagreement_max_rad": 0.9}, "must be less than ten times"),
        ({"kind": "incremental"}, "both incremental"),
    ],
)
def test_problems(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    kind = change.get("kind", "absolute")
    with pytest.raises(ConfigurationError, match=re.escape(message)):
        short_run(tmp_path, {**NODE, **change}, encoder__kind=kind)


def test_the_bus_load_counts_the_second_position(tmp_path: Path) -> None:
    with_one = cyclic_bus_load(load_config(CONFIGS / "virtual.toml"))
    assert cyclic_bus_load(short_run(tmp_path, NODE)) == pytest.approx(with_one + 95e3 / 1e6)


@pytest.mark.parametrize(("rate_Hz", "refused"), [(2105.0, False), (2106.0, True)])
def test_the_arithmetic_names_the_second_position(tmp_path: Path, rate_Hz: float, refused: bool) -> None:
    """SYNC 55, TPDO 135, RPDO 95 and 95 bits; `doctor` reckons alike."""
    config = short_run(tmp_path, NODE).changed(loop__rate_Hz=rate_Hz)
    assert bus_budget(config).status == ("problem" if refused else "ok")
    if refused:
        with pytest.raises(ConfigurationError, match=re.escape("TPDO(8) + RPDO(4) + second encoder(4) = 380 bits")):
            cyclic_bus_load(config)
    else:
        assert cyclic_bus_load(config) == pytest.approx(380 * rate_Hz / 1e6)


def test_settings_of_the_driver(tmp_path: Path) -> None:
    settings = canopen_settings(short_run(tmp_path, {**DRIVE, "object": "2ABC:3"}))
    assert (settings.joint_encoder.index, settings.joint_encoder.sub) == (0x2ABC, 3)
    assert dataclasses.replace(settings, joint_encoder=None).joint_encoder is None
