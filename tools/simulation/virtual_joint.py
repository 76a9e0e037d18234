"""The virtual joint of a configuration: bus, drive and plant, in this process (`jointctl hil`) or in one of its own."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from jointctl.drivers.can.open import CYCLIC_INTERFACES, open_cyclic_end, open_python_can
from jointctl.drivers.errors import BusError, ConfigurationError
from jointctl.hil.bus.virtual_bus import VirtualBusError, VirtualBusHub, default_socket_path
from jointctl.hil.canopen.device import Cia402Device
from jointctl.hil.plant.joint import plant
from jointctl.hil.realtime_device import RealtimeDevice
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.plant_settings import device_settings, fault_constants, plant_settings
from jointctl.tools.simulation.device_pump import PumpedDevice
from jointctl.tools.simulation.starting import Starting

_POLL_S = 0.1


def new_device(config: Config) -> Cia402Device:
    """The drive with its plant, as the configuration says that the joint truly is."""
    constants, state = plant(**plant_settings(config))
    try:
        return Cia402Device(config.eds_path, device_settings(config), constants, state, fault_constants(config))
    except ValueError as error:  # what the EDS file must hold for a virtual drive
        raise ConfigurationError(f"drive.eds (={config.canopen.eds}) does not make a virtual drive: {error}") from None


@contextmanager
def serve_virtual_joint(config: Config, timing: bool = False) -> Iterator[RealtimeDevice | PumpedDevice]:
    """Drive in threads of this process; the bus as well if it is the virtual one, all others exist already."""
    device = new_device(config)
    if config.bus.interface in CYCLIC_INTERFACES:
        RealtimeDevice(device, -1).compile()  # a bus that can be found has a drive that answers
    with ExitStack() as stack:
        if config.bus.interface == "jointctl":
            path = default_socket_path(config.bus.channel)
            try:
                stack.enter_context(VirtualBusHub(path, config.bus.bitrate_bitps, timing))
            except VirtualBusError as error:
                raise BusError(str(error)) from None
        if config.bus.interface not in CYCLIC_INTERFACES:
            if len(device.faults):
                raise ConfigurationError(
                    f"bus.interface (={config.bus.interface}) must be one of {', '.join(CYCLIC_INTERFACES)} "
                    "for [[virtual.faults]]"
                )
            bus = open_python_can(config.bus.interface, config.bus.channel, config.bus.bitrate_bitps)
            stack.callback(bus.shutdown)
            yield stack.enter_context(PumpedDevice(device, bus))
            return
        end = stack.enter_context(open_cyclic_end(config.bus.interface, config.bus.channel))
        yield stack.enter_context(RealtimeDevice(device, end.fileno()))


@contextmanager
def separate_virtual_joint(
    config_path: Path, channel: str, tell: Callable[[str], None] = lambda _: None
) -> Iterator[subprocess.Popen[bytes]]:
    """`jointctl hil` as a process of its own on a bus of the given name; ended when the block is left.

    `tell` gets a line now and then while it compiles.  Raises `BusError` if it ends, or hangs, before it is ready.
    """
    read_end, write_end = os.pipe()
    command = [sys.executable, "-P", "-m", "jointctl.tools.cli", "hil", str(config_path), "--interface", "jointctl"]
    command += ["--channel", channel, "--ready-fd", str(write_end), "--quiet"]
    process = subprocess.Popen(command, pass_fds=(write_end,), stdin=subprocess.DEVNULL, start_new_session=True)
    os.close(write_end)
    try:
        starting = Starting("the virtual joint", process, tell, BusError)
        while not select.select([read_end], [], [], _POLL_S)[0]:
            starting.check()
        if os.read(read_end, 1) != b"+":  # its end of the pipe has gone, and so will it
            process.wait()
            starting.check()
        yield process
    finally:
        os.close(read_end)
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
