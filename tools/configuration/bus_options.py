"""`bus.options`: what an interface of python-can needs besides channel and bit rate, such as host and port."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from pydantic_core import PydanticCustomError

from jointctl.drivers.can.channel import NAME, RESERVED, split_channel, with_options
from jointctl.drivers.can.open import CYCLIC_INTERFACES

if TYPE_CHECKING:
    from jointctl.tools.configuration.sections import Bus

ALLOWED = "names of python-can with texts, numbers, true or false; none for socketcan and jointctl"


def checked_options(value: Any) -> Any:
    """For pydantic: a table of names and plain values."""
    if value is None:
        return None
    if not isinstance(value, dict):
        raise PydanticCustomError("options", 'must be a table: {{ host = "...", port = 29536 }}')
    for name, option in value.items():
        if not NAME.fullmatch(str(name)) or name in RESERVED:
            raise PydanticCustomError("options", "{name} is no option of an interface", {"name": str(name)})
        if not isinstance(option, (str, int, float)) or (isinstance(option, float) and not math.isfinite(option)):
            raise PydanticCustomError("options", "{name} must be a text, a number, true or false", {"name": name})
    return value


def whole_channel(bus: Bus) -> Bus:
    """The bus with its options in `channel`, which then names it completely.

    What stands in the channel already (from the command line) goes before `options`.
    """
    channel, given = split_channel(bus.channel)
    options = {**(bus.options or {}), **given}
    if options and bus.interface in CYCLIC_INTERFACES:
        raise PydanticCustomError("options", "options must be absent for the interface {name}", {"name": bus.interface})
    return bus.model_copy(update={"channel": with_options(channel, options), "options": options or None})
