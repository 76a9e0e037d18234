"""`tune` as a process on the virtual bus in real time."""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from jointctl.hil.canopen.records import PowerState
from jointctl.tools.configuration.load import load_config
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log_reader import read_run_log
from jointctl.tools.session.plan import TerminalConsent
from jointctl.tools.tuning.carry_out import Carrier
from jointctl.tools.verbs import tune_steps
from jointctl.tools.verbs.tune import TuneOptions
from jointctl.tools.verbs.tune_steps import STEPS, Tune
from tests.configurations import written

LATE_CYCLES = 5  # far more than the delay that is measured


# The least travel that is enough: legs of the response hold two seconds each instead of four, and slow plateaus one
# period of the motor's ripple.  Without ripple of the friction no plateau is visited twice.
SHORT = {
    "limits__position_min_rad": -0.2725, "limits__position_max_rad": 0.2725, "limits__velocity_max_radps": 1.3,
    "sequence__brake_radps2": 8.0, "virtual__friction_ripple": 0.0, "trajectory__amplitude_rad": 0.1,
    "trajectory__frequency_Hz": 0.3, "trajectory__duration_s": 3.0,
}  # fmt: skip


@pytest.fixture
def joint(bench: Any) -> Any:
    """The bench with a joint as that of `precise` running, whose tune is short; limits for a busy computer."""
    bench.config(base="precise", limits__sample_age_max_s=0.5, limits__skipped_max_s=0.5, drive__heartbeat_s=0.5,
                 sequence__supervisor_timeout_s=5.0, **SHORT)  # fmt: skip
    bench.virtual = bench.joint("joint.toml")
    return bench


def believed(joint: Any, old: str, new: str) -> Path:
    """What the user believes of that joint."""
    text = (joint.folder / "joint.toml").read_text()
    assert text.count(old) == 1, old
    path: Path = joint.folder / "mine.toml"
    path.write_text(text.replace(old, new))
    return path


def test_an_encoder_that_counts_the_other_way_ends_it_with_the_drive_off(joint: Any) -> None:
    path = believed(joint, "direction = 1 ", "direction = -1 ")
    text = path.read_text()
    done = joint.run("tune", "mine.toml", "-y")
    assert done.code == 7, done.err
    assert "direction: by [encoder] the joint moved against the torque" in done.err
    assert "mine.toml is as it was" in done.err
    assert "Traceback" not in done.err
    assert joint.disabled()
    assert path.read_text() == text


def test_ctrl_c_in_the_response_ramps_down_and_keeps_the_steps_before(joint: Any) -> None:
    path = believed(joint, "inertia_kgm2 = 2.1 ", "inertia_kgm2 = 1.5 ")
    text = path.read_text()
    started = joint.start("tune", "mine.toml", "-y")
    started.saw("excitation multisine")
    started.until(lambda: started.err.count("\n  tracking") >= 2, "tracking twice")
    started.signal(signal.SIGINT)
    done = started.finished()
    assert done.code == 130, done.err
    assert "stopped by SIGINT" in done.err
    assert done.err.count("\n  releasing") == 2  # as after the direction: under control, and then without torque
    assert joint.disabled()
    assert path.read_text() == text
    assert '"direction"' in (joint.folder / "mine.tune" / "steps.json").read_text()


def tune_of(path: Path, *, lockstep: bool) -> Tune:
    output = Output(quiet=True, stdout=io.StringIO(), stderr=io.StringIO())
    carrier = Carrier(output, TerminalConsent(output, assume_yes=True), None)
    return Tune(load_config(path), TuneOptions(lockstep=lockstep), carrier, path.with_suffix(".tune"))


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Tune:
    """The steps before the bristles, of that joint in simulated time."""
    path = written(tmp_path_factory.mktemp("simulated") / "mine.toml", "precise", **SHORT)
    job = tune_of(path, lockstep=True)
    with patch.object(tune_steps, "STEPS", STEPS[: STEPS.index("bristles")]):
        job.carry_out()
    return job


def begun(joint: Any, simulated: Tune, *steps: str) -> Path:
    """A real-time tune of that joint with these steps done."""
    path: Path = joint.folder / "mine.toml"
    path.write_text((joint.folder / "joint.toml").read_text())
    job = tune_of(path, lockstep=False)
    job._open()
    job.state = {name: simulated.state[name] for name in steps}
    job._save()
    for measured in simulated.folder.glob("friction.*"):
        shutil.copy(measured, job.folder)
    return path


