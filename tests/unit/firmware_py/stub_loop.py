"""The fixed-rate loop with everything that it works on, and a stub drive whose memory a test writes."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numba.core import types

from jointctl.firmware_py.kernel import exported, record_array_type
from jointctl.firmware_py.libc import monotonic_ns, store_release
from jointctl.firmware_py.realtime import HISTOGRAM_BINS, WORDS, Word, run_loop
from jointctl.firmware_py.records import AxisState, Command, LogRecord, Sample
from jointctl.firmware_py.schema import dtype_of, new
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import DriveRequest, DriveState, FeedForward

PERIOD_ns = 1_000_000


# words of the stub drive's own memory
CYCLE, BUSY_CYCLE, BUSY_ns, STOP_CYCLE, STOP, REQUEST, SENT, HEARD_AT_ns, LATEST_ns = range(9)


ANSWER_ns = 9
STUB_WORDS = 10
_I64 = types.Array(types.int64, 1, "C")
_SAMPLES = record_array_type(dtype_of(Sample))
_COMMANDS = record_array_type(dtype_of(Command))


@exported(types.int64(_I64, _I64, _I64, _SAMPLES, types.int64, types.int64))
def stub_receive(stub: Any, words: Any, scratch: Any, samples: Any, now_ns: int, deadline_ns: int) -> int:
    """A drive that obeys at once; busy for a while in one cycle, writes the stop word in another."""
    cycle = stub[CYCLE]
    stub[CYCLE] += 1
    stub[HEARD_AT_ns] = now_ns
    stub[LATEST_ns] = deadline_ns
    if cycle == stub[BUSY_CYCLE]:
        end_ns = monotonic_ns(scratch) + stub[BUSY_ns]
        while monotonic_ns(scratch) < end_ns:
            pass
    if cycle == stub[STOP_CYCLE]:
        store_release(words, Word.STOP, stub[STOP])
    sample = samples[0]
    sample.count += 1
    sample.time_ns = now_ns + stub[ANSWER_ns] if stub[ANSWER_ns] != 0 else 0
    sample.drive_state = DriveState.ENABLED if stub[REQUEST] == DriveRequest.ENABLE else DriveState.OFF
    return np.int64(1500)  # type: ignore[return-value]


@exported(types.int32(_I64, _I64, _SAMPLES, _COMMANDS))
def stub_send(stub: Any, words: Any, samples: Any, commands: Any) -> int:
    stub[REQUEST] = commands[0].request
    stub[SENT] += 1
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
        self.histograms = np.zeros((3, HISTOGRAM_BINS), np.int64)
        self.stub = np.zeros(STUB_WORDS, np.int64)
        self.stub[BUSY_CYCLE] = self.stub[STOP_CYCLE] = -1
        self.period_ns = period_ns
        self.words[Word.SUPERVISOR_NS] = time.monotonic_ns()

    def run(self, cycles: int, receive_ns: int = 0) -> int:
        return int(
            run_loop(
                stub_receive, stub_send, self.stub, self.words, np.zeros(2, np.int64), self.constants, self.state,
                np.zeros((1, 5)), self.sample, self.command, self.words, self.ring, self.histograms,
                np.zeros(2, np.int64), self.period_ns, receive_ns, cycles,
            )
        )  # fmt: skip
