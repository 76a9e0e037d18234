"""What others cost the loop that have to do with a run: wake-up and work with them and without, in turn.

    python -m tests.bench.client_speed [--with set-points] [--pairs 20] [--seconds 5] [--rate 500] [--json]

One run of the virtual joint; windows with them and windows in which the program only waits alternate, and which of the
two comes first.  `set-points`: the program sends them.  `foxglove`, `ros2`: the server serves a client that gets every
topic, on the same cores, or on one (`--client-cpu 0`, where the server is: a client elsewhere takes nothing of the
others); in the other windows both processes are held.

Of server and client also their processor time and wake-ups a second, which a busy computer changes little.

From the run's log: p99 of the wake-up and of the work in each window, the ratio of each pair, and the median of the
ratios with its quartiles.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any
from unittest.mock import patch

import numpy as np
import typer

import jointctl
from jointctl.tools.output import Output
from tests.bench.paired import Row, conditions, measured, outcome_data, outcome_table
from tests.browser import free_port
from tests.python_process import child

ROOT = Path(__file__).resolve().parents[2]
GROUP = "client"
SET_POINTS, FOXGLOVE, ROS2 = "set-points", "foxglove", "ros2"
GOAL = 1.1
AMPLITUDE_rad, FREQUENCY_Hz = 0.05, 0.5
STREAM_DELAY_S, STREAM_TIMEOUT_S = 0.2, 0.5  # a shared computer may stand still for so long


Load = Callable[[jointctl.Joint, float], None]  # for so many seconds


def _windows(joint: jointctl.Joint, pairs: int, seconds: float, load: Load) -> list[tuple[bool, int, int]]:
    """(with the load, from, to [CLOCK_MONOTONIC ns]) of each window, two for each pair."""
    found = []
    for pair in range(pairs):
        for loaded in (True, False) if pair % 2 else (False, True):
            joint.wait(0.5)  # the reference comes to rest
            begun_ns = time.monotonic_ns()
            if loaded:
                load(joint, seconds)
            else:
                joint.wait(seconds)
            found.append((loaded, begun_ns, time.monotonic_ns()))
    return found


def _used(pid: int) -> np.ndarray:
    """Of all threads of a process so far: processor time [ms], and how often they woke up."""
    total = np.zeros(2)
    for task in Path(f"/proc/{pid}/task").iterdir():
        switches = next(line for line in (task / "status").read_text().splitlines() if line.startswith("voluntary"))
        total += int((task / "schedstat").read_text().split()[0]) * 1e-6, int(switches.split()[1])
    return total


@contextmanager
def _onlooker(kind: str, port: int, client_cpu: int | None, costs: list[list[np.ndarray]]) -> Iterator[Load]:
    """A client of its own process, which runs, as the server does, only for the windows with it.

    `costs` gets what server and client used a second, for each window.
    """
    command = [sys.executable, "-m", "tests.bench.onlooker", kind, str(port)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as process:
        if client_cpu is not None:
            os.sched_setaffinity(process.pid, {client_cpu})
        pids = [process.pid, child(os.getpid(), f"{kind}_server")]

        def look_on(joint: jointctl.Joint, seconds: float) -> None:
            before = [_used(pid) for pid in pids]
            _signal(pids, signal.SIGCONT)
            joint.wait(seconds)
            _signal(pids, signal.SIGSTOP)
            costs.append([(_used(pid) - used) / seconds for pid, used in zip(pids, before, strict=True)])

        try:
            assert process.stdout.readline()  # it has seen a message
            _signal(pids, signal.SIGSTOP)
            yield look_on
        finally:
            _signal(pids, signal.SIGCONT)
            process.kill()


def _signal(pids: list[int], number: int) -> None:
    for pid in pids:
        os.kill(pid, number)


def _stream(joint: jointctl.Joint, seconds: float, rate_Hz: float) -> None:
    middle_rad = joint.state.desired_position_rad
    begun_s, sent = time.monotonic(), 0
    while (now_s := time.monotonic() - begun_s) < seconds:
        rise = min(now_s, seconds - now_s, 1.0)  # from rest to rest
        share = rise * rise * (3.0 - 2.0 * rise)
        joint.command(middle_rad + AMPLITUDE_rad * share * math.sin(math.tau * FREQUENCY_Hz * now_s), time_s=now_s)
        sent += 1
        time.sleep(max(0.0, begun_s + sent / rate_Hz - time.monotonic()))


def client_rows(
    pairs: int,
    seconds: float,
    rate_Hz: float,
    beside: str = SET_POINTS,
    client_cpu: int | None = None,
    loop_cpu: int | None = None,
) -> list[Row]:
    """A row each for wake-up and work."""
    from jointctl.tools.configuration.load import load_config, shipped_config

    config = load_config(shipped_config("virtual"))
    # the program waits for a client that starts
    patient = {"delay_s": STREAM_DELAY_S, "timeout_s": STREAM_TIMEOUT_S, "client_timeout_s": 60.0}
    config = config.changed(stream=patient, loop__cpu=loop_cpu)
    port = free_port()
    at = f"127.0.0.1:{port}"
    costs: list[list[np.ndarray]] = []
    with ExitStack() as stack:
        stack.enter_context(patch("jointctl.tools.scoping.remote.LISTEN_AT", f"tcp/{at}"))
        joint = stack.enter_context(
            jointctl.Joint(
                config, virtual=True, foxglove=at if beside == FOXGLOVE else False,
                ros2=port % 200 if beside == ROS2 else False,
            )
        )  # fmt: skip
        joint.enable()
        if beside == SET_POINTS:
            windows = _windows(joint, pairs, seconds, lambda joint, seconds: _stream(joint, seconds, rate_Hz))
        else:
            load = stack.enter_context(_onlooker(beside, port, client_cpu, costs))
            windows = _windows(joint, pairs, seconds, load)
    assert joint.log_path is not None
    records = jointctl.read_log(joint.log_path).records
    names = ("wake_late_ns", "wake-up"), ("work_ns", "work")
    rows = [_row(records, windows, field, f"{name} with {beside}") for field, name in names]
    for number, who in enumerate(("client", "server") if costs else ()):
        used = np.array([window[number] for window in costs])
        rows.append(measured(GROUP, f"processor time a second, {who}", used[:, 0].tolist(), "ms"))
        rows.append(measured(GROUP, f"wake-ups a second, {who}", used[:, 1].tolist(), ""))
    return rows


def _row(records: Any, windows: list[tuple[bool, int, int]], field: str, name: str) -> Row:
    p99: dict[bool, list[float]] = {True: [], False: []}
    for streaming, from_ns, to_ns in windows:
        inside = (records.time_ns >= from_ns) & (records.time_ns < to_ns)
        p99[streaming].append(float(np.percentile(records[field][inside], 99.0)) * 1e-3)
    ratios = np.array(p99[True]) / np.array(p99[False])
    low, middle, high = (float(value) for value in np.percentile(ratios, [25.0, 50.0, 75.0]))
    return Row(
        GROUP, f"p99 of the {name}", float(np.median(p99[True])), "us", float(np.median(p99[False])),
        "without", middle, low, high, len(ratios), GOAL,
    )  # fmt: skip


def main(
    pairs: Annotated[int, typer.Option(min=1)] = 20,
    seconds: Annotated[float, typer.Option(min=2.5)] = 5.0,
    rate: Annotated[float, typer.Option(help="set-points a second", min=1.0)] = 500.0,
    beside: Annotated[str, typer.Option("--with", help=f"{SET_POINTS}, {FOXGLOVE} or {ROS2}")] = SET_POINTS,
    client_cpu: Annotated[int | None, typer.Option(help="the only processor of the client", min=0)] = None,
    loop_cpu: Annotated[int | None, typer.Option(help="loop.cpu; the server keeps off it", min=0)] = None,
    json: bool = False,
) -> None:
    """Measure and print."""
    rows = client_rows(pairs, seconds, rate, beside, client_cpu, loop_cpu)
    Output(json=json).result(outcome_table(rows), outcome_data(rows, conditions()))


if __name__ == "__main__":
    typer.run(main)
