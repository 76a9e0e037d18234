"""`jointctl monitor`: the traffic of a bus in words, line by line.  Listens only, unless it is asked to ask."""

from __future__ import annotations

import json
import time
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jointctl.drivers.errors import BusError, ConfigurationError
from jointctl.tools.output import Output
from jointctl.tools.verbs.bench_drive import AskedDrive, bench_of
from jointctl.tools.verbs.verb_options import VerbOutput

if TYPE_CHECKING:
    import can

    from jointctl.tools.inspection.frame_decoder import Decoded, FrameDecoder
    from jointctl.tools.inspection.subject import Subject

POLL_S = 0.1


@dataclass(frozen=True)
class MonitorOptions:
    """Which lines are shown; None: all, until Ctrl-C."""

    cob_ids: Annotated[list[str] | None, typer.Option("--cob-id", help="identifier (hex); may be repeated")] = None
    kinds: Annotated[
        list[str] | None, typer.Option("--kind", help="nmt, sync, time, emcy, pdo, sdo, heartbeat, lss, error, other")
    ] = None
    nodes: Annotated[list[int] | None, typer.Option("--node", help="node number; may be repeated")] = None
    count: Annotated[int | None, typer.Option("--count", help="end after so many lines", min=1)] = None
    duration_s: Annotated[float | None, typer.Option("--duration", help="end after so many seconds", min=0.0)] = None
    changes: Annotated[bool, typer.Option("--changes", help="only frames that differ from the last of theirs")] = False
    ask: Annotated[bool, typer.Option("--ask", help="read the PDO mapping from the drive first (sends SDO)")] = False


@dataclass(frozen=True)
class Selection:
    """Which frames are shown; an empty set means all.  `count` and `duration_s` end it, None = Ctrl-C does."""

    cob_ids: frozenset[int] = frozenset()
    kinds: frozenset[str] = frozenset()
    nodes: frozenset[int] = frozenset()
    count: int | None = None
    duration_s: float | None = None
    changes: bool = False  # only frames whose bytes differ from the last ones of the same identifier

    def shows(self, cob_id: int, decoded: Decoded) -> bool:
        """Whether a frame passes the filters."""
        return (
            (not self.cob_ids or cob_id in self.cob_ids)
            and (not self.kinds or decoded.kind in self.kinds)
            and (not self.nodes or decoded.node in self.nodes or (decoded.kind == "nmt" and decoded.node == 0))
        )


def selection_of(options: MonitorOptions) -> Selection:
    """From the texts of the command line; identifiers are hexadecimal, as candump writes them."""
    from jointctl.tools.inspection.frame_decoder import KINDS

    identifiers = set()
    for text in options.cob_ids or ():
        try:
            identifiers.add(int(text.lower().removesuffix("h").removeprefix("0x"), 16))
        except ValueError:
            raise ConfigurationError(f"--cob-id (={text}) must be a hexadecimal identifier, such as 181") from None
    for kind in options.kinds or ():
        if kind not in KINDS:
            raise ConfigurationError(f"--kind (={kind}) must be one of {', '.join(KINDS)}")
    shown = frozenset(identifiers), frozenset(options.kinds or ()), frozenset(options.nodes or ())
    return Selection(*shown, options.count, options.duration_s, options.changes)


def new_decoder(subject: Subject, *, ask: bool) -> FrameDecoder:
    """With what the subject tells about objects and PDOs; `ask` reads the mapping from the drive over SDO."""
    from jointctl.tools.configuration.canopen import canopen_settings
    from jointctl.tools.inspection.drive_info import pdo_maps
    from jointctl.tools.inspection.frame_decoder import FrameDecoder, PdoMaps, sent_by_loop
    from jointctl.tools.inspection.objects import Objects
    from jointctl.tools.inspection.subject import SdoReader, canopen_network

    maps, objects = PdoMaps(), {}
    if subject.eds is not None and subject.node is not None:
        known = subject.objects()
        objects[subject.node] = known
        if known.dictionary is not None:
            maps.learn_from_eds(known.dictionary, subject.node)
    if subject.config is not None and subject.node is not None:
        maps.learn_loop(subject.node, sent_by_loop(canopen_settings(subject.config)))
    if ask:
        node = subject.required_node()
        with canopen_network(subject) as network:
            reader = SdoReader(network, node, objects.get(node, Objects()))
            reader.require_answer()
            pdo_maps(reader, maps)
    return FrameDecoder(objects, maps)


