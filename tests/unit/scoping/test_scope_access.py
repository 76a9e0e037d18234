"""The scope's door: nobody else comes in, and orders are checked."""

from __future__ import annotations

import socket
from typing import Any

import pytest

from drivers.errors import DataError, UsageError
from tools.scoping import order as order_module
from tools.scoping.access import COOKIE, allowed
from tools.scoping.order import ScopeOrder, scope_order


def request(host: str, query: str = "", **headers: str) -> dict[str, Any]:
    listed = [(b"host", host.encode())] + [(name.encode(), value.encode()) for name, value in headers.items()]
    return {"type": "http", "headers": listed, "query_string": query.encode()}


@pytest.mark.parametrize(
    ("host", "origin", "passes"),
    [
        ("127.0.0.1:8642", "", True),
        ("localhost:8642", "http://localhost:8642", True),
        ("[::1]:8642", "", True),
        ("evil.example:8642", "", False),
        ("127.0.0.1.evil.example", "", False),
        ("127.0.0.1:8642", "http://evil.example", False),
        ("127.0.0.1:8642", "null", False),
        ("", "", False),
    ],
)
def test_without_a_token_only_this_computer_comes_in(host: str, origin: str, passes: bool) -> None:
    assert allowed(request(host, **({"origin": origin} if origin else {})), "") is passes


@pytest.mark.parametrize(
    ("query", "cookie", "passes"),
    [
        ("", "", False),
        ("token=secret", "", True),
        ("token=secreT", "", False),
        ("token=", "", False),
        ("", f"{COOKIE}=secret", True),
        ("", f"{COOKIE}=other", False),
        ("", "other=secret", False),
        ("token=wrong", f"{COOKIE}=secret", True),
    ],
)
def test_beyond_this_computer_the_token_is_asked_for(query: str, cookie: str, passes: bool) -> None:
    headers = {"cookie": cookie} if cookie else {}
    assert allowed(request("192.168.0.5:8642", query, **headers), "secret") is passes
    assert allowed(request("127.0.0.1:8642", query, **headers), "secret") is passes


def test_orders_are_checked_and_beyond_this_computer_get_a_token(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(order_module, "find_spec", lambda name: None)
    with pytest.raises(DataError, match="needs the package nicegui"):
        scope_order("t", "127.0.0.1", 8642)
    monkeypatch.setattr(order_module, "find_spec", lambda name: object())
    with pytest.raises(UsageError, match=r"--port \(=0\) must be in \[1..65535\]"):
        scope_order("t", "127.0.0.1", 0)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(DataError, match=f"cannot be served at 127.0.0.1:{port}"):
            scope_order("t", "127.0.0.1", port)
    near, far = scope_order("t", "127.0.0.1", port), scope_order("t", "0.0.0.0", port)
    assert near.token == ""
    assert near.url == f"http://127.0.0.1:{port}/"
    assert len(far.token) >= 20
    assert far.url.endswith(f"?token={far.token}")
    assert far.token != scope_order("t", "0.0.0.0", port).token
    assert ScopeOrder("t", "::1", 1, "").url == "http://[::1]:1/"
