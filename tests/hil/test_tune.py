"""`response` and `tune` on the virtual joint in simulated time: they find what is there; a failure leaves the file."""

from __future__ import annotations

import io
import json
import re
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from jointctl.drivers.errors import (
    ConfigurationError,
    DataError,
    JointctlError,
    LimitCycle,
    MarginError,
    MotionFault,
    StoodStill,
    TooFewPoints,
    UsageError,
)
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import Fault
from jointctl.tools.analysis.linear_loop import loop_settings
from jointctl.tools.analysis.margin_gate import require_margin
from jointctl.tools.analysis.margins import margins
from jointctl.tools.configuration.config import Config, ConfigurationProblems
from jointctl.tools.configuration.drive_section import GivenPlace
from jointctl.tools.configuration.found_values import with_break_away
from jointctl.tools.configuration.load import load_config, moved, shipped_config
from jointctl.tools.configuration.sections import Trapezoid
from jointctl.tools.identification.friction_data import read_friction_data
from jointctl.tools.output import Output
from jointctl.tools.session.fault_words import FaultText
from jointctl.tools.session.plan import TerminalConsent
from jointctl.tools.tuning.carry_out import (
    ALONE,
    FED_STIFF,
    FED_STIFFEST,
    Carried,
    Carrier,
    LearningSwings,
    SLOW_OBSERVER_radps,
    TooWeak,
    _ended,
    response_by_any_law,
)
from jointctl.tools.tuning.joint_fit import fit_of
from jointctl.tools.verbs import tune_steps
from jointctl.tools.verbs.response import ResponseOptions, response
from jointctl.tools.verbs.sweep import Sweep
from jointctl.tools.verbs.tune import TuneOptions, tune
from jointctl.tools.verbs.tune_report import _shown, envelope
from jointctl.tools.verbs.tune_steps import Tune
from jointctl.tools.virtual_joint import plant_settings
from tests.bench.tune_ensemble import scaled
from tests.configurations import shipped, written
from tests.joint_sizes import Size, joint
from tests.page_figures import foreign_colours, svgs

pytestmark = pytest.mark.usefixtures("undrawn")
IN_LOCKSTEP = ResponseOptions(lockstep=True)
STIFF: dict[str, Any] = {"virtual__reducer_knees_Nm": (), "virtual__reducer_stiffness_beyond_Nmprad": ()}
LIGHT: dict[str, Any] = {  # 0.3 kg m^2 that break away at 10 Nm
    "joint__inertia_kgm2": 0.375, "virtual__inertia_scale": 0.8, "virtual__friction_positive_scale": 0.55,
    "virtual__friction_negative_scale": 0.5,
}  # fmt: skip
STICKY: dict[str, Any] = {  # 0.11 kg m^2 that break away at 14 Nm, believed to be 0.05 kg m^2
    "joint__inertia_kgm2": 0.05, "virtual__inertia_scale": 2.2, "virtual__friction_positive_scale": 0.8,
    "virtual__friction_negative_scale": 0.75,
}  # fmt: skip


def outputs(*, json_too: bool = True) -> tuple[Output, io.StringIO, io.StringIO]:
    out, err = io.StringIO(), io.StringIO()
    return Output(json=json_too, stdout=out, stderr=err), out, err


