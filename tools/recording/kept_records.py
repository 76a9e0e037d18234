"""Records of a long run that are held: all of them for summary and picture, decimated ones for the log."""

from __future__ import annotations

import tempfile
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of

# an hour at 1 kHz is 1.2 GB; the supervisor's memory must not grow with the run
IN_MEMORY = 60_000  # records: 20 MB


class KeptRecords:
    """Takes arrays of LogRecord in order of time, gives them back as one.  The file is gone when this is closed."""

    def __init__(self, folder: Path, in_memory: int = IN_MEMORY) -> None:
        self._folder, self._in_memory = folder, in_memory
        self._parts: list[Any] = []
        self._count = 0
        self._file: IO[bytes] | None = None

    def __len__(self) -> int:
        return self._count

    def append(self, records: np.ndarray) -> None:
        """Keep `records` (array of LogRecord, shape (N,)); `OSError` if the disk is full."""
        self._count += len(records)
        self._parts.append(records)
        if self._file is None and self._count <= self._in_memory:
            return
        if self._file is None:
            self._file = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115 closed in close()
        for part in self._parts:
            self._file.write(np.ascontiguousarray(part).tobytes())
        self._parts.clear()

    def records(self) -> Any:
        """All of them: record array of LogRecord, shape (N,); of a long run a view of the file, read-only."""
        if self._file is None:
            kept = np.concatenate(self._parts) if self._parts else np.zeros(0, dtype_of(LogRecord))
            return kept.view(np.recarray)
        self._file.flush()
        return np.memmap(self._file, dtype_of(LogRecord), mode="r", shape=(self._count,)).view(np.recarray)

    def close(self) -> None:
        """Let go of the file; arrays that `records` has given stay valid."""
        if self._file is not None:
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, _: TracebackType | None) -> None:
        self.close()


class ThinnedRecords:
    """Holds the last `whole` records back; of what is older it gives every `every`-th one."""

    def __init__(self, every: int, whole: int) -> None:
        self._every, self._whole = every, whole
        self._held: Any = np.zeros(0, dtype_of(LogRecord)).view(np.recarray)
        self._seen = 0  # records that are no longer held

    def take(self, records: np.ndarray) -> Any:
        """New `records` (array of LogRecord, shape (N,)) in order of time; returns those to be written now."""
        held = np.concatenate((self._held, records)).view(np.recarray)
        old = held[: max(0, len(held) - self._whole)]
        self._held = held[len(old) :]
        chosen = old[-self._seen % self._every :: self._every]
        self._seen += len(old)
        return chosen

    def last(self) -> Any:
        """Those held back, all of them; nothing is held afterwards."""
        held, self._held = self._held, self._held[:0]
        self._seen += len(held)
        return held
