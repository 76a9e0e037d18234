"""One segment of the control loop, or of the same exchange in C, on the virtual joint; both enabled and in control.

Both run as a process of their own with the same priority and locked memory, on a bus that both find commissioned by
the same driver; the load begins after that.  The C loop has no phases, no limits of motion and no supervision: it is
what the exchange itself costs.  FOR THE VIRTUAL JOINT ONLY.
"""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.can.open import open_cyclic_end
from jointctl.drivers.drive import Drive
from jointctl.drivers.errors import JointctlError
from jointctl.firmware_py.states import DriveState, StopRequest
from jointctl.tools.benchmarks.law_memory import setting_doubles
from jointctl.tools.benchmarks.load import load, on_core
from jointctl.tools.benchmarks.loop_times import NO_VALUES, LoopTimes, times_from_ns
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.records import axis_constants, trajectory_table
from jointctl.tools.running.loop.loop_handle import RECEIVE_SHARE, LoopHandle
from jointctl.tools.running.open_drive import open_drive
from jointctl.tools.wake_up import cores_awake, fifo, wake_up_lateness_ns

SETTLE_S = 0.5  # from the start of the loop until the drive is enabled, and a little more
POLL_S = 0.02
END_S = 3.0
PATIENCE_S = 0.25
ENABLED_SHARE = 0.9


def at_rate(config: Config, rate_Hz: float) -> Config:
    """The same joint with another loop rate."""
    return config.model_copy(update={"loop": config.loop.model_copy(update={"rate_Hz": rate_Hz})})


def on_the_core(config: Config, core: int) -> Config:
    """The same joint with its loop on that core."""
    return config.model_copy(update={"loop": config.loop.model_copy(update={"cpu": core})})


def patient(config: Config) -> Config:
    """The same joint with limits that let a computer stand still for a while without ending the run."""
    limits = config.limits.model_copy(update={"sample_age_max_s": PATIENCE_S, "skipped_max_s": PATIENCE_S})
    return config.model_copy(update={"limits": limits})


@contextmanager
def commissioned(config: Config) -> Iterator[tuple[Drive, Any]]:
    """(drive, AxisConstants) of the joint as it stands; afterwards the drive is off."""
    drive = open_drive(config)
    try:
        report = drive.commission()
        yield drive, axis_constants(config, start_position_rad=report.start_position_rad)
    finally:
        drive.make_safe()
        drive.close()


def run_ours(config: Config, seconds: float, load_name: str) -> LoopTimes:
    """The control loop for so long after it has settled; this process only gives its sign of life meanwhile."""
    with LoopHandle(config, trajectory_table(config)) as loop, commissioned(config) as (drive, constants):
        loop.wait_ready()
        drive.start_cyclic()
        loop.go(constants, drive.port())
        chunks = []
        end_s = time.monotonic() + SETTLE_S + seconds
        with load(load_name):
            while time.monotonic() < end_s and loop.running():
                loop.beat()
                chunks.append(loop.new_records())
                time.sleep(POLL_S)
        ended_early, (fault, value) = not loop.running(), loop.verdict()
        loop.request_stop(StopRequest.OFF)
        end_s = time.monotonic() + END_S
        while time.monotonic() < end_s and loop.running():
            loop.beat()
            time.sleep(POLL_S)
    if ended_early:
        raise JointctlError(f"the control loop stopped by itself while it was measured: {fault.name} ({value:g})")
    records = np.concatenate(chunks)[round(SETTLE_S * config.loop.rate_Hz) :]
    _require_enabled("our", records["drive_state"] == DriveState.ENABLED)
    rows = np.column_stack([records["wake_late_ns"], records["round_trip_ns"], records["work_ns"]])
    return times_from_ns(rows.astype(np.int64))


def _require_enabled(whose: str, enabled: np.ndarray) -> None:
    """`JointctlError` unless the drive was enabled most of the time: cycles that command nothing are no measurement."""
    share = float(np.mean(enabled)) if len(enabled) else 0.0
    if share < ENABLED_SHARE:
        raise JointctlError(f"{whose} loop had the drive enabled in {share:.0%} of its cycles only")


def run_c(program: Path, config: Config, seconds: float, load_name: str) -> LoopTimes:
    """The same exchange in C for so long after it has settled."""
    rate_Hz = config.loop.rate_Hz
    cycles = round((SETTLE_S + seconds) * rate_Hz)
    period_ns = round(1e9 / rate_Hz)
    with (
        open_cyclic_end(config.bus.interface, config.bus.channel) as end,
        commissioned(config) as (drive, constants),
    ):
        setting = setting_doubles(constants[0], drive.port()[0])
        drive.start_cyclic()
        fd = end.fileno()
        numbers = (fd, config.loop.priority or 0, period_ns, int(RECEIVE_SHARE * period_ns), cycles)
        with load(load_name), cores_awake(), on_core(config.loop.cpu):  # as ours, and awake as cyclictest as well
            result = subprocess.run(
                [str(program), *map(str, numbers)],
                input=setting.tobytes(),
                stdout=subprocess.PIPE,
                pass_fds=(fd,),
                check=False,
                timeout=10.0 * (SETTLE_S + seconds) + 10.0,
            )
    rows = np.frombuffer(result.stdout, np.int64)
    if result.returncode != 0 or len(rows) != 4 * cycles:
        raise JointctlError(f"the C loop ended with code {result.returncode} after {len(rows) // 4} of {cycles} cycles")
    rows = rows.reshape(cycles, 4)[round(SETTLE_S * rate_Hz) : -round(0.1 * rate_Hz)]
    enabled = rows[:, 3] == 1
    _require_enabled("the C", enabled)
    return times_from_ns(rows[enabled])


def cyclictest_path() -> str | None:
    """Where rt-tests' cyclictest is installed, if it is."""
    return shutil.which("cyclictest")


def run_cyclictest(path: str, config: Config, seconds: float, load_name: str) -> LoopTimes:
    """cyclictest's wake-ups at the same rate and priority; whole microseconds."""
    period_us = round(1e6 / config.loop.rate_Hz)
    options = ["-q", "-m", "-t1", f"-i{period_us}", f"-l{round(seconds * config.loop.rate_Hz)}", "-h20000"]
    if config.loop.priority:
        options.append(f"-p{config.loop.priority}")
    with load(load_name), on_core(config.loop.cpu):
        result = subprocess.run(
            [path, *options], capture_output=True, text=True, check=False, timeout=10.0 * seconds + 10.0
        )
    pairs = [line.split() for line in result.stdout.splitlines() if line[:1].isdigit()]
    counts = np.array([[int(late), int(count)] for late, count in pairs], np.int64)
    if result.returncode != 0 or not len(counts):
        raise JointctlError(f"cyclictest ended with code {result.returncode} and no histogram")
    return LoopTimes(np.repeat(counts[:, 0], counts[:, 1]).astype(float), NO_VALUES, NO_VALUES)


def run_sleep_only(config: Config, seconds: float, load_name: str) -> LoopTimes:
    """Our compiled sleep without any exchange, in this process: what cyclictest does."""
    with load(load_name), on_core(config.loop.cpu), fifo(config.loop.priority or 1), cores_awake():
        late_ns = wake_up_lateness_ns(config.loop.rate_Hz, round(seconds * config.loop.rate_Hz))
    return LoopTimes(late_ns * 1e-3, NO_VALUES, NO_VALUES)
