"""Writing parameters back into a drive, each read back; what is refused is told and does not end the work.

The order is that of the indices, except for PDOs, whose identifier and mapping change in the order of CiA 301
(disable, type, number 0, entries, number, enable).  What was refused is tried once more at the end: one object may only
accept its value after another has got its own (a minimum above the old maximum).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from jointctl.drivers.canopen.pdo import DISABLED
from jointctl.drivers.canopen.sdo import download
from jointctl.tools.inspection.objects import Place
from jointctl.tools.inspection.parameters import Value
from jointctl.tools.inspection.sdo_reading import ATTEMPTS, Refusal, SdoReader, abort_text

_SPAN = 0x200
_COMMUNICATION, _MAPPING_OFFSET = (0x1400, 0x1800), 0x200


@dataclass(frozen=True)
class Written:
    """`failure` is empty if the value was taken and reads back."""

    place: Place
    wanted: Value
    failure: str = ""


def write_value(reader: SdoReader, place: Place, value: Value) -> str:
    """Write and read back; "" or what went wrong."""
    variable = reader.objects.variable(place.index, place.sub)
    if variable is None:
        return "the EDS does not have it"
    try:
        data = variable.encode_raw(value)
    except Exception as error:  # the library raises whatever struct does
        return f"{value!r} does not fit its type: {error}"
    failure = _download(reader, place, data)
    if failure:
        return failure
    found = reader.upload(place.index, place.sub)
    if isinstance(found, Refusal):
        return f"written, but not read back: {found}"
    value_read = reader.objects.value(place.index, place.sub, found)
    return "" if value_read == value else f"reads back {value_read}"


def _download(reader: SdoReader, place: Place, data: bytes) -> str:
    for _ in range(ATTEMPTS):
        try:
            download(reader.remote.sdo, place.index, place.sub, data)
            return ""
        except SdoAbortedError as error:
            return abort_text(error.code)
        except SdoCommunicationError:
            continue
    return "no answer"


def _pdo_of(place: Place) -> int | None:
    """Index of the communication record that an object of a PDO belongs to."""
    for base in _COMMUNICATION:
        if base <= place.index < base + _SPAN:
            return place.index
        if base + _MAPPING_OFFSET <= place.index < base + _MAPPING_OFFSET + _SPAN:
            return place.index - _MAPPING_OFFSET
    return None


def _write_pdo(
    reader: SdoReader, communication: int, changed: dict[Place, Value], all_values: dict[Place, Value]
) -> Iterator[Written]:
    """One PDO: switched off while it changes; its identifier, which may switch it on again, comes last."""
    identifier, mapping = Place(communication, 1), communication + _MAPPING_OFFSET
    before = reader.value(identifier.index, 1)
    final = all_values.get(identifier, before)
    if isinstance(before, int) and not before & DISABLED:
        _download(reader, identifier, (before | DISABLED).to_bytes(4, "little"))
    for place, value in changed.items():
        if place.index == communication and place != identifier:
            yield Written(place, value, write_value(reader, place, value))
    mapped = {place: value for place, value in changed.items() if place.index == mapping}
    if mapped:
        count = all_values.get(Place(mapping, 0), reader.value(mapping, 0) or 0)
        off = _download(reader, Place(mapping, 0), b"\0")
        for place, value in mapped.items():
            if place.sub:
                yield Written(place, value, off or write_value(reader, place, value))
        failure = write_value(reader, Place(mapping, 0), count)
        if failure or Place(mapping, 0) in mapped:
            yield Written(Place(mapping, 0), count, failure)
    if final is not None:
        failure = write_value(reader, identifier, final)
        if failure or identifier in changed:
            yield Written(identifier, final, failure)


def restore(reader: SdoReader, changed: dict[Place, Value], all_values: dict[Place, Value]) -> list[Written]:
    """Write `changed`, a part of `all_values` of the file; the node is pre-operational and its drive is off."""
    results: dict[Place, Written] = {}
    pdos: dict[int, dict[Place, Value]] = {}
    for place, value in changed.items():
        pdo = _pdo_of(place)
        if pdo is None:
            results[place] = Written(place, value, write_value(reader, place, value))
        else:
            pdos.setdefault(pdo, {})[place] = value
    for communication, part in pdos.items():
        for done in _write_pdo(reader, communication, part, all_values):
            results[done.place] = done
    for place, done in list(results.items()):
        if done.failure and _pdo_of(place) is None:
            results[place] = Written(place, done.wanted, write_value(reader, place, done.wanted))
    return list(results.values())
