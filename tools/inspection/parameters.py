"""A drive's objects as a set of values: which are parameters, which only readings; reading and comparing them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import canopen
from canopen.objectdictionary import ODVariable

from jointctl.tools.inspection.objects import Objects, Place
from jointctl.tools.inspection.sdo_reading import Refusal, SdoReader

Value = int | float | str | bytes
# Writable, but commands or process data and not settings: error history, store and restore, programme download,
# controlword, targets and their offsets, interpolation data, digital outputs.  They are never restored.
COMMANDS = frozenset(
    (0x1003, 0x1010, 0x1011, 0x1F50, 0x1F51, 0x1F57, 0x6040, 0x6042, 0x6071, 0x607A, 0x60B0, 0x60B1, 0x60B2, 0x60C1,
     0x60FE, 0x60FF)
)  # fmt: skip
_HISTORY = 0x1003


@dataclass
class ParameterSet:
    """`parameters` can be written back; `readings` cannot or must not; `unreadable` tells why."""

    origin: str
    device: dict[str, Any] = field(default_factory=dict)
    parameters: dict[Place, Value] = field(default_factory=dict)
    readings: dict[Place, Value] = field(default_factory=dict)
    unreadable: dict[Place, str] = field(default_factory=dict)

    def put(self, variable: ODVariable, value: Value) -> None:
        """Into the group that the object belongs to."""
        group = self.parameters if is_parameter(variable) else self.readings
        group[Place(variable.index, variable.subindex)] = value


@dataclass(frozen=True)
class Difference:
    """None where one side does not have the object."""

    place: Place
    first: Value | None
    second: Value | None


def is_parameter(variable: ODVariable) -> bool:
    """Whether restoring may write the object."""
    counts = variable.subindex == 0 and variable.parent is not None and hasattr(variable.parent, "subindices")
    mapping = 0x1600 <= variable.index < 0x1800 or 0x1A00 <= variable.index < 0x1C00
    return bool(variable.writable and variable.readable and variable.index not in COMMANDS and (mapping or not counts))


def variables(dictionary: canopen.ObjectDictionary) -> Iterator[ODVariable]:
    """Every object with a value, in the order of their indices; dummy entries for gaps in PDOs are left out."""
    for index in sorted(dictionary):
        if index < 0x1000:
            continue
        entry = dictionary[index]
        if isinstance(entry, ODVariable):
            yield entry
        else:
            yield from (variable for _, variable in sorted(entry.subindices.items()))


def identity_of(reader: SdoReader) -> dict[str, Any]:
    """What a file is checked against before it is restored; names for people."""
    keys = ("vendor_id", "product_code", "revision", "serial_number")
    numbers = {key: reader.value(0x1018, sub) for sub, key in enumerate(keys, start=1)}
    return {"node": reader.node, **numbers, "name": reader.value(0x1008), "software": reader.value(0x100A)}


def read_parameters(reader: SdoReader, advance: Callable[[float], None] = lambda _: None) -> ParameterSet:
    """All readable objects of the EDS as the drive has them now; `advance` gets how many have been asked for."""
    reader.require_answer()
    found = ParameterSet(f"node {reader.node}", identity_of(reader))
    entries = 0
    for number, variable in enumerate(variables(reader.objects.required()), start=1):
        advance(number)
        place = Place(variable.index, variable.subindex)
        if not variable.readable or (place.index == _HISTORY and place.sub > entries):
            continue
        data = reader.upload(place.index, place.sub)
        if isinstance(data, Refusal):
            found.unreadable[place] = str(data)
            continue
        value = reader.objects.value(place.index, place.sub, data)
        if place == Place(_HISTORY):
            entries = int(value)
        found.put(variable, value)
    return found


def differences(first: ParameterSet, second: ParameterSet, *, readings: bool = False) -> list[Difference]:
    """Objects whose values differ, in order; `readings` looks at those that are no parameters as well."""
    a, b = dict(first.parameters), dict(second.parameters)
    if readings:
        a |= first.readings
        b |= second.readings
    places = sorted(set(a) | set(b), key=lambda place: (place.index, place.sub))
    return [Difference(place, a.get(place), b.get(place)) for place in places if a.get(place) != b.get(place)]


def shown(objects: Objects, place: Place, value: Value | None) -> str:
    """A value for people."""
    if value is None:
        return "-"
    variable = objects.variable(place.index, place.sub)
    bits = len(variable) if variable is not None and variable.fixed_size else 32
    return objects.value_text(place.index, place.sub, value, bits)