@pytest.mark.parametrize(
    ("steps", "number"),
    [(3, signal.SIGINT), (4, signal.SIGINT), (4, signal.SIGTERM)],
    ids=["friction", "bristles", "bristles, SIGTERM"],
)
def test_a_stop_in_a_step_releases_the_joint_and_the_next_tune_begins_with_that_step(
    joint: Any, simulated: Tune, steps: int, number: signal.Signals
) -> None:
    """Each step prints its progress: the friction took four minutes without a line."""
    path = begun(joint, simulated, *STEPS[:steps])
    text = path.read_text()
    for _ in range(2):
        started = joint.start("tune", "mine.toml", "-y", "--resume")
        started.until(lambda run=started: "\n  tracking" in run.err, "tracking")
        assert f"\n{STEPS[steps]}\n" in started.err
        started.signal(number)
        done = started.finished()
        assert done.code == 130, done.err
        assert f"stopped by {number.name}; mine.toml is as it was; --resume goes on" in done.err
        assert f"{STEPS[steps - 1]}: done before" in done.err
        assert joint.disabled()
        assert path.read_text() == text
        kept = json.loads((joint.folder / "mine.tune" / "steps.json").read_text())
        assert {*kept} & {*STEPS} == {*STEPS[:steps]}


def kill_loop(joint: Any, tune: Any) -> None:
    os.kill(tune.child("loop_process"), signal.SIGKILL)


def switch_off(joint: Any, tune: Any) -> None:
    """As STO does: the drive leaves Operation Enabled by itself."""
    joint.virtual._devices[0].device[0].state = PowerState.SWITCH_ON_DISABLED


@pytest.mark.parametrize(("end", "words"), [(kill_loop, "the loop process"), (switch_off, "DRIVE_NOT_ENABLED (9)")])
def test_an_end_while_the_joint_stands_switches_the_drive_off_and_keeps_the_steps_before(
    joint: Any, simulated: Tune, end: Any, words: str
) -> None:
    path = begun(joint, simulated, *STEPS[:4])
    started = joint.start("tune", "mine.toml", "-y", "--resume")
    started.until(lambda: "\n  tracking" in started.err, "tracking")
    end(joint, started)
    done = started.finished()
    assert done.code == 7, done.err
    line = next(line for line in done.err.splitlines() if line.startswith("error: "))
    assert line.startswith("error: bristles: ")
    assert words in line
    assert "mine.toml is as it was" in line
    assert "has the steps before" in line
    assert "Traceback" not in done.err
    assert joint.disabled()
    assert '"friction"' in (path.with_suffix(".tune") / "steps.json").read_text()


def held_up(joint: Any, done: Any) -> bool:
    """Whether the computer stood still: legs were lost, or the drive had not answered for cycles before the fault."""
    if "legs that were measured" in done.err:
        return True
    newest = max((joint.folder / "runs").glob("*.mcap"), key=lambda path: path.stat().st_mtime)
    return "LIMIT_CYCLE" in done.err and int(read_run_log(newest).records.sample_age_cycles[-1000:].max()) > LATE_CYCLES


@pytest.mark.slow("three minutes of motion")
def test_a_whole_tune_in_real_time(joint: Any) -> None:
    """Its gains are for the delay that was measured: samples that are tens of milliseconds old end it in a limit cycle.

    `--resume` goes on then, as it says.
    """
    path = believed(joint, "inertia_kgm2 = 2.1 ", "inertia_kgm2 = 1.5 ")
    done = joint.start("tune", "mine.toml", "-y").finished(1500.0)
    for _ in range(4):
        if done.code == 0 or not held_up(joint, done):
            break
        assert joint.disabled()
        done = joint.start("tune", "mine.toml", "-y", "--resume").finished(1500.0)
    assert done.code == 0, done.err
    assert joint.disabled()
    found = load_config(path)
    assert found.joint.inertia_kgm2 == pytest.approx(2.1, rel=0.05)
    assert found.margin.loop_delay_s is not None
    assert found.margin.loop_delay_s + found.margin.current_lag_s == pytest.approx(1.5e-3, abs=0.5e-3)
    assert (joint.folder / "mine.tune" / "report.html").exists()
    assert joint.run("check", "mine.toml").code == 0
