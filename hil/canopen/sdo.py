"""The SDO server of the virtual drive: expedited, segmented and block transfer (CiA 301, 7.2.4)."""

from __future__ import annotations

import binascii
import struct
from collections.abc import Callable

from jointctl.hil.canopen.dictionary import (
    BLOCK_SIZE,
    CRC_ERROR,
    LENGTH_MISMATCH,
    SEQUENCE_NUMBER,
    TIMED_OUT,
    TOGGLE_ERROR,
    TOO_LONG,
    UNKNOWN_COMMAND,
    ObjectDictionary,
    SdoAbort,
)

# --- SDO block transfer of the virtual drive, server side (CiA 301, 7.2.4.3.9 to 7.2.4.3.15); no I/O, no clock ---
# A block is up to 127 segments of 7 bytes without an answer between them; the receiver then names the last segment
# that it got in sequence and the sender repeats from there.  A CRC over all data (polynomial x^16 + x^12 + x^5 + 1,
# start 0) is used when the client offers it (some clients expect it as soon as the server says that it could).
#
# Each transfer is an object: `begin` gives the answer to the initiate request, `handle` the answers to every further
# frame, `finished` turns True with the last one; SdoAbort ends it.


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


# --- SDO server of the virtual drive (CiA 301, 7.2.4): request data in, response data out, no I/O ---
# Expedited, segmented and block transfers; one transfer at a time; a new initiate request replaces an
# unfinished one, except inside a block download, where every frame is a segment.  A transfer on which the client
# falls silent is aborted with 0504 0000: the user tells the time with `handle` and asks `expire`.


TIMEOUT_NS = 1_000_000_000  # longest pause of a client inside a transfer
_LONGEST_STRING = 256


def _initiates(command: int) -> bool:
    """True for the first frame of a transfer."""
    kind = command >> 5
    return kind in (1, 2) or (kind == 5 and not command & 0x03) or (kind == 6 and not command & 0x01)


class SdoServer:
    """`write` carries out a complete download (and raises SdoAbort); reading goes straight to the dictionary.

    `block_size` is the number of segments of a block that a client may send without an answer.
    """

    def __init__(
        self, objects: ObjectDictionary, write: Callable[[int, int, bytes], None], block_size: int = LARGEST_BLOCK
    ) -> None:
        self._objects = objects
        self._write = write
        self._block_size = block_size
        self._heard_ns = 0
        self._forget()

    def _forget(self) -> None:
        self._target = (0, 0)
        self._upload: bytes | None = None
        self._download: bytearray | None = None
        self._block: BlockDownload | BlockUpload | None = None
        self._announced: int | None = None
        self._toggle = 0

    @property
    def busy(self) -> bool:
        """True while a transfer waits for its client's next frame."""
        return self._upload is not None or self._download is not None or self._block is not None

    def expire(self, now_ns: int) -> list[bytes]:
        """The abort of a transfer whose client has been silent too long, if there is one."""
        if not self.busy or now_ns - self._heard_ns < TIMEOUT_NS:
            return []
        return self._abort(*self._target, TIMED_OUT)

    def _abort(self, index: int, sub: int, code: int) -> list[bytes]:
        self._forget()
        return [struct.pack("<BHBI", 0x80, index, sub, code)]

    def handle(self, request: bytes, now_ns: int = 0) -> list[bytes]:
        """The 8-byte responses to the data of one request frame; a frame of another length is ignored."""
        if len(request) != 8:
            return []
        self._heard_ns = now_ns
        if request[0] == 0x80:
            self._forget()
            return []
        command = request[0] >> 5
        if isinstance(self._block, BlockUpload) and _initiates(request[0]):
            self._forget()
        index, sub = struct.unpack_from("<HB", request, 1)
        if command in (0, 3) or self._block is not None:
            index, sub = self._target
        try:
            if self._block is not None:
                return self._block_frame(request)
            if command == 0:
                return [self._download_segment(request)]
            if command == 3:
                return [self._upload_segment(request)]
            self._forget()
            self._target = (index, sub)
            if command == 1:
                return [self._initiate_download(request)]
            if command == 2:
                return [self._initiate_upload()]
            if not _initiates(request[0]):
                raise SdoAbort(UNKNOWN_COMMAND)
            if command == 5:
                return self._initiate_block_upload(request)
            return self._initiate_block_download(request)
        except SdoAbort as abort:
            return self._abort(index, sub, abort.code)

    def _block_frame(self, request: bytes) -> list[bytes]:
        assert self._block is not None
        responses = self._block.handle(request)
        if self._block.finished:
            self._forget()
        return responses

    def _initiate_block_upload(self, request: bytes) -> list[bytes]:
        index, sub = self._target
        data = self._objects.read(index, sub)
        block = BlockUpload(index, sub, data)
        responses = block.begin(request)
        if len(data) <= request[5]:  # not above the client's protocol switch threshold
            return [self._initiate_upload()]
        self._block = block
        return responses

    def _initiate_block_download(self, request: bytes) -> list[bytes]:
        index, sub = self._target
        block = BlockDownload(
            index, sub, self._longest(index, sub), lambda data: self._write(index, sub, data), self._block_size
        )
        responses = block.begin(request)
        self._block = block
        return responses

    def _longest(self, index: int, sub: int) -> int:
        """Bytes that a download may have, or the abort of an object that is not writable."""
        entry = self._objects.entry(index, sub)
        if not entry.writable:
            self._objects.check(index, sub, b"")
        return entry.size or _LONGEST_STRING

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
            longest = self._longest(index, sub)
            self._announced = struct.unpack_from("<I", request, 4)[0] if sized else None
            if self._announced is not None and self._announced > longest:
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
