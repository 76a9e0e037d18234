"""Open a bus by the names that python-can gives it: interface, channel, bit rate.

Two kinds of end: a cyclic end is a file descriptor that the compiled loop uses ("socketcan" and "jointctl"); any
interface of python-can serves for commissioning and for the plain Python loop.  Such a bus of a third party is
normalised, and the serial port of an adapter (slcan), which serves one program at a time, is locked.

One text names a bus completely, on the command line, in the configuration (where `bus.options` is put into it), to the
loop's process and to the lock of the bus: the channel, with the options that its interface needs besides, for example
`can0,host=192.168.1.5,port=29536`.  Values are whole numbers, numbers, true, false, or texts; what would be read as
something else, or holds a comma, is written in quotes or with percent signs.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import socket
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from inspect import Parameter, signature
from typing import Any
from urllib.parse import quote, unquote

import can

from jointctl.drivers.can import socketcan, virtual_bus
from jointctl.drivers.errors import BusError
from jointctl.drivers.port_users import keep_from_forks, users_text

# its `recv` measures its time-out by the calendar: one that is set back by an hour would hold up who waits for so long
vars(can.bus)["time"] = time.monotonic

Option = str | int | float | bool
RESERVED = frozenset(("interface", "channel", "bitrate", "can_filters", "ignore_config", "config_context", "context"))
NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_CHANNEL = re.compile(rf"(.*?)((?:,{NAME.pattern}=[^,]*)*)", re.DOTALL)
_WHOLE, _NUMBER = re.compile(r"[+-]?[0-9]{1,18}"), re.compile(r"[+-]?[0-9]*\.?[0-9]+([eE][+-]?[0-9]+)?")
_AS_IT_IS = " /:@*?&#()[]{}<>|~!$^;+"  # a comma, a percent sign, a quote and an equals sign are written as %2C


def split_channel(text: str) -> tuple[str, dict[str, Option]]:
    """The channel as the interface names it, and the options behind it."""
    found = _CHANNEL.fullmatch(text)
    assert found is not None
    pairs = [part.partition("=") for part in found[2].split(",")[1:]]
    return found[1], {name: _value(word) for name, _, word in pairs}


def with_options(channel: str, options: Mapping[str, Option]) -> str:
    """The other way round; the same text for the same bus."""
    return channel + "".join(f",{name}={_word(value)}" for name, value in sorted(options.items()))


def _value(word: str) -> Option:
    if len(word) >= 2 and word[0] == word[-1] == "'":
        return unquote(word[1:-1])
    if word in ("true", "false"):
        return word == "true"
    if _WHOLE.fullmatch(word):
        return int(word)
    return float(word) if _NUMBER.fullmatch(word) else unquote(word)


def _word(value: Option) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if not isinstance(value, str):
        return repr(value)
    word = quote(value, safe=_AS_IT_IS)
    return word if _value(word) == value and isinstance(_value(word), str) else f"'{word}'"


def port_path(channel: str) -> str:
    """The device file of `/dev/ttyACM0@115200`, as python-can writes port and baud rate."""
    return split_channel(channel)[0].partition("@")[0]


def check_options(interface: str, options: Mapping[str, Option]) -> None:
    """`BusError` for an option that the interface does not have, and for one that it needs."""
    if interface in ("socketcan", "jointctl") and options:
        raise BusError(f"option {next(iter(options))} of the bus: interface {interface} takes none")
    for name in options:
        if name in RESERVED:
            raise BusError(f"option {name} of the bus: is no option, it has a key of its own or is not the user's")
    if interface not in can.interfaces.BACKENDS:
        return  # python-can's own error lists them
    module, name = can.interfaces.BACKENDS[interface]
    made = getattr(import_module(module), name)
    known, words, required = _parameters(made.__mro__)
    for option in options:
        if option not in known and option not in words:
            allowed = ", ".join(sorted(known)) or "nothing"
            raise BusError(f"option {option} of the bus: interface {interface} takes {allowed}")
    missing = [option for option in required if option not in options]
    if missing:
        example = ", ".join(f"{option} = ..." for option in missing)
        raise BusError(
            f"interface {interface} needs the option{'s' if len(missing) > 1 else ''} {', '.join(missing)}",
            f"bus.options = {{ {example} }}, or -c CHANNEL{''.join(f',{option}=...' for option in missing)}",
        )


def _parameters(classes: Iterable[type]) -> tuple[set[str], set[str], list[str]]:
    """Named parameters of a class and its bases; texts in their code, by which some ask for more; what is required."""
    known: set[str] = set()
    words: set[str] = set()
    required: list[str] = []
    for number, made in enumerate(classes):
        start: Any = vars(made).get("__init__")
        if not hasattr(start, "__code__"):
            continue
        words |= {constant for constant in start.__code__.co_consts if isinstance(constant, str)}
        for parameter in list(signature(start).parameters.values())[1:]:
            if parameter.kind in (Parameter.VAR_KEYWORD, Parameter.VAR_POSITIONAL) or parameter.name in RESERVED:
                continue
            known.add(parameter.name)
            if number == 0 and parameter.default is Parameter.empty:
                required.append(parameter.name)
    return known, words, required


CYCLIC_INTERFACES = ("socketcan", "jointctl")
# several programs can open them at once; any other may serve one at a time
SHARED_INTERFACES = (*CYCLIC_INTERFACES, "udp_multicast", "virtual")
# python-can waits 2 s for an Arduino to boot; an adapter for a control loop does not boot when its port is opened, and
# a supervisor takes a loop that does nothing for 2 s for dead
SLCAN_SETTLE_S = 0.2


def open_cyclic_end(interface: str, channel: str) -> socket.socket:
    """A non-blocking socket whose `fileno()` the compiled loop reads and writes; the caller closes it."""
    if interface == "socketcan":
        return socketcan.open_socket(channel)
    if interface == "jointctl":
        return virtual_bus.connect(channel)
    raise BusError(
        f"interface (={interface!r}) must be one of {', '.join(CYCLIC_INTERFACES)} for the compiled loop",
        "other python-can interfaces run in the plain Python loop",
    )


def known_interface(interface: str) -> None:
    """`BusError` for a name that python-can does not know; no bus is opened."""
    names = can.VALID_INTERFACES | {"jointctl"}
    if interface not in names:
        raise BusError(f"interface (={interface!r}) must be one of {', '.join(sorted(names))}")


@contextlib.contextmanager
def _without_its_log() -> Iterator[None]:
    """What python-can and its interfaces log while they open comes as an exception as well: one line is enough."""
    log = logging.getLogger("can")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(level)


@contextlib.contextmanager
def reserved_port(channel: str, *, exclusive: bool) -> Iterator[None]:
    """`OSError` if the port cannot be opened, `BusError` if `exclusive` and a program of ours has it.

    Opening it would close the CAN channel under that program's feet.  The port stays open in the meantime, so that its
    control lines, which restart some adapters, do not move in between.
    """
    if "://" in channel:  # pyserial's URLs: no device file
        yield
        return
    path = port_path(channel)
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if exclusive:
            lock_port(descriptor, path)
        yield
    finally:
        os.close(descriptor)


def lock_port(descriptor: int, path: str) -> None:
    """Keep others off as long as the descriptor is open; `BusError` names the program that has the port."""
    from fcntl import LOCK_EX, LOCK_NB, flock  # not every system has it, and each verb loads this module

    try:
        flock(descriptor, LOCK_EX | LOCK_NB)
    except OSError:
        users = users_text(path)
        raise BusError(
            f"the adapter on {path} is in use by another program{f' ({users})' if users else ''}",
            "it serves one at a time: end that program; `jointctl stop` switches the drive off all the same",
        ) from None


def _failure(doing: str, error: Exception) -> can.CanOperationError:
    return can.CanOperationError(f"{doing} failed: {str(error) or type(error).__name__}", getattr(error, "errno", None))


def normalised(bus: can.BusABC) -> can.BusABC:
    """The same bus; `send` and `recv` raise only `can.CanError`, and what cannot be decoded is a lost frame.

    So python-can documents it, and not all interfaces keep to it: slcan, for one, raises ValueError for a line that is
    not whole, as they come when two programs use one adapter.  Code that makes a joint safe over such a bus must go on,
    or get the bus's failure, but not end with a traceback.
    """
    send, receive = bus.send, bus.recv

    def checked_send(msg: can.Message, timeout: float | None = None) -> None:
        try:
            send(msg, timeout)
        except can.CanError:
            raise
        except Exception as error:
            raise _failure("sending", error) from error

    def checked_receive(timeout: float | None = None) -> can.Message | None:
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
    changed.send, changed.recv = checked_send, checked_receive
    return bus


_KERNEL_HAS = ("pcan", "kvaser", "gs_usb", "candle")  # adapters that Linux has as network interfaces
_AS_SOCKETCAN = (
    "on Linux the kernel's driver is enough: sudo ip link set can0 up type can bitrate 1000000, then "
    "-i socketcan -c can0 (docs/adapters.md)"
)


def _remedy(interface: str, elsewhere: str) -> str:
    """What helps where a library of the maker is missing."""
    return _AS_SOCKETCAN if sys.platform == "linux" and interface in _KERNEL_HAS else elsewhere


@_without_its_log()
def open_python_can(
    interface: str, channel: str, bitrate: int | None = None, *, exclusive: bool = True, **settings: Any
) -> can.BusABC:
    """A python-can bus; everything that can go wrong while opening it becomes a BusError.

    `bitrate` [bit/s] is passed on where given; SocketCAN and the virtual bus ignore it.  `settings`, and the options in
    `channel` (`drivers.can.open`), go to the interface.  The interface "jointctl" works even where the package is
    not installed.  `exclusive` False: to switch the drive off although another program has the serial adapter.
    """
    place = f"{interface}:{channel}"
    if bitrate is not None:
        settings["bitrate"] = bitrate
    try:
        return _opened(interface, channel, settings, exclusive=exclusive)
    except BusError:
        raise
    except NotImplementedError as error:  # also CanInterfaceNotImplementedError
        known_interface(interface)
        raise BusError(
            f"interface {interface} cannot be used here: {error}", _remedy(interface, "install its driver")
        ) from None
    except Exception as error:  # without its maker's library an interface raises NameError, AttributeError, ctypes' own
        if isinstance(error.__cause__, BusError):
            raise error.__cause__ from None
        raise _cannot_open(interface, place, error) from None


def _opened(interface: str, channel: str, settings: dict[str, Any], *, exclusive: bool) -> can.BusABC:
    channel, options = split_channel(channel)
    check_options(interface, options)
    if interface == "slcan":
        settings.setdefault("sleep_after_open", SLCAN_SETTLE_S)
    settings |= options
    if interface == "jointctl":
        return virtual_bus.VirtualBus(channel, **settings)
    if interface == "socketcan":
        # python-can binds to an interface that is down without a word: ask the kernel first.
        socketcan.open_socket(channel).close()
    if interface == "slcan":
        with reserved_port(channel, exclusive=exclusive):
            bus = can.Bus(channel=channel, interface=interface, ignore_config=True, **settings)
        if exclusive and "://" not in channel:
            lock_port(bus.fileno(), port_path(channel))
            keep_from_forks(bus)
        return normalised(bus)
    return normalised(can.Bus(channel=channel, interface=interface, ignore_config=True, **settings))


def _cannot_open(interface: str, place: str, error: Exception) -> BusError:
    """In words, with what helps."""
    if isinstance(error, ImportError):
        text = f"interface {interface} needs a module that is not installed: {error}"
        return BusError(text, _remedy(interface, "install it"))
    if isinstance(error, PermissionError):
        remedy = "sudo usermod -aG dialout $USER" if interface == "slcan" else "add the user to the device's group"
        return BusError(f"no permission to open {place}", f"{remedy}; log in again")
    if isinstance(error, OSError):
        if error.errno in (errno.ENODEV, errno.ENOENT, errno.ENXIO):
            return BusError(f"no such device: {place}", "plug in the adapter")
        return BusError(f"cannot open {place}: {error.strerror or error}")
    if isinstance(error, (can.CanError, ValueError, TypeError)):
        return BusError(f"cannot open {place}: {error}", _remedy(interface, ""))
    hint = _remedy(interface, f"is the driver of {interface} installed?")
    if isinstance(error, (NameError, AttributeError)):  # python-can goes on without it until the first call
        missing = f"{error.name} is missing" if error.name else str(error)
        lacks = "the library of the adapter's maker is not installed, or too old"
        return BusError(f"cannot open {place}: {lacks}: {missing}", hint)
    return BusError(f"cannot open {place}: {type(error).__name__}: {error}", hint)


@_without_its_log()
def receive_only(bus: can.BusABC, identifiers: Iterable[tuple[int, int]]) -> None:
    """`bus` hands over no other frames from here on; `identifiers`: of 11 bits, each with the bits that count.

    Only where the system filters: python-can's own filter takes longer than listeners that ignore a frame.
    """
    if isinstance(bus, virtual_bus.VirtualBus) or type(bus).__module__.startswith("can.interfaces.socketcan."):
        bus.set_filters([{"can_id": wanted, "can_mask": mask, "extended": False} for wanted, mask in identifiers])