@pytest.mark.draws
def test_the_response_of_a_soft_joint_names_both_masses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    output, out, _ = outputs()
    assert response(load_config(shipped_config("realistic")), output, options=IN_LOCKSTEP) == 0
    found = json.loads(out.getvalue())
    values = {name: one["value"] for name, one in found["fit"]["values"].items()}
    assert found["fit"]["model"] == "two masses"
    assert values["inertia_kgm2"] == pytest.approx(2.1, rel=0.03)
    assert values["link_kgm2"] == pytest.approx(1.1, rel=0.06)
    assert values["late_s"] == pytest.approx(1.5e-3, abs=0.1e-3)
    assert 1.4 < values["stiffness_Nmprad"] / 1.6e4 < 2.0  # hysteresis makes a small motion stiffer
    assert (tmp_path / "realistic.response.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((tmp_path / "realistic.response.json").read_text()) == found


def friction_step(folder: Path, *, resume: bool = False) -> Tune:
    """A tune that comes to the step of the friction."""
    config = load_config(written(folder / "joint.toml", "precise"))
    carrier = Carrier(outputs()[0], TerminalConsent(outputs()[0], assume_yes=True), None)
    job = Tune(config, TuneOptions(lockstep=True, resume=resume), carrier, folder)
    job.state = {"direction": [{"numbers": {"break_away_Nm": 19.0}}], "response": {"gravity": {}}}
    return job


@dataclass(frozen=True)
class Tuned:
    """A joint whose inertia is 1.6 times what its configuration said, with lower gains than it could have, tuned."""

    before: Config
    path: Path
    printed: dict[str, Any]

    def ended_before_its_gains(self, folder: Path) -> Path:
        """The configuration as it was, in a folder of its own, and the steps that --resume goes on with."""
        path = folder / "joint.toml"
        path.write_text(self.before.text)
        shutil.copytree(self.path.with_suffix(".tune"), path.with_suffix(".tune"))
        change_steps(path, lambda state: [state.pop(name) for name in ("gains", "verification")])
        return path


def change_steps(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """What a tune has kept of its steps, changed."""
    steps = path.with_suffix(".tune") / "steps.json"
    state = json.loads(steps.read_text())
    change(state)
    steps.write_text(json.dumps(state))


@pytest.fixture(scope="module")
def tuned(tmp_path_factory: pytest.TempPathFactory) -> Tuned:
    path = written(
        tmp_path_factory.mktemp("tuned") / "joint.toml", "precise", joint__inertia_kgm2=1.3125,
        virtual__inertia_scale=1.6, control__kp=900.0, control__kv=60.0, control__observer_radps=20.0,
        control__learning=None, virtual__gravity_Nm=4.0,
    )  # fmt: skip
    before = load_config(path)
    output, out, _ = outputs()
    assert tune(before, output, options=TuneOptions(lockstep=True)) == 0
    return Tuned(before, path, json.loads(out.getvalue()))


def test_a_tune_finds_the_joint_and_writes_what_is_better(tuned: Tuned) -> None:
    before, after, text = tuned.before, load_config(tuned.path), tuned.path.read_text()
    assert after.joint.inertia_kgm2 == pytest.approx(2.1, rel=0.03)
    assert after.joint.gravity_Nm == pytest.approx(4.0, rel=0.3)
    assert after.margin.loop_delay_s is not None
    assert after.margin.loop_delay_s + after.margin.current_lag_s == pytest.approx(1.5e-3, abs=0.1e-3)
    assert after.friction.positive.tc_Nm == pytest.approx(1.1 * 0.11985, rel=0.03)
    lugre = after.friction.lugre
    assert lugre.stiffness_Nmprad == pytest.approx(8e4, rel=0.2)
    assert lugre.damping_Nmspr == pytest.approx(200.0, rel=0.2)
    assert f"# tuned by jointctl: stiffness_Nmprad = {lugre.stiffness_Nmprad:g}; " in text
    assert plant_settings(after)["inertia_kgm2"] == pytest.approx(plant_settings(before)["inertia_kgm2"], rel=1e-4)
    true = after.changed(joint__inertia_kgm2=2.1, margin__loop_delay_s=1e-3, margin__current_lag_s=5e-4)
    assert margins(loop_settings(true)[0]).phase_margin_deg > 30.0
    found = tuned.printed["verification"]
    assert found["after"]["rmse_mrad"] < 0.5 * found["before"]["rmse_mrad"]
    comments = [line.split("#", 1)[1].rstrip() for line in before.text.splitlines() if "#" in line]
    assert all(comment in text for comment in comments)
    folder = tuned.path.with_suffix(".tune")
    page = (folder / "report.html").read_text()
    assert "Bode plot" in page
    assert [foreign_colours(svg) for svg in svgs(page)] == [set()] * 3
    assert (folder / "before.toml").read_text() == before.text


@pytest.mark.parametrize(
    ("joint", "law", "inertia_kgm2", "off", "rmse_mrad"),
    [(LIGHT, FED_STIFF, 0.3, 0.08, 0.2), (STICKY, FED_STIFFEST, 0.11, 0.3, 0.2)],
)
def test_a_tune_of_a_light_joint_with_much_friction_takes_a_stiffer_law_for_its_response(
    tmp_path: Path, joint: dict[str, Any], law: str, inertia_kgm2: float, off: float, rmse_mrad: float
) -> None:
    """A weak law swung or stood, and 9 Nm would turn it round; gains with more margin stick and slide by turns."""
    path = written(tmp_path / "light.toml", "precise", **joint)
    before = load_config(path)
    output, out, _ = outputs()
    assert tune(before, output, options=TuneOptions(lockstep=True)) == 0
    found, tuned = json.loads(out.getvalue()), load_config(path)
    assert found["response"]["law"] == law
    assert tuned.joint.inertia_kgm2 == pytest.approx(inertia_kgm2, rel=off)
    assert found["verification"]["after"]["rmse_mrad"] < rmse_mrad
    true = tuned.changed(joint__inertia_kgm2=inertia_kgm2, margin__loop_delay_s=1e-3, margin__current_lag_s=5e-4)
    assert margins(loop_settings(true)[0]).phase_margin_deg > 30.0


def test_a_response_alone_of_a_light_joint_has_the_law_of_a_tune(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The friction of its configuration tells; a weak law stood still."""
    monkeypatch.chdir(tmp_path)
    output, out, err = outputs()
    config = load_config(written(tmp_path / "light.toml", "precise", **LIGHT))
    assert response(config, output, options=IN_LOCKSTEP) == 0
    assert f"law: {FED_STIFF}" in err.getvalue()
    found = json.loads(out.getvalue())["fit"]["values"]["inertia_kgm2"]
    assert found["value"] == pytest.approx(0.3, abs=found["half"])
    assert found["half"] < 0.1


@pytest.mark.slow("the whole tune of a soft joint once more, with a file that is wrong")
def test_a_motor_that_weighs_more_by_its_file_than_the_whole_joint_is_found_all_the_same(tmp_path: Path) -> None:
    """0.84 kg m^2, of which 0.3 are the motor's; by the file they are 2.1 and 0.95."""
    wrong = {"virtual__inertia_scale": 0.4, "virtual__motor_side_inertia_kgm2": 0.3}
    path = written(tmp_path / "soft.toml", "realistic", **wrong)
    output, *_ = outputs()
    assert tune(load_config(path), output, options=TuneOptions(lockstep=True)) == 0
    found = load_config(path)
    assert found.joint.inertia_kgm2 == pytest.approx(0.84, rel=0.05)
    assert found.reducer.motor_inertia_kgm2 == pytest.approx(0.3, rel=0.1)


@pytest.mark.parametrize("gains", [(300.0, 20.0, 80.0), (80.8, 6.03, 32.16)], ids=["refused", "just accepted"])
def test_on_a_slow_bus_the_response_finds_gains_of_its_own(tmp_path: Path, gains: tuple[float, float, float]) -> None:
    """At 250 Hz the gate refuses the weak law, and the file's, or the file's on the joint that is found."""
    control = dict(zip(("control__kp", "control__kv", "control__observer_radps"), gains, strict=True))
    path = written(tmp_path / "soft.toml", "realistic", loop__rate_Hz=250, control__velocity_cutoff_Hz=100, **control)
    output, _, err = outputs()
    carrier = Carrier(output, TerminalConsent(output, assume_yes=True), None)
    before = with_break_away(load_config(path), 19.0)
    law, task, (found, *_) = response_by_any_law(before, 12, carrier)
    assert law == ALONE
    assert task.config.control.kind == "flexible_joint"
    assert ("the gate refuses the gains of the file; for the response: kp" in err.getvalue()) == (gains[0] == 300.0)
    assert fit_of(found, task.config, 19.0).inertia_kgm2.value == pytest.approx(2.1, rel=0.03)


def test_a_map_at_which_the_joint_swings_is_measured_faster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moved, speeds = Carrier.run, list[float]()

    def swings(self: Carrier, config: Config, *rest: Any) -> Any:
        assert isinstance(config.trajectory, Trapezoid)
        speeds.append(config.trajectory.speed_radps)
        if len(speeds) < 3:
            raise LimitCycle("swings")
        return moved(self, config, *rest)

    monkeypatch.setattr(Carrier, "run", swings)
    output, _, err = outputs()
    carrier = Carrier(output, TerminalConsent(output, assume_yes=True), None)
    job = Tune(load_config(shipped_config("realistic")), TuneOptions(lockstep=True), carrier, tmp_path)
    assert len(job._step_map()["kinematic_error_rad"]) >= 2
    assert speeds == [0.03, 0.06, 0.12]
    assert err.getvalue().count("swings: once more, faster") == 2
    speeds[:] = []
    job.original = job.config = job.config.changed(limits__velocity_max_radps=0.2)
    with pytest.raises(LimitCycle, match="swings"):
        job._step_map()  # half of 0.2 rad/s is less than 0.12
    assert speeds == [0.03, 0.06]


@pytest.mark.parametrize("error", [MarginError, TooWeak])
def test_a_law_that_cannot_look_whether_the_joint_is_the_same_is_no_end(
    monkeypatch: pytest.MonkeyPatch, error: type[MotionFault], tmp_path: Path
) -> None:
    monkeypatch.setattr(tune_steps, "require_same_joint", Mock(side_effect=error("it swings")))
    output, _, err = outputs()
    carrier = Carrier(output, TerminalConsent(output, assume_yes=True), None)
    job = Tune(load_config(shipped_config("precise")), TuneOptions(lockstep=True), carrier, tmp_path)
    job.state |= {"direction": [{"numbers": {}}], "response": {"law": FED_STIFF}}
    job.fit, job.response = Mock(), Mock()
    job._require_same_joint("before the gains")
    assert "warning: whether it is the same joint before the gains is not measured: it swings" in err.getvalue()


@pytest.mark.parametrize("dead", [False, True])
def test_a_reading_that_stood_with_the_old_gains_is_looked_at_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dead: bool
) -> None:
    """A friction of the file that is too large throws a light joint, which then stands; an encoder may be dead too."""
    runs: list[str] = []

    def verified(self: Tune, config: Config, title: str) -> dict[str, Any]:
        assert (config is self.config) is (title != "the same before")
        runs.append(title)
        if dead and runs[1:] and title != "the same before":
            raise MotionFault("verification once more: POSITION_FROZEN", "")
        return {"fault": "POSITION_FROZEN"} if title == "the same before" else {"rmse_mrad": 0.1}

    monkeypatch.setattr(Tune, "_verified", verified)
    monkeypatch.setattr(tune_steps, "require_same_joint", lambda *given: None)
    carrier = Carrier(outputs()[0], TerminalConsent(outputs()[0], assume_yes=True), None)
    job = Tune(load_config(shipped_config("precise")), TuneOptions(lockstep=True), carrier, tmp_path)
    job.state |= {"direction": [{"numbers": {}}], "response": {"law": FED_STIFF}}
    job.fit, job.response = Mock(), Mock()
    if dead:
        with pytest.raises(MotionFault, match="POSITION_FROZEN"):
            job._step_verification()
    else:
        assert job._step_verification()["before"] == {"fault": "POSITION_FROZEN"}
    assert runs == ["verification", "the same before", "verification once more"]


def test_a_joint_that_learning_makes_worse_is_tuned_without_it(tmp_path: Path) -> None:
    """Its friction stops it within a few milliseconds, at other places in every period."""
    size = Size(4.2, 0.0086, 5.0, 0.31, 1.1, 0.34, 17)
    true = joint(size, virtual__command_delay_s=0.8e-3, virtual__current_lag_s=0.7e-3)
    output, _, err = outputs()
    carrier = Carrier(output, TerminalConsent(output, assume_yes=True), None)
    believed = true.changed(joint__inertia_kgm2=0.55 * 0.0086, virtual__inertia_scale=1.0 / 0.55)
    job = Tune(believed, TuneOptions(lockstep=True), carrier, tmp_path)
    job.carry_out()
    assert re.search(r"learning is left out: with it the error that repeats was 1\.\d\d times that of", err.getvalue())
    assert job.config.control.learning is None
    assert "learning" not in job.state["gains"]["control"]
    after = job.state["verification"]["after"]
    assert job.gains is not None
    with_learning = job._verified(job._with_control(job.gains.control), "verification")
    assert after["rmse_mrad"] < 0.8 * with_learning["rmse_mrad"]


@pytest.mark.parametrize(("learned_Nm", "kind"), [(0.0, LimitCycle), (0.1, LearningSwings)])
def test_a_limit_cycle_is_that_of_learning_only_where_it_added_torque(learned_Nm: float, kind: type) -> None:
    records = new(LogRecord, 10)
    records.learned_torque_Nm[-1] = learned_Nm
    error = _ended("verification", Carried(records, Fault.LIMIT_CYCLE, FaultText("it swung", "cause", "next"), ""))
    assert type(error) is kind
    assert error.message == "verification: LIMIT_CYCLE (27): it swung"
    assert error.hint == "likely cause: cause; next: next"


SWINGS = "verification: LIMIT_CYCLE (27): torque swung"


@pytest.mark.parametrize(
    ("outcome", "left_out"),
    [
        ({"rmse_mrad": 0.1, "learning": 0.99}, None),
        ({"rmse_mrad": 0.1, "learning": None}, None),
        ({"rmse_mrad": 0.1, "learning": 1.01}, "the error that repeats was 1.01 times that of"),
        (LearningSwings(SWINGS, "lower the gains"), "LIMIT_CYCLE (27): torque swung"),
        (LimitCycle(SWINGS, "lower the gains"), None),  # before it had learned anything
    ],
)
def test_learning_that_does_not_help_is_left_out_and_what_remains_is_verified(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, outcome: Any, left_out: str | None
) -> None:
    runs: list[bool] = []

    def verified(_: Tune, config: Config, title: str) -> dict[str, Any]:
        runs.append(config.control.learning is not None)
        if title == "verification" and isinstance(outcome, Exception):
            raise outcome
        return dict(outcome) if title == "verification" else {"rmse_mrad": 0.2, "learning": None}

    monkeypatch.setattr(Tune, "_verified", verified)
    output, _, err = outputs()
    carrier = Carrier(output, TerminalConsent(output, assume_yes=True), None)
    job = Tune(load_config(shipped_config("precise")), TuneOptions(), carrier, tmp_path)
    job.state["gains"] = {"control": {"learning": {}}}
    if isinstance(outcome, LimitCycle) and left_out is None:
        with pytest.raises(LimitCycle):
            job._verified_with_what_helps()
        assert runs == [True]
        return
    found = job._verified_with_what_helps()
    assert found["rmse_mrad"] == (0.1 if left_out is None else 0.2)
    assert runs == ([True] if left_out is None else [True, False])
    assert (job.config.control.learning is None) is ("learning" not in job.state["gains"]["control"]) is bool(left_out)
    assert f"warning: iterative learning is left out: with it {left_out}" in err.getvalue() or left_out is None


def test_a_law_that_is_none_of_the_file_is_no_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gains that the gate names for the spring of the first step would change nothing in the file."""
    path = written(tmp_path / "soft.toml", "realistic")
    refusal = MarginError("phase margin (=9.3 deg) must be at least 30 deg", "control.kv = 7.8")
    monkeypatch.setattr(Carrier, "run", Mock(side_effect=refusal))
    with pytest.raises(MarginError, match=r"direction: phase margin \(=9\.3 deg\)") as raised:
        tune(load_config(path), outputs()[0], options=TuneOptions(lockstep=True))
    assert "control." not in raised.value.hint
    assert "loop.rate_Hz" in raised.value.hint


@pytest.mark.parametrize(("after", "worse"), [(0.029, False), (0.031, True)])
def test_gains_that_track_worse_than_the_old_ones_are_named(tmp_path: Path, after: float, worse: bool) -> None:
    output, _, err = outputs()
    carrier = Carrier(output, TerminalConsent(output, assume_yes=True), None)
    job = Tune(load_config(shipped_config("precise")), TuneOptions(lockstep=True), carrier, tmp_path)
    job._take_verification({"after": {"rmse_mrad": after}, "before": {"rmse_mrad": 0.02}})
    assert f"RMSE before 0.0200 mrad, after {after:.4f} mrad" in err.getvalue()
    assert ("warning: the old gains track better; " in err.getvalue()) is worse
    job._take_verification({"after": {"rmse_mrad": after}, "before_refused": "too soft"})


def test_an_unstable_loop_has_no_margins_in_the_table() -> None:
    """Its sensitivity of inf and its gain margin of 1 read as figures of a loop that runs."""
    config = load_config(shipped_config("precise"))
    for factor, words in ((1.0, "1.7"), (4.0, "unstable")):
        found = margins(loop_settings(config.changed(control__kp=factor**2 * 3600.0, control__kv=factor * 120.0))[0])
        assert _shown(found, "sensitivity_peak", ".1f") == words
    assert _shown(None, "sensitivity_peak", ".1f") == "-"


def test_all_problems_of_a_step_are_told_with_what_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def problems(_: Tune) -> None:
        raise ConfigurationProblems(["one", "other"])

    monkeypatch.setattr(Tune, "_step_direction", problems)
    path = written(tmp_path / "joint.toml", "precise")
    output, *_ = outputs()
    with pytest.raises(ConfigurationProblems) as raised:
        tune(load_config(path), output, options=TuneOptions(lockstep=True))
    assert str(raised.value).startswith(f"direction: one\nother; {path} is as it was")
    assert "has the steps before" not in str(raised.value)


@pytest.mark.parametrize("step", ["direction", "response"])
def test_an_interruption_offers_to_go_on_only_where_a_step_was_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    def interrupted(_: Tune) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Tune, "_step_direction", lambda _: [])
    monkeypatch.setattr(Tune, f"_step_{step}", interrupted)
    path = written(tmp_path / "joint.toml", "precise")
    output, _, err = outputs()
    kept = tmp_path / "joint.tune" / "steps.json"
    kept.parent.mkdir()
    kept.write_text("{}")  # an older tune's, which --resume must not go on with
    assert tune(load_config(path), output, options=TuneOptions(lockstep=True)) == 130
    assert ("--resume goes on" in err.getvalue()) == kept.exists()
    assert ("no step was done" in err.getvalue()) == (step == "direction")


def resumed(path: Path, config: Config, *, lockstep: bool = True) -> Tune:
    """A tune that goes on with the steps in its folder, up to its first step."""
    carrier = Carrier(outputs()[0], TerminalConsent(outputs()[0], assume_yes=True), None)
    job = Tune(config, TuneOptions(lockstep=lockstep, resume=True), carrier, path.with_suffix(".tune"))
    job._open()
    return job


def begun_tune(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The configuration of a simulated tune that was interrupted after its first step."""
    monkeypatch.setattr(Tune, "_step_direction", lambda _: [])
    monkeypatch.setattr(Tune, "_step_response", Mock(side_effect=KeyboardInterrupt))
    path = written(folder / "joint.toml", "precise")
    assert tune(load_config(path), outputs()[0], options=TuneOptions(lockstep=True)) == 130
    return path


def test_a_real_joint_does_not_go_on_with_the_steps_of_the_simulated_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor another joint on the bus: its directions were not looked at."""
    path = begun_tune(tmp_path, monkeypatch)
    config = load_config(path)
    with pytest.raises(DataError, match="of a simulated joint instead of a real one"):
        resumed(path, config, lockstep=False)
    for elsewhere in (GivenPlace(channel="other"), GivenPlace(node=5)):
        with pytest.raises(DataError, match="of another drive"):
            resumed(path, moved(config, elsewhere, {}))


def test_its_twin_goes_on_with_those_of_the_same_joint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = begun_tune(tmp_path, monkeypatch)
    assert resumed(path, load_config(path)).state == {"direction": []}


@pytest.mark.parametrize("damaged", ["[]", "7", "[" * 2000, '{"about": 3}'])
def test_steps_that_mean_nothing_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damaged: str) -> None:
    path = begun_tune(tmp_path, monkeypatch)
    (path.with_suffix(".tune") / "steps.json").write_text(damaged)
    with pytest.raises(DataError, match=r"steps\.json"):
        resumed(path, load_config(path))


@pytest.mark.parametrize(
    ("step", "kept"),
    [
        ("response", {}), ("response", None), ("friction", {}), ("bristles", {}), ("gains", {"control": {"kp": -1.0}}),
        ("verification", {}),
    ],
)  # fmt: skip
def test_a_step_that_means_nothing_is_refused_before_the_file_is_written(
    tuned: Tuned, tmp_path: Path, step: str, kept: Any
) -> None:
    path = tuned.ended_before_its_gains(tmp_path)
    shutil.copy(tuned.path.with_suffix(".tune") / "steps.json", path.with_suffix(".tune") / "steps.json")
    change_steps(path, lambda state: state.update({step: kept}))
    with pytest.raises(DataError, match=rf"steps\.json: the step {step} cannot be read") as raised:
        tune(load_config(path), outputs()[0], options=TuneOptions(lockstep=True, resume=True))
    assert raised.value.hint == "without --resume it begins anew"
    assert path.read_text() == tuned.before.text


@pytest.mark.parametrize("name", ["friction.csv", "friction.json"])
def test_a_measured_friction_that_is_gone_is_missed_before_the_file_is_written(
    tuned: Tuned, tmp_path: Path, name: str
) -> None:
    """The report needs it: the tune ended in an error when the configuration was written already."""
    path = tuned.ended_before_its_gains(tmp_path)
    (path.with_suffix(".tune") / name).unlink()
    with pytest.raises(DataError, match=rf"friction: .*{name}: .* is as it was") as raised:
        tune(load_config(path), outputs()[0], options=TuneOptions(lockstep=True, resume=True))
    assert raised.value.hint == "without --resume it begins anew"
    assert path.read_text() == tuned.before.text


def test_a_file_that_was_changed_during_the_tune_is_left_as_it_is(
    tuned: Tuned, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A limit that its user has narrowed in the meantime must not be as wide again, nor count for steps before it."""
    path = tuned.ended_before_its_gains(tmp_path)
    config, narrower = load_config(path), path.read_text().replace("position_max_rad = 0.7", "position_max_rad = 0.5")
    assert narrower != config.text
    begin = Tune.run

    def edited(job: Tune) -> int:
        path.write_text(narrower)  # while the question is open
        return begin(job)

    monkeypatch.setattr(Tune, "run", edited)
    with pytest.raises(DataError, match="was changed during the tune, and is left as it is"):
        tune(config, outputs()[0], options=TuneOptions(lockstep=True, resume=True))
    assert path.read_text() == narrower
    assert "95 %" in (path.with_suffix(".tune") / "tuned.toml").read_text()
    with pytest.raises(DataError, match="is of another configuration"):
        resumed(path, load_config(path))


def test_a_tune_of_a_soft_joint_with_two_encoders_passes_the_gate_in_every_step(tmp_path: Path) -> None:
    path = written(tmp_path / "soft.toml", "realistic")
    output, out, _ = outputs()
    assert tune(load_config(path), output, options=TuneOptions(lockstep=True)) == 0
    assert json.loads(out.getvalue())["friction"]["points"] > 30
    tuned = load_config(path)
    assert tuned.control.kind == "flexible_joint"
    assert tuned.control.observer_radps > SLOW_OBSERVER_radps  # not a slower one, which measures the friction
    require_margin(tuned)


@pytest.mark.slow("the whole tune of a soft joint once more, with the other encoder")
def test_a_tune_of_a_soft_joint_with_its_encoder_on_the_link_alone_passes_the_gate(tmp_path: Path) -> None:
    control = load_config(shipped_config("precise")).control.model_dump(mode="json", exclude_none=True)
    path = written(
        tmp_path / "link.toml", "realistic", encoder__side="joint", encoder__counts_per_turn=524288, joint_encoder=None,
        reducer=None, control=control,
    )  # fmt: skip
    output, out, _ = outputs()
    assert tune(load_config(path), output, options=TuneOptions(lockstep=True)) == 0
    found, tuned = json.loads(out.getvalue()), load_config(path)
    assert found["gains"]["law"] == "link_encoder"
    assert not found["response"]["fit"]["tells_link"]
    assert tuned.joint.inertia_kgm2 == pytest.approx(2.1, rel=0.03)
    assert found["verification"]["after"]["rmse_mrad"] < 1.5
    assert "before_refused" in found["verification"]
    assert "a share that the encoder on the link does not tell" in path.read_text()
    require_margin(tuned)


@pytest.mark.parametrize(("ends", "slowest"), [([LimitCycle("")], 25.0), ([TooFewPoints(""), LimitCycle("")], 8.0)])
def test_slow_plateaus_that_swing_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: list[JointctlError], slowest: float
) -> None:
    job = friction_step(tmp_path)
    measure, todo = Tune._sweep, list(ends)

    def swings(self: Tune, command: Sweep) -> None:
        if todo:
            raise todo.pop(0)
        measure(self, command)

    monkeypatch.setattr(Tune, "_sweep", swings)
    assert job._step_friction()["points"] > 30
    speeds = np.abs(read_friction_data(tmp_path / "friction.csv", None).velocity_radps)
    assert np.max(speeds) / np.min(speeds) == pytest.approx(slowest, rel=0.03)
    before = (tmp_path / "friction.csv").read_bytes()
    assert friction_step(tmp_path, resume=True)._step_friction()["points"] > 30  # with what there is
    assert (tmp_path / "friction.csv").read_bytes() == before
    todo += [LimitCycle("swings")] * 3
    with pytest.raises(LimitCycle, match="swings"):
        friction_step(tmp_path)._step_friction()


@pytest.mark.parametrize(
    ("side", "slid", "resumed", "tries"),
    [
        ("joint", True, False, 3), ("joint", False, False, 1),
        ("joint", True, True, 1),  # what was measured before tells nothing of the encoder now
        ("motor", True, False, 1), (None, True, False, 1),
    ],
)  # fmt: skip
def test_slow_plateaus_at_which_a_joint_sticks_behind_its_links_encoder_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, side: Any, slid: bool, resumed: bool, tries: int
) -> None:
    """A reading that never moved is an encoder; a loop over the link's encoder sticks and slides at low speed."""
    job, seen = friction_step(tmp_path), list[float]()
    if side is not None:
        job.config = job.config.changed(reducer=shipped("realistic").reducer, encoder__side=side)

    def sticks(self: Tune, command: Sweep) -> None:
        command.options = replace(command.options, resume=resumed)
        seen.append(min(abs(point.velocity_radps) for point in command.plan.points))
        command.file = Mock(done={0} if slid else set(), elapsed_s=1.0)
        raise StoodStill("stood still")

    monkeypatch.setattr(Tune, "_sweep", sticks)
    with pytest.raises(StoodStill, match="stood still"):
        job._step_friction()
    assert len(seen) == tries
    assert sorted(seen) == seen


