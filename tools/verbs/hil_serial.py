"""`jointctl hil --serial CONFIG`: keep the virtual joint up behind a virtual Elmo drive on a pseudo-terminal."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager

from drivers.errors import ConfigurationError
from hil.elmo.device import ElmoDevice
from hil.elmo.interpreter import ElmoInterpreter
from hil.plant.joint import plant
from tools.configuration.config import Config
from tools.configuration.elmo_settings import elmo_device_settings, elmo_section
from tools.configuration.plant_settings import plant_settings
from tools.output import Output
from tools.running.stop_signals import stop_signals
from tools.verbs.hil import make_realtime, wait_for_end


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
            with contextlib.suppress(FileNotFoundError):
                os.unlink(link)
            os.symlink(device.path, link)
        try:
            yield device
        finally:
            if link is not None:
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(link)


def refuse_options(config: Config, *, port: str | None, timing: bool) -> None:
    """`ConfigurationError` for a CANopen drive, and for options that mean nothing on a pseudo-terminal."""
    elmo_section(config)
    if port is not None:
        raise ConfigurationError(
            f"--port (={port}) must be absent for hil: the system names its port",
            "--link PATH makes a name of yours for it",
        )
    if timing:
        raise ConfigurationError("--timing is for a CAN bus: a serial line always takes the time of its baud rate")


def hil_serial(config: Config, output: Output, *, link: str | None = None, ready_fd: int | None = None) -> int:
    """Serve until a stop signal; prints the port on stdout.  `ready_fd` as in `tools.verbs.hil.hil`."""
    with stop_signals() as signals, serve_virtual_elmo(config, link) as device:
        make_realtime(config, output)
        path = link or device.path
        output.result(path, {"port": path, "baud_rate_bitps": device.baud_rate_bitps})
        output.note(f"virtual drive: {path} at {device.baud_rate_bitps} baud; Ctrl-C ends it")
        wait_for_end(signals, ready_fd)
    return 0
