"""The scope's door: nobody else comes in, and orders are checked."""

from __future__ import annotations

import socket
from typing import Any

import pytest

from jointctl.drivers.errors import DataError, UsageError
from jointctl.tools.scoping import feed as feed_module
from jointctl.tools.scoping.feed import ScopeOrder, scope_order
from jointctl.tools.scoping.server import COOKIE, allowed, cookie_name


def request(host: str, query: str = "", **headers: str) -> dict[str, Any]:
    listed = [(b"host", host.encode())] + [(name.encode(), value.encode()) for name, value in headers.items()]
    return {"type": "http", "headers": listed, "query_string": query.encode()}


@pytest.mark.parametrize(
    ("host", "origin", "passes"),
    [
        ("127.0.0.1:8642", "", True),
        ("localhost:8642", "http://localhost:8642", True),
        ("[::1]:8642", "", True),
        ("127.0.0.1:8642", "http://evil.example", False),
        ("127.0.0.1:8642", "null", False),
        ("127.0.0.1:8642", "http://[::1", False),
    ],
)
def test_a_page_of_another_site_does_not_come_in_even_with_the_token(host: str, origin: str, passes: bool) -> None:
    assert allowed(request(host, "token=secret", **({"origin": origin} if origin else {})), "secret") is passes


@pytest.mark.parametrize("host", ["127.0.0.1:8642", "localhost:8642", "[::1]:8642", "192.168.0.5:8642", ""])
@pytest.mark.parametrize(
    ("query", "cookie", "passes"),
    [
        ("", "", False),
        ("token=secret", "", True),
        ("token=secreT", "", False),
        ("token=", "", False),
        ("token=%", "", False),
        ("token=\xff", "", False),
        ("", f"{COOKIE}=secret", True),
        ("", f"{COOKIE}_1234=other; {COOKIE}_5678=secret", True),
        ("", f"{{]bad; =; {COOKIE}=secret", True),
        ("", f"{COOKIE}=other", False),
        ("", "other=secret", False),
        ("token=wrong", f"{COOKIE}=secret", True),
    ],
)
def test_the_token_is_asked_for_on_this_computer_too(host: str, query: str, cookie: str, passes: bool) -> None:
    headers = {"cookie": cookie} if cookie else {}
    found = {**request(host, **headers), "query_string": query.encode("latin-1")}
    assert allowed(found, "secret") is passes
    assert not allowed(found, "")  # a server without a token serves no one


def test_orders_are_checked_and_each_has_a_token_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feed_module, "find_spec", lambda name: None)
    with pytest.raises(DataError, match="needs the package nicegui"):
        scope_order("t", "127.0.0.1", 8642)
    monkeypatch.setattr(feed_module, "find_spec", lambda name: object())
    with pytest.raises(UsageError, match=r"--port \(=0\) must be in \[1..65535\]"):
        scope_order("t", "127.0.0.1", 0)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(DataError, match=f"cannot be served at 127.0.0.1:{port}"):
            scope_order("t", "127.0.0.1", port)
    for host, shown in (("127.0.0.1", "127.0.0.1"), ("localhost", "localhost"), ("0.0.0.0", "0.0.0.0")):
        order, other = scope_order("t", host, port), scope_order("t", host, port)
        assert len(order.token) >= 20
        assert order.url == f"http://{shown}:{port}/?token={order.token}"
        assert order.token != other.token
        assert cookie_name(order.token) != cookie_name(other.token)
    assert ScopeOrder("t", "::1", 1, "secret").url == "http://[::1]:1/?token=secret"
    assert scope_order("a\x1b[2Jb", "127.0.0.1", port).title == "a\\u001b[2Jb"
