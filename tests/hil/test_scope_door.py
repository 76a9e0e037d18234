"""Another user of this computer reaches the scope's port, and gets nothing there; the token is seen by no one else."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from tests.browser import free_port
from tests.hil.test_scope_browser import environment, printed_address

MISSING = [name for name in ("nicegui", "websockets") if importlib.util.find_spec(name) is None]
pytestmark = pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)} (extra `scope`)")


def status(address: str, method: str = "GET", **headers: str) -> tuple[int, str, Any]:
    """Code, body and headers of an answer; waits until the server is up."""
    give_up = time.monotonic() + 60.0
    while True:
        try:
            request = urllib.request.Request(address, method=method, headers=headers)
            with urllib.request.urlopen(request, timeout=5) as answer:
                return answer.status, answer.read().decode(), answer.headers
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode(), error.headers
        except OSError:
            assert time.monotonic() < give_up
            time.sleep(0.2)


def processes_that_show(word: str) -> list[str]:
    """Arguments and environments of all processes, in which the word stands."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        for name in ("cmdline", "environ"):
            with contextlib.suppress(OSError):
                if word.encode() in (folder / name).read_bytes():
                    found.append(f"{folder / name}: {(folder / 'cmdline').read_bytes()!r}")
    return found


@pytest.mark.parametrize(("live", "host"), [(True, "127.0.0.1"), (True, "0.0.0.0"), (False, "127.0.0.1")])
def test_without_the_token_nothing_is_shown_or_taken(bench: Any, live: bool, host: str) -> None:
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    config = bench.with_joint(trajectory__duration_s=0.0 if live else 0.2)
    if not live:
        assert bench.run("run", config, "-y").code == 0
    port = free_port()
    shown = config if live else str(next(bench.folder.glob("runs/*.mcap")))
    scope = bench.start("scope", shown, "--host", host, "--port", str(port), "--quiet", env=environment()).saw("token=")
    place, token = printed_address(scope).split("?token=")
    assert place == f"http://{host}:{port}/"
    place = f"http://127.0.0.1:{port}/"
    url = f"{place}?token={token}"

    code, body, headers = status(place)
    assert (code, "token included" in body, headers["set-cookie"]) == (403, True, None)
    code, body, headers = status(url)
    assert code == 200
    assert (headers["referrer-policy"], headers["cache-control"]) == ("no-referrer", "no-store")
    cookie = headers["set-cookie"].split(";")[0]
    assert cookie.endswith(f"={token}")
    assert status(place, cookie=cookie)[0] == 200
    assert status(place, cookie=cookie[:-1])[0] == 403
    script = next(part.split('"')[0] for part in body.split('src="')[1:] if part.startswith("/_nicegui"))
    assert [status(place + script.lstrip("/"), **kept)[0] for kept in ({}, {"cookie": cookie})] == [403, 200]

    way = f"ws://127.0.0.1:{port}/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
    with pytest.raises(InvalidStatus, match="403"):
        connect(way, open_timeout=20)
    with connect(way, additional_headers={"cookie": cookie}, open_timeout=20) as door:
        assert door.recv(timeout=20)

    assert processes_that_show("jointctl.tools.scoping.server" if live else shown)  # the test does look
    assert processes_that_show(token) == []

    if not live:
        scope.signal(signal.SIGINT)
        scope.finished(30.0)
        return
    child = scope.child("jointctl.tools.scoping.server")
    for _ in range(3):  # what another user would do
        assert status(f"{place}stop", "POST")[0] == 403
    time.sleep(0.5)
    assert os.path.exists(f"/proc/{child}")
    assert "stopped" not in scope.err
    assert status(f"{place}stop", "POST", cookie=cookie)[:2] == (200, "STOP taken; again: quick stop")
    time.sleep(2.0)
    scope.signal(signal.SIGINT)
    assert scope.finished(30.0).code == 12  # it was prepared, and not begun
    assert bench.disabled()


def test_the_address_is_printed_with_a_run_as_well(bench: Any) -> None:
    config = bench.with_joint(trajectory__duration_s=0.5)
    done = bench.run("run", config, "-y", "--scope", "--scope-port", str(free_port()), "--quiet", "--json",
                     env=environment())  # fmt: skip
    assert done.code == 0, done.err
    assert done.err.count("token=") == 1
    assert "token=" not in done.out
    for log in bench.folder.glob("runs/*.mcap"):
        assert done.err.split("token=")[1].split()[0].encode() not in log.read_bytes()
