"""The folder of a file to write, made and tried before the work that fills it."""

from __future__ import annotations

import os
from pathlib import Path

from drivers.errors import DataError


def prepare_folder(folder: Path) -> None:
    """Make it where it is not there; `DataError` if nothing could be written into it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder}: cannot be made: {error.strerror or error}") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise DataError(f"{folder}: cannot be written: no permission")


def prepare_target(file: Path | None) -> None:
    """As `prepare_folder` for the folder of a file; `DataError` if the name is that of a folder.  None: nothing."""
    if file is None:
        return
    prepare_folder(file.parent)
    if file.is_dir():
        raise DataError(f"{file}: is a folder, not a file to write")