@pytest.mark.parametrize(
    ("error", "missing", "counts"), [(LimitCycle, 0, True), (LimitCycle, 1, False), (StoodStill, 0, False)]
)
def test_plateaus_that_are_all_measured_count_where_the_last_sweep_swings_at_one_once_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[MotionFault], missing: int, counts: bool
) -> None:
    """Of a rigid joint whose reading stands then, as it does where the encoder is dead, nothing counts."""
    job, measure = friction_step(tmp_path), Tune._sweep

    def swings(self: Tune, command: Sweep) -> None:
        if min(abs(point.velocity_radps) for point in command.plan.points) > 0.05:  # the last one
            measure(self, command)
            command.file = Mock(done=set(range(len(command.plan.points) - missing)), elapsed_s=1.0)
            raise error("swings")
        raise LimitCycle("swings")

    monkeypatch.setattr(Tune, "_sweep", swings)
    with nullcontext() if counts else pytest.raises(error):
        assert job._step_friction()["points"] > 30


def test_a_tune_chooses_the_law_of_the_paper_where_it_is_wanted(tuned: Tuned, tmp_path: Path) -> None:
    path = tuned.ended_before_its_gains(tmp_path)
    output, out, _ = outputs()
    assert tune(load_config(path), output, options=TuneOptions(lockstep=True, law="paper", resume=True)) == 0
    control = load_config(path).control
    assert (control.kind, control.observer_radps) == ("computed_torque_rbf", 0.0)
    found = json.loads(out.getvalue())["verification"]
    assert found["after"]["rmse_mrad"] < found["before"]["rmse_mrad"]


