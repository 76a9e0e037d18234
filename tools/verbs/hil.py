"""`jointctl hil CONFIG`: keep the virtual joint up, for jointctl or any other CAN tool to attach to."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jointctl.drivers.errors import ConfigurationError, UsageError
from jointctl.tools.child_process import BUS, DRIVE, own_threads
from jointctl.tools.output import Output
from jointctl.tools.scoping.remote_options import NOBODY, ObserveOptions
from jointctl.tools.verbs.verb_options import BusOptions, ConfigPath, ProgressOutput, loaded_joint_or_arm

if TYPE_CHECKING:
    import numpy as np

    from jointctl.tools.configuration.arm import ArmConfig
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.session.control import StopSignals

_POLL_S = 0.05


@dataclass(frozen=True)
class ModelOptions:
    """What the virtual drive and its bus are like."""

    timing: Annotated[bool, typer.Option("--timing", help="model bit times and arbitration")] = False
    eds: Annotated[
        Path | None, typer.Option("--eds", help="EDS of another drive: the virtual one gets its objects and identity")
    ] = None


AS_IT_IS = ModelOptions()
_STATES_S = 0.01  # between two joint states


def hil(
    *,
    config: ConfigPath = Path("virtual"),
    bus: BusOptions,
    serial: Annotated[bool, typer.Option("--serial", help="the virtual serial drive instead of the CAN bus")] = False,
    link: Annotated[str | None, typer.Option("--link", help="serial drive: path of a link to its port")] = None,
    model: ModelOptions = AS_IT_IS,
    ready_fd: Annotated[int | None, typer.Option("--ready-fd", hidden=True)] = None,
    live: ObserveOptions = NOBODY,
    output: ProgressOutput,
) -> int:
    """Keep a virtual joint or arm up, on a virtual bus or a pseudo-terminal, for other programs to attach to."""
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.verbs.bench_drive import ServeOptions, bench_of

    joint = loaded_joint_or_arm(Path("elmo_serial") if serial and config == Path("virtual") else config, bus)
    options = ServeOptions(model.timing, serial, bus.port, link, ready_fd, live)
    if not isinstance(joint, Config):
        if model.eds is not None:
            raise UsageError(f"--eds (={model.eds}) is for a single joint, and {joint.path} is an arm")
        if serial or link is not None:
            raise UsageError(f"--serial and --link are for a single joint, and {joint.path} is an arm on CAN")
        return bench_of(joint.joints[0]).serve_arm(joint, output, options)
    if model.eds is not None:
        joint = with_eds(joint, model.eds)
    return bench_of(joint).serve(joint, output, options)


def with_eds(config: Config, eds: Path) -> Config:
    """The joint whose drive has the objects of that file; an object of the maker's own cannot be looked up in it."""
    from jointctl.tools.configuration.canopen import canopen_section

    if not eds.is_file():
        raise ConfigurationError(f"--eds (={eds}) must name a file")
    drive = canopen_section(config).model_copy(update={"eds": str(eds.resolve()), "temperature_object": None})
    return config.changed(drive=drive)


def serve_can(
    given: Config | ArmConfig,
    output: Output,
    *,
    timing: bool = False,
    ready_fd: int | None = None,
    live: ObserveOptions = NOBODY,
) -> int:
    """Serve until a stop signal; `ready_fd` gets `BUS` and `DRIVE` in time, and its reader's end ends us."""
    from jointctl.hil.realtime_device import ENDED_WORD
    from jointctl.hil.virtual_bus import default_socket_path
    from jointctl.tools.configuration.canopen import canopen_section
    from jointctl.tools.configuration.config import Config, first_on_bus
    from jointctl.tools.session.control import stop_signals
    from jointctl.tools.virtual_joint import serve_virtual_joint

    joints = [given] if isinstance(given, Config) else list(given.joints)
    config = joints[0]
    with (
        stop_signals() as signals,
        serve_virtual_joint(given, timing, None if ready_fd is None else partial(say, ready_fd, BUS)) as joint,
    ):
        make_realtime(config, output)
        buses = first_on_bus(joints)
        parts = []
        for axis in sorted(set(buses)):
            bus = joints[axis].bus
            place = f"{bus.interface}:{bus.channel}"
            if bus.interface == "jointctl":
                place += f" ({default_socket_path(bus.channel)})"
            own = [str(canopen_section(each).node) for each, its in zip(joints, buses, strict=True) if its == axis]
            parts.append(f"{'node' if len(own) == 1 else 'nodes'} {', '.join(own)} on {place}")
        output.note(f"virtual {'joint' if len(joints) == 1 else 'arm'}: {'; '.join(parts)}; Ctrl-C ends it")
        for axis in sorted(set(buses)):
            bus = joints[axis].bus
            if bus.interface == "jointctl":
                output.note(f'attach with python-can: can.Bus(interface="jointctl", channel="{bus.channel}")')
        with watched(given, live, output, joint.plant_states):
            wait_for_end(signals, ready_fd, lambda: bool(joint.words[ENDED_WORD]))
    return 0


@contextlib.contextmanager
def watched(config: Config | ArmConfig, live: ObserveOptions, output: Output, plants: np.recarray) -> Iterator[None]:
    """With Foxglove and ROS 2 looking on: the joint states of the plants, a record array of `PlantState`."""
    from jointctl.firmware_py.records import LogRecord
    from jointctl.firmware_py.schema import new
    from jointctl.tools.scoping.feed import RECORDS
    from jointctl.tools.scoping.remote import remote

    with remote(live, config, output, motion="plant", only_states=True) as others:
        if not others.feeds:
            yield
            return
        ended, records = threading.Event(), new(LogRecord, len(plants))

        def watch() -> None:
            while not ended.wait(_STATES_S):
                records.time_ns = time.monotonic_ns()
                records.position_rad, records.velocity_radps = plants.joint_position_rad, plants.joint_velocity_radps
                records.measured_torque_Nm = plants.actuator_torque_Nm
                for axis, record in enumerate(records):
                    for feed in others.feeds:
                        feed.send(RECORDS, bytes([axis]) + record.tobytes())

        thread = threading.Thread(target=watch, name="joint states", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()


def make_realtime(config: Config, output: Output) -> None:
    """Every thread of this process, once bus, drive and SDO server are compiled and run."""
    from jointctl.tools.session.loop_process import become_realtime

    for line in become_realtime(None, config.loop.priority, sorted(own_threads())):
        output.note(f"virtual joint: {line}")


def wait_for_end(signals: StopSignals, ready_fd: int | None, ended: Callable[[], bool] = lambda: False) -> None:
    """Tell `ready_fd` that the drive answers; until a stop signal, its reader's end, or `ended`."""
    if ready_fd is not None:
        say(ready_fd, DRIVE)
    while not signals.count and not ended() and not _reader_gone(ready_fd):
        time.sleep(_POLL_S)


def say(ready_fd: int, word: bytes) -> None:
    """To the program that has started us."""
    os.set_blocking(ready_fd, False)
    with contextlib.suppress(BrokenPipeError):
        os.write(ready_fd, word)


def _reader_gone(ready_fd: int | None) -> bool:
    """Whether the program that started us and waited on `ready_fd` has gone."""
    if ready_fd is None:
        return False
    poll = select.poll()
    poll.register(ready_fd, 0)
    return bool(poll.poll(0))
