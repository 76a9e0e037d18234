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

import numpy as np
import pytest

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, Fault
from jointctl.tools.recording.run_log import RunLogWriter
from jointctl.tools.scoping.feed import LATE_S
from tests.browser import PROGRAM, Browser, Tab, free_port
from tests.python_process import eventually

MISSING = [name for name in ("nicegui", "websockets") if importlib.util.find_spec(name) is None]
pytestmark = [
    pytest.mark.skipif(PROGRAM is None, reason="no Chromium on this computer"),
    pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)} (extra `scope`)"),
]
LAST_s = "(() => { const c = document.querySelector('[data-testid=\"chart\"]'); const o = getElement(c.id.slice(1)).chart.getOption(); const d = o.series[0].data; return d[d.length - 1][0] })()"  # noqa: E501
ZOOM = "getElement(document.querySelector('[data-testid=\"chart\"]').id.slice(1)).chart"

# after a rest before it began, the axis has every value of the angle in it, and most of its length is used
SEEN = f"""(() => {{
  const chart = {ZOOM}, values = chart.getOption().series[1].data.map(pair => pair[1]).filter(value => value !== null)
  const [low, high] = chart.getModel().getComponent('yAxis', 0).axis.scale.getExtent()
  const least = Math.min(...values), greatest = Math.max(...values)
  return greatest - least > 0.05 && low <= least && greatest <= high && greatest - least > 0.3 * (high - low)
}})()"""


@pytest.fixture(scope="module")
def shared_browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser")) as browser:
        yield browser


@pytest.fixture
def browser(shared_browser: Browser) -> Iterator[Browser]:
    """To start one takes more time than most pages need: each test has tabs of its own."""
    yield shared_browser
    shared_browser.close_tabs()


@pytest.fixture
def own_browser(tmp_path: Path) -> Iterator[Browser]:
    """For a test that stops it."""
    with Browser(tmp_path) as browser:
        yield browser


STATE = "document.querySelector('[data-testid=\"state\"]').innerText"


def state_is(tab: Tab, words: str, timeout_s: float = 90.0) -> None:
    tab.until(f"{STATE}.includes('{words}')", timeout_s)


