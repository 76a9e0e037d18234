"""The loops, ready to go: compiled on a bus that is a descriptor, in plain Python over python-can.

`python -m jointctl.tools.session.loops` loads the compiled one, or compiles it: so the time of a start is measured.
"""

from __future__ import annotations

import contextlib
import gc
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING

from jointctl.drivers.errors import BusError
from jointctl.firmware_py.cycle import Exchange, Word
from jointctl.firmware_py.libc import NANOSECONDS
from jointctl.tools.child_process import say
from jointctl.tools.session.loop_memory import FOREVER, LoopOrder, SharedBlock

if TYPE_CHECKING:
    import can


_POLL_S = 0.001


@dataclass(frozen=True)
class ReadyLoop:
    """A loop that is warm: `go` runs it to its end, `flush` throws away what the bus has said so far."""

    go: Callable[[], object]
    flush: Callable[[], None] = lambda: None  # of a loop that does not listen before it goes


Loop = Callable[[LoopOrder, SharedBlock], AbstractContextManager[ReadyLoop]]


def _of_canopen() -> tuple[type, Loop]:
    from jointctl.drivers.can.open import CYCLIC_INTERFACES
    from jointctl.drivers.canopen.cyclic import CanopenPort

    return CanopenPort, lambda order, block: (compiled_loop if order.interface in CYCLIC_INTERFACES else portable_loop)(
        order, block
    )


def _of_elmo_serial() -> tuple[type, Loop]:
    from jointctl.drivers.elmo.cyclic import ElmoPort

    return ElmoPort, serial_loop


_KINDS = {"canopen": _of_canopen, "elmo_serial": _of_elmo_serial}


def loop_of(kind: str) -> tuple[type, Loop]:
    """For drive.kind, of which alone modules are loaded: the record of its exchange, and its loop when it is warm."""
    return _KINDS[kind]()


def loop_call(
    driver: ModuleType, link: object, block: SharedBlock, period_ns: int, receive_ns: int
) -> Callable[[int], int]:
    """`run_loop` on this memory with this driver's exchange, as a function of the greatest number of cycles.

    0 only compiles, or loads from the cache.
    """
    from jointctl.firmware_py.cycle import run_loop

    memory, exchange = block.memory(), Exchange(driver.receive, driver.send, link)
    return lambda max_cycles: int(run_loop(memory, exchange, period_ns, receive_ns, max_cycles))


def compiled_call(block: SharedBlock, period_ns: int, receive_ns: int) -> Callable[[int], int]:
    """`loop_call` on a CAN bus that is a descriptor."""
    from jointctl.drivers.canopen import exchange

    return loop_call(exchange, exchange.link_of(block.port, block.near()), block, period_ns, receive_ns)


@contextmanager
def compiled_loop(order: LoopOrder, block: SharedBlock) -> Iterator[ReadyLoop]:
    """The compiled loop, warm and attached to the bus, or to the buses of an arm."""
    from jointctl.drivers.can.frames import FRAME_BYTES
    from jointctl.drivers.can.open import open_cyclic_end

    call = compiled_call(block, order.period_ns, order.receive_ns)
    call(0)  # compiles, or loads from the cache
    while block.words[Word.BUS] == 0:
        if order.supervisor_gone():
            raise BusError("the supervising process went before the bus was there")
        time.sleep(_POLL_S)
    with contextlib.ExitStack() as stack:
        ends = {
            axis: stack.enter_context(open_cyclic_end(interface, channel))
            for axis, interface, channel in ((0, order.interface, order.channel), *order.more_buses)
        }

        def go() -> None:
            for axis, end in ends.items():
                block.port[axis].fd = end.fileno()
            call(FOREVER)

        def flush() -> None:
            for end in ends.values():
                with contextlib.suppress(OSError):  # nothing waits, or the bus is down: the loop will tell
                    while end.recv(FRAME_BYTES, socket.MSG_DONTWAIT):
                        pass

        yield ReadyLoop(go, flush)


def _leave(bus: can.BusABC) -> None:
    """Close it; of an adapter that is gone, what failed before counts."""
    with contextlib.suppress(Exception):
        bus.shutdown()


@contextmanager
def portable_loop(order: LoopOrder, block: SharedBlock) -> Iterator[ReadyLoop]:
    """The plain Python loop in the same way, and a line that tells what it can hold.

    An adapter that serves one program at a time belongs to commissioning until the loop is let go, which opens it then
    (see `CanopenDrive.start_cyclic`).
    """
    from jointctl.drivers.can.open import SHARED_INTERFACES, known_interface, open_python_can
    from jointctl.tools.session.portable_loop import (
        check_portable_rate,
        held_rate_Hz,
        portable_note,
        run_portable_loop,
        throw_away,
        warm_up,
    )

    rate_Hz = NANOSECONDS / order.period_ns
    known_interface(order.interface)
    check_portable_rate(order.interface, rate_Hz)
    warm_up()
    held_Hz = held_rate_Hz(order.receive_ns / order.period_ns)
    say(f"loop: {portable_note(order.interface, rate_Hz, held_Hz)}")

    with contextlib.ExitStack() as stack:

        def opened() -> can.BusABC:
            bus = open_python_can(order.interface, order.channel, order.bitrate_bitps)
            stack.callback(_leave, bus)
            return bus

        if order.interface in SHARED_INTERFACES:
            bus = opened()
            yield ReadyLoop(
                lambda: run_portable_loop(bus, block, order.period_ns, order.receive_ns), lambda: throw_away(bus)
            )
        else:
            yield ReadyLoop(lambda: run_portable_loop(opened(), block, order.period_ns, order.receive_ns))


def warm_up_compiled_loop() -> None:
    """Do what the loop process does before it is ready; no bus is opened, nothing is sent."""
    from jointctl.drivers.canopen.cyclic import CanopenPort

    block = SharedBlock.create(1, CanopenPort)
    compiled_call(block, 1_000_000, 0)(0)
    os.close(block.fd)


@contextmanager
def serial_loop(order: LoopOrder, block: SharedBlock) -> Iterator[ReadyLoop]:
    """The compiled loop on a serial line, warm; a port is a descriptor that the C library reads and writes.

    It is opened when the loop is let go: by then the supervisor has locked and configured it.
    """
    from jointctl.drivers.elmo import exchange

    call = loop_call(exchange, exchange.link_of(block.port), block, order.period_ns, order.receive_ns)
    call(0)  # compiles, or loads from the cache

    def go() -> None:
        with exchange.attached(block.port, order.channel):
            call(FOREVER)

    yield ReadyLoop(go)


if __name__ == "__main__":
    gc.disable()  # what a compiler leaves behind is little beside what it holds
    warm_up_compiled_loop()
