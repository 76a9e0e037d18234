"""CAN adapters on USB that are plugged in but not up, and the command that brings each one up; reads /sys only.

Sources of the USB numbers: Linux drivers/net/can/usb (gs_usb.c, peak_usb, kvaser_usb), firmware of the CANable.
docs/adapters.md has the same table in words.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from jointctl.drivers.can.socketcan import up_command
from jointctl.tools.configuration.config import Config
from jointctl.tools.inspection.health import NOTE, Finding, file_text

ANY_PRODUCT = ""
_CAN_LINK = "280"  # ARPHRD_CAN
_IFF_UP = 1
SLCAN_CODES = {
    10_000: 0, 20_000: 1, 50_000: 2, 100_000: 3, 125_000: 4, 250_000: 5, 500_000: 6, 1_000_000: 8,
}  # fmt: skip


@dataclass(frozen=True)
class AdapterKind:
    """What a USB number stands for; `module` is Linux' driver, None for one that has none and is no slcan adapter."""

    name: str
    module: str | None
    instead: str = ""  # without a driver: the interface of python-can


_KINDS = {
    ("1d50", "606f"): AdapterKind("candleLight, CANable (candleLight firmware) or other gs_usb adapter", "gs_usb"),
    ("1209", "2323"): AdapterKind("candleLight", "gs_usb"),
    ("1209", "ca01"): AdapterKind("CANnectivity", "gs_usb"),
    ("1cd2", "606f"): AdapterKind("CES CANext FD", "gs_usb"),
    ("16d0", "10b8"): AdapterKind("ABE CAN Debugger FD", "gs_usb"),
    ("0c72", "000c"): AdapterKind("PCAN-USB", "peak_usb"),
    ("0c72", "000d"): AdapterKind("PCAN-USB Pro", "peak_usb"),
    ("0c72", "0011"): AdapterKind("PCAN-USB Pro FD", "peak_usb"),
    ("0c72", "0012"): AdapterKind("PCAN-USB FD", "peak_usb"),
    ("0c72", "0013"): AdapterKind("PCAN-Chip USB", "peak_usb"),
    ("0c72", "0014"): AdapterKind("PCAN-USB X6", "peak_usb"),
    ("0bfd", ANY_PRODUCT): AdapterKind("Kvaser", "kvaser_usb"),
    ("ad50", "60c4"): AdapterKind("CANable (slcan firmware)", "slcan"),
    ("16d0", "117e"): AdapterKind("CANable 2 (slcan firmware)", "slcan"),
    ("04d8", "0053"): AdapterKind("CANalyst-II, Waveshare USB-CAN-B", None, "canalystii"),
}


@dataclass(frozen=True)
class Adapter:
    """One that is plugged in: its CAN interfaces and its serial ports, by the names that Linux gave them."""

    kind: AdapterKind
    links: tuple[str, ...]
    ports: tuple[str, ...]


def plugged_in(root: Path = Path("/")) -> list[Adapter]:
    """The USB devices that are known as CAN adapters."""
    found = []
    for device in sorted((root / "sys/bus/usb/devices").glob("*")):
        vendor, product = file_text(device / "idVendor") or "", file_text(device / "idProduct") or ""
        kind = _KINDS.get((vendor.lower(), product.lower())) or _KINDS.get((vendor.lower(), ANY_PRODUCT))
        if kind is None:
            continue
        links = tuple(sorted(path.name for path in device.glob("*/net/*")))
        ports = {path.name for path in [*device.glob("*/tty/tty*"), *device.glob("*/ttyUSB*")]}
        found.append(Adapter(kind, links, tuple(sorted(ports))))
    return found


def _links(root: Path) -> Iterator[tuple[str, bool]]:
    """Every CAN interface and whether it is up."""
    for path in sorted((root / "sys/class/net").glob("*")):
        if file_text(path / "type") == _CAN_LINK:
            flags = file_text(path / "flags") or "0"
            yield path.name, bool(int(flags, 16) & _IFF_UP)


def _attach_command(port: str, bitrate_bitps: int) -> str | None:
    """What makes a serial port a CAN interface; None for a bit rate that slcan has no code for."""
    code = SLCAN_CODES.get(bitrate_bitps)
    if code is None:
        return None
    return f"sudo slcand -o -s{code} -t hw /dev/{port} slcan0 && sudo ip link set slcan0 up txqueuelen 1000"


def _down_finding(name: str, owner: str, bitrate_bitps: int) -> Finding:
    """An interface that has only to be set up; slcan and virtual ones have no bit rate there."""
    own_rate = not name.startswith(("slcan", "vcan"))
    remedy = up_command(name, bitrate_bitps) if own_rate else f"sudo ip link set {name} up"
    return Finding("adapter", NOTE, f"{name}{f' ({owner})' if owner else ''} is plugged in but down", remedy)


def adapters_not_up(config: Config, root: Path = Path("/")) -> Iterator[Finding]:
    """One finding for each interface or adapter that could be used after one command.

    The configured interface is left out: `health.interface_state` has its state.
    """
    bus, links = config.bus, dict(_links(root))
    adapters = plugged_in(root)
    owners = {name: adapter.kind.name for adapter in adapters for name in adapter.links}
    for name, up in links.items():
        if not up and not (bus.interface == "socketcan" and name == bus.channel):
            yield _down_finding(name, owners.get(name, ""), bus.bitrate_bitps)
    attached = any(name.startswith("slcan") for name in links)
    for adapter in adapters:
        finding = _without_link(adapter, bus.bitrate_bitps, attached)
        if finding is not None:
            yield finding


def _without_link(adapter: Adapter, bitrate_bitps: int, attached: bool) -> Finding | None:
    """An adapter that is no CAN interface yet, or never will be."""
    kind = adapter.kind
    if adapter.links:
        return None
    text = f"{kind.name} is plugged in but is no CAN interface"
    if kind.module is None:
        remedy = f"Linux has no driver for it: interface {kind.instead} of python-can, in the plain Python loop"
        return Finding("adapter", NOTE, text, remedy)
    if kind.module != "slcan":
        return Finding("adapter", NOTE, text, f"sudo modprobe {kind.module}; a driver of the maker may hold it instead")
    if attached:
        return None
    if not adapter.ports:
        return Finding("adapter", NOTE, text, "it has no serial port: sudo modprobe cdc_acm, or plug it in again")
    command = _attach_command(adapter.ports[0], bitrate_bitps)
    return Finding("adapter", NOTE, text, command or f"slcan has no code for {bitrate_bitps} bit/s")