def environment() -> dict[str, str]:
    """Without pytest's marks: nicegui would take itself for one of its own tests."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}


def opened(bench: Any, browser: Browser, *options: str, **changes: Any) -> tuple[Any, Tab, str]:
    """`jointctl scope CONFIG` on a joint of its own, and its page at "ready"."""
    # with a browser beside it the loop may stand still for milliseconds: that is not what these tests are about
    config = bench.with_joint(trajectory__duration_s=0.0, limits__velocity_max_radps=3.0, **changes)
    scope, tab, url = page_of(bench, browser, config, *options)
    state_is(tab, "ready; nothing moves")
    return scope, tab, url


def page_of(bench: Any, browser: Browser, config: str, *options: str) -> tuple[Any, Tab, str]:
    """`jointctl scope CONFIG` and its page, whatever it shows."""
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
    return scope, browser.open(url), url


def printed_address(scope: Any) -> str:
    """With its token, as a user copies it from the terminal."""
    found = re.search(r"scope: (http://\S+)", scope.err)
    assert found is not None, scope.err
    return found[1]


def start(tab: Tab) -> None:
    """Tick and press; once more if a busy computer has cut the page off, which then begins with an empty box."""
    give_up = time.monotonic() + 120.0
    disabled = "document.querySelector('[data-testid=\"start\"]').disabled"
    while "ready" in tab.text("state"):
        assert time.monotonic() < give_up, tab.text("state")
        cleared = not tab.js(disabled)
        tab.click("start" if cleared else "clear")
        with contextlib.suppress(AssertionError):
            tab.until(f"!{STATE}.includes('ready')" if cleared else f"!{disabled}", 2.0)
    state_is(tab, "tracking")


def moves(tab: Tab, within_s: float = 60.0) -> None:
    before = tab.until(LAST_s)
    tab.until(f"{LAST_s} > {before} + 0.5", within_s)


def resident_kB(pid: int) -> int:
    found = re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
    assert found is not None
    return int(found[1])


@pytest.mark.slow("a minute with a browser")
def test_nothing_moves_before_start_and_stop_stops(bench: Any, browser: Browser) -> None:
    scope, tab, url = opened(bench, browser)
    assert tab.js("document.querySelector('[data-testid=\"start\"]').disabled") is True
    tab.click("start")  # without the word that the way is clear
    time.sleep(1.0)
    state_is(tab, "ready; nothing moves")
    assert bench.is_pre_operational()
    start(tab)
    moves(tab)
    tab.until(SEEN)
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


def test_a_stop_that_is_answered_late_is_told_as_taken(bench: Any, browser: Browser) -> None:
    scope, tab, _ = opened(bench, browser)
    start(tab)
    moves(tab)
    server = scope.child("jointctl.tools.scoping.server")
    os.kill(server, signal.SIGSTOP)
    tab.click("stop")
    tab.until("document.querySelector('[data-testid=\"stop-word\"]').innerText.includes('STOP DID NOT ARRIVE')")
    os.kill(server, signal.SIGCONT)
    tab.until("document.querySelector('[data-testid=\"stop-word\"]').innerText.includes('STOP taken')")
    state_is(tab, "the run has ended")
    assert bench.disabled()


def panel(tab: Tab) -> str:
    """What the panel with Start and Prepare shows."""
    return str(tab.js("document.querySelector('[data-testid=\"start-panel\"]').innerText"))


@pytest.mark.parametrize("moving", [False, True])
def test_stop_from_a_second_terminal_ends_the_page_in_words(bench: Any, own_browser: Browser, moving: bool) -> None:
    scope, tab, _ = opened(bench, own_browser)
    if moving:
        start(tab)
        moves(tab)
    else:
        os.killpg(own_browser.process.pid, signal.SIGSTOP)  # a computer too busy to show anything
    stopped = bench.run("stop", "joint.toml")
    assert (stopped.code, stopped.out) == (0, "the drive is switch on disabled\n"), stopped
    if not moving:
        time.sleep(5.0)
        os.killpg(own_browser.process.pid, signal.SIGCONT)
    assert scope.finished(40.0).code == 130
    assert bench.disabled()
    state_is(tab, "jointctl has ended")
    assert "operation enabled" not in tab.text("state")
    words = "stopped  by jointctl stop" if moving else "scope ended by jointctl stop; the drive is disabled"
    assert words in panel(tab)
    assert "Prepare" not in panel(tab)  # no one would take it
    assert "Start" not in panel(tab)
    time.sleep(4.0)
    assert tab.js("document.querySelector('[data-testid=\"stale\"]').style.display") == "none"  # nothing may move


def test_what_is_prepared_after_a_stop_is_a_new_run(bench: Any, browser: Browser) -> None:
    config = bench.with_joint(trajectory__duration_s=0.0, limits__velocity_max_radps=3.0)
    run = bench.start("run", config, "-y").saw("tracking")
    scope, tab, _ = page_of(bench, browser, config)
    tab.until("document.querySelector('[data-testid=\"start-panel\"]').innerText.includes('another program controls')")
    assert bench.run("stop", config).code == 0
    assert run.finished(40.0).code == 130
    tab.click("prepare")  # within the first minute of the page's program
    state_is(tab, "ready; nothing moves")
    tab.click("stop")
    state_is(tab, "not started; the drive is disabled")
    assert bench.run("stop", config).code == 0  # the page controls nothing, and goes on
    tab.click("prepare")
    state_is(tab, "ready; nothing moves")
    start(tab)
    moves(tab)
    tab.click("stop")
    state_is(tab, "the run has ended")
    tab.click("prepare")
    assert bench.run("stop", config).code == 0  # after the press
    scope.saw("scope ended by jointctl stop", 20.0)
    assert scope.finished(40.0).code == 130
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


# number, text and code of a key; a keyboard on a screen or from afar may have no code
KEYS = {"Escape": (27, "Escape", "Escape"), "Space": (32, " ", "Space"), "Space without a code": (32, " ", "")}
# what every text has against what is behind it; WCAG 2.2, 1.4.3: 4.5, 3 for large or bold text
CONTRASTS = """(() => {
  const linear = v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4
  const light = c => { const [r, g, b] = c.map(v => linear(v / 255)); return 0.2126 * r + 0.7152 * g + 0.0722 * b }
  const parts = text => (text.match(/[0-9.]+/g) || []).map(Number)
  const filled = element => parts(getComputedStyle(element).backgroundColor)
  const opaque = element => filled(element).length && filled(element)[3] !== 0
  const poor = []
  for (const element of document.querySelectorAll('.nicegui-content *')) {
    const text = [...element.childNodes].filter(n => n.nodeType === 3).map(n => n.textContent.trim()).join('')
    const style = getComputedStyle(element)
    const hidden = !element.getClientRects().length || style.visibility === 'hidden'
    if (!text || hidden || element.closest('[disabled], .disabled')) continue
    let behind = element
    while (behind && !opaque(behind)) behind = behind.parentElement
    const back = behind ? filled(behind).slice(0, 3) : [255, 255, 255]
    const pair = [light(parts(style.color).slice(0, 3)), light(back)].sort((a, b) => b - a)
    const ratio = (pair[0] + 0.05) / (pair[1] + 0.05), large = parseFloat(style.fontSize) >= 24
    if (ratio < (large ? 3 : 4.5)) poor.push(text.slice(0, 30) + ' ' + ratio.toFixed(2))
  }
  return poor.join('; ')
})()"""


def press(tab: Tab, key: str, *, held: int = 0) -> None:
    number, text, code = KEYS[key]
    event = {"code": code, "key": text, "windowsVirtualKeyCode": number}
    tab.call("Input.dispatchKeyEvent", type="keyDown", **event)
    for _ in range(held):
        tab.call("Input.dispatchKeyEvent", type="keyDown", autoRepeat=True, **event)
    tab.call("Input.dispatchKeyEvent", type="keyUp", **event)


@pytest.mark.parametrize(("key", "focus"), [
    ("Escape", "set-point"), ("Space", "record"), ("Space", "set-point"), ("Space without a code", "signals"),
])  # fmt: skip
def test_a_key_stops_from_anywhere(bench: Any, browser: Browser, key: str, focus: str) -> None:
    _, tab, _ = opened(bench, browser)
    start(tab)
    tab.until("document.querySelector('[data-testid=\"beat\"]').textContent.endsWith('MOVES')")
    tab.js(f"document.querySelector('[data-testid=\"{focus}\"]').focus(); null")
    press(tab, key, held=3)
    tab.until("document.querySelector('[data-testid=\"stop-word\"]').innerText.includes('STOP taken; again')")
    state_is(tab, "the run has ended")
    assert bench.disabled()
    log = bench.log()
    assert AxisPhase.QUICK_STOPPING not in set(log.records.phase.tolist())  # held down is pressed once
    assert not any("recording" in event.text for event in log.events)  # the button under the key was not pressed


def test_the_page_can_be_read_and_used_without_eyes_or_mouse(bench: Any, browser: Browser) -> None:
    _, tab, _ = opened(bench, browser)
    press(tab, "Space")  # nothing is under control yet: space is for the page's own
    time.sleep(0.5)
    state_is(tab, "ready; nothing moves")
    assert tab.js("document.documentElement.lang") == "en-US"
    heads = tab.js("[...document.querySelectorAll('[role=heading]')].map(h => h.getAttribute('aria-level')).join('')")
    assert heads[0] == "1"
    assert set(heads[1:]) == {"2"}
    for name, role in (("state", "status"), ("stop-word", "alert"), ("stale", "alert"), ("events", "log")):
        assert tab.js(f"document.querySelector('[data-testid=\"{name}\"]').getAttribute('role')") == role
    assert tab.js("document.querySelectorAll('[role=main]').length") == 1
    order = (
        "[...document.querySelectorAll('button, input, [tabindex=\"0\"]')].filter(e => e.getClientRects().length)[0]"
    )
    assert tab.js(f"{order}.getAttribute('data-testid')") == "stop"
    unnamed = """[...document.querySelectorAll('input, button')].filter(e => e.getClientRects().length && !(
        e.innerText || e.getAttribute('aria-label') || e.title || e.labels && e.labels.length)).length"""
    assert tab.js(unnamed) == 0
    assert tab.js(CONTRASTS) == ""
    tab.click("dark")
    tab.until("document.body.classList.contains('body--dark')")
    assert tab.js(CONTRASTS) == ""
    start(tab)  # with the fields of a joint that is under way
    tab.until("document.querySelector('[data-testid=\"apply\"]') !== null")
    assert tab.js(CONTRASTS) == ""


def test_a_refused_set_point_is_told_at_its_field(bench: Any, browser: Browser) -> None:
    _, tab, _ = opened(bench, browser)
    start(tab)
    tab.enter("set-point", "9")
    tab.click("go")
    field = "document.querySelector('[data-testid=\"set-point\"]').closest('.q-field')"
    tab.until(f"{field}.innerText.includes('must be in')")
    tab.click("dark")
    tab.until("document.body.classList.contains('body--dark')")
    time.sleep(1.0)  # colours fade
    assert tab.js(CONTRASTS) == ""
    tab.enter("set-point", "0.1")
    tab.until(f"!{field}.innerText.includes('must be in')")
    tab.enter("set-point", "")
    tab.click("go")
    tab.until(f"{field}.innerText.includes('position_rad is empty: must be a number')")


def test_with_a_drive_that_closes_its_own_loop_motions_are_offered_and_no_gains(bench: Any, browser: Browser) -> None:
    """All of the panel was hidden in CSP and CSV, since there are no gains to show."""
    cascade = {"position_gain_ps": 30.0, "velocity_gain_Nmspr": 200.0, "velocity_integral_Nmprad": 10_000.0}
    _, tab, _ = opened(
        bench, browser, drive__mode="csv", drive__cascade=cascade, control__kind="computed_torque",
        limits__position_min_rad=-0.2, limits__position_max_rad=0.2, trajectory__amplitude_rad=0.05,
        limits__swing_error_share=1.0,
    )  # fmt: skip
    start(tab)
    shown = "[...document.querySelectorAll('[data-testid=\"{}\"]')].some(e => e.offsetParent !== null)"
    tab.until(shown.format("set-point"))
    assert not tab.js(shown.format("apply"))
    tab.enter("set-point", "0.15")
    tab.click("go")
    tab.until("document.body.innerText.includes('set-point +0.1500 rad')")


def test_stop_before_start_ends_the_preparation(bench: Any, browser: Browser) -> None:
    _, tab, _ = opened(bench, browser)
    tab.click("stop")
    state_is(tab, "not started; the drive is disabled")
    assert bench.disabled()


def stands(tab: Tab) -> bool:
    """Whether nothing was drawn for a second."""
    shown = tab.js(LAST_s)
    time.sleep(1.0)
    return bool(tab.js(LAST_s) == shown)


def comes_to_stand(tab: Tab) -> None:
    """What was on its way is still drawn, and nothing after it."""
    eventually(lambda: stands(tab), 15.0)
    assert stands(tab)


def test_pause_zoom_and_trigger(bench: Any, browser: Browser) -> None:
    _, tab, _ = opened(bench, browser)
    start(tab)
    moves(tab)
    tab.js(f"{ZOOM}.dispatchAction({{type: 'dataZoom', start: 40, end: 60}}); null")
    moves(tab)
    assert tab.js(f"{ZOOM}.getOption().dataZoom[0].start") == pytest.approx(40.0)  # the zoom outlives new data
    tab.click("pause")
    comes_to_stand(tab)
    tab.click("pause")
    moves(tab)
    tab.click("trigger")  # the angle's rising zero crossing, once in 10 s
    tab.until("document.querySelector('[data-testid=\"pause\"]').getAttribute('aria-checked') === 'true'", 40.0)
    comes_to_stand(tab)


def is_on(tab: Tab, name: str) -> bool:
    """Of a switch or a box."""
    return bool(tab.js(f"document.querySelector('[data-testid=\"{name}\"]').getAttribute('aria-checked') === 'true'"))


def test_what_is_chosen_between_two_runs_is_for_the_next_one(bench: Any, browser: Browser) -> None:
    _, tab, _ = opened(bench, browser)
    start(tab)
    moves(tab)
    time.sleep(6.0)  # half a span after the angle's zero crossing, with which it begins
    tab.click("stop")
    state_is(tab, "the run has ended")
    tab.click("prepare")
    tab.click("trigger")
    state_is(tab, "ready; nothing moves")
    assert is_on(tab, "trigger")  # the crossing of the run before does not count
    start(tab)
    moves(tab)
    tab.until("document.querySelector('[data-testid=\"pause\"]').getAttribute('aria-checked') === 'true'", 40.0)
    assert not is_on(tab, "trigger")
    tab.click("stop")
    state_is(tab, "the run has ended")
    tab.click("prepare")
    state_is(tab, "ready; nothing moves")
    start(tab)
    moves(tab)  # what was held is gone
    assert not is_on(tab, "pause")


def test_no_choice_is_lost_to_a_page_that_answers_late(bench: Any, browser: Browser) -> None:
    scope, tab, url = opened(bench, browser)
    server = scope.child("jointctl.tools.scoping.server")
    tab.js("document.querySelector('[data-testid=\"signals\"]').click(); null")
    items = "[...document.querySelectorAll('.q-menu .q-item')]"
    tab.until(f"{items}.length > 5")
    os.kill(server, signal.SIGSTOP)
    for name in ("velocity [rad/s]", "error [mrad]"):
        tab.js(f"{items}.find(item => item.innerText === '{name}').click(); null")
        time.sleep(0.2)
    os.kill(server, signal.SIGCONT)
    start(tab)
    shown = f"{ZOOM}.getOption().series.map(one => one.name).join()"
    tab.until(f"{shown} === 'desired angle [rad],angle [rad],command torque [Nm],velocity [rad/s],error [mrad]'")
    new = browser.open(url)  # whose colours are asked for while it comes up
    new.click("dark")
    new.until("document.body.classList.contains('body--dark')")
    time.sleep(2.0)
    assert new.js("document.body.classList.contains('body--dark')")


def test_cursors_views_and_export(bench: Any, browser: Browser, tmp_path: Path) -> None:
    _, tab, _ = opened(bench, browser)
    start(tab)
    moves(tab)
    time.sleep(5.0)
    tab.click("cursors")  # holds the picture
    tab.until("document.querySelector('[data-testid=\"pause\"]').getAttribute('aria-checked') === 'true'")
    tab.until(f"{ZOOM}.getOption().series[0].markLine.data.length === 2")
    end_s = float(tab.js(LAST_s))
    tab.enter("cursor-a", f"{end_s - 4.0:.2f}")
    tab.enter("cursor-b", f"{end_s - 3.5:.2f}")
    tab.until("document.querySelector('[data-testid=\"readings\"]').innerText.includes('1/(B - A) = 2 Hz')")
    held = tab.text("readings")
    assert [line.split()[0] for line in held.splitlines()[2:]] == ["desired", "angle", "command"]
    pixel = f"c.convertToPixel({{xAxisIndex: 0, yAxisIndex: 0}}, [{end_s - 3.0}, 0])"
    box = "b = c.getDom().getBoundingClientRect()"
    x, y = tab.js(f"(c => {{ const p = {pixel}, {box}; return [p[0] + b.x, p[1] + b.y] }})({ZOOM})")
    for kind in ("mousePressed", "mouseReleased"):
        tab.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
    tab.until(f"Math.abs(document.querySelector('input[data-testid=\"cursor-a\"]').value - {end_s - 3.0}) < 0.05")

    folder = tmp_path / "downloads"
    tab.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder))
    tab.js(f"{ZOOM}.dispatchAction({{type: 'dataZoom', startValue: {end_s - 2.0}, endValue: {end_s - 1.0}}}); null")
    time.sleep(0.5)
    tab.click("csv")
    tab.click("png")
    rows = [line.split(",") for line in downloaded(folder / "jointctl-time.csv").decode().splitlines()]
    assert rows[0] == ["time [s]", "desired angle [rad]", "angle [rad]", "command torque [Nm]"]
    assert end_s - 2.001 <= float(rows[1][0]) < float(rows[-1][0]) <= end_s - 0.999
    assert len(rows) > 800  # every sample, not the drawn ones
    assert downloaded(folder / "jointctl-time.png").startswith(b"\x89PNG")

    for view, axis in (("x-y", "desired angle [rad]"), ("spectrum", "frequency [Hz]"), ("time", "time [s]")):
        buttons = "[...document.querySelectorAll('[data-testid=\"view\"] button')]"
        tab.js(f"{buttons}.find(b => b.innerText === '{view}').click(); null")
        tab.until(f"{ZOOM}.getOption().xAxis[0].name === '{axis}'")
        assert tab.js(CONTRASTS) == ""
    tab.click("stop")
    state_is(tab, "the run has ended")
    assert bench.disabled()


def test_each_stretch_of_a_long_log_can_be_seen_and_its_axes_are_named(
    bench: Any, browser: Browser, tmp_path: Path
) -> None:
    log = bench.folder / "long.mcap"
    records = new(LogRecord, 100_000)
    records.time_ns = 1 + np.arange(100_000) * 1_000_000
    records.phase = AxisPhase.TRACKING
    records.position_rad = 0.001 * np.arange(100_000)
    records.position_rad[-1] -= (
        0.002  # of the last samples this one is neither the least nor the greatest: it is not drawn
    )
    with RunLogWriter(log, {}) as writer:
        writer.write_records(records.view(np.recarray))
    _, tab, _ = page_of(bench, browser, str(log))
    tab.until(f"{LAST_s} > 99.9")
    folder = tmp_path / "downloads"
    tab.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder))
    tab.click("csv")
    assert downloaded(folder / "jointctl-time.csv").decode().splitlines()[-1].startswith("99.999,")
    tab.enter("until", "30")
    tab.until(f"Math.abs({LAST_s} - 30) < 0.01")
    buttons = "[...document.querySelectorAll('[data-testid=\"view\"] button')]"
    tab.js(f"{buttons}.find(b => b.innerText === 'spectrum').click(); null")
    tab.until(f"{ZOOM}.getOption().xAxis[0].name === 'frequency [Hz]'")
    # nothing draws it again, as it does while a joint runs
    tab.until(f"typeof {ZOOM}.getOption().yAxis[0].axisLabel.formatter === 'function'")
    tab.call("Emulation.setDeviceMetricsOverride", width=400, height=900, deviceScaleFactor=1, mobile=False)
    tab.until(f"{ZOOM}.getOption().legend[0].type === 'scroll'")
    assert tab.js("document.documentElement.scrollWidth") <= 400


def downloaded(path: Path) -> bytes:
    eventually(lambda: path.exists() and path.stat().st_size, 20.0, lambda: list(path.parent.glob("*")))
    time.sleep(0.3)  # a browser renames it when it is whole
    return path.read_bytes()


def test_a_stalled_or_closed_browser_costs_the_run_nothing(bench: Any, own_browser: Browser) -> None:
    scope, tab, _ = opened(bench, own_browser)
    start(tab)
    moves(tab)
    server = scope.child("jointctl.tools.scoping.server")
    before_kB, before_supervisor_kB = resident_kB(server), resident_kB(scope.process.pid)
    os.killpg(own_browser.process.pid, signal.SIGSTOP)
    time.sleep(15.0)
    stalled_kB, stalled_supervisor_kB = resident_kB(server), resident_kB(scope.process.pid)
    os.killpg(own_browser.process.pid, signal.SIGKILL)
    time.sleep(2.0)
    scope.signal(signal.SIGINT)
    assert scope.finished(30.0).code == 130
    assert stalled_kB - before_kB < 40_000, (before_kB, stalled_kB)
    records = bench.log().records
    assert int(records.fault.max()) == Fault.NONE
    assert records.trajectory_s[records.phase == AxisPhase.TRACKING][-1] > 16.0
    assert stalled_supervisor_kB - before_supervisor_kB < 40_000, (before_supervisor_kB, stalled_supervisor_kB)


@pytest.mark.parametrize("who", ["server", "supervisor"])
def test_a_start_that_was_held_up_is_not_taken(bench: Any, browser: Browser, who: str) -> None:
    """Its connection is there, but one of the two stands still; a later one starts."""
    scope, tab, _url = opened(bench, browser)
    pid = scope.child("jointctl.tools.scoping.server") if who == "server" else scope.process.pid
    tab.click("clear")
    tab.until("!document.querySelector('[data-testid=\"start\"]').disabled")
    os.kill(pid, signal.SIGSTOP)
    try:
        tab.click("start")
        time.sleep(LATE_S + 1.0)
    finally:
        os.kill(pid, signal.SIGCONT)
    tab.until("document.querySelector('[data-testid=\"late\"]').innerText.includes('press it again')")
    state_is(tab, "ready; nothing moves", 5.0)
    assert bench.is_pre_operational()
    start(tab)


def test_a_press_while_the_page_is_cut_off_is_refused_and_not_carried_out_later(bench: Any, browser: Browser) -> None:
    """The page's library would keep it, and send it when the page has its connection again."""
    _scope, tab, url = opened(bench, browser)
    tab.click("clear")
    tab.until("!document.querySelector('[data-testid=\"start\"]').disabled")
    time.sleep(0.5)  # the page has come to rest: a mouse does not press what moves
    tab.js("void window.socket.disconnect()")
    tab.click("start")
    tab.until("document.querySelector('[data-testid=\"stop-word\"]').innerText.includes('NOT CONNECTED')")
    tab.js("document.querySelector('[data-testid=\"clear\"]').focus(); null")
    press(tab, "Space")  # this would be sent later as well
    assert tab.js("document.querySelector('[data-testid=\"clear\"]').getAttribute('aria-checked')") == "true"
    tab.js("void window.socket.connect()")
    tab.until("window.socket.connected")
    time.sleep(3.0)
    state_is(tab, "ready; nothing moves", 5.0)
    assert bench.is_pre_operational()
    start(tab)
    tab.js("void window.socket.disconnect()")
    tab.click("stop")  # a request of its own
    tab.until("document.querySelector('[data-testid=\"stop-word\"]').innerText.includes('STOP taken')")
    state_is(browser.open(url), "the run has ended")  # it brakes first
    assert bench.disabled()
