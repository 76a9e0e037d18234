"""A stop that comes at the end of a tune: behind its last motion, or while it writes what it has found."""

from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from jointctl.drivers.errors import INTERRUPTED
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.output import Output
from jointctl.tools.session.control import StopSignals
from jointctl.tools.session.plan import TerminalConsent
from jointctl.tools.tuning import carry_out
from jointctl.tools.tuning.carry_out import Carrier, NotCarriedOut
from jointctl.tools.verbs import tune_steps
from jointctl.tools.verbs.tune import TuneOptions, tune
from jointctl.tools.verbs.tune_steps import Tune
from tests.configurations import written


def cut_off(*_: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("during", ["what was before", "the steps", "the file", "the report"])
def test_what_is_said_of_the_file_is_true_wherever_writing_is_cut_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, during: str
) -> None:
    """The report was called a file as it was; the file was replaced before what it had been was kept."""
    path, folder = written(tmp_path / "joint.toml", "precise"), tmp_path / "joint.tune"
    before, replace_file = path.read_text(), tune_steps.replace_file
    names = {"what was before": "before.toml", "the steps": "steps.json", "the file": "joint.toml"}

    def replace(target: Path, *content: Any) -> None:
        if target.name == names.get(during):
            cut_off()
        replace_file(target, *content)

    def carry_out(job: Tune) -> None:
        job._open()
        job.state = {"friction": {"points": 36, "rmse_Nm": 0.01}, "map": {}}

    monkeypatch.setattr(Tune, "carry_out", carry_out)
    monkeypatch.setattr(tune_steps, "values_of", lambda _: [])
    monkeypatch.setattr(tune_steps, "with_tuned", lambda text, *_: f"{text}# found\n")
    monkeypatch.setattr(tune_steps, "replace_file", replace)
    monkeypatch.setattr(tune_steps, "write_report", cut_off)
    err = io.StringIO()
    output = Output(stdout=io.StringIO(), stderr=err)
    assert tune(load_config(path), output, options=TuneOptions(lockstep=True), folder=folder) == INTERRUPTED
    found = path.read_text() != before
    assert found is (during == "the report")
    assert ("has what was found" in err.getvalue()) is found
    assert (f"written: {path}; as it was: " in err.getvalue()) is found  # also where the report cannot be written
    assert ("is as it was" in err.getvalue()) is not found
    assert not found or (folder / "before.toml").read_text() == before


@pytest.mark.parametrize("stopped", [True, False])
def test_a_stop_behind_the_result_of_a_motion_ends_the_tune(monkeypatch: pytest.MonkeyPatch, stopped: bool) -> None:
    """As its log was closed, say: the result says nothing of it.  The twin goes on."""
    signals = StopSignals(wake=lambda: None)

    def run(_: object) -> SimpleNamespace:
        if stopped:
            signals.on_stop_command()
        return SimpleNamespace(
            stopped_by="", lost_records=0, log_path="", fault=0, fault_text=None, fault_value=0.0
        )  # fmt: skip

    monkeypatch.setattr(carry_out, "Session", lambda *_: Mock(run=lambda: run(0), drive_state="switch on disabled"))
    monkeypatch.setattr(carry_out, "read_run_log", lambda _: Mock(records=()))
    output = Output(stdout=io.StringIO(), stderr=io.StringIO())
    carrier = Carrier(output, TerminalConsent(output, assume_yes=True), Mock(signals=signals))
    config = load_config(shipped_config("virtual"))
    if stopped:
        with pytest.raises(NotCarriedOut) as raised:
            carrier.run(config, Mock(), "verification")
        assert raised.value.stopped_by == "jointctl stop"
    else:
        assert carrier.run(config, Mock(), "verification").records == ()
