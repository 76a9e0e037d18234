"""The plain Python loop on a clock of the test."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import TrajectoryKind
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.session import portable_loop
from jointctl.tools.session.loop_handle import SharedBlock
from tests.sessions import constants_of
from tests.unit.session.portable_bus import LIMIT, OWN_HEARTBEAT, RPDO, SYNC, TPDO, Clock


@pytest.fixture(scope="module")
def warm() -> None:
    """Compiling in the middle of a run would be an overrun of seconds."""
    portable_loop.warm_up()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clock of the loop."""
    clock = Clock()
    monkeypatch.setattr(portable_loop, "time", clock)
    monkeypatch.setattr(portable_loop, "sleep_until_ns", clock.sleep_until_ns)
    return clock


@pytest.fixture
def block(clock: Clock, warm: None) -> Iterator[SharedBlock]:
    """Holds position 0 for 50 ms; no limit of the schedule or of the supervisor is at work."""
    block = SharedBlock.create(1)
    block.constants[:] = constants_of(load_config(shipped_config("virtual")), start_position_rad=0.0)
    axis = block.constants[0]
    axis.trajectory.kind = TrajectoryKind.HOLD
    axis.trajectory.duration_s = 0.05
    axis.sequence.approach_s = 0.0
    axis.sequence.settle_cycles = 5
    axis.sequence.release_s = 0.005
    axis.sequence.supervisor_max_cycles = 0
    axis.limits.skipped_max_cycles = 1 << 40
    axis.limits.sample_age_max_cycles = LIMIT
    reset_axis(axis, block.state[0])
    port = block.port[0]
    port.sync_id, port.tpdo_id, port.rpdo_id = SYNC, TPDO, RPDO
    port.emergency_id, port.heartbeat_id, port.own_heartbeat_id = 0x81, 0x701, OWN_HEARTBEAT
    port.heartbeat_cycles = 5
    port.tpdo_length, port.rpdo_length = 8, 4
    port.position_at, port.torque_at, port.target_at = 2, 6, 2
    port.position_radpcount, port.torque_Nmppermille, port.max_permille = 1e-4, 0.06, 1000
    yield block
    os.close(block.fd)
