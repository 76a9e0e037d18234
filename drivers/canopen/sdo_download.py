"""Writing an object over SDO so that nothing follows once the transfer has failed.

The canopen library's `SdoClient.download` leaves its stream open when a segmented transfer (more than 4 bytes, or none:
CiA 301, 7.2.4.3.3) is refused at its beginning or not answered.  Whenever that stream is collected, its destructor
sends one more segment, which belongs to no transfer and may fall into another one, waits for the answer, and fails;
since Python 3.13 that failure is printed with its traceback.  Refused later, the same segment is sent again, and the
abort code of that hides the reason.  Here the stream of a failed transfer ends without a word.
"""

from __future__ import annotations

import io
from typing import Any

from canopen.sdo.client import SdoClient, WritableStream


class _DownloadStream(WritableStream):
    """The library's stream; `_begun`: the server takes part in a transfer, whose last segment `close` may send."""

    _begun = False

    def __init__(self, client: SdoClient, index: int, sub: int, size: int) -> None:
        super().__init__(client, index, sub, size)  # type: ignore[no-untyped-call]
        self._begun = True

    def write(self, data: Any) -> int:
        """Send the next segment, or all of an expedited transfer; how many bytes were taken."""
        self._begun = False
        taken = int(super().write(data))  # type: ignore[no-untyped-call]
        self._begun = True
        return taken

    def close(self) -> None:
        """End the transfer where there is one."""
        if self._begun:
            super().close()  # type: ignore[no-untyped-call]
        else:
            io.RawIOBase.close(self)


def download(client: SdoClient, index: int, sub: int, data: bytes) -> None:
    """Write `data` to an object: expedited up to 4 bytes, else in segments.

    Raises `SdoAbortedError` if the server refuses, `SdoCommunicationError` if it does not answer, as the library does.
    """
    with _DownloadStream(client, index, sub, len(data)) as stream:
        rest = memoryview(data)
        while rest:
            rest = rest[stream.write(rest) :]
