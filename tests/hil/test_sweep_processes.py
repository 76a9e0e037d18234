"""Sweeps as processes in real time: stopped by Ctrl-C, resumed, and dry."""

from __future__ import annotations

import signal
from typing import Any

import numpy as np
import pytest

from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.recording.run_log_reader import read_run_log
from tests.hil.sweep_rows import rows, truth_Nm

SWEEP = (
    "sweep", "joint.toml", "-o", "data.csv", "--max-speed", "1.0", "--min-speed", "0.5", "--points", "6",
    "--dwell", "0.3", "--warm-up", "0",
)  # fmt: skip


@pytest.fixture
def joint(bench: Any) -> Any:
    """The bench with the joint of sweep_virtual running; limits for a busy computer."""
    bench.config(base="sweep_virtual", limits__sample_age_max_s=0.5, limits__skipped_max_s=0.5,
                 drive__heartbeat_s=0.5)  # fmt: skip
    bench.joint("joint.toml")
    return bench


def test_ctrl_c_keeps_the_rows_and_resume_measures_the_rest(joint: Any) -> None:
    out = joint.folder / "data.csv"
    started = joint.start(*SWEEP, "-y")
    started.until(lambda: out.exists() and len(out.read_text().splitlines()) >= 3, "three rows")
    started.signal(signal.SIGINT)
    done = started.finished()
    assert done.code == 130, done.err
    assert "Traceback" not in done.err
    assert "ramping" in done.err
    assert "--resume goes on" in done.err
    assert joint.disabled()
    kept = out.read_text()
    assert 3 <= len(kept.splitlines()) < 7
    (log,) = (joint.folder / "runs").glob("*.mcap")
    assert read_run_log(log).metadata["thinning"] == {"every": "20", "whole_s": "2"}
    time_s = read_run_log(log).records.time_ns * 1e-9
    assert np.sum(time_s > time_s[-1] - 2.0) > 1000  # the last seconds are whole, the ones before are not
    assert len(time_s) < 0.5 * 1000 * (time_s[-1] - time_s[0])
    sidecar = out.with_suffix(".json")
    about = sidecar.read_text()
    sidecar.write_text(about.replace('"serial": "1"', '"serial": "2"'))
    assert sidecar.read_text() != about
    joint.run(*SWEEP, "-y", "--resume").refused(6, "another drive answers than before", "serial 1; it was", "serial 2")
    assert out.read_text() == kept
    sidecar.write_text(about)
    done = joint.run(*SWEEP, "-y", "--resume")
    assert done.code == 0, done.err
    assert joint.disabled()
    found = rows(out)
    assert out.read_text().startswith(kept)
    once = {(round(v, 1), d) for v, d in zip(found["velocity_radps"], found["direction"], strict=True)}
    assert len(once) == 6
    error_Nm = found["motor_torque_Nm"] - truth_Nm(
        load_config(shipped_config("sweep_virtual")), found["velocity_radps"]
    )
    assert np.max(np.abs(error_Nm)) < 0.005


def test_a_dry_run_and_a_missing_y_move_nothing(joint: Any) -> None:
    done = joint.run(*SWEEP, "--dry-run")
    assert done.code == 0, done.err
    assert "dry run: nothing moved; the drive is disabled" in done.err
    joint.run(*SWEEP).refused(2, "no terminal to ask on")
    assert joint.disabled()
    assert not (joint.folder / "data.csv").exists()
