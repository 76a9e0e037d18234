"""The index of a log's chunks while the log is written: in a file without a name, not in memory.

MCAP's index stands at the end of the file.  Its library keeps 0.56 kB for each chunk until then, and a log that is
flushed twice a second has 7200 chunks an hour.
"""

from __future__ import annotations

import errno
import os
import struct
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from itertools import chain, islice
from pathlib import Path
from typing import IO, Any

from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.records import ChunkIndex
from mcap.stream_reader import StreamReader

IN_MEMORY = 64  # chunks: half a minute of a run
_LIBRARY_S_LIST = "_Writer__chunk_indices"  # private in mcap.writer.Writer, which knows no other way


class ChunkIndexes:
    """Takes the `ChunkIndex` of each chunk and gives them back in order.  The file is gone when this is closed.

    A disk that takes no file costs memory, no error: the log on it is about to tell.
    """

    def __init__(self, folder: Path, in_memory: int = IN_MEMORY) -> None:
        self._folder, self._in_memory = folder, in_memory
        self._newest: list[Any] = []
        self._file: IO[bytes] | None = None
        self._put_away, self._end = 0, 0  # how many, how many bytes

    def append(self, index: ChunkIndex) -> None:
        """Keep `index`."""
        self._newest.append(index)
        if len(self._newest) >= self._in_memory:
            with suppress(OSError):
                self._put_newest_away()

    def _put_newest_away(self) -> None:
        if self._file is None:
            self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115 closed in close()
        builder: Any = RecordBuilder()  # some of the library's methods carry no types
        for index in self._newest:
            index.write(builder)
        data = builder.end()
        if os.pwrite(self._file.fileno(), data, self._end) == len(data):
            self._end += len(data)
            self._put_away += len(self._newest)
            self._newest.clear()

    def in_memory(self) -> int:
        """How many of them are in memory now."""
        return len(self._newest)

    def __len__(self) -> int:
        return self._put_away + len(self._newest)

    def __iter__(self) -> Iterator[Any]:
        data = os.pread(self._file.fileno(), self._end, 0) if self._file is not None else b""
        return chain(islice(StreamReader(BytesIO(data), skip_magic=True).records, self._put_away), self._newest)

    def close(self) -> None:
        """Let go of the file; nobody needs it any more, so nothing that goes wrong matters."""
        if self._file is not None:
            with suppress(OSError):
                self._file.close()

    def take_the_place_in(self, writer: object) -> bool:
        """Let `writer`, an MCAP writer that has no chunk yet, keep its index here.

        False where the library does not keep it in that list (another version): then it stays in the library's memory.
        """
        if getattr(writer, _LIBRARY_S_LIST, None) != []:
            return False
        setattr(writer, _LIBRARY_S_LIST, self)
        return True

    def give_back_to(self, writer: object) -> None:
        """A list of all of them for the end of the file, which is what the library expects; `OSError` if unreadable."""
        if getattr(writer, _LIBRARY_S_LIST, None) is not self:
            return
        try:
            indexes = list(self)
        except (McapError, struct.error, ValueError) as error:
            raise OSError(errno.EIO, f"the index of its chunks cannot be read back ({error})") from None
        setattr(writer, _LIBRARY_S_LIST, indexes)
