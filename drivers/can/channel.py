"""The channel of a bus with the options that its interface needs besides: `can0,host=192.168.1.5,port=29536`.

One text names a bus completely, on the command line, in the configuration (where `bus.options` is put into it), to the
loop's process and to the lock of the bus.  Values are whole numbers, numbers, true, false, or texts; what would be
read as something else, or holds a comma, is written in quotes or with percent signs.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from importlib import import_module
from inspect import Parameter, signature
from typing import Any
from urllib.parse import quote, unquote

import can

from jointctl.drivers.errors import BusError

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
