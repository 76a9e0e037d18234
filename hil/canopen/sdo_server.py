"""SDO server of the virtual drive (CiA 301, 7.2.4): request data in, response data out, no I/O.

Expedited, segmented and block transfers (`sdo_block`); one transfer at a time; a new initiate request replaces an
unfinished one, except inside a block download, where every frame is a segment.  A transfer on which the client falls
silent is aborted with 0504 0000: the user tells the time with `handle` and asks `expire`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from jointctl.hil.canopen.object_dictionary import (
    LENGTH_MISMATCH,
    TIMED_OUT,
    TOGGLE_ERROR,
    TOO_LONG,
    UNKNOWN_COMMAND,
    ObjectDictionary,
    SdoAbort,
)
from jointctl.hil.canopen.sdo_block import LARGEST_BLOCK, BlockDownload, BlockUpload

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
        self,
        objects: ObjectDictionary,
        write: Callable[[int, int, bytes], None],
        block_size: int = LARGEST_BLOCK,
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
