"""Everything that a drive tells about itself over SDO, as one document of plain values; reads only.

Objects that the drive does not have are null or missing; nothing is asked twice, nothing is written.
"""

from __future__ import annotations

from typing import Any

from jointctl.drivers.canopen.cia import state_text
from jointctl.tools.inspection.frame_decoder import PdoMap, PdoMaps
from jointctl.tools.inspection.objects import (
    ABORT_OPTIONS,
    QUICK_STOP_OPTIONS,
    Place,
    device_type_text,
    error_register_text,
    no_error_or,
    polarity_text,
    status_bits,
    supported_modes,
    transmission_text,
)
from jointctl.tools.inspection.subject import SdoReader
from jointctl.tools.session.fault_words import emergency_text

HISTORY = 8  # entries of 1003 that are shown
CONSUMERS = 4  # entries of 1016
PDO_NUMBERS = 4  # that are read where no EDS lists others
ALL_PDOS = frozenset(range(0x200))
MILLI = 1e-3
MAXON = 0xFB  # vendor of 1018:1

# object, its unit as CiA 402 has it; positions count as 6064 does, and so do speeds and accelerations unless the drive
# scales them, or its maker has other units
_POSITION, _SPEED, _RAMP = "units of 6064", "units of 6064 per s, unless scaled", "units of 6064 per s2, unless scaled"
_LIMITS = (
    (0x6072, 0, "permille of rated torque"), (0x6073, 0, "permille of rated current"), (0x607F, 0, _SPEED),
    (0x6080, 0, "r/min"), (0x607D, 1, _POSITION), (0x607D, 2, _POSITION), (0x6065, 0, _POSITION), (0x6066, 0, "ms"),
    (0x60C5, 0, _RAMP), (0x60C6, 0, _RAMP), (0x6085, 0, _RAMP), (0x6087, 0, "permille of rated torque per s"),
)  # fmt: skip
_PRESENT = (
    (0x6064, 0, "counts, unless scaled"), (0x606C, 0, _SPEED), (0x6077, 0, "permille of rated torque"),
    (0x6078, 0, "permille of rated current"), (0x6079, 0, "mV"), (0x60F4, 0, _POSITION),
    (0x6071, 0, "permille of rated torque"), (0x60FF, 0, _SPEED), (0x607A, 0, _POSITION),
)  # fmt: skip


def _hexadecimal(value: int | None) -> str | None:
    return None if value is None else f"{value:#010x}"


def identity(reader: SdoReader) -> dict[str, Any]:
    """1000, 1008 to 100A, 1018."""
    device_type = reader.require_answer()
    vendor, product, revision, serial = (reader.value(0x1018, sub) for sub in (1, 2, 3, 4))
    return {
        "node": reader.node,
        "device_type": device_type_text(device_type),
        "name": reader.value(0x1008),
        "hardware": reader.value(0x1009),
        "software": reader.value(0x100A),
        "vendor_id": _hexadecimal(vendor),
        "product_code": _hexadecimal(product),
        "revision": _hexadecimal(revision),
        "serial_number": serial,
    }


def state(reader: SdoReader) -> dict[str, Any]:
    """6041 in words, the mode, and the modes that there are."""
    word, modes = reader.value(0x6041), reader.value(0x6502)
    return {
        "status_word": None if word is None else f"{word:04X}h",
        "drive_state": None if word is None else state_text(word),
        "status_bits": [] if word is None else status_bits(word),
        "mode_selected": reader.text(0x6060),
        "mode_shown": reader.text(0x6061),
        "supported_modes": None if modes is None else supported_modes(modes),
    }


def errors(reader: SdoReader) -> dict[str, Any]:
    """1001, 603F, and the history 1003, newest first; the upper half of an entry is the maker's own."""
    register, code, count = reader.value(0x1001), reader.value(0x603F), reader.value(0x1003, 0)
    history = []
    for sub in range(1, min(count or 0, HISTORY) + 1):
        entry = reader.value(0x1003, sub)
        if entry is not None:
            text = no_error_or(entry & 0xFFFF, emergency_text)
            history.append(text + (f" (maker's part {entry >> 16:04X}h)" if entry >> 16 else ""))
    return {
        "error_register": None if register is None else error_register_text(register),
        "error_code": None if code is None else no_error_or(code, emergency_text),
        "history_length": count,
        "history": history,
    }


def rated_torque_mNm(reader: SdoReader) -> float | None:
    """6076, which counts µNm in maxon's drives."""
    torque = reader.value(0x6076)
    return torque if torque is None or reader.value(0x1018, 1) != MAXON else torque * MILLI