def test_a_tune_goes_on_where_it_ended(tuned: Tuned, tmp_path: Path) -> None:
    path = tuned.ended_before_its_gains(tmp_path)
    change_steps(path, lambda state: state["response"].update(legs=77))
    output, _, err = outputs()
    assert tune(load_config(path), output, options=TuneOptions(lockstep=True, resume=True)) == 0
    assert "friction: done before" in err.getvalue()
    assert path.read_text() == tuned.path.read_text().replace("of 12 legs", "of 77 legs")
    kv = load_config(path).control.kv
    with pytest.raises(DataError, match="is of another configuration or torque than"):
        tune(load_config(path), output, options=TuneOptions(lockstep=True, torque_Nm=50.0, resume=True))
    output, _, err = outputs()  # another objective for what was identified
    assert tune(load_config(path), output, options=TuneOptions(lockstep=True, objective="quiet", resume=True)) == 0
    assert "friction: done before" in err.getvalue()
    assert "gains: done before" not in err.getvalue()
    assert load_config(path).control.kv not in (kv, tuned.before.control.kv)


def test_a_tune_of_before_the_bristles_measures_them_and_chooses_its_gains_again(tuned: Tuned, tmp_path: Path) -> None:
    """A folder of an older version is gone on with from the step that it lacks, also where the tune was finished."""
    path = tuned.ended_before_its_gains(tmp_path)
    shutil.copy(tuned.path.with_suffix(".tune") / "steps.json", path.with_suffix(".tune") / "steps.json")
    change_steps(path, lambda state: state.pop("bristles"))
    output, out, err = outputs()
    assert tune(load_config(path), output, options=TuneOptions(lockstep=True, resume=True)) == 0
    said = err.getvalue()
    assert "friction: done before" in said
    assert not any(f"{name}: done before" in said for name in ("bristles", "gains", "verification"))
    assert json.loads(out.getvalue())["bristles"]["found_Nmprad"] == pytest.approx(8e4, rel=0.2)


