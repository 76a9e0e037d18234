"""SDO server of the virtual drive (CiA 301, 7.2.4): request data in, response data out, no I/O.

Expedited and segmented transfers; one transfer at a time; a new initiate request replaces an unfinished one.
Not modelled: block transfer (aborted with 0504 0001) and the server's own time-out.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from hil.object_dictionary import LENGTH_MISMATCH, TOO_LONG, ObjectDictionary, SdoAbort

UNKNOWN_COMMAND = 0x05040001
TOGGLE_ERROR = 0x05030000
_LONGEST_STRING = 256


class SdoServer:
    """`write` carries out a complete download (and raises SdoAbort); reading goes straight to the dictionary."""

    def __init__(self, objects: ObjectDictionary, write: Callable[[int, int, bytes], None]) -> None:
        self._objects = objects
        self._write = write
        self._forget()

    def _forget(self) -> None:
        self._target = (0, 0)
        self._upload: bytes | None = None
        self._download: bytearray | None = None
        self._announced: int | None = None
        self._toggle = 0

    def handle(self, request: bytes) -> list[bytes]:
        """The 8-byte responses (none or one) to the data of one request frame; a frame of another length is ignored."""
        if len(request) != 8:
            return []
        command = request[0] >> 5
        index, sub = struct.unpack_from("<HB", request, 1)
        if command in (0, 3):
            index, sub = self._target
        try:
            if command == 0:
                return [self._download_segment(request)]
            if command == 1:
                self._forget()
                self._target = (index, sub)
                return [self._initiate_download(request)]
            if command == 2:
                self._forget()
                self._target = (index, sub)
                return [self._initiate_upload()]
            if command == 3:
                return [self._upload_segment(request)]
            if command == 4:
                self._forget()
                return []
            raise SdoAbort(UNKNOWN_COMMAND)
        except SdoAbort as abort:
            self._forget()
            return [struct.pack("<BHBI", 0x80, index, sub, abort.code)]

    def _initiate_upload(self) -> bytes:
        index, sub = self._target
        data = self._objects.read(index, sub)
        if 0 < len(data) <= 4:
            return struct.pack("<BHB4s", 0x43 | (4 - len(data)) << 2, index, sub, data)
        self._upload = data
        return struct.pack("<BHBI", 0x41, index, sub, len(data))

    def _upload_segment(self, request: bytes) -> bytes:
        if self._upload is None:
            raise SdoAbort(UNKNOWN_COMMAND)
        self._check_toggle(request)
        part, self._upload = self._upload[:7], self._upload[7:]
        last = not self._upload
        answer = struct.pack("<B7s", self._toggle | (7 - len(part)) << 1 | last, part)
        self._toggle ^= 0x10
        if last:
            self._forget()
        return answer

    def _initiate_download(self, request: bytes) -> bytes:
        index, sub = self._target
        expedited, sized = request[0] & 0x02, request[0] & 0x01
        entry = self._objects.entry(index, sub)
        if expedited:
            length = 4 - (request[0] >> 2 & 0x03) if sized else entry.size or 4
            self._write(index, sub, request[4 : 4 + length])
        else:
            if not entry.writable:
                self._objects.check(index, sub, b"")
            self._announced = struct.unpack_from("<I", request, 4)[0] if sized else None
            if self._announced is not None and self._announced > (entry.size or _LONGEST_STRING):
                raise SdoAbort(TOO_LONG)
            self._download = bytearray()
        return struct.pack("<BHB4x", 0x60, index, sub)

    def _download_segment(self, request: bytes) -> bytes:
        if self._download is None:
            raise SdoAbort(UNKNOWN_COMMAND)
        self._check_toggle(request)
        self._download += request[1 : 8 - (request[0] >> 1 & 0x07)]
        if len(self._download) > _LONGEST_STRING:
            raise SdoAbort(TOO_LONG)
        answer = struct.pack("<B7x", 0x20 | self._toggle)
        self._toggle ^= 0x10
        if request[0] & 0x01:
            data = bytes(self._download)
            if self._announced is not None and self._announced != len(data):
                raise SdoAbort(LENGTH_MISMATCH)
            self._write(*self._target, data)
            self._forget()
        return answer

    def _check_toggle(self, request: bytes) -> None:
        if request[0] & 0x10 != self._toggle:
            raise SdoAbort(TOGGLE_ERROR)
