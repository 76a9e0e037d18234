"""Whatever a bus may deliver: the cyclic protocol, the virtual drive and its SDO server never fail, and stay sane."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jointctl.drivers.can.frames import Frame
from jointctl.drivers.canopen.cyclic import FRAME_SLOTS, SLOT_RECEIVED, SLOT_RPDO, accept_frame, begin_cycle, end_cycle
from jointctl.drivers.canopen.pdo import new_port
from jointctl.firmware_py.records import Command, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import DriveRequest, DriveState
from jointctl.tools.configuration.load import load_config
from jointctl.tools.simulation.virtual_joint import new_device
from tests.places import CONFIGS

quick = settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
identifiers = st.one_of(
    st.sampled_from([0x000, 0x080, 0x081, 0x181, 0x201, 0x581, 0x601, 0x701, 0x77E]),
    st.integers(0, 0x7FF),
    st.integers(0, 0xFFFFFFFF),
)
frames = st.tuples(identifiers, st.integers(0, 255), st.binary(min_size=8, max_size=8))


@quick
@given(received=st.lists(frames, min_size=1, max_size=40), torque=st.floats(allow_nan=True, allow_infinity=True))
def test_any_frames_into_the_cyclic_protocol(
    received: list[tuple[int, int, bytes]], torque: float, settings_of_virtual_joint: Any
) -> None:
    port = new_port(settings_of_virtual_joint, 0.0605, 1000)[0]
    memory, sample, command = new(Frame, FRAME_SLOTS), new(Sample)[0], new(Command)[0]
    for now_ns, (identifier, length, data) in enumerate(received):
        begin_cycle(port, memory)
        frame = memory[SLOT_RECEIVED]
        frame.can_id, frame.length = identifier, length
        frame.payload[:] = np.frombuffer(data, np.uint8)
        before = int(sample.count)
        taken = accept_frame(port, frame, sample, now_ns)
        assert taken == (sample.count == before + 1)
        if taken:
            assert identifier == port.tpdo_id
            assert length >= port.tpdo_length
        assert math.isfinite(sample.position_rad)
        assert math.isfinite(sample.torque_Nm)
        assert 0 <= sample.status_word <= 0xFFFF
        assert int(sample.drive_state) in list(DriveState)
        command.torque_Nm, command.request = torque, DriveRequest.ENABLE
        end_cycle(port, memory, sample, command)
        sent = memory[SLOT_RPDO]
        permille = struct.unpack_from("<h", bytes(sent.payload), int(port.target_at))[0]
        assert abs(permille) <= port.max_permille
        if sample.drive_state != DriveState.ENABLED:
            assert permille == 0


@quick
@given(low=st.binary(min_size=8, max_size=8), length=st.integers(0, 8))
def test_a_tpdo_is_decoded_or_counted_as_malformed(low: bytes, length: int, settings_of_virtual_joint: Any) -> None:
    port = new_port(settings_of_virtual_joint, 0.0605, 1000)[0]
    memory, sample = new(Frame, FRAME_SLOTS), new(Sample)[0]
    frame = memory[SLOT_RECEIVED]
    frame.can_id, frame.length = port.tpdo_id, length
    frame.payload[:] = np.frombuffer(low, np.uint8)
    assert accept_frame(port, frame, sample, 5) is (length >= 8)
    if length < 8:
        assert (port.malformed, sample.count) == (1, 0)
        return
    status, counts, torque = struct.unpack("<Hih", low)
    assert sample.status_word == status
    assert port.counts == counts
    assert sample.torque_Nm == pytest.approx(torque * port.torque_Nmppermille)


@pytest.fixture(scope="module")
def device() -> Any:

    return new_device(load_config(CONFIGS / "virtual.toml"))


@quick
@given(received=st.lists(st.tuples(identifiers, st.integers(0, 8), st.binary(min_size=8, max_size=8)), max_size=20))
def test_any_frames_into_the_virtual_drive(device: Any, received: list[tuple[int, int, bytes]]) -> None:
    now_ns = max(int(device.device[0].time_ns), 1)
    for identifier, length, data in received:
        now_ns += 1000
        for frame in device.handle(struct.pack("<IB3x8s", identifier, length, data), now_ns):
            assert len(frame) == 16
            assert frame[4] <= 8
            assert struct.unpack_from("<I", frame)[0] <= 0x7FF
    assert math.isfinite(device.plant_state[0].joint_position_rad)


@quick
@given(requests=st.lists(st.binary(min_size=0, max_size=8), min_size=1, max_size=20))
def test_any_sdo_requests_are_answered_by_eight_bytes_or_not_at_all(device: Any, requests: list[bytes]) -> None:
    for request in requests:
        for response in device.sdo.handle(request):
            assert len(response) == 8
    # and afterwards a good request is answered: an abort, then the device type
    device.sdo.handle(bytes([0x80, 0, 0, 0, 0, 0, 0, 0]))
    (answer,) = device.sdo.handle(bytes([0x40, 0x00, 0x10, 0, 0, 0, 0, 0]))
    assert answer[:4] == bytes([0x43, 0x00, 0x10, 0x00])
