"""The scope in a headless Chromium: start, watch, change, pause, zoom, trigger, STOP, reload, two viewers, none."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import signal
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from jointctl.firmware_py.states import AxisPhase, Fault
from tests.browser import PROGRAM, Browser, Tab, free_port

MISSING = [name for name in ("nicegui", "websockets") if importlib.util.find_spec(name) is None]
pytestmark = [
    pytest.mark.skipif(PROGRAM is None, reason="no Chromium on this computer"),
    pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)} (extra `scope`)"),
]
LAST_s = "(() => { const c = document.querySelector('[data-testid=\"chart\"]'); const o = getElement(c.id.slice(1)).chart.getOption(); const d = o.series[0].data; return d[d.length - 1][0] })()"  # noqa: E501
ZOOM = "getElement(document.querySelector('[data-testid=\"chart\"]').id.slice(1)).chart"


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    with Browser(tmp_path) as browser:
        yield browser


def state_is(tab: Tab, words: str, timeout_s: float = 90.0) -> None:
    tab.until(f"document.querySelector('[data-testid=\"state\"]').innerText.includes('{words}')", timeout_s)


def environment() -> dict[str, str]:
    """Without pytest's marks: nicegui would take itself for one of its own tests."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}


def opened(bench: Any, browser: Browser, *options: str, **changes: Any) -> tuple[Any, Tab, str]:
    """`jointctl scope CONFIG` on a joint of its own, and its page at "ready"."""
    # with a browser beside it the loop may stand still for milliseconds: that is not what these tests are about
    config = bench.config(trajectory__duration_s=0.0, limits__velocity_max_radps=3.0, **changes)
    bench.joint(config)
    port = free_port()
    scope = bench.start("scope", config, "--port", str(port), *options, env=environment()).saw("token=")
    url = printed_address(scope)
    give_up = time.monotonic() + 60.0
    while True:
        try:
            urllib.request.urlopen(url, timeout=5).close()
            break
        except OSError:
            assert time.monotonic() < give_up, scope.err
            time.sleep(0.2)
    tab = browser.open(url)
    state_is(tab, "ready; nothing moves")
    return scope, tab, url


def printed_address(scope: Any) -> str:
    """With its token, as a user copies it from the terminal."""
    found = re.search(r"scope: (http://\S+)", scope.err)
    assert found is not None, scope.err
    return found[1]


def start(tab: Tab) -> None:
    """Tick and press; once more if a busy computer has cut the page off, which then begins with an empty box."""
    give_up = time.monotonic() + 120.0
    while "ready" in tab.text("state"):
        assert time.monotonic() < give_up, tab.text("state")
        if tab.js("document.querySelector('[data-testid=\"start\"]').disabled"):
            tab.click("clear")
        else:
            tab.click("start")
        time.sleep(2.0)
    state_is(tab, "tracking")


def moves(tab: Tab, within_s: float = 60.0) -> None:
    before = tab.until(LAST_s)
    tab.until(f"{LAST_s} > {before} + 0.5", within_s)


def resident_kB(pid: int) -> int:
    found = re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
    assert found is not None
    return int(found[1])


def test_nothing_moves_before_start_and_stop_stops(bench: Any, browser: Browser) -> None:
    scope, tab, url = opened(bench, browser)
    assert tab.js("document.querySelector('[data-testid=\"start\"]').disabled") is True
    tab.click("start")  # without the word that the way is clear
    time.sleep(1.0)
    state_is(tab, "ready; nothing moves")
    assert bench.is_pre_operational()
    start(tab)
    moves(tab)
    tab.enter("set-point", "-0.2")
    tab.click("go")
    told = "set-point -0.2000 rad, until stopped, by"
    tab.until(f"document.querySelector('[data-testid=\"events\"]').innerText.includes('{told}')")
    tab.enter("gain-kv", "28")
    tab.click("apply")
    tab.until("document.querySelector('[data-testid=\"events\"]').innerText.includes('the control loop is unstable')")
    tab.click("record")
    tab.until("document.querySelector('[data-testid=\"record\"]').innerText.includes('Stop')")

    tab.call("Page.reload")
    moves(tab)
    second = browser.open(url)
    moves(second)
    moves(tab)
    second.click("stop")
    state_is(tab, "the run has ended")
    state_is(second, "the run has ended")
    assert bench.disabled()
    log = bench.log()
    assert any("ramp asked for by the scope's STOP, a viewer at 127.0.0.1" in event.text for event in log.events)
    assert int(log.records.fault.max()) == Fault.NONE
    assert AxisPhase.QUICK_STOPPING not in set(log.records.phase.tolist())
    assert len(list(bench.folder.glob("runs/*.recording-1.mcap"))) == 1

    tab.click("prepare")  # a second run from the same page
    state_is(tab, "ready; nothing moves")
    start(tab)
    moves(tab)
    scope.signal(signal.SIGINT)
    done = scope.finished(30.0)
    assert done.code == 130
    assert "Traceback" not in done.err
    assert bench.disabled()