def monitor(asked: AskedDrive, output: VerbOutput, options: MonitorOptions) -> int:
    """The traffic of a bus in words: NMT, SYNC, heartbeats, EMCY, SDO, PDO by their mapping.  Listens only."""
    return bench_of(asked.config).monitor(asked, output, options)


def monitor_bus(subject: Subject, output: Output, selection: Selection, *, ask: bool = False) -> int:
    """Show frames until the selection or a stop signal ends it; 0.  A dead bus is a `BusError`."""
    import can

    from jointctl.tools.session.control import stop_signals

    decoder = new_decoder(subject, ask=ask)
    bus = subject.open_bus()
    try:
        with stop_signals() as signals:
            output.note(f"listening on {subject.place}; Ctrl-C ends it")
            _show(bus, decoder, output, selection, lambda: bool(signals.count))
    except can.CanError as error:
        raise BusError(f"{subject.place} failed: {error}", "wiring, bit rate, and whether it is up") from None
    finally:
        bus.shutdown()
    return 0


def _show(bus: can.BusABC, decoder: FrameDecoder, output: Output, selection: Selection, asked: Any) -> None:
    until_s = None if selection.duration_s is None else time.monotonic() + selection.duration_s
    kinds: Counter[str] = Counter()
    shown = 0
    last: dict[int, bytes] = {}
    started_s = time.monotonic()
    while not asked() and (selection.count is None or shown < selection.count):
        left_s = POLL_S if until_s is None else min(POLL_S, until_s - time.monotonic())
        if left_s <= 0.0:
            break
        message = bus.recv(left_s)
        if message is None:
            continue
        decoded = decoder.decode(message)
        kinds[decoded.kind] += 1
        if not selection.shows(message.arbitration_id, decoded):
            continue
        if selection.changes and last.get(message.arbitration_id) == bytes(message.data):
            continue
        last[message.arbitration_id] = bytes(message.data)
        shown += 1
        if not output.line(json_line(message, decoded) if output.json else text_line(message, decoded)):
            break
    elapsed_s = time.monotonic() - started_s
    counted = ", ".join(f"{kind} {number}" for kind, number in kinds.most_common())
    output.note(f"{sum(kinds.values())} frames in {elapsed_s:.1f} s{': ' + counted if counted else ''}")


def text_line(message: can.Message, decoded: Decoded) -> str:
    """`12:00:00.123456  181 [8]  node 1  pdo  TPDO1 Statusword ...`."""
    clock = time.strftime("%H:%M:%S", time.localtime(message.timestamp)) + f"{message.timestamp % 1:.6f}"[1:]
    name = "err" if message.is_error_frame else f"{message.arbitration_id:03X}"
    node = f"node {decoded.node}" if decoded.node else ""
    raw = bytes(message.data).hex(" ") if decoded.kind in ("other", "lss", "time") else ""
    return f"{clock}  {name:>3} [{message.dlc}]  {node:<8} {decoded.kind:<9} {decoded.text} {raw}".rstrip()


def json_line(message: can.Message, decoded: Decoded) -> str:
    return json.dumps(
        {
            "time_s": message.timestamp,
            "cob_id": message.arbitration_id,
            "kind": decoded.kind,
            "node": decoded.node,
            "data": bytes(message.data).hex(),
            "text": decoded.text,
            **decoded.fields,
        }
    )
