"""A headless Chromium driven over its DevTools protocol: enough to open a page, press, type, read and take pictures."""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import os
import shutil
import signal
import socket
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PROGRAM = next((found for name in NAMES if (found := shutil.which(name))), None)


def free_port() -> int:
    """For a server on this computer."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Refused(Exception):
    """The browser has not carried out a command."""


class Tab:
    """One page of the browser."""

    def __init__(self, browser: Browser, url: str) -> None:
        from websockets.sync.client import connect

        request = urllib.request.Request(f"http://127.0.0.1:{browser.port}/json/new?{url}", method="PUT")
        with urllib.request.urlopen(request, timeout=20) as answer:
            target = json.load(answer)
        self._id, self._port = target["id"], browser.port
        self._stack = contextlib.ExitStack()
        way = connect(target["webSocketDebuggerUrl"], max_size=1 << 26, open_timeout=20)
        self._socket = self._stack.enter_context(way)
        browser.tabs.append(self)
        self._numbers = itertools.count(1)

    def call(self, method: str, **parameters: Any) -> Any:
        """One command of the protocol and its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=30))
            if answer.get("id") == number:
                if "error" in answer:
                    raise Refused(str(answer["error"]))
                return answer["result"]

    def js(self, code: str) -> Any:
        """The value of an expression."""
        found = self.call("Runtime.evaluate", expression=code, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def until(self, code: str, timeout_s: float = 30.0) -> Any:
        """Wait until the expression is true; what it is by then."""
        give_up = time.monotonic() + timeout_s
        while True:
            try:
                value = self.js(f"(() => {{ try {{ return {code} }} catch (e) {{ return null }} }})()")
            except Refused:  # the page is being loaded
                value = None
            if value:
                return value
            assert time.monotonic() < give_up, f"never: {code}; page: {self.js('document.body.innerText')[:1500]}"
            time.sleep(0.1)

    def text(self, name: str) -> str:
        """What an element says, by its data-testid."""
        return str(self.until(f"document.querySelector('[data-testid=\"{name}\"]').innerText"))

    def click(self, name: str) -> None:
        """Press with the mouse, so that only what can be seen can be pressed, once it has come to rest."""
        where = (
            f"(() => {{ const e = document.querySelector('[data-testid=\"{name}\"]'); e.scrollIntoView({{block: "
            "'center'}); const b = e.getBoundingClientRect(); "
            "return b.width > 0 ? [b.x + Math.min(b.width / 2, 20), b.y + b.height / 2] : null })()"
        )
        last, box, give_up = None, self.until(where), time.monotonic() + 5.0
        while box != last and time.monotonic() < give_up:  # a page that comes up, or has grown, moves what it shows
            time.sleep(0.2)
            last, box = box, self.until(where)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=box[0], y=box[1], button="left", clickCount=1)

    def enter(self, name: str, text: str) -> None:
        """Type into a field, whatever stood there; again if a value that was on its way came between, as one sees."""
        found = f"document.querySelector('input[data-testid=\"{name}\"]')"
        give_up = time.monotonic() + 10.0
        self.until(found + " !== null")
        while True:
            self.js(f"{found}.focus(); {found}.select(); null")
            self.call("Input.insertText", text=text)
            time.sleep(0.3)  # until the page has what was typed, and would have undone it
            if self.js(f"{found}.value") == text:
                break
            assert time.monotonic() < give_up, f"{name} never shows {text}"
        self.js(f"{found}.blur(); null")

    def picture(self, path: Path) -> None:
        """A screenshot; a page in the background is not drawn."""
        self.call("Page.bringToFront")
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def close(self) -> None:
        with contextlib.suppress(Exception):  # the browser may have been killed
            self._stack.close()
            urllib.request.urlopen(f"http://127.0.0.1:{self._port}/json/close/{self._id}", timeout=20).close()


class Browser:
    """The process; a context manager."""

    def __init__(self, folder: Path, width: int = 1280, height: int = 800) -> None:
        assert PROGRAM is not None
        self.tabs: list[Tab] = []
        self._profile = folder / "profile"
        self.process = subprocess.Popen(
            [
                PROGRAM, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
                "--no-first-run", "--disable-background-networking", "--hide-scrollbars",
                f"--window-size={width},{height}", f"--user-data-dir={self._profile}", "--remote-debugging-port=0",
                "--remote-allow-origins=*", "about:blank",
            ],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        port_file, give_up = self._profile / "DevToolsActivePort", time.monotonic() + 60.0
        while not port_file.exists() or not port_file.read_text():
            assert self.process.poll() is None, f"{PROGRAM} ended with {self.process.returncode}"
            assert time.monotonic() < give_up, f"{PROGRAM} did not start"
            time.sleep(0.05)
        self.port = int(port_file.read_text().splitlines()[0])
        self._width, self._height = width, height

    def open(self, url: str) -> Tab:
        tab = Tab(self, url)
        tab.call(
            "Emulation.setDeviceMetricsOverride",
            width=self._width, height=self._height, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip
        return tab

    def close_tabs(self) -> None:
        while self.tabs:
            self.tabs.pop().close()

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self.close_tabs()
