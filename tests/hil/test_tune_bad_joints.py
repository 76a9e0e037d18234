"""`tune` on joints that are not as they should be, in simulated time: off, one line that says what was seen, data kept.

Faults are those of [[virtual.faults]], which begin anew with each motion: one that begins late spares the short ones.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Container
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from jointctl.drivers.errors import JointctlError, MotionFault
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import load_config
from jointctl.tools.output import Output
from jointctl.tools.session.fault_words import FaultText
from jointctl.tools.session.plan import Motion, TerminalConsent
from jointctl.tools.tuning.carry_out import Carried, Carrier, NotCarriedOut
from jointctl.tools.verbs.tune import TuneOptions
from jointctl.tools.verbs.tune_steps import Tune
from tests.configurations import shipped, written

OFF = ("switch on disabled", "ready to switch on", "switched on", "fault")  # states of the drive without power


class Watched(Carrier):
    """Keeps what the joint weighs from motion to motion: `heavier` times from the `since`-th motion on."""

    heavier, since, motions = 1.0, 1_000, 0

    def run(self, config: Config, motion: Motion, title: str, *, also_faults: Container[Fault] = ()) -> Carried:
        self.motions += 1
        assert config.virtual is not None
        if self.motions >= self.since:
            config = config.changed(virtual__inertia_scale=self.heavier * config.virtual.inertia_scale)
        return super().run(config, motion, title, also_faults=also_faults)


class PutOnMidway(Watched):
    """A payload that is put on in the middle of the `since`-th motion: its second half is that of a heavier joint."""

    def run(self, config: Config, motion: Motion, title: str, *, also_faults: Container[Fault] = ()) -> Carried:
        carried = super().run(config, motion, title, also_faults=also_faults)
        if self.motions != self.since:
            return carried
        self.since = 1_000
        light = super().run(config, motion, title, also_faults=also_faults)
        rows = light.records.trajectory_s < 0.5 * float(np.max(light.records.trajectory_s))
        before = light.records[rows & (light.records.phase == AxisPhase.TRACKING)]
        after = carried.records[carried.records.trajectory_s > before.trajectory_s[-1]]
        return replace(carried, records=np.concatenate((before, after)).view(np.recarray))


def ended(path: Path, carrier: Watched, text: str) -> tuple[str, dict[str, Any]]:
    """(the line, steps that were kept) of a tune that ends; the drive is off and the file as it was."""
    folder = path.with_suffix(".tune")
    with pytest.raises(JointctlError) as raised:
        Tune(load_config(path), TuneOptions(lockstep=True), carrier, folder).run()
    assert isinstance(raised.value, MotionFault)
    line = raised.value.message
    assert "\n" not in line
    assert "is as it was" in line
    assert path.read_text() == text
    assert carrier.drive_state in OFF
    kept = folder / "steps.json"
    assert ("has the steps before" in line) == kept.exists()
    return line, json.loads(kept.read_text()) if kept.exists() else {}


def watched(kind: type[Any] = Watched) -> Any:
    output = Output(quiet=True, stdout=io.StringIO(), stderr=io.StringIO())
    return kind(output, TerminalConsent(output, assume_yes=True), None)


def with_fault(path: Path, kind: str, at_s: float, **keys: float) -> str:
    lines = "".join(f"{key} = {value}\n" for key, value in keys.items())
    text = path.read_text() + f'\n[[virtual.faults]]\nkind = "{kind}"\nat_s = {at_s}\n{lines}'
    path.write_text(text)
    return text


@pytest.mark.parametrize(
    ("kind", "at_s", "line", "steps"),
    [
        ("encoder_reversed", 0.0, r"direction: by \[encoder\] the joint moved against the torque", 0),
        ("torque_reversed", 0.0, r"direction: by \[encoder\] the joint moved against the torque", 0),
        ("frames_lost", 1.0, r"direction: ended while the joint moved: STALE_SAMPLE", 0),
        ("frames_lost", 12.0, r"response: .*STALE_SAMPLE", 1),
        ("frames_lost", 120.0, r"friction: .*STALE_SAMPLE", 3),
        ("current_loop_dead", 12.0, r"response: .*(POSITION_FROZEN|FOLLOWING_ERROR|TORQUE_SATURATED)", 1),
    ],
)
def test_a_fault_in_a_step_ends_it_in_one_line(tmp_path: Path, kind: str, at_s: float, line: str, steps: int) -> None:
    path = written(tmp_path / "joint.toml", "precise")
    text = with_fault(path, kind, at_s)
    carrier = watched()
    said, kept = ended(path, carrier, text)
    assert re.match(line, said), said
    assert len([name for name in kept if name not in ("about", "asked", "drives")]) == steps
    if steps == 3:
        assert len((path.with_suffix(".tune") / "friction.csv").read_text().splitlines()) > 3


@pytest.mark.parametrize(
    ("kind", "fault"),
    [
        ("encoder_stuck", "POSITION_FROZEN"),
        ("current_loop_dead", "POSITION_FROZEN"),
        ("frames_lost", "STALE_SAMPLE"),
        ("drive_fault", "DRIVE_FAULT"),
        ("drive_reboot", "DRIVE_RESTARTED"),
    ],
)
def test_a_fault_while_the_joint_stands_ends_it_and_keeps_the_steps_before(
    tmp_path: Path, kind: str, fault: str
) -> None:
    """A reading that stands under less torque than moves the joint is none: the twin is every tune."""
    path = written(tmp_path / "joint.toml", "precise")
    text = with_fault(path, kind, 30.0)
    carrier, folder = watched(), path.with_suffix(".tune")
    job = Tune(load_config(path), TuneOptions(lockstep=True), carrier, folder)
    job._open()
    job.state = {"direction": [], "response": {}, "gravity": {}, "friction": {}}
    job._save()
    job.fit = Mock(flexible=False)
    with pytest.raises(MotionFault, match=f"bristles: {fault}"):
        job._step_bristles()
    assert carrier.drive_state in OFF
    assert path.read_text() == text
    assert "friction" in json.loads((folder / "steps.json").read_text())


@pytest.mark.parametrize("title", ["the same before", "refinement", "verification"])
@pytest.mark.parametrize(
    "fault",
    [Fault.LIMIT_CYCLE, Fault.VELOCITY_LIMIT, Fault.POSITION_FROZEN, Fault.POSITION_JUMP, Fault.STALE_SAMPLE],
)
def test_only_a_fault_of_the_gains_lets_a_tune_go_on_to_its_next_motion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, title: str, fault: Fault
) -> None:
    """An encoder that jumped while other gains were tried was a line of the report, and the joint was enabled again."""
    carrier, config = watched(Carrier), shipped("precise")
    ended = Carried(new(LogRecord, 10), fault, FaultText("happened", "cause", "next"), "")
    monkeypatch.setattr(Carrier, "_simulated", lambda *_: ended)
    goes_on = title != "verification" and fault in (Fault.LIMIT_CYCLE, Fault.VELOCITY_LIMIT)
    goes_on = goes_on or (title == "the same before" and fault is Fault.POSITION_FROZEN)
    with nullcontext() if goes_on else pytest.raises(MotionFault, match=f"{title}: {fault.name}"):
        assert Tune(config, TuneOptions(), carrier, tmp_path)._verified(config, title) == {"fault": fault.name}


class FirstStages(Watched):
    """Ends with the first stage of the response that measured."""

    def run(self, config: Config, motion: Motion, title: str, *, also_faults: Container[Fault] = ()) -> Carried:
        carried = super().run(config, motion, title, also_faults=also_faults)
        if "response" in title and carried.text is None:
            raise NotCarriedOut(self.drive_state)
        return carried


def too_light(inertia_kgm2: float) -> Config:
    """2.1 kg m^2 that stick and slip, taken for less."""
    config = shipped("realistic", reducer=None, virtual__friction_kind="stick_slip")
    return config.changed(joint__inertia_kgm2=inertia_kgm2, virtual__inertia_scale=2.1 / inertia_kgm2)


def test_an_inertia_of_less_than_half_gets_the_stiffer_law(tmp_path: Path) -> None:
    """With the weak one the reference went 50 mrad, where a leg turned back, before the torque had turned."""
    carrier = watched(FirstStages)
    with pytest.raises(NotCarriedOut):
        Tune(too_light(0.8), TuneOptions(lockstep=True), carrier, tmp_path).carry_out()
    assert carrier.motions == 2  # the direction, and the first stage


def test_a_law_that_is_far_too_weak_says_what_it_may_be(tmp_path: Path) -> None:
    carrier = watched()
    with pytest.raises(MotionFault, match="POSITION_FROZEN") as raised:
        Tune(too_light(0.1), TuneOptions(lockstep=True), carrier, tmp_path).carry_out()
    assert "where joint.inertia_kgm2 (=0.1) is too small" in raised.value.hint
    assert "the encoder or its cable is dead" in raised.value.hint
    assert carrier.motions == 4  # the direction, and three laws


def test_a_joint_that_stands_under_enough_torque_is_not_tried_again(tmp_path: Path) -> None:
    path = written(tmp_path / "joint.toml", "realistic")
    text = with_fault(path, "current_loop_dead", 6.0)
    carrier = watched()
    said, _ = ended(path, carrier, text)
    assert "POSITION_FROZEN" in said
    assert carrier.motions == 2


@pytest.mark.parametrize(("since", "steps"), [(7, 6), (9, 7)])
def test_a_payload_between_the_steps_is_seen_before_gains_and_after_the_verification(
    tmp_path: Path, since: int, steps: int
) -> None:
    path = written(tmp_path / "joint.toml", "precise")
    carrier = watched()
    carrier.heavier, carrier.since = 1.3, since
    said, kept = ended(path, carrier, path.read_text())
    assert "the joint is another one: 2.1" in said
    assert len([name for name in kept if name not in ("about", "asked", "drives")]) == steps


def test_a_payload_that_is_put_on_during_the_response_is_seen(tmp_path: Path) -> None:
    path = written(tmp_path / "joint.toml", "precise")
    carrier = watched(PutOnMidway)
    carrier.heavier, carrier.since = 1.5, 5
    said, kept = ended(path, carrier, path.read_text())
    assert "the joint is another one: 2.1" in said
    assert "in the second half" in said
    assert "direction" in kept


def test_a_joint_that_stays_the_same_is_none_of_this(tmp_path: Path) -> None:
    """The twin: a little heavier than the limit allows to tell, and no fault."""
    path = written(tmp_path / "joint.toml", "precise")
    carrier = watched()
    carrier.heavier, carrier.since = 1.03, 6
    Tune(load_config(path), TuneOptions(lockstep=True), carrier, path.with_suffix(".tune")).run()
    assert "tuned by jointctl" in path.read_text()
