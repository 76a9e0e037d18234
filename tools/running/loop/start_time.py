"""How long a start of the loop takes: from a new process until its kernels are loaded, or compiled."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

from jointctl.tools.running.loop.loop_process import compiled_call
from jointctl.tools.running.loop.shared_block import SharedBlock

PROBE_TIMEOUT_S = 600.0


def warm_up_compiled_loop() -> None:
    """Do what the loop process does before it is ready; no bus is opened, nothing is sent."""
    block = SharedBlock.create(1)
    compiled_call(block, 1_000_000, 0)(0)
    os.close(block.fd)


def start_time_s(cache: Path | None = None) -> float:
    """Seconds from starting a process until the loop is ready in it; `cache` another cache folder than the present.

    Raises subprocess.SubprocessError if the process fails.
    """
    environment = dict(os.environ, **({"JOINTCTL_CACHE_DIR": str(cache)} if cache else {}))
    command = [sys.executable, "-P", "-m", "jointctl.tools.running.loop.start_time"]
    started_s = time.monotonic()
    subprocess.run(command, env=environment, check=True, timeout=PROBE_TIMEOUT_S, capture_output=True)
    return time.monotonic() - started_s


if __name__ == "__main__":
    warm_up_compiled_loop()
