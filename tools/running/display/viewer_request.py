"""What somebody who watches a run asks for, as it comes from the page: nothing in it has been checked."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

LONGEST_BYTES = 4096


@dataclass(frozen=True)
class ViewerRequest:
    """`kind` is gains, set_point, trajectory, record, start or prepare; `values` belong to it.

    Two kinds come from the page's server itself: viewers, with the `count` of open pages, and stop, with `strength`.
    """

    kind: str
    who: str
    values: Mapping[str, Any] = field(default_factory=dict)

    def encoded(self) -> bytes:
        """As one message."""
        return json.dumps(asdict(self)).encode()


def viewer(address: str | None) -> str:
    """What a viewer is called in events."""
    return f"a viewer at {address or 'an unknown address'}"


def decoded(message: bytes) -> ViewerRequest | None:
    """The request in a message; None if it is none."""
    try:
        found = json.loads(message)
        kind, who, values = found["kind"], found["who"], found["values"]
    except (ValueError, TypeError, KeyError):
        return None
    if not (isinstance(kind, str) and isinstance(who, str) and isinstance(values, dict)):
        return None
    return ViewerRequest(kind, " ".join(who.split())[:80], values)
