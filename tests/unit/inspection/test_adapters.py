"""Adapters that are plugged in but not up, found in a folder with files as /sys has them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from jointctl.tools.inspection.health import adapters_not_up, plugged_in
from tests.configurations import shipped

UP, DOWN = "0x40041\n", "0x40080\n"
CONFIG = shipped()


def plug(root: Path, vendor: str, product: str, *below: str, place: str = "1-4") -> None:
    device = root / "sys/bus/usb/devices" / place
    device.mkdir(parents=True)
    (device / "idVendor").write_text(vendor + "\n")
    (device / "idProduct").write_text(product + "\n")
    for name in below:
        (device / f"{place}:1.0" / name).mkdir(parents=True)


def link(root: Path, name: str, flags: str, kind: str = "280") -> None:
    folder = root / "sys/class/net" / name
    folder.mkdir(parents=True)
    (folder / "type").write_text(kind + "\n")
    (folder / "flags").write_text(flags)


def told(root: Path, **bus: object) -> list[tuple[str, str]]:
    config = CONFIG.changed(bus=bus)
    return [(finding.text, finding.remedy) for finding in adapters_not_up(config, root)]


@pytest.mark.parametrize(
    ("plugged", "links", "bus", "expected"),
    [
        (("046d", "c52b"), {"eth0": (DOWN, "1")}, {}, []),
        (("1d50", "606f", "net/can0"), {"can0": (DOWN,)}, {"bitrate_bitps": 500_000},
         [(r"can0 \(candleLight.* is plugged in but down", "sudo ip link set can0 up type can bitrate 500000")]),
        (("0c72", "000c", "net/can0"), {"can0": (UP,)}, {}, []),
        # the configured one is judged elsewhere
        (None, {"can0": (DOWN,), "can1": (DOWN,)}, {"interface": "socketcan", "channel": "can0"},
         [("can1 is plugged in but down", "sudo ip link set can1 up type can bitrate 1000000")]),
        (None, {"slcan0": (DOWN,)}, {}, [("slcan0 is plugged in but down", "sudo ip link set slcan0 up")]),
        (None, {"vcan0": (DOWN,)}, {}, [("vcan0 is plugged in but down", "sudo ip link set vcan0 up")]),
        # a driver that is not loaded
        *(
            (("0C72", product), {}, {},
             [(f"{name} is plugged in but is no CAN interface", "sudo modprobe peak_usb;.*")])
            for product, name in (("000c", "PCAN-USB"), ("0012", "PCAN-USB FD"))
        ),
        # slcan is attached with the code of the bit rate, if there is one and a port
        *(
            (("16d0", "117e", "tty/ttyACM3"), {}, {"bitrate_bitps": bitrate},
             [(".*", f"sudo slcand -o {code} -t hw /dev/ttyACM3 slcan0 && .*")])
            for bitrate, code in ((1_000_000, "-s8"), (500_000, "-s6"), (125_000, "-s4"))
        ),
        (("ad50", "60c4"), {}, {}, [(".*", ".*no serial port.*")]),
        (("ad50", "60c4", "tty/ttyACM0"), {}, {"bitrate_bitps": 333_000},
         [(".*", "slcan has no code for 333000 bit/s")]),
        (("16d0", "117e", "tty/ttyACM0"), {"slcan0": (UP,)}, {}, []),
        (("04d8", "0053", "ttyUSB0"), {}, {}, [(".*", ".*canalystii.*plain Python loop.*")]),
    ],
)  # fmt: skip
def test_what_is_plugged_in_and_not_up_is_told_with_its_remedy(
    tmp_path: Path, plugged: tuple[str, ...] | None, links: dict[str, tuple[str, ...]], bus: dict[str, Any],
    expected: list[tuple[str, str]],
) -> None:  # fmt: skip
    if plugged is not None:
        plug(tmp_path, *plugged)
    for name, flags_and_kind in links.items():
        link(tmp_path, name, *flags_and_kind)
    for found, patterns in zip(told(tmp_path, **bus), expected, strict=True):
        assert all(re.fullmatch(pattern, text) for pattern, text in zip(patterns, found, strict=True)), found


def test_every_product_of_kvaser(tmp_path: Path) -> None:
    plug(tmp_path, "0bfd", "0107")
    assert [adapter.kind.module for adapter in plugged_in(tmp_path)] == ["kvaser_usb"]


def test_a_device_that_goes_while_it_is_looked_at(tmp_path: Path) -> None:
    (tmp_path / "sys/bus/usb/devices/1-4").mkdir(parents=True)
    (tmp_path / "sys/class/net/can0").mkdir(parents=True)
    assert told(tmp_path) == []
