"""Makes a bus of a third party fail as python-can documents it: with `can.CanError`, which not all of them keep to.

slcan, for one, raises ValueError for a line that is not whole, as they come when two programs talk to one adapter.
Whoever makes a joint safe over such a bus must go on, or be told that the bus failed, but not end with a traceback.
"""

from __future__ import annotations

from typing import Any

import can


def _failure(doing: str, error: Exception) -> can.CanOperationError:
    return can.CanOperationError(f"{doing} failed: {str(error) or type(error).__name__}", getattr(error, "errno", None))


def tamed(bus: can.BusABC) -> can.BusABC:
    """The same bus; `send` and `recv` raise only `can.CanError`, and what cannot be decoded is a lost frame."""
    send, receive = bus.send, bus.recv

    def tamed_send(msg: can.Message, timeout: float | None = None) -> None:
        try:
            send(msg, timeout)
        except can.CanError:
            raise
        except Exception as error:
            raise _failure("sending", error) from error

    def tamed_receive(timeout: float | None = None) -> can.Message | None:
        try:
            return receive(timeout)
        except (ValueError, IndexError):
            return None
        except can.CanError as error:
            if not (isinstance(error.__cause__, UnicodeDecodeError) and hasattr(bus, "flush")):
                raise
            bus.flush()  # slcan keeps what it could not decode, and would fail at each line from here on
            return None
        except Exception as error:
            raise _failure("receiving", error) from error

    changed: Any = bus  # the methods of this one object
    changed.send, changed.recv = tamed_send, tamed_receive
    return bus
