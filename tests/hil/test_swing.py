"""A swinging joint and a noisy command, as the user of `jointctl run` sees them: terminal, log and report."""

from __future__ import annotations

from typing import Any

from firmware_py.states import Fault

NOISE = "torque noise: the command changes by"


def test_torque_noise_is_told_once_by_terminal_log_and_report(bench: Any) -> None:
    config = bench.config(base="precise", encoder__counts_per_turn=2**16, trajectory__duration_s=3.0)
    bench.joint(config)
    done = bench.run("run", config, "-y")
    assert done.code == 0, done.err
    assert done.err.count(NOISE) == 1
    assert sum(NOISE in event.text for event in bench.log().events) == 1
    log = next(bench.folder.glob("runs/*.mcap"))
    assert bench.run("report", str(log), "-o", "page.html").code == 0
    assert NOISE in (bench.folder / "page.html").read_text()


def test_its_twin_with_a_finer_encoder_tells_nothing(bench: Any) -> None:
    config = bench.config(base="precise", trajectory__duration_s=3.0)
    bench.joint(config)
    done = bench.run("run", config, "-y")
    assert done.code == 0, done.err
    assert NOISE not in done.err
    assert not any(NOISE in event.text for event in bench.log().events)


def test_a_limit_cycle_ends_the_run_with_its_advice(bench: Any) -> None:
    """The delay is the joint's own: what is measured before enabling does not show it."""
    config = bench.config(base="precise", virtual__command_delay_s=0.008, trajectory__duration_s=5.0)
    bench.joint(config)
    done = bench.run("run", config, "-y")
    assert done.code == 7, done.err
    assert Fault.LIMIT_CYCLE.name in done.err
    assert "loop delay" in done.err
    assert "learning" in done.err
    assert bench.disabled()