def ratings(reader: SdoReader) -> dict[str, Any]:
    """Rated current and torque, the torque constant that follows from them, encoder, gear, what 6064 counts in."""
    current_mA, torque_mNm = reader.value(0x6075), rated_torque_mNm(reader)
    increments, turns = reader.value(0x608F, 1), reader.value(0x608F, 2)
    motor, shaft = reader.value(0x6091, 1), reader.value(0x6091, 2)
    feed, turns_of_feed, polarity = reader.value(0x6092, 1), reader.value(0x6092, 2), reader.value(0x607E)
    return {
        "rated_current_A": None if current_mA is None else current_mA * MILLI,
        "rated_torque_Nm": None if torque_mNm is None else torque_mNm * MILLI,
        "torque_constant_NmpA": torque_mNm / current_mA if current_mA and torque_mNm else None,
        "encoder_increments": increments,
        "encoder_motor_revolutions": turns,
        "gear_ratio": motor / shaft if motor and shaft else None,
        "feed_constant": f"{feed} units of 6064 for {turns_of_feed} turns of the shaft" if feed else None,
        "polarity": None if polarity is None else polarity_text(polarity),
    }


def _listed(reader: SdoReader, places: tuple[tuple[int, int, str], ...]) -> list[dict[str, Any]]:
    found = []
    for index, sub, unit in places:
        value = reader.value(index, sub)
        if value is not None:
            name = reader.objects.name(index, sub)
            found.append({"object": str(Place(index, sub)), "name": name, "value": value, "unit": unit})
    return found


def supervision(reader: SdoReader) -> dict[str, Any]:
    """What the drive does when it loses its master: heartbeat, 6007, 605A, 1029; and its SYNC period 60C2."""
    abort, quick, behaviour = reader.value(0x6007), reader.value(0x605A), reader.value(0x1029, 1)
    value, exponent = reader.value(0x60C2, 1), reader.value(0x60C2, 2)
    consumers = []
    for sub in range(1, min(reader.value(0x1016, 0) or 0, CONSUMERS) + 1):
        entry = reader.value(0x1016, sub)
        if entry and entry & 0xFFFF:
            consumers.append({"node": entry >> 16 & 0x7F, "ms": entry & 0xFFFF})
    return {
        "heartbeat_ms": reader.value(0x1017),
        "watched_heartbeats": consumers,
        "on_connection_loss": None if abort is None else f"{abort} {ABORT_OPTIONS.get(abort, 'its own')}",
        "on_quick_stop": None if quick is None else f"{quick} {QUICK_STOP_OPTIONS.get(quick, 'its own')}",
        "on_communication_error": None
        if behaviour is None
        else {0: "0 pre-operational if operational", 1: "1 no change", 2: "2 stopped"}.get(behaviour, str(behaviour)),
        "interpolation_period_s": None if value is None or exponent is None else value * 10.0**exponent,
    }


def pdo_maps(reader: SdoReader, maps: PdoMaps | None = None) -> list[PdoMap]:
    """The PDOs as they are set up in the drive; also taught to `maps`."""
    maps = PdoMaps() if maps is None else maps
    for communication, mapping in ((0x1800, 0x1A00), (0x1400, 0x1600)):
        listed = {index - communication for index in reader.objects.dictionary or ()}
        for number in sorted({*range(PDO_NUMBERS), *(listed & ALL_PDOS)}):
            cob_id = reader.value(communication + number, 1)
            if cob_id is None:
                continue
            maps.learn(reader.node, communication + number, 1, cob_id)
            kind = reader.value(communication + number, 2)
            if kind is not None:
                maps.learn(reader.node, communication + number, 2, kind)
            count = reader.value(mapping + number, 0) or 0
            maps.learn(reader.node, mapping + number, 0, count)
            for sub in range(1, min(count, 64) + 1):
                entry = reader.value(mapping + number, sub)
                if entry is not None:
                    maps.learn(reader.node, mapping + number, sub, entry)
    return maps.of_node(reader.node)


def pdo_rows(reader: SdoReader, pdos: list[PdoMap]) -> list[dict[str, Any]]:
    """For the report: identifier, whether it is on, its transmission type in words, and what it carries by name."""
    return [
        {
            "pdo": pdo.name,
            "cob_id": None if pdo.cob_id is None else f"{pdo.cob_id:03X}h",
            "enabled": pdo.enabled,
            "transmission": None if pdo.transmission is None else transmission_text(pdo.transmission),
            "objects": [
                f"{Place(index, sub)} {reader.objects.name(index, sub)} ({bits} bit)"
                for index, sub, bits in pdo.entries
            ],
        }
        for pdo in pdos
    ]


def drive_info(reader: SdoReader) -> dict[str, Any]:
    """All of the above as one document."""
    found: dict[str, Any] = {"identity": identity(reader)}
    is_drive = reader.value(0x6041) is not None
    found["errors"] = errors(reader)
    if is_drive:
        found["state"] = state(reader)
        found["ratings"] = ratings(reader)
        found["limits"] = _listed(reader, _LIMITS)
        found["present"] = _listed(reader, _PRESENT)
    found["supervision"] = supervision(reader)
    found["pdos"] = pdo_rows(reader, pdo_maps(reader))
    return found
