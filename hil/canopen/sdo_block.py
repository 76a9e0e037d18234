"""SDO block transfer of the virtual drive, server side (CiA 301, 7.2.4.3.9 to 7.2.4.3.15); no I/O, no clock.

A block is up to 127 segments of 7 bytes without an answer between them; the receiver then names the last segment that
it got in sequence and the sender repeats from there.  A CRC over all data (polynomial x^16 + x^12 + x^5 + 1, start 0)
is used when the client offers it (some clients expect it as soon as the server says that it could).

Each transfer is an object: `begin` gives the answer to the initiate request, `handle` the answers to every further
frame, `finished` turns True with the last one; SdoAbort ends it.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Callable

from jointctl.hil.canopen.object_dictionary import (
    BLOCK_SIZE,
    CRC_ERROR,
    LENGTH_MISMATCH,
    SEQUENCE_NUMBER,
    TOO_LONG,
    UNKNOWN_COMMAND,
    SdoAbort,
)

LARGEST_BLOCK = 127
_SEGMENT = 7
_LAST = 0x80
_CRC = 0x04


class BlockDownload:
    """Client to server.  `store` gets the complete data; `limit` is the longest data that is accepted [bytes]."""

    def __init__(self, index: int, sub: int, limit: int, store: Callable[[bytes], None], block_size: int) -> None:
        self.finished = False
        self._index, self._sub = index, sub
        self._limit = limit
        self._store = store
        self._block_size = block_size
        self._announced: int | None = None
        self._crc = False
        self._expected = 1
        self._ending = False
        self._data = bytearray()

    def begin(self, request: bytes) -> list[bytes]:
        if request[0] & 0x01:
            raise SdoAbort(UNKNOWN_COMMAND)
        self._crc = bool(request[0] & _CRC)
        if request[0] & 0x02:
            self._announced = struct.unpack_from("<I", request, 4)[0]
            if self._announced > self._limit:
                raise SdoAbort(TOO_LONG)
        return [struct.pack("<BHBB3x", 0xA0 | (_CRC if self._crc else 0), self._index, self._sub, self._block_size)]

    def handle(self, request: bytes) -> list[bytes]:
        return self._end(request) if self._ending else self._segment(request)

    def _segment(self, request: bytes) -> list[bytes]:
        number, last = request[0] & 0x7F, bool(request[0] & _LAST)
        if not 1 <= number <= self._block_size:
            raise SdoAbort(SEQUENCE_NUMBER)
        taken = number == self._expected
        if taken:
            self._expected += 1
            self._data += request[1:]
            if len(self._data) - (_SEGMENT - 1 if last else 0) > self._limit:
                raise SdoAbort(TOO_LONG)
        if not last and number != self._block_size:
            return []
        got, self._expected = self._expected - 1, 1
        self._ending = last and taken
        return [struct.pack("<BBB5x", 0xA2, got, self._block_size)]

    def _end(self, request: bytes) -> list[bytes]:
        if request[0] & 0xE3 != 0xC1:
            raise SdoAbort(UNKNOWN_COMMAND)
        data = bytes(self._data[: len(self._data) - (request[0] >> 2 & 0x07)])
        if self._crc and struct.unpack_from("<H", request, 1)[0] != binascii.crc_hqx(data, 0):
            raise SdoAbort(CRC_ERROR)
        if len(data) > self._limit:
            raise SdoAbort(TOO_LONG)
        if self._announced is not None and self._announced != len(data):
            raise SdoAbort(LENGTH_MISMATCH)
        self._store(data)
        self.finished = True
        return [struct.pack("<B7x", 0xA1)]


class BlockUpload:
    """Server to client."""

    def __init__(self, index: int, sub: int, data: bytes) -> None:
        self.finished = False
        self._index, self._sub = index, sub
        self._data = data
        self._segments = [data[i : i + _SEGMENT] for i in range(0, len(data), _SEGMENT)] or [b""]
        self._crc = False
        self._block_size = 0
        self._confirmed = 0  # segments that the client has
        self._sent = 0  # of the present block
        self._started = self._ending = False

    def _take_block_size(self, block_size: int) -> None:
        if not 1 <= block_size <= LARGEST_BLOCK:
            raise SdoAbort(BLOCK_SIZE)
        self._block_size = block_size

    def begin(self, request: bytes) -> list[bytes]:
        if request[0] & 0x03:
            raise SdoAbort(UNKNOWN_COMMAND)
        self._crc = bool(request[0] & _CRC)
        self._take_block_size(request[4])
        return [struct.pack("<BHBI", 0xC2 | (_CRC if self._crc else 0), self._index, self._sub, len(self._data))]

    def handle(self, request: bytes) -> list[bytes]:
        command = request[0] & 0xE3
        if not self._started and command == 0xA3:
            self._started = True
            return self._block()
        if self._started and not self._ending and command == 0xA2:
            return self._acknowledged(request[1], request[2])
        if self._ending and command == 0xA1:
            self.finished = True
            return []
        raise SdoAbort(UNKNOWN_COMMAND)

    def _acknowledged(self, number: int, block_size: int) -> list[bytes]:
        if number > self._sent:
            raise SdoAbort(SEQUENCE_NUMBER)
        self._confirmed += number
        self._take_block_size(block_size)
        if self._confirmed < len(self._segments):
            return self._block()
        self._ending = True
        unused = _SEGMENT - len(self._segments[-1])
        crc = binascii.crc_hqx(self._data, 0) if self._crc else 0
        return [struct.pack("<BH5x", 0xC1 | unused << 2, crc)]

    def _block(self) -> list[bytes]:
        part = self._segments[self._confirmed : self._confirmed + self._block_size]
        self._sent = len(part)
        ends = self._confirmed + self._sent == len(self._segments)
        return [
            struct.pack("<B7s", number | (_LAST if ends and number == self._sent else 0), segment)
            for number, segment in enumerate(part, 1)
        ]
