"""Objects 1010 and 1011 of the virtual drive: what a reset brings back (CiA 301, 7.5.2.13 and 14).

"save" written to 1010 makes the present values the ones that a reset restores; "load" written to 1011 makes it those
of the EDS and the drive's settings again.  Sub 1 means all, 2 the communication objects (1000..1FFF), 3 the others.
Commands and targets are never saved (6040, 6060, 6071, 607A, 60B2, 60FF), nor the error history.  With a file the
saved values outlive the process.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

from jointctl.hil.canopen.device_records import PowerState
from jointctl.hil.canopen.object_dictionary import CANNOT_STORE, DEVICE_STATE, HARDWARE, ObjectDictionary, SdoAbort

SAVE = 0x65766173
LOAD = 0x64616F6C
_NEVER_SAVED = (0x1003, 0x1010, 0x1011, 0x6040, 0x6060, 0x6071, 0x607A, 0x60B2, 0x60FF)


class ParameterStore:
    """Saves and restores the writable objects of one device; `path` is read once, at construction (ValueError)."""

    def __init__(self, objects: ObjectDictionary, path: Path | None) -> None:
        self._objects = objects
        self._path = path
        self._keys = [(e.index, e.sub) for e in objects if e.writable and e.index not in _NEVER_SAVED]
        self._factory = {key: objects.default(*key) for key in self._keys}
        self._saved: dict[tuple[int, int], int | bytes] = {}
        if path is not None and path.exists():
            self._load(path)

    def _load(self, path: Path) -> None:
        try:
            stored = json.loads(path.read_text(encoding="utf-8"))
            self._saved = {}
            for text, value in stored.items():
                index, sub = (int(part, 16) for part in text.split(":"))
                data = value.encode() if isinstance(value, str) else int(value)
                if (index, sub) not in self._factory or type(data) is not type(self._factory[index, sub]):
                    raise ValueError(f"{text} (={value}) is not a parameter of this drive")
                self._objects.set_default(index, sub, data)
                self._saved[index, sub] = data
        except (OSError, AttributeError, ValueError, TypeError, OverflowError) as error:
            raise ValueError(f"parameter file {path.name}: {' '.join(str(error).split())}") from None

    def command(self, index: int, sub: int, signature: int, power_state: int) -> None:
        """Carry out a write of 1010 or 1011; SdoAbort when the signature is wrong or the motor has torque."""
        if signature != (SAVE if index == 0x1010 else LOAD):
            raise SdoAbort(CANNOT_STORE)
        if power_state in (
            PowerState.OPERATION_ENABLED,
            PowerState.QUICK_STOP_ACTIVE,
            PowerState.FAULT_REACTION_ACTIVE,
        ):
            raise SdoAbort(DEVICE_STATE)
        saved = dict(self._saved)
        for key in self._keys:
            if sub == 1 or (sub == 2) == (key[0] < 0x2000):
                saved.pop(key, None)
                if index == 0x1010:
                    saved[key] = self._present(key)
        self._write_file(saved)
        self._saved = saved
        for key, value in self._factory.items():
            self._objects.set_default(*key, saved.get(key, value))

    def _present(self, key: tuple[int, int]) -> int | bytes:
        if isinstance(self._factory[key], bytes):
            return self._objects.read(*key)
        return self._objects.value(*key)

    def _write_file(self, saved: dict[tuple[int, int], int | bytes]) -> None:
        if self._path is None:
            return
        texts = {
            f"{index:04X}:{sub:X}": value.decode("utf-8", "replace") if isinstance(value, bytes) else value
            for (index, sub), value in saved.items()
        }
        new = self._path.with_name(self._path.name + ".new")
        try:
            new.write_text(json.dumps(texts, indent=1) + "\n", encoding="utf-8")
            os.replace(new, self._path)
        except OSError:
            raise SdoAbort(HARDWARE) from None
