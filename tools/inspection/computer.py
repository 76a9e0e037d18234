"""What this computer allows a 1 kHz loop: versions, kernel, real-time rights, wake-up times, kernel cache."""

from __future__ import annotations

import contextlib
import ctypes
import getpass
import os
import platform
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import numpy as np

from jointctl.tools.configuration.config import Config
from jointctl.tools.inspection.findings import NOTE, OK, PROBLEM, Finding, file_text
from jointctl.tools.session.loops import start_time_s
from jointctl.tools.wake_up import cores_awake, fifo, wake_up_lateness_ns

DEFAULT_PRIORITY = 60
_GOOD_CLOCKS = ("tsc", "kvm-clock", "arch_sys_counter", "riscv_clocksource")
_PR_GET_TIMERSLACK = 30
_MCL_CURRENT = 1
_MUCH_SLACK_NS = 50_000
_LATE_US = 500.0
_FULL = "preempt=full"  # an option of kernels built with PREEMPT_DYNAMIC
_RIGHTS = "in /etc/security/limits.d/jointctl.conf: '{user} - rtprio 90' and '{user} - memlock unlimited'; log in again"
_LATENCY_RIGHT = (
    """a udev rule gives the right: KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660", and you in that group"""
)


def _rights() -> str:
    return _RIGHTS.format(user=getpass.getuser())


def software() -> Iterator[Finding]:
    """Python, numba, kernel, cores."""
    python = platform.python_version()
    good = sys.version_info >= (3, 11)
    yield Finding("Python", OK if good else PROBLEM, python, "" if good else "install Python 3.11 or newer")
    yield Finding("numba", OK, f"{version('numba')}, numpy {version('numpy')}, python-can {version('python-can')}")
    cores = len(os.sched_getaffinity(0))
    few = "one core for the loop and one for the rest are the least; close other programs"
    yield Finding("cores", OK if cores >= 2 else NOTE, str(cores), "" if cores >= 2 else few, {"cores": cores})


