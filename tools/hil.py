"""`jointctl hil CONFIG`: keep the virtual joint up, for jointctl or any other CAN tool to attach to."""

from __future__ import annotations

import os
import time

from hil.bus import default_socket_path
from tools.config import Config
from tools.loop_process import become_realtime
from tools.output import Output
from tools.stop_signals import stop_signals
from tools.virtual_joint import serve_virtual_joint

_POLL_S = 0.05


def hil(config: Config, output: Output, *, timing: bool = False, ready_fd: int | None = None) -> int:
    """Serve until a stop signal; `ready_fd` gets one byte once the bus can be used."""
    for line in become_realtime(None, config.loop.priority):
        output.note(f"virtual joint: {line}")
    with stop_signals() as signals, serve_virtual_joint(config, timing) as joint:
        bus = config.bus
        place = f"{bus.interface}:{bus.channel}"
        if bus.interface == "jointctl":
            place += f" ({default_socket_path(bus.channel)})"
        output.note(f"virtual joint: node {config.drive.node} on {place}; Ctrl-C ends it")
        if bus.interface == "jointctl":
            output.note(f'attach with python-can: can.Bus(interface="jointctl", channel="{bus.channel}")')
        if ready_fd is not None:
            os.write(ready_fd, b"+")
            os.close(ready_fd)
        while not signals.count and not joint.words[2]:
            time.sleep(_POLL_S)
    return 0
