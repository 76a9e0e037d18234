"""What a page asks for: only what its viewer has typed, from where the joint is, and how long a motion goes on."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.drive import CommissioningReport, DriveIdentity
from jointctl.drivers.errors import DECLINED, MotionFault
from jointctl.firmware_py.realtime import HISTOGRAM_BINS, Word
from jointctl.firmware_py.records import AxisState, LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, StopRequest
from jointctl.tools.output import Output
from jointctl.tools.session import session as session_module
from jointctl.tools.session.bus_watch import BusWatch
from jointctl.tools.session.control import StopSignals
from jointctl.tools.session.display import ViewerRequest
from jointctl.tools.session.live_changes import new_motion
from jointctl.tools.session.live_panel import time_left
from jointctl.tools.session.plan import resolve
from jointctl.tools.session.run_watch import Around, RunParts, RunWatch
from jointctl.tools.session.session import Session
from jointctl.tools.verbs import scope as scope_module
from tests.sessions import constants_of

TABLE = np.zeros((1, 5))


class Panels:
    """The change panels' fields without a browser."""

    def __init__(self, **shown: float) -> None:
        panels = pytest.importorskip("jointctl.tools.scoping.scope_page")
        self.asked: list[tuple[str, dict[str, Any]]] = []
        self.panels = panels.ChangePanels.__new__(panels.ChangePanels)
        self.panels._ask = lambda kind, values: self.asked.append((kind, values))
        self.fields = {name: SimpleNamespace(value=value) for name, value in shown.items()}
        self.panels._gains = {name: panels.Followed(field, ".5g") for name, field in self.fields.items()}

    def in_force(self, **now: float) -> None:
        for name, value in now.items():
            self.panels._gains[name].follow(value)

    def apply(self) -> list[tuple[str, dict[str, Any]]]:
        self.asked.clear()
        self.panels._apply()
        return self.asked


def test_apply_sends_what_was_typed_and_puts_nothing_back() -> None:
    page = Panels(kp=784.0, kv=56.0)
    page.fields["kv"].value = 60.0
    page.in_force(kp=700.0, kv=56.0)  # another viewer has changed kp
    assert page.fields["kp"].value == 700.0
    assert page.apply() == [("gains", {"kv": 60.0})]
    page.in_force(kp=700.0, kv=60.0)
    assert page.apply() == []  # it is in force: nothing is the viewer's own any more
    page.in_force(kp=700.0, kv=50.0)
    assert page.fields["kv"].value == 50.0


def test_what_was_typed_stays_until_it_is_in_force() -> None:
    page = Panels(kp=784.0)
    page.fields["kp"].value = 900.0
    for now in (784.0, 800.0, 850.0):
        page.in_force(kp=now)
        assert page.fields["kp"].value == 900.0
    assert page.apply() == [("gains", {"kp": 900.0})]
    page.fields["kp"].value = None
    assert page.apply() == [("gains", {"kp": None})]  # refused by the supervisor, in words


def test_what_a_browser_rounds_was_not_typed() -> None:
    page = Panels(kp=784.12345)
    page.fields["kp"].value = 784.12
    assert page.apply() == []
    page.fields["kp"].value = 784.13
    assert page.apply() == [("gains", {"kp": 784.13})]


@pytest.mark.parametrize(
    ("values", "ends"),
    [
        ({"kind": "hold", "duration_s": 0.0, "position_rad": 0.1}, False),
        ({"kind": "sine", "duration_s": 0.0, "amplitude_rad": 0.1, "frequency_Hz": 0.2}, False),
        ({"kind": "sine", "duration_s": 5.0, "amplitude_rad": 0.1, "frequency_Hz": 0.2}, True),
        ({"kind": "configured"}, True),
    ],
)
def test_a_motion_without_an_end_says_so(
    virtual_config: Any, tmp_path: Path, values: dict[str, Any], ends: bool
) -> None:
    constants, words = new_motion(virtual_config, TABLE, values)
    assert words.endswith(", until stopped") is not ends
    assert virtual_config.trajectory.duration_s > 0.0
    shown: list[Any] = []
    axis = constants_of(virtual_config, start_position_rad=0.0)
    axis[0].trajectory = constants[0]  # as the loop has taken it
    block = SimpleNamespace(
        constants=axis,
        state=new(AxisState),
        words=np.zeros(max(Word) + 1),
        histograms=np.zeros((3, HISTOGRAM_BINS), np.int64),
    )
    sink: Any = SimpleNamespace(path=tmp_path, append=lambda records: None, write_records=lambda records: None)
    display: Any = SimpleNamespace(show=shown.append, event=lambda event: None)
    sink.write_event = lambda *_: None
    loop: Any = SimpleNamespace(block=block, new_records=lambda: new(LogRecord, 1).view(np.recarray))
    around = Around(StopSignals(), BusWatch(virtual_config, None))
    RunWatch(resolve(virtual_config), axis[0], RunParts(loop, around, sink, sink, display, {})).take_records()
    assert (time_left(1e4, shown[0].duration_s, AxisPhase.TRACKING) == "until stopped") is not ends


# --- before Start, and after the end -------------------------------------------------------------------------------


class Feed:
    """Presses Start as soon as it can, and asks for the next run when the end has been told three times."""

    gone = False

    def __init__(self) -> None:
        self.told: list[dict[str, Any]] = []

    def settings(self, values: dict[str, Any]) -> None:
        self.told.append(values)

    def forget(self) -> None: ...

    def stop_request(self) -> StopRequest:
        return StopRequest.NONE

    def requests(self) -> list[ViewerRequest]:
        last = self.told[-1]
        if last["stage"] == "ready":
            return [ViewerRequest("start", "a viewer", {"number": last["number"], "clear": True})]
        return [ViewerRequest("prepare", "a viewer", {})] if self.told.count(last) >= 3 else []


@pytest.mark.parametrize("refused", [True, False])
def test_what_run_checks_is_checked_before_start(
    monkeypatch: pytest.MonkeyPatch, virtual_config: Any, refused: bool
) -> None:
    calls: list[str] = []

    def require_ready(*_: Any) -> None:
        calls.append("checked")
        if refused:
            raise MotionFault("outside", "move it")

    class Asking(Session):
        """Asks, and does not run."""

        def run(self) -> None:
            self.drive_state = "switch on disabled"
            self._allowed(CommissioningReport(DriveIdentity("", "", "", ""), "cst", 0.0, 0.1, 1e-5))

    monkeypatch.setattr(scope_module, "Session", Asking)
    monkeypatch.setattr(session_module, "require_ready", require_ready)
    monkeypatch.setattr(session_module, "prepare_log", lambda *_: calls.append("log prepared"))
    feed: Any = Feed()
    runs = scope_module._Runs(virtual_config, Output(), feed, "title", allow_low_margin=False)
    assert runs.one() is False
    assert calls == (["checked"] if refused else ["checked", "log prepared"])
    assert ("ready" in [told["stage"] for told in feed.told]) is not refused
    assert feed.told[-1]["stage"] == ("ended" if refused else "declined")
    assert runs.code == (7 if refused else DECLINED)
    assert runs.drive_state == "switch on disabled"


def test_the_end_of_a_run_is_told_until_the_next_is_prepared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scope_module, "TELL_AGAIN_S", 0.02)
    feed: Any = Feed()
    ended = {"stage": "ended", "lines": ["log"]}
    feed.settings(ended)
    scope_module._wait_for_prepare(feed, ended)
    assert feed.told == [ended] * 3
