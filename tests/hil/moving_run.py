"""A run that moves the joint, in processes that a test may end, and an onlooker on the bus."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

TPDO_ID, EMCY_ID = 0x181, 0x81
ENABLED, QUICK_STOP_ACTIVE, SWITCH_ON_DISABLED, FAULT = 0x27, 0x07, 0x40, 0x08
COUNTS_PER_RAD = 524288 / 6.283185307179586
WINDOW_s = 0.05


class Witness:
    """What an independent client saw: (time [s], statusword, position [rad]) of each TPDO, and emergency codes."""

    def __init__(self, bench: Any) -> None:
        self.samples: list[tuple[float, int, float]] = []
        self.emergencies: list[int] = []
        self.network = bench.network()
        self.network.subscribe(TPDO_ID, self._on_tpdo)
        self.network.subscribe(EMCY_ID, self._on_emergency)

    def _on_tpdo(self, _: int, data: bytearray, timestamp_s: float) -> None:
        status = int.from_bytes(data[:2], "little")
        position = int.from_bytes(data[2:6], "little", signed=True) / COUNTS_PER_RAD
        self.samples.append((timestamp_s, status, position))

    def _on_emergency(self, _: int, data: bytearray, timestamp_s: float) -> None:
        self.emergencies.append(int.from_bytes(data[:2], "little"))

    def saw(self, state: int, mask: int = 0x6F, timeout_s: float = 10.0) -> bool:
        """Wait for a statusword from now on."""
        seen, give_up = len(self.samples), time.monotonic() + timeout_s
        while time.monotonic() < give_up:
            if any(status & mask == state for _, status, _ in self.samples[seen:]):
                return True
            time.sleep(0.01)
        return False

    def states_since(self, time_s: float) -> set[int]:
        return {status & 0x6F for at, status, _ in self.samples if at >= time_s}

    def largest_speed_radps(self, time_s: float) -> float:
        """Over `WINDOW_s` each: from one sample to the next, the loop may have been held up for a while."""
        kept = np.array([(at, position) for at, _, position in self.samples if at >= time_s])
        ends = np.searchsorted(kept[:, 0], kept[:, 0] + WINDOW_s)
        starts = np.flatnonzero(ends < len(kept))
        assert len(starts) > 100
        way_s, way_rad = (kept[ends[starts]] - kept[starts]).T
        return float(np.abs(way_rad / way_s).max())


def alive(pid: int) -> bool:
    """Whether the process has not ended; a zombie has."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def gone(pid: int, timeout_s: float = 10.0) -> bool:
    """Wait until the process has ended."""
    give_up = time.monotonic() + timeout_s
    while time.monotonic() < give_up:
        if not alive(pid):
            return True
        time.sleep(0.01)
    return False


class Moving:
    """A joint in motion under `jointctl run`, with an onlooker; `loop` is the process id of the compiled loop."""

    def __init__(self, bench: Any, start_joint: Callable[[str], Any] | None = None) -> None:
        self.bench = bench
        self.config = bench.config(trajectory__duration_s=60.0, sequence__supervisor_timeout_s=0.8)
        self.joint = (start_joint or bench.joint)(self.config)
        self.witness = Witness(bench)
        try:
            self.run = bench.start("run", self.config, "-y").saw("  tracking")
            (self.loop,) = self.run.children()
            assert self.witness.saw(ENABLED)
        except BaseException:
            self.close()  # or its thread tells the next test that the bus has gone
            raise
        self.since_s = time.time()

    def close(self) -> None:
        self.witness.network.disconnect()
