"""An object of a drive as configurations name it: index in hexadecimal, sub-index in decimal."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator
from pydantic_core import PydanticCustomError


def _checked(value: str) -> str:
    match = re.fullmatch(r"([0-9A-Fa-f]{4})(?::([0-9]{1,3}))?", value)
    if match is None or int(match[1], 16) < 0x2000 or int(match[2] or 0) > 254:
        raise PydanticCustomError("object", 'must be an object such as "60E4:1" (index in hexadecimal, sub-index)')
    return value


ObjectPlace = Annotated[str, AfterValidator(_checked)]


def index_and_sub(place: str) -> tuple[int, int]:
    """(60E4h, 1) of "60E4:1"; sub-index 0 where none is named."""
    index, _, sub = place.partition(":")
    return int(index, 16), int(sub or 0)
