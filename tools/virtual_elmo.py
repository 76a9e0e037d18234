"""The virtual joint behind a virtual Elmo drive on a pseudo-terminal, as a configuration describes both."""

from __future__ import annotations

import contextlib
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager

from jointctl.drivers.errors import DataError
from jointctl.hil.elmo_drive import ElmoDeviceSettings, ElmoInterpreter
from jointctl.hil.elmo_line import ElmoDevice
from jointctl.hil.plant import plant
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo import elmo_section
from jointctl.tools.configuration.plant_settings import plant_settings


def elmo_device_settings(config: Config) -> ElmoDeviceSettings:
    """The virtual drive that the configuration describes."""
    drive = elmo_section(config)
    return ElmoDeviceSettings(
        maximum_current_A=max(20.0, drive.peak_current_A),
        counts_per_turn=config.encoder.counts_per_turn,
        current_sign=drive.torque_direction * config.encoder.direction,
    )


def new_elmo_device(config: Config) -> ElmoDevice:
    """The drive with its plant, as the configuration says that the joint truly is; its port is open, nobody serves."""
    constants, state = plant(**plant_settings(config))
    interpreter = ElmoInterpreter(elmo_device_settings(config), constants, state)
    return ElmoDevice(interpreter, elmo_section(config).baud_rate_bitps)


@contextmanager
def serve_virtual_elmo(config: Config, link: str | None = None) -> Iterator[ElmoDevice]:
    """Drive and plant in a thread of this process; `link` is a path that shall point to the port."""
    with new_elmo_device(config) as device:
        if link is not None:
            _make_link(link, device.path)
        try:
            yield device
        finally:
            # by now it may be that of another program
            if link is not None and _target(link) == device.path:
                with contextlib.suppress(OSError):
                    os.unlink(link)


def _target(link: str) -> str:
    """Where a link points; empty if there is none."""
    try:
        return os.readlink(link)
    except OSError:
        return ""


def _make_link(link: str, port: str) -> None:
    """`DataError` where anything but the link of an earlier `hil` of this user has the name: it is left alone."""
    try:
        with contextlib.suppress(FileNotFoundError):
            _require_own_link(link)
            os.unlink(link)
        os.symlink(port, link)  # never follows or replaces anything
    except (OSError, ValueError) as error:  # ValueError: a zero in its name
        raise DataError(f"--link (={link}): cannot be made: {getattr(error, 'strerror', None) or error}") from None


def _require_own_link(link: str) -> None:
    """A link to a pseudo-terminal, which ended with its `hil` or belongs to this user."""
    hint = "give a name that is free, or remove what is there by hand"
    found = os.lstat(link)
    kind = next((words for is_it, words in _KINDS if is_it(found.st_mode)), "a file")
    if not stat.S_ISLNK(found.st_mode):
        raise DataError(f"--link (={link}): is {kind}, and only the link of an earlier hil is replaced", hint)
    target = os.readlink(link)
    if found.st_uid != os.getuid() or not _PORT.fullmatch(target):
        raise DataError(f"--link (={link}): is a link to {target} which no hil of yours has made: left as it is", hint)
    with contextlib.suppress(FileNotFoundError):
        if os.stat(target).st_uid != os.getuid():
            raise DataError(f"--link (={link}): is a link to {target}, the terminal of another user", hint)


_PORT = re.compile(r"/dev/pts/[0-9]+")
_KINDS = (
    (stat.S_ISREG, "a regular file"),
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISSOCK, "a socket"),
)
