"""Other tools on the same bus: a python-can client and a CANopen client beside a run (masters: tests/parties)."""

from __future__ import annotations

import time
from typing import Any

import can

from tests.places import EDS

SYNC_ID, TPDO_ID, RPDO_ID, HEARTBEAT_ID = 0x80, 0x181, 0x201, 0x701


def test_clients_see_the_run_and_read_objects_meanwhile(bench: Any) -> None:
    config = bench.config(trajectory__duration_s=3.0)
    bench.joint_process(config)
    with can.Bus(interface="jointctl", channel=bench.channel) as onlooker:
        network = bench.network()
        node = network.add_node(1, str(EDS))
        run = bench.start("run", config, "-y").saw("  tracking")
        seen: dict[int, int] = {}
        give_up = time.monotonic() + 1.0
        while time.monotonic() < give_up:
            if (message := onlooker.recv(0.1)) is not None:
                seen[message.arbitration_id] = seen.get(message.arbitration_id, 0) + 1
        assert node.sdo["Statusword"].raw & 0x6F == 0x27
        assert node.sdo["Modes of operation display"].raw == 10
        assert abs(node.sdo[0x6064].raw) < 524288
        network.disconnect()
        done = run.finished(30.0)
    assert done.code == 0, done.err
    for identifier in (SYNC_ID, TPDO_ID, RPDO_ID):
        assert seen[identifier] > 100, seen
    assert seen[HEARTBEAT_ID] >= 2, seen
    assert bench.disabled()
