"""A serial drive to look at: identified, nothing written, the line released at the end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from jointctl.drivers.drive import DriveIdentity
from jointctl.drivers.elmo.drive import ElmoDrive
from jointctl.drivers.errors import BusError
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import torque_constant_NmpA
from jointctl.tools.configuration.elmo_settings import elmo_section, elmo_settings
from jointctl.tools.session.line_guard import running_supervisor


@contextmanager
def inspected_drive(config: Config) -> Iterator[tuple[ElmoDrive, DriveIdentity]]:
    """The drive, and who it says it is.  `BusError` while another program has the line, a run of ours by name."""
    port = elmo_section(config).port
    pid = running_supervisor(port)
    if pid is not None:
        raise BusError(
            f"a run has {port} (pid {pid}), and a serial line has one user at a time",
            "its live values: `jointctl run --scope`; its log has every cycle",
        )
    drive = ElmoDrive(elmo_settings(config, torque_constant_NmpA(config)))
    try:
        yield drive, drive.identify()
    finally:
        drive.close()
