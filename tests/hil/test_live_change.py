"""Gains, set-points and motions changed while a real run goes on, over the virtual bus; each change is in the log."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.states import AxisPhase, StopRequest
from jointctl.tools.configuration.load import load_config
from jointctl.tools.recording.run_log import Event
from jointctl.tools.recording.run_log_reader import read_run_log
from jointctl.tools.session.display import Display, ViewerRequest
from jointctl.tools.session.result import RunResult
from tests.sessions import session_of

WHO = "a test"
SINE = {"kind": "sine", "duration_s": 0.0, "amplitude_rad": 0.1, "frequency_Hz": 0.5, "offset_rad": 0.2}


class Script(Display):
    """Asks for one thing after the other, each as soon as the one before has come to its end, then stops."""

    def __init__(self, requests: Sequence[ViewerRequest]) -> None:
        self._left = list(requests)
        self.seen: list[dict[str, Any]] = []
        self.events: list[str] = []
        self._settled = 0
        self._answers = 0
        self._give_up_s = time.monotonic() + 40.0

    def event(self, event: Event) -> None:
        self.events.append(event.text)
        self._answers += event.text.startswith(("parameter change", "recording"))

    def settings(self, values: Mapping[str, Any]) -> None:
        self.seen.append(dict(values))
        tracking = "tracking" in self.events
        self._settled = 0 if values["under_way"] or not tracking else self._settled + 1

    def requests(self) -> Sequence[ViewerRequest]:
        if self._settled < 2 or not self._left:
            return ()
        self._settled = 0
        return [self._left.pop(0)]

    def stop_request(self) -> StopRequest:
        done = not self._left and self._settled >= 3
        return StopRequest.RAMP if done or time.monotonic() > self._give_up_s else StopRequest.NONE


def carried_out(bench: Any, *requests: tuple[str, dict[str, Any]], **changes: Any) -> tuple[Script, RunResult]:
    name = bench.with_joint(trajectory__duration_s=0.0, live={"gain_factor": 2.0, "ramp_s": 0.2}, **changes)
    config = load_config(bench.folder / name)
    script = Script([ViewerRequest(kind, WHO, values) for kind, values in requests])
    path = Path(bench.folder) / "runs" / "live.mcap"
    result = session_of(config, path, lambda _: script).run()
    assert result is not None
    return script, result


def test_gains_and_motions_change_on_the_way_and_are_told(bench: Any) -> None:
    script, result = carried_out(
        bench,
        ("gains", {"kp": 700.0, "kv": 70.0}),
        ("set_point", {"position_rad": -0.3}),
        ("trajectory", SINE),
        ("trajectory", {"kind": "configured"}),
    )
    assert result.fault.name == "NONE"
    told = [event.text for event in read_run_log(result.log_path).events if event.source == "scope"]
    assert len(told) == 4, told
    assert told[0].startswith("parameter change: control.kp 784 -> 700, control.kv 56 -> 70 (phase margin ")
    assert told[1].startswith(
        "parameter change: motion sine -0.3500 .. +0.3500 rad, up to 0.22 rad/s, until stopped -> set-point -0.3"
    )
    assert "-> sine +0.1000 .. +0.3000 rad, up to 0.314 rad/s" in told[2]
    assert "-> sine -0.3500 .. +0.3500 rad" in told[3]
    assert all(text.endswith(f"by {WHO}") for text in told)
    assert tuple(script.seen[-1]["gains"]["kp"]) == (392.0, 700.0, 1568.0)
    records = result.records
    rows = records[(records.phase == AxisPhase.TRACKING) & (records.skipped == 0)]
    speed = np.abs(rows.desired_velocity_radps)
    assert speed.max() < 0.32  # moves are as quick as an automatic approach: a quarter of limits.velocity_max_radps
    assert np.min(np.abs(rows.desired_position_rad + 0.3)) < 1e-9
    assert np.max(np.abs(np.diff(rows.desired_velocity_radps)[np.diff(rows.cycle) == 1])) < 2.1e-3
    assert np.max(np.abs(rows.error_rad)) < 0.05


def test_what_is_not_allowed_is_refused_in_words_and_changes_nothing(bench: Any) -> None:
    script, result = carried_out(
        bench,
        ("gains", {"kv": 28.0}),
        ("gains", {"kp": 2000.0}),
        ("gains", {"kp": math.nan}),
        ("gains", {"kp": "900"}),
        ("gains", {"kp": None}),
        ("gains", {"ki": 5.0}),
        ("set_point", {"position_rad": 0.71}),
        ("set_point", {"position_rad": None}),
        ("trajectory", {"kind": "sine", "duration_s": 0.0, "amplitude_rad": 0.5, "frequency_Hz": 0.5}),
        ("trajectory", {"kind": "sine", "duration_s": 0.0, "amplitude_rad": 0.01, "frequency_Hz": 90.0}),
        ("trajectory", {"kind": "table", "file": "x.csv", "duration_s": 1.0}),
        ("trajectory", {"kind": "leap"}),
    )  # fmt: skip
    assert result.fault.name == "NONE"
    told = [text for text in script.events if text.startswith("parameter change")]
    for text, words in zip(
        told,
        (
            "the control loop is unstable; a phase margin of at least 15 deg is required",
            "control.kp (=2000) must be in [392..1568], from live.gain_factor",
            "control.kp (=nan) must be in [392..1568]",
            "control.kp (=900) must be in [392..1568]",
            "control.kp is empty: must be in [392..1568]",
            "'ki' is no gain that can be changed: kp, kv, learning_rate",
            "position (=0.71 rad) must be in [-0.7..0.7]",
            "trajectory.position_rad is empty: must be a number",
            "peak speed (=1.5708 rad/s) must be in [0..1]",
            "peak speed (=5.65487 rad/s) must be in [0..1]",
            "can only be chosen as",
            "kind",
        ),
        strict=True,
    ):
        assert text.startswith("parameter change refused: ")
        assert words in text
        assert text.endswith(f"asked for by {WHO}")
    rows = result.records[result.records.phase == AxisPhase.TRACKING]
    assert np.min(rows.trajectory_s) >= 0.0  # the motion was never left
    assert {tuple(values["gains"]["kp"])[1] for values in script.seen} == {784.0}


def test_a_recording_is_a_log_of_its_own(bench: Any) -> None:
    script, result = carried_out(
        bench, ("record", {"on": True}), ("set_point", {"position_rad": 0.1}), ("record", {"on": False})
    )
    recorded = read_run_log(result.log_path.with_name("live.recording-1.mcap"))
    assert recorded.complete
    assert 0 < len(recorded.records) < len(result.records)
    np.testing.assert_array_equal(np.diff(recorded.records.cycle) - 1, recorded.records.skipped[1:])
    assert any("motion" in event.text for event in recorded.events)
    assert "recording live.recording-1.mcap ended by a test" in script.events


@pytest.mark.parametrize("kind", ["gains", "set_point"])
def test_before_the_joint_is_under_way_nothing_is_taken(bench: Any, kind: str) -> None:
    class Early(Script):
        def settings(self, values: Mapping[str, Any]) -> None:
            super().settings({**values, "under_way": False})
            self._settled += 2

    name = bench.with_joint(trajectory__duration_s=0.3)
    script = Early([ViewerRequest(kind, WHO, {"kp": 700.0, "position_rad": 0.1})])
    config = load_config(bench.folder / name)
    path = Path(bench.folder) / "runs" / "early.mcap"
    session_of(config, path, lambda _: script).run()
    told = [text for text in script.events if text.startswith("parameter change")]
    assert told == ["parameter change refused: the joint is not under way, or it is being stopped; asked for by a test"]
