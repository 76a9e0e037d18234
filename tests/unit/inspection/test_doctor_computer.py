"""What `jointctl doctor` finds out about the computer: scheduling, wake-ups, the compile cache."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.tools.configuration.config import Config
from jointctl.tools.inspection import health
from jointctl.tools.inspection.health import NOTE, OK, PROBLEM, kernel_cache, kernel_findings, wake_up
from jointctl.tools.session import loops as start_time
from jointctl.tools.wake_up import fifo, wake_up_lateness_ns
from tests.unit.inspection.system_files import write


class TestComputer:
    @pytest.mark.parametrize(("text", "status"), [("1\n", OK), ("0\n", NOTE), (None, NOTE)])
    def test_preempt_rt(self, tmp_path: Path, text: str | None, status: str, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(health.platform, "version", lambda: "#1 SMP PREEMPT_DYNAMIC")
        if text is not None:
            write(tmp_path, "sys/kernel/realtime", text)
        kernel = next(kernel_findings(tmp_path))
        assert kernel.status == status
        assert ("not PREEMPT_RT" in kernel.text) == (status == NOTE)
        assert bool(kernel.cure) == (status == NOTE)

    @pytest.mark.parametrize(
        ("version", "options", "advised"),
        [
            ("#1 SMP PREEMPT_DYNAMIC Debian", "quiet preempt=voluntary", True),
            ("#1 SMP PREEMPT_DYNAMIC Debian", "quiet preempt=full", False),
            ("#1 SMP Debian", "quiet", False),  # could not
        ],
    )
    def test_full_preemption_is_advised_where_the_kernel_can(
        self, tmp_path: Path, version: str, options: str, advised: bool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(health.platform, "version", lambda: version)
        write(tmp_path, "proc/cmdline", options + "\n")
        kernel = next(kernel_findings(tmp_path))
        assert ("preempt=full" in kernel.cure) is advised
        assert ("preempt=full" in kernel.text) is ("preempt=full" in options)

    @pytest.mark.parametrize(("clock", "status"), [("tsc", OK), ("hpet", NOTE), ("acpi_pm", NOTE)])
    def test_clock_source(self, tmp_path: Path, clock: str, status: str) -> None:
        write(tmp_path, "sys/devices/system/clocksource/clocksource0/current_clocksource", clock + "\n")
        found = {f.topic: f for f in kernel_findings(tmp_path)}["clock source"]
        assert (found.status, found.text, bool(found.cure)) == (status, clock, status == NOTE)

    @pytest.mark.parametrize(
        ("governors", "status"), [([], OK), (["performance"] * 2, OK), (["performance", "powersave"], NOTE)]
    )
    def test_governor(self, tmp_path: Path, governors: list[str], status: str) -> None:
        for core, governor in enumerate(governors):
            write(tmp_path, f"sys/devices/system/cpu/cpu{core}/cpufreq/scaling_governor", governor)
        found = {f.topic: f for f in kernel_findings(tmp_path)}["CPU governor"]
        assert found.status == status
        assert ("cpupower" in found.cure) == (status == NOTE)

    def test_fifo_is_left_again(self) -> None:
        before = os.sched_getscheduler(0)
        with fifo(1) as refused:
            assert refused or os.sched_getscheduler(0) == os.SCHED_FIFO
        assert os.sched_getscheduler(0) == before

    def test_a_refused_priority_is_told_and_not_raised(self) -> None:
        with fifo(1000) as refused:
            assert refused


class TestWakeUp:
    def test_one_value_a_cycle_and_none_early(self) -> None:
        late_ns = wake_up_lateness_ns(1000.0, 20)
        assert late_ns.shape == (20,)
        assert (late_ns >= 0).all()

    @pytest.mark.parametrize(("rate_Hz", "cycles"), [(0.0, 1), (-1.0, 1), (float("nan"), 1), (1000.0, 0)])
    def test_bad_input(self, rate_Hz: float, cycles: int) -> None:
        with pytest.raises(ValueError, match=r"\(=.*\) must be"):
            wake_up_lateness_ns(rate_Hz, cycles)

    @pytest.mark.parametrize(("worst_us", "status"), [(499, OK), (500, OK), (501, NOTE), (3000, NOTE)])
    def test_the_worst_decides(
        self, virtual_config: Config, worst_us: int, status: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        late = np.array([10_000] * 99 + [worst_us * 1000])
        monkeypatch.setattr(health, "wake_up_lateness_ns", lambda rate, cycles: late)
        found = next(wake_up(virtual_config, 100))
        assert found.status == status
        assert (found.numbers["p50_us"], found.numbers["max_us"]) == (10.0, worst_us)
        assert bool(found.cure) == (status == NOTE)


class TestCache:
    def test_no_folder(self) -> None:
        (found,) = kernel_cache(None, False)
        assert found.status == PROBLEM
        assert "JOINTCTL_CACHE_DIR" in found.cure

    def test_cold_is_not_started_unless_asked(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        started: list[Path | None] = []
        monkeypatch.setattr(health, "start_time_s", lambda cache: float(not started.append(cache)))
        (found,) = kernel_cache(tmp_path, False)
        assert (found.status, found.numbers["warm"], started) == (NOTE, False, [])
        write(tmp_path, "firmware_py_1/realtime.run_loop-86.py311.1.nbc", "12345678")
        found, warm = kernel_cache(tmp_path, False)
        assert (found.status, found.numbers) == (OK, {"files": 1, "bytes": 8, "warm": True})
        assert (warm.topic, warm.numbers, started) == ("warm start", {"start_s": 1.0}, [None])
        assert [f.topic for f in kernel_cache(tmp_path, True)] == ["kernel cache", "warm start", "cold start"]
        assert isinstance(started[-1], Path)
        assert started[-1] != tmp_path
        found = list(kernel_cache(tmp_path / "firmware_py_2", True))
        assert [f.topic for f in found] == ["kernel cache", "cold start", "warm start"]
        assert started[-1] == started[-2]  # warm, because the cold start has just filled it

    def test_a_start_that_fails_is_a_problem(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def failing(cache: Path | None) -> float:
            raise subprocess.CalledProcessError(1, "python", stderr=b"Traceback\nImportError: no numba\n")

        monkeypatch.setattr(health, "start_time_s", failing)
        write(tmp_path, "x/realtime.run_loop-86.py311.1.nbc", "1")
        assert list(kernel_cache(tmp_path, False))[1].text == "the loop cannot be started: ImportError: no numba"

    def test_the_probe_gets_the_other_cache(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        calls: list[dict[str, Any]] = []
        monkeypatch.setattr(start_time.subprocess, "run", lambda command, **rest: calls.append(rest))
        monkeypatch.setenv("JOINTCTL_CACHE_DIR", "unchanged")
        assert start_time.start_time_s() >= 0.0
        assert start_time.start_time_s(tmp_path) >= 0.0
        assert [call["env"]["JOINTCTL_CACHE_DIR"] for call in calls] == ["unchanged", str(tmp_path)]
        assert calls[0]["check"]