def _preemption(root: Path) -> Finding:
    """How long the kernel itself may hold a woken loop up: without preemption, to the end of what it is doing."""
    kernel, version = platform.release(), platform.version()
    if file_text(root / "sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        return Finding("kernel", OK, f"{kernel}, PREEMPT_RT")
    cure = "a real-time kernel bounds the worst wake-up; install one if the measured max is too late"
    if _FULL in (file_text(root / "proc/cmdline") or "").split():
        return Finding("kernel", NOTE, f"{kernel}, not PREEMPT_RT, {_FULL}", cure)
    if "PREEMPT_DYNAMIC" in version:
        cure += f"; the kernel option {_FULL} goes half the way"
    return Finding("kernel", NOTE, f"{kernel}, not PREEMPT_RT", cure)


def kernel_findings(root: Path = Path("/")) -> Iterator[Finding]:
    """Kernel, clock, governor, timer slack; `root` is replaced in tests."""
    yield _preemption(root)
    clock = file_text(root / "sys/devices/system/clocksource/clocksource0/current_clocksource")
    good = clock in _GOOD_CLOCKS
    cure = "" if good else "a slow clock costs microseconds a reading: try the kernel option clocksource=tsc"
    yield Finding("clock source", OK if good else NOTE, clock or "not told by this system", cure if clock else "")
    paths = sorted((root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor"))
    governors = sorted({text for path in paths if (text := file_text(path))})
    good = governors in ([], ["performance"])
    cure = "" if good else "cores that clock down wake up late: sudo cpupower frequency-set -g performance"
    yield Finding("CPU governor", OK if good else NOTE, ", ".join(governors) or "not told by this system", cure)


def scheduling() -> Iterator[Finding]:
    """Real-time priority, locked memory, timer slack."""
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    with fifo(1) as refused:
        good = not refused
    shown = "unlimited" if limit == resource.RLIM_INFINITY else str(limit)
    text = f"{'permitted' if good else 'refused'}; rtprio limit {shown}"
    yield Finding("SCHED_FIFO", OK if good else NOTE, text, "" if good else _rights())
    libc = ctypes.CDLL(None)
    good = libc.mlockall(_MCL_CURRENT) == 0
    libc.munlockall()
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    shown = "unlimited" if limit == resource.RLIM_INFINITY else f"{limit // 1024} KiB"
    text = f"{'permitted' if good else 'refused'}; limit {shown}"
    yield Finding("memory lock", OK if good else NOTE, text, "" if good else _rights())
    with cores_awake() as refused:
        good = not refused
    text = "cores stay awake during a run" if good else f"cores may sleep deeply: {refused}"
    yield Finding("idle states", OK if good else NOTE, text, "" if good else _LATENCY_RIGHT)
    slack_ns = int(libc.prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0))
    good = 0 < slack_ns <= _MUCH_SLACK_NS
    cure = "" if good else "without SCHED_FIFO every sleep is that much longer: start jointctl from an ordinary shell"
    yield Finding("timer slack", OK if good else NOTE, f"{slack_ns / 1000:g} us", cure, {"timer_slack_ns": slack_ns})


def wake_up(config: Config, cycles: int) -> Iterator[Finding]:
    """Measured lateness of a compiled sleep loop at the configured rate, with SCHED_FIFO where it is permitted."""
    rate_Hz = config.loop.rate_Hz
    priority = config.loop.priority or DEFAULT_PRIORITY
    for name, wanted in (("wake-up, ordinary", 0), (f"wake-up, SCHED_FIFO {priority}", priority)):
        with fifo(wanted) if wanted else contextlib.nullcontext("") as refused:
            if refused:
                yield Finding(name, NOTE, f"not measured: {refused}", _rights())
                continue
            with cores_awake():
                late_us = wake_up_lateness_ns(rate_Hz, cycles) / 1000.0
        p50, p99 = np.percentile(late_us, (50.0, 99.0))
        worst = float(late_us.max())
        numbers = {"rate_Hz": rate_Hz, "p50_us": float(p50), "p99_us": float(p99), "max_us": worst}
        good = worst <= min(_LATE_US, 0.5e6 / rate_Hz)
        text = f"late by {p50:.0f} / {p99:.0f} / {worst:.0f} us (p50/p99/max of {cycles} at {rate_Hz:g} Hz)"
        cure = "" if good else "give loop.cpu a core of its own (isolcpus), set loop.priority, close other programs"
        yield Finding(name, OK if good else NOTE, text, cure, numbers)


def kernel_cache(folder: Path | None, cold: bool) -> Iterator[Finding]:
    """Where it is, whether the loop is in it, and how long a start takes."""
    if folder is None:
        cure = "set JOINTCTL_CACHE_DIR to a folder that can be written; else every start compiles"
        yield Finding("kernel cache", PROBLEM, "no folder can be written", cure)
        return
    files = [path for path in folder.rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files)
    warm = any(path.name.startswith("realtime.run_loop") and path.suffix == ".nbc" for path in files)
    text = f"{folder}, {len(files)} files, {size / 1e6:.1f} MB, {'warm' if warm else 'cold'}"
    cure = "" if warm else "the first start compiles for about a minute: run `jointctl demo` once"
    yield Finding("kernel cache", OK if warm else NOTE, text, cure, {"files": len(files), "bytes": size, "warm": warm})
    if warm:
        yield _start("warm start", None)
    if cold:
        with tempfile.TemporaryDirectory() as empty:
            yield _start("cold start", Path(empty))
            if not warm:
                yield _start("warm start", Path(empty))


def _start(topic: str, cache: Path | None) -> Finding:
    try:
        seconds = start_time_s(cache)
    except (subprocess.SubprocessError, OSError) as error:
        lines = str(getattr(error, "stderr", b"").decode(errors="replace") or error).strip().splitlines()
        return Finding(topic, PROBLEM, f"the loop cannot be started: {lines[-1]}", "reinstall jointctl")
    return Finding(topic, OK, f"{seconds:.2f} s until the loop is ready", "", {"start_s": seconds})
