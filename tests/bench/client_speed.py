"""What a program that streams set-points costs the loop: wake-up and work with it and without, in turn.

    python -m tests.bench.client_speed [--pairs 20] [--seconds 5] [--rate 500] [--json]

One run of the virtual joint; windows with set-points from Python and windows in which the program only waits alternate,
and which of the two comes first.  From the run's log: p99 of the wake-up and of the work in each window, the ratio of
each pair, and the median of the ratios with its quartiles.
"""

from __future__ import annotations

import math
import time
from typing import Annotated, Any

import numpy as np
import typer

import jointctl
from jointctl.tools.output import Output
from tests.bench.paired import Row, conditions, outcome_data, outcome_table

GROUP = "client"
GOAL = 1.1
AMPLITUDE_rad, FREQUENCY_Hz = 0.05, 0.5
STREAM_DELAY_S, STREAM_TIMEOUT_S = 0.2, 0.5  # a shared computer may stand still for so long


def _windows(joint: jointctl.Joint, pairs: int, seconds: float, rate_Hz: float) -> list[tuple[bool, int, int]]:
    """(with set-points, from, to [CLOCK_MONOTONIC ns]) of each window, two for each pair."""
    found = []
    for pair in range(pairs):
        for streaming in (True, False) if pair % 2 else (False, True):
            joint.wait(0.5)  # the reference comes to rest
            begun_ns = time.monotonic_ns()
            if streaming:
                _stream(joint, seconds, rate_Hz)
            else:
                joint.wait(seconds)
            found.append((streaming, begun_ns, time.monotonic_ns()))
    return found


def _stream(joint: jointctl.Joint, seconds: float, rate_Hz: float) -> None:
    middle_rad = joint.state.desired_position_rad
    begun_s, sent = time.monotonic(), 0
    while (now_s := time.monotonic() - begun_s) < seconds:
        rise = min(now_s, seconds - now_s, 1.0)  # from rest to rest
        share = rise * rise * (3.0 - 2.0 * rise)
        joint.command(middle_rad + AMPLITUDE_rad * share * math.sin(math.tau * FREQUENCY_Hz * now_s), time_s=now_s)
        sent += 1
        time.sleep(max(0.0, begun_s + sent / rate_Hz - time.monotonic()))


def client_rows(pairs: int, seconds: float, rate_Hz: float) -> list[Row]:
    """A row each for wake-up and work."""
    from jointctl.tools.configuration.load import load_config, shipped_config

    config = load_config(shipped_config("virtual"))
    stream = config.stream.model_copy(update={"delay_s": STREAM_DELAY_S, "timeout_s": STREAM_TIMEOUT_S})
    with jointctl.Joint(config.model_copy(update={"stream": stream}), virtual=True) as joint:
        joint.enable()
        windows = _windows(joint, pairs, seconds, rate_Hz)
    assert joint.log_path is not None
    records = jointctl.read_log(joint.log_path).records
    return [_row(records, windows, "wake_late_ns", "wake-up"), _row(records, windows, "work_ns", "work")]


def _row(records: Any, windows: list[tuple[bool, int, int]], field: str, name: str) -> Row:
    p99: dict[bool, list[float]] = {True: [], False: []}
    for streaming, from_ns, to_ns in windows:
        inside = (records.time_ns >= from_ns) & (records.time_ns < to_ns)
        p99[streaming].append(float(np.percentile(records[field][inside], 99.0)) * 1e-3)
    ratios = np.array(p99[True]) / np.array(p99[False])
    low, middle, high = (float(value) for value in np.percentile(ratios, [25.0, 50.0, 75.0]))
    return Row(
        GROUP, f"p99 of the {name} with set-points", float(np.median(p99[True])), "us", float(np.median(p99[False])),
        "without", middle, low, high, len(ratios), GOAL,
    )  # fmt: skip


def main(
    pairs: Annotated[int, typer.Option(min=1)] = 20,
    seconds: Annotated[float, typer.Option(min=2.5)] = 5.0,
    rate: Annotated[float, typer.Option(help="set-points a second", min=1.0)] = 500.0,
    json: bool = False,
) -> None:
    """Measure and print."""
    rows = client_rows(pairs, seconds, rate)
    Output(json=json).result(outcome_table(rows), outcome_data(rows, conditions()))


if __name__ == "__main__":
    typer.run(main)