def test_the_bristles_of_a_stick_slip_joint_are_a_bound(tmp_path: Path) -> None:
    """No stiffer than what bends by a quarter of a count; a file without the section gets one."""
    friction = load_config(shipped_config("precise")).friction.model_dump(exclude={"lugre"}, exclude_none=True)
    path = written(
        tmp_path / "joint.toml", "precise", virtual__friction_kind="stick_slip", encoder__counts_per_turn=2**17,
        friction=friction, control__feed_forward="desired",
    )  # fmt: skip
    config = load_config(path)
    job = Tune(
        config,
        TuneOptions(lockstep=True),
        Carrier(outputs()[0], TerminalConsent(outputs()[0], assume_yes=True), None),
        tmp_path,
    )
    job.fit = Mock(flexible=False)
    kept = job._step_bristles()
    assert (kept["found_Nmprad"], kept["most_Nmprad"]) == (None, None)
    assert 1e6 < kept["stiffness_Nmprad"] <= kept["least_Nmprad"]
    job._take_bristles(kept)
    assert job.config.friction is not None
    assert job.config.friction.lugre is not None
    assert job.config.friction.lugre.stiffness_Nmprad == kept["stiffness_Nmprad"]


def test_the_bristles_of_a_soft_joint_are_left_alone(tmp_path: Path) -> None:
    config = load_config(shipped_config("realistic"))
    carrier = Carrier(outputs()[0], TerminalConsent(outputs()[0], assume_yes=True), None)
    job = Tune(config, TuneOptions(lockstep=True), carrier, tmp_path)
    job.fit = Mock(flexible=True)
    job._take_bristles(job._step_bristles())
    assert job.config == config


