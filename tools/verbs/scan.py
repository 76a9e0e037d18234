"""`jointctl scan`: which CANopen nodes are on a bus.  Reads only, and may be used beside a run."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from jointctl.drivers.errors import NoDeviceError
from jointctl.tools.verbs.bench_drive import NodeOnBus
from jointctl.tools.verbs.verb_options import VerbOutput

if TYPE_CHECKING:
    from jointctl.tools.inspection.subject import Heard, Subject

_NOT_CANOPEN = "power the drives; check the bit rate of each (a drive that keeps silent may only send when asked)"


def scan(
    subject: NodeOnBus,
    output: VerbOutput,
    *,
    # a little more than the usual heartbeat period of one second
    listen_s: Annotated[float, typer.Option("--listen", help="seconds to listen before asking", min=0.0)] = 1.2,
    passive: Annotated[bool, typer.Option("--passive", help="only listen, ask nobody")] = False,
) -> int:
    """Which CANopen nodes are on the bus: identity, device type, NMT state, drive state.  Reads only."""
    from jointctl.drivers.canopen.cia import HIGHEST_NODE
    from jointctl.tools.inspection.subject import Ear, ask_everybody, canopen_network, describe

    ear = Ear()
    with canopen_network(subject, ear) as network:
        output.note(f"listening on {subject.place} for {listen_s:g} s")
        time.sleep(listen_s)
        heard_first = ear.nodes()
        active = ear.heard.syncs > 0
        if active:
            output.note("SYNC is on the bus: a controller is active; asking goes on beside it")
            output.note("a node that answers no SDO may be the heartbeat of that controller")
        answered: set[int] = set()
        if not passive:
            if subject.node is None or subject.config is not None:
                wanted = set(range(1, HIGHEST_NODE + 1))
            else:
                wanted = {subject.node}
            output.note(f"asking {len(wanted)} node number{'s' if len(wanted) > 1 else ''}")
            answered = ask_everybody(network, ear, wanted)
        nodes = sorted(answered | heard_first | ear.nodes())
        rows = [describe(network, node, node in answered, ear.heard.heartbeats.get(node)) for node in nodes]
        if not rows:
            raise _nobody(subject, ear.heard)
    titles = ("node", "NMT state", "device", "name", "vendor", "product", "revision", "serial", "drive state")
    table = Table(*titles, box=None, pad_edge=False)
    for row in rows:
        device = row["device_type"] or ("" if row["answers_sdo"] else "answers no SDO")
        cells = (row["node"], row["nmt_state"], device, row["name"], row["vendor_id"], row["product_code"],
                 row["revision"], row["serial_number"], row["drive_state"])  # fmt: skip
        table.add_row(*("" if cell is None else str(cell) for cell in cells))
    output.result(table, {"bus": subject.place, "controller_active": active, "nodes": rows})
    return 0


def _nobody(subject: Subject, heard: Heard) -> NoDeviceError:
    """Why probably nobody answers."""
    rate = f"{subject.bitrate_bitps} bit/s" if subject.bitrate_bitps else "its bit rate"
    if heard.frames:
        return NoDeviceError(f"{heard.frames} frames came on {subject.place}, but no CANopen node", _NOT_CANOPEN)
    if heard.errors:
        return NoDeviceError(
            f"only error frames ({heard.errors}) came on {subject.place}: the bit rate is likely wrong",
            f"this end is set to {rate}; set that of the drives; then wiring and termination (60 ohm between H and L)",
        )
    return NoDeviceError(
        f"nobody is on {subject.place}: no frame came, no node answered",
        f"power, wiring, termination (60 ohm between H and L), and the bit rate: {rate} here",
    )
