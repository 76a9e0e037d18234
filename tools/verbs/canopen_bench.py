"""A CANopen drive at the bench."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pydantic_core import PydanticCustomError

from jointctl.drivers.can.open import CYCLIC_INTERFACES, SHARED_INTERFACES, open_python_can, split_channel, with_options
from jointctl.drivers.canopen.cia import HIGHEST_NODE
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.drive_section import FOR_A_PORT, wrong_kind
from jointctl.tools.configuration.sections import checked_options
from jointctl.tools.output import Output
from jointctl.tools.verbs.bench_drive import Asked, BenchDrive, ReadableKeys, ServeOptions, is_text

if TYPE_CHECKING:
    from jointctl.tools.configuration.arm import ArmConfig
    from jointctl.tools.inspection.health import Finding
    from jointctl.tools.inspection.subject import Subject
    from jointctl.tools.verbs.monitor import MonitorOptions

MONITOR_NICENESS = 10  # the loop of a run beside it goes first


@dataclass(frozen=True)
class CanTarget:
    """See `StopTarget`; `bitrate_bitps` None where it does not matter."""

    interface: str
    channel: str
    bitrate_bitps: int | None
    node: int
    encoder_node: int | None = None
    sdo_timeout_s: float | None = None
    braking_s: float | None = None
    off_s: float | None = None

    @property
    def place(self) -> tuple[str, str]:
        return self.interface, self.channel

    def switch_off(self, output: Output) -> str:
        from jointctl.drivers.canopen.switch_off import stop_node

        bus = open_python_can(self.interface, self.channel, self.bitrate_bitps, exclusive=False)
        return stop_node(
            bus, self.node, encoder_node=self.encoder_node, sdo_timeout_s=self.sdo_timeout_s, braking_s=self.braking_s,
            off_s=self.off_s,
        )  # fmt: skip


class CanopenBench(BenchDrive):
    """See `BenchDrive`."""

    def stop_target(self, keys: ReadableKeys) -> CanTarget:
        drive, bus, given, environ = keys.section("drive"), keys.section("bus"), keys.given, keys.environ
        if given.port is not None:
            raise wrong_kind(keys.path, drive.get("kind"), FOR_A_PORT)
        interfaces = [given.interface, environ.get("CAN_INTERFACE") or None, bus.get("interface")]
        interface = keys.required("bus.interface", interfaces, is_text, "a text in quotes")
        channels = [given.channel, environ.get("CAN_CHANNEL") or None, bus.get("channel")]
        channel = keys.required("bus.channel", channels, is_text, "a text in quotes")
        if interface == bus.get("interface") and interface not in CYCLIC_INTERFACES:
            channel, inline = split_channel(channel)
            with contextlib.suppress(PydanticCustomError):  # without them rather than not at all
                channel = with_options(channel, {**(checked_options(bus.get("options")) or {}), **inline})
        nodes = [given.node, drive.get("node")]
        node = keys.required("drive.node", nodes, lambda n: _whole(n, 1, HIGHEST_NODE), "in [1..127]")
        bitrates = [given.bitrate, _number(environ.get("CAN_BITRATE")), bus.get("bitrate_bitps")]
        bitrate: int | None = None
        if interface not in SHARED_INTERFACES or any(_whole(value, 1, 10**7) for value in bitrates[:1]):
            rule = "in [10000..1000000]"
            bitrate = keys.required("bus.bitrate_bitps", bitrates, lambda b: _whole(b, 10_000, 1_000_000), rule)
        encoder = keys.section("joint_encoder")
        encoder_node = encoder.get("node") if encoder.get("source") == "node" else None
        return CanTarget(
            interface, channel, bitrate, node,
            encoder_node if _whole(encoder_node, 1, HIGHEST_NODE) else None, keys.seconds("drive", "sdo_timeout_s"),
            keys.seconds("sequence", "stop_timeout_s", 60.0), keys.seconds("sequence", "off_timeout_s", 60.0),
        )  # fmt: skip

    def info(self, asked: Asked, output: Output) -> int:
        from jointctl.tools.verbs.info import node_info

        return node_info(canopen_subject(asked), output)

    def monitor(self, asked: Asked, output: Output, options: MonitorOptions) -> int:
        """See `BenchDrive`: the traffic of the bus in words."""
        from jointctl.tools.verbs.monitor import monitor_bus, selection_of

        selection, subject = selection_of(options), canopen_subject(asked)
        os.nice(MONITOR_NICENESS)
        return monitor_bus(subject, output, selection, ask=options.ask)

    def findings(self, config: Config) -> Iterator[Finding]:
        from jointctl.tools.inspection.health import (
            adapters,
            adapters_not_up,
            bus_budget,
            drive_finding,
            interface_state,
            quick_stop_finding,
        )

        yield from adapters(config)
        yield from adapters_not_up(config)
        yield bus_budget(config)
        yield (answer := drive_finding(config))
        if answer.numbers:
            yield from quick_stop_finding(config)
        yield from interface_state(config)  # last: a bus on which nobody acknowledges shows once something was sent

    def serve(self, config: Config, output: Output, options: ServeOptions) -> int:
        from jointctl.tools.verbs.hil import serve_can

        if options.serial or options.link is not None:
            raise wrong_kind(config.path, config.drive.kind, FOR_A_PORT)
        return serve_can(config, output, timing=options.timing, ready_fd=options.ready_fd, live=options.live)

    def serve_arm(self, arm: ArmConfig, output: Output, options: ServeOptions) -> int:
        from jointctl.tools.session.canopen_drive import require_buses
        from jointctl.tools.verbs.hil import serve_can

        require_buses(arm.joints)
        return serve_can(arm, output, timing=options.timing, ready_fd=options.ready_fd, live=options.live)


def canopen_subject(asked: Asked) -> Subject:
    """The node, its bus and its EDS."""
    from jointctl.tools.inspection.subject import subject_of_config, subject_of_flags

    if asked.config is None:
        return subject_of_flags(asked.given, asked.eds)
    return subject_of_config(asked.config, asked.eds)


def _whole(value: object, low: int, high: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def _number(text: str | None) -> int | None:
    """Of the environment; one that is no number is left out."""
    return int(text) if text and text.isdecimal() else None