def refined(path: Path) -> Tune:
    """A tune that goes on with the steps in its folder, and then refines what it chose."""
    carrier = Carrier(outputs()[0], TerminalConsent(outputs()[0], assume_yes=True), None)
    options = TuneOptions(lockstep=True, refine=True, resume=True)
    job = Tune(load_config(path), options, carrier, path.with_suffix(".tune"))
    job.carry_out()
    return job


def test_gains_that_measure_better_bring_their_own_margins(
    tuned: Tuned, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tuned.ended_before_its_gains(tmp_path)
    errors, learning = iter(0.1 * 0.5**k for k in range(20)), list[bool]()

    def verified(_: Tune, config: Config, title: str) -> dict[str, Any]:
        learning.append(config.control.learning is not None)
        factor = 1.1 if learning[-1] else None
        return {"rmse_mrad": next(errors), "peak_mrad": 1.0, "chatter_Nm": 0.1, "learning": factor}

    monkeypatch.setattr(Tune, "_verified", verified)
    job = refined(path)
    gains, kept = job.gains, job.state["gains"]
    assert gains is not None
    assert len(job.state["refinement"]["runs"]) > 1
    assert learning[0]
    assert not any(learning[1:])  # nor has the file as it was
    assert kept["control"]["kv"] == job.config.control.kv == gains.best.settings.kv
    assert kept["control"]["kv"] == job.state["refinement"]["runs"][-1]["kv"]
    assert kept["phase_margin_deg"] == gains.best.phase_margin_deg


@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_gains_with_which_learning_does_harm_are_no_better(
    tuned: Tuned, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factor: float
) -> None:
    path = tuned.ended_before_its_gains(tmp_path)

    def verified(_: Tune, __: Config, title: str) -> dict[str, Any]:
        refined = title == "refinement"
        return {"rmse_mrad": 0.1 if refined else 0.2, "learning": factor if refined else 0.5}

    monkeypatch.setattr(Tune, "_verified", verified)
    job = refined(path)
    assert job.state["verification"]["after"]["rmse_mrad"] == (0.1 if factor < 1.0 else 0.2)


@pytest.mark.parametrize(
    ("name", "changes", "error", "words"),
    [
        # as stuck as a joint with its brake closed
        ("precise", {"virtual__friction_positive_scale": 9.0, "virtual__friction_negative_scale": 9.0}, MotionFault,
         r"direction: the reading of \[encoder\] stood still .* at up to 60.0 Nm"),
        ("precise", {"virtual__friction_positive_scale": 2.2, "virtual__friction_negative_scale": 2.2}, MotionFault,
         r"friction: TORQUE_SATURATED .* 34 points are in .*friction.csv"),
        ("precise",
         {"virtual__end_stops": True, "virtual__end_stop_min_rad": -0.3, "virtual__end_stop_max_rad": 0.3}, MotionFault,
         r"response: .*(FOLLOWING_ERROR|TORQUE_SATURATED|POSITION_FROZEN|LIMIT_CYCLE)"),
        # a reducer that is 100 times as stiff as [reducer] says, and one of 12 times that
        ("realistic", {**STIFF, "virtual__reducer_stiffness_Nmprad": 1.6e6}, ConfigurationError,
         r"response: .*: \[reducer\] has a resonance at 36 Hz, and the response shows none; .*correct \[reducer\]"),
        ("realistic", {**STIFF, "virtual__reducer_stiffness_Nmprad": 2e5}, ConfigurationError,
         r"response: .*: reducer.loop_stiffness_Nmprad \(=\d+\) must be at most 310000, .*correct that section"),
    ],
)  # fmt: skip
def test_a_joint_that_does_not_move_as_it_should_ends_it_in_one_line(
    tmp_path: Path, name: str, changes: dict[str, object], error: type[JointctlError], words: str
) -> None:
    path = written(tmp_path / "joint.toml", name, **changes)
    text = path.read_text()
    output, *_ = outputs()
    with pytest.raises(error, match=words) as raised:
        tune(load_config(path), output, options=TuneOptions(lockstep=True))
    assert "is as it was" in str(raised.value)
    assert path.read_text() == text


@pytest.mark.parametrize(("frequency_Hz", "kind"), [(0.1, "sine"), (1.0, "min_jerk")])
@pytest.mark.parametrize("title", ["verification", "the same before"])
def test_it_is_verified_from_wherever_the_joint_stands(
    tmp_path: Path, frequency_Hz: float, kind: str, title: str
) -> None:
    """The sine begins with speed, 80 mrad from a limit: from the other one its approach would swing beyond it."""
    output, *_ = outputs()
    carrier = Carrier(output, TerminalConsent(output, assume_yes=True), None)
    for start_rad in (-0.69, 0.69):
        config = load_config(shipped_config("precise")).changed(
            trajectory__offset_rad=-0.62, trajectory__amplitude_rad=0.05,
            trajectory__frequency_Hz=frequency_Hz, sequence__approach_s=0.0, virtual__initial_position_rad=start_rad,
        )  # fmt: skip
        job = Tune(config, TuneOptions(lockstep=True), carrier, tmp_path)
        assert f"verify     {kind} " in "\n".join(envelope(job))
        assert job._verified(config, title)["peak_mrad"] < 5.0


@pytest.mark.parametrize(("duration_s", "shown"), [(0.0, "30 s"), (40.0, "30 s"), (10.0, "10 s"), (2.5, "2.5 s")])
def test_the_time_of_the_run_that_verifies_is_that_which_is_announced(duration_s: float, shown: str) -> None:
    output, *_ = outputs()
    config = load_config(shipped_config("precise")).changed(trajectory__duration_s=duration_s)
    job = Tune(
        config, TuneOptions(lockstep=True), Carrier(output, TerminalConsent(output, assume_yes=True), None), Path()
    )
    (line,) = (line for line in envelope(job) if line.startswith("verify"))
    assert f"sine of the configuration, {shown}, with" in line
    assert f"{job.verifying.duration_s:g} s" == shown


def test_the_old_gains_are_compared_though_the_friction_of_the_file_was_half_of_what_was_found(tmp_path: Path) -> None:
    """The reading may stand under the true friction: with that of the file it was called frozen, at the very end."""
    output, *_ = outputs()
    carrier = Carrier(output, TerminalConsent(output, assume_yes=True), None)
    found = load_config(shipped_config("precise"))
    before = found.changed(friction=scaled(found.friction, 0.5, 0.5), virtual__friction=found.friction)
    job = Tune(before, TuneOptions(lockstep=True), carrier, tmp_path)
    assert job._verified(before, "the same before") == {"fault": "POSITION_FROZEN"}
    job.config = before.changed(friction=found.friction)
    assert job._verified(before, "the same before")["peak_mrad"] < 1.0


@pytest.mark.parametrize("plan", ["same", "another"])
def test_a_friction_step_that_was_cut_off_goes_on_where_it_ended(tmp_path: Path, plan: str) -> None:
    friction_step(tmp_path)._step_friction()
    path, beside = tmp_path / "friction.csv", tmp_path / "friction.json"
    kept, sidecar = path.read_bytes().splitlines(keepends=True)[:11], json.loads(beside.read_text())
    every = set(sidecar["measured"])
    kept[2] = b",".join([*(fields := kept[2].split(b","))[:9], b"0.001", *fields[10:]])  # at a time as no other one
    path.write_bytes(b"".join(kept))
    sidecar |= {"measured": sidecar["measured"][:10], "unsettled": {}} | ({"plan": "0"} if plan == "another" else {})
    beside.write_text(json.dumps(sidecar))
    assert friction_step(tmp_path, resume=True)._step_friction()["points"] > 30
    assert set(json.loads(beside.read_text())["measured"]) == every
    assert (path.read_bytes().splitlines(keepends=True)[:11] == kept) is (plan == "same")


def test_what_cannot_be_is_refused_before_anything_moves(tmp_path: Path) -> None:
    output, *_ = outputs()
    path = written(tmp_path / "joint.toml", "precise")
    for options, words in (
        (TuneOptions(lockstep=True, law="best"), r"--law \(=best\) must be one of auto, paper"),
        (TuneOptions(lockstep=True, objective="fast"), r"--objective \(=fast\) must be one of"),
        (TuneOptions(lockstep=True, torque_Nm=99.0), r"--torque \(=99\) must be in \(0..60\]"),
        (TuneOptions(lockstep=True, torque_Nm=10.0), r"the torque \(=10 Nm\) must be more than"),
    ):
        with pytest.raises(UsageError, match=words):
            tune(load_config(path), output, options=options)
    with pytest.raises(ConfigurationError, match="is a shipped configuration and is not changed"):
        tune(load_config(shipped_config("precise")), output, options=TuneOptions(lockstep=True))
    wrong = written(tmp_path / "wrong.toml", "precise", joint__torque_constant_NmpA=0.8)
    with pytest.raises(ConfigurationError, match=r"is 8 times drive.rated_torque_Nm \(=0.5\): one of them is wrong"):
        tune(load_config(wrong), output, options=TuneOptions(lockstep=True))
    assert not (tmp_path / "wrong.tune").exists()
    over = written(tmp_path / "over.toml", "precise", trajectory__duration_s=0.001)
    with pytest.raises(UsageError, match=r"trajectory.duration_s \(=0.001\) must be 0 or at least 0.5"):
        tune(load_config(over), output, options=TuneOptions(lockstep=True))
    with pytest.raises(DataError, match=r"steps.json: cannot be read"):
        tune(load_config(path), output, options=TuneOptions(lockstep=True, resume=True))
    with pytest.raises(UsageError, match=r"--legs \(=2\) must be in \[8..100\]"):
        response(load_config(path), output, options=ResponseOptions(legs=2, lockstep=True))