def test_stop_works_when_nothing_else_on_the_page_does(bench: Any, browser: Browser) -> None:
    _, tab, url = opened(bench, browser)
    start(tab)
    tab.js("window.socket.disconnect(); null")
    stale = "document.querySelector('[data-testid=\"stale\"]')"
    tab.until(f"{stale}.style.display === 'block' && {stale}.innerText.includes('old')")
    tab.click("stop")
    tab.until("document.querySelector('[data-testid=\"stop-word\"]').innerText.includes('STOP taken')")
    state_is(browser.open(url), "the run has ended")
    assert bench.disabled()


def test_a_stop_that_does_not_arrive_is_told(bench: Any, browser: Browser) -> None:
    scope, tab, _ = opened(bench, browser)
    server = scope.child("jointctl.tools.scoping.server")
    os.kill(server, signal.SIGSTOP)
    tab.click("stop")
    tab.until("document.querySelector('[data-testid=\"stop-word\"]').innerText.includes('STOP DID NOT ARRIVE')")
    os.kill(server, signal.SIGKILL)
    done = scope.finished(30.0)
    done.refused(done.code, "the scope's web server has ended")
    assert bench.disabled()


def test_a_run_led_from_the_page_brakes_when_its_server_ends(bench: Any, browser: Browser) -> None:
    scope, tab, _ = opened(bench, browser)
    start(tab)
    os.kill(scope.child("jointctl.tools.scoping.server"), signal.SIGKILL)
    scope.finished(60.0)
    assert "no page shows or stops the joint, braking" in scope.err
    assert "stopped by the end of the scope's server; the joint is switch on disabled" in scope.err
    assert bench.disabled()


def test_the_terminal_is_told_when_the_last_page_closes(bench: Any, browser: Browser) -> None:
    scope, tab, _ = opened(bench, browser, "--stop-unwatched", "6")
    start(tab)
    assert "no page is open" not in scope.err
    with contextlib.suppress(Exception):  # the answer may not come any more
        tab.call("Page.close")
    scope.saw("no page is open any more; the joint goes on", 30.0)
    scope.saw("stopped by the scope: no page open for 6 s; the joint is switch on disabled", 60.0)
    assert bench.disabled()


def test_stop_before_start_ends_the_preparation(bench: Any, browser: Browser) -> None:
    _, tab, _ = opened(bench, browser)
    tab.click("stop")
    state_is(tab, "not started; the drive is disabled")
    assert bench.disabled()


def test_pause_zoom_and_trigger(bench: Any, browser: Browser) -> None:
    _, tab, _ = opened(bench, browser)
    start(tab)
    moves(tab)
    tab.js(f"{ZOOM}.dispatchAction({{type: 'dataZoom', start: 40, end: 60}}); null")
    moves(tab)
    assert tab.js(f"{ZOOM}.getOption().dataZoom[0].start") == pytest.approx(40.0)  # the zoom outlives new data
    tab.click("pause")
    time.sleep(1.0)
    held = tab.js(LAST_s)
    time.sleep(1.0)
    assert tab.js(LAST_s) == held
    tab.click("pause")
    moves(tab)
    tab.click("trigger")  # the angle's rising zero crossing, once in 10 s
    tab.until("document.querySelector('[data-testid=\"pause\"]').getAttribute('aria-checked') === 'true'", 40.0)
    held = tab.js(LAST_s)
    time.sleep(1.0)
    assert tab.js(LAST_s) == held


def test_a_stalled_or_closed_browser_costs_the_run_nothing(bench: Any, browser: Browser) -> None:
    scope, tab, _ = opened(bench, browser)
    start(tab)
    moves(tab)
    server = scope.child("jointctl.tools.scoping.server")
    before_kB, before_supervisor_kB = resident_kB(server), resident_kB(scope.process.pid)
    os.killpg(browser.process.pid, signal.SIGSTOP)
    time.sleep(15.0)
    stalled_kB, stalled_supervisor_kB = resident_kB(server), resident_kB(scope.process.pid)
    os.killpg(browser.process.pid, signal.SIGKILL)
    time.sleep(2.0)
    scope.signal(signal.SIGINT)
    assert scope.finished(30.0).code == 130
    assert stalled_kB - before_kB < 40_000, (before_kB, stalled_kB)
    records = bench.log().records
    assert int(records.fault.max()) == Fault.NONE
    assert records.trajectory_s[records.phase == AxisPhase.TRACKING][-1] > 16.0
    assert stalled_supervisor_kB - before_supervisor_kB < 40_000, (before_supervisor_kB, stalled_supervisor_kB)
