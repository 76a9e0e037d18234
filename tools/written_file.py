"""Files that a command writes: refused before the work begins, and put in place in one step or not at all."""

from __future__ import annotations

import os
import re
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from jointctl.drivers.errors import DataError


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """An `OSError` inside the `with` becomes the `DataError` that `path` cannot be written."""
    try:
        yield
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {error.strerror or error}") from None


_LONGEST_STEM = 50  # letters, of up to four bytes each; a file system takes 255 bytes


def file_stems(names: Sequence[str], taken: Iterable[str] = ()) -> list[str]:
    """Of files named after these, all different, whatever the file system thinks of capitals."""
    found: list[str] = []
    for name in names:
        first = stem = re.sub(r"[^\w.-]+", "_", name)[:_LONGEST_STEM].strip(".") or "joint"
        number = 1
        while stem.lower() in {*taken, *map(str.lower, found)}:
            number += 1
            stem = f"{first[: _LONGEST_STEM - len(str(number)) - 1]}_{number}"
        found.append(stem)
    return found


def with_ending(path: Path, ending: str) -> Path:
    """Of the same name with another ending; `DataError` for a path without a name, such as . and /."""
    if not path.name:
        raise DataError(f"{path}: is a folder, not a file")
    return path.with_suffix(ending)


def refuse_overwriting(path: Path, inputs: Iterable[Path]) -> None:
    """`DataError` if `path` is one of the files that the command reads; ask before the work is done."""
    if path.resolve() in {other.resolve() for other in inputs}:
        raise DataError(f"{path}: is an input of this command and would be overwritten", "choose another name")


def refuse_special(path: Path) -> None:
    """`DataError` where there is something that is no file: a new file in its place would take its name away."""
    with writing(path):
        try:
            mode = os.stat(path).st_mode
        except FileNotFoundError:
            return
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):  # a folder is refused by what writes
            raise DataError(f"{path}: is a device, a FIFO or a socket, and only files are written")


def refuse_read_only(path: Path) -> None:
    """`DataError` for a file whose mode protects it: in a folder of ours a new one could take its place."""
    if path.exists() and not os.access(path, os.W_OK):
        raise DataError(f"{path}: cannot be written: no permission")


def refuse_unwritable(path: Path) -> None:
    """As `refuse_special` and `refuse_read_only`; `DataError` too where its folder takes no file (missing: is made)."""
    refuse_special(path)
    refuse_read_only(path)
    folder = next(parent for parent in path.absolute().parents if os.path.isdir(parent))
    if not os.access(folder, os.W_OK | os.X_OK):
        raise DataError(f"{path}: cannot be written: no permission in {folder}")


def require_target(path: Path, inputs: Iterable[Path] = ()) -> None:
    """As `refuse_overwriting` and `refuse_unwritable`; `DataError` too if its folder is not there."""
    refuse_overwriting(path, inputs)
    refuse_unwritable(path)
    if not os.path.isdir(path.parent):
        raise DataError(f"{path}: cannot be written: no folder {path.parent}")


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
    refuse_unwritable(file)
    prepare_folder(file.parent)
    if os.path.isdir(file):
        raise DataError(f"{file}: is a folder, not a file to write")


def replace_file(path: Path, content: bytes, check: Callable[[Path], object] | None = None) -> None:
    """Write a new file beside `path`, let `check` read it, then put it in place in one step.

    `DataError` if it cannot be written: then `path` is as it was, and nothing is beside it.
    """
    refuse_special(path)
    refuse_read_only(path)
    with writing(path):
        target = path.resolve()
        prefix = f".{target.stem[:_LONGEST_STEM]}."
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=target.suffix, dir=target.parent)
    temporary = Path(name)
    try:
        with writing(path):
            with os.fdopen(handle, "wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            if check is not None:
                check(temporary)
            if target.exists():
                shutil.copymode(target, temporary)
            else:
                mask = os.umask(0)
                os.umask(mask)
                temporary.chmod(0o666 & ~mask)
            os.replace(temporary, target)
    finally:
        with suppress(FileNotFoundError):
            temporary.unlink()
