"""The fixed-rate loop with everything that it works on, and a stub drive whose memory a test writes."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from jointctl.firmware_py.cycle import HISTOGRAM_BINS, WORDS, CycleMemory, Exchange, Histogram, Word, run_loop
from jointctl.firmware_py.kernel import exported
from jointctl.firmware_py.libc import monotonic_ns, store_release
from jointctl.firmware_py.records import AxisState, Command, LogRecord, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import DriveRequest, DriveState, FeedForward

PERIOD_ns = 1_000_000


# words of the stub drive's own memory
CYCLE, BUSY_CYCLE, BUSY_ns, STOP_CYCLE, STOP, REQUEST, SENT, HEARD_AT_ns, LATEST_ns = range(9)


ANSWER_ns = 9
STUB_WORDS = 10


# Words of the stub drive, words of the loop, scratch; a plain tuple: compiled callers are cached under its type, which
# a program that shares the cache must be able to load.
StubLink = tuple[np.ndarray, np.ndarray, np.ndarray]


@exported
def stub_receive(link: StubLink, samples: Any, now_ns: int, until_ns: int) -> int:
    """A drive that obeys at once; busy for a while in one cycle, writes the stop word in another."""
    stub = link[0]
    cycle = stub[CYCLE]
    stub[CYCLE] += 1
    stub[HEARD_AT_ns] = now_ns
    stub[LATEST_ns] = until_ns
    if cycle == stub[BUSY_CYCLE]:
        end_ns = monotonic_ns(link[2]) + stub[BUSY_ns]
        while monotonic_ns(link[2]) < end_ns:
            pass
    if cycle == stub[STOP_CYCLE]:
        store_release(link[1], Word.STOP, stub[STOP])
    sample = samples[0]
    sample.count += 1
    sample.time_ns = now_ns + stub[ANSWER_ns] if stub[ANSWER_ns] != 0 else 0
    sample.drive_state = DriveState.ENABLED if stub[REQUEST] == DriveRequest.ENABLE else DriveState.OFF
    return np.int64(1500)  # type: ignore[return-value]


@exported
def stub_send(link: StubLink, samples: Any, commands: Any) -> int:
    link[0][REQUEST] = commands[0].request
    link[0][SENT] += 1
    return np.int32(0)  # type: ignore[return-value]


class Loop:
    """Everything that `run_loop` works on; limits so wide that a noisy computer trips none of them."""

    def __init__(self, constants: Any, ring: int = 1024, period_ns: int = PERIOD_ns) -> None:
        self.constants = constants
        axis = constants[0]
        axis.limits.skipped_max_cycles = axis.limits.saturation_max_cycles = 1 << 40
        axis.limits.position_min_rad, axis.limits.position_max_rad = -1e9, 1e9
        axis.limits.velocity_max_radps = axis.limits.following_error_max_rad = 1e9
        axis.sequence.supervisor_max_cycles = 0
        axis.sequence.approach_s = 0.02
        axis.law.feed_forward = FeedForward.LUGRE_DESIRED
        axis.law.network.weight_limit = 10.0
        axis.law.network.leakage = 0.01
        self.state, self.sample, self.command = new(AxisState), new(Sample), new(Command)
        reset_axis(constants[0], self.state[0])
        self.words, self.ring = np.zeros(WORDS, np.int64), new(LogRecord, ring)
        self.histograms = np.zeros((len(Histogram), HISTOGRAM_BINS), np.int64)
        self.stub = np.zeros(STUB_WORDS, np.int64)
        self.stub[BUSY_CYCLE] = self.stub[STOP_CYCLE] = -1
        self.period_ns = period_ns
        self.words[Word.SUPERVISOR_NS] = time.monotonic_ns()

    def memory(self) -> CycleMemory:
        return CycleMemory(
            self.constants, self.state, np.zeros((1, 1, 5)), self.sample, self.command, self.words, self.ring,
            self.histograms, np.zeros(2, np.int64),
        )  # fmt: skip

    def run(self, cycles: int, receive_ns: int = 0) -> int:
        exchange = Exchange(stub_receive, stub_send, (self.stub, self.words, np.zeros(2, np.int64)))
        return int(run_loop(self.memory(), exchange, self.period_ns, receive_ns, cycles))
