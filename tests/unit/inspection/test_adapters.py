"""Adapters that are plugged in but not up, found in a folder with files as /sys has them."""

from __future__ import annotations

from pathlib import Path

import pytest

from jointctl.tools.inspection.adapters import adapters_not_up, plugged_in
from tests.configurations import changed, shipped

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
    config = changed(CONFIG, **{f"bus__{key}": value for key, value in bus.items()})
    return [(finding.text, finding.remedy) for finding in adapters_not_up(config, root)]


def test_nothing_plugged_in_is_nothing_to_say(tmp_path: Path) -> None:
    link(tmp_path, "eth0", DOWN, kind="1")
    plug(tmp_path, "046d", "c52b")
    assert told(tmp_path) == []


@pytest.mark.parametrize("bitrate", [500_000, 1_000_000])
def test_an_interface_that_is_down_gets_the_configured_bit_rate(tmp_path: Path, bitrate: int) -> None:
    plug(tmp_path, "1d50", "606f", "net/can0")
    link(tmp_path, "can0", DOWN)
    ((text, remedy),) = told(tmp_path, bitrate_bitps=bitrate)
    assert text.startswith("can0 (candleLight")
    assert text.endswith("is plugged in but down")
    assert remedy == f"sudo ip link set can0 up type can bitrate {bitrate}"


def test_an_interface_that_is_up_is_left_alone(tmp_path: Path) -> None:
    plug(tmp_path, "0c72", "000c", "net/can0")
    link(tmp_path, "can0", UP)
    assert told(tmp_path) == []


def test_the_configured_interface_is_judged_elsewhere(tmp_path: Path) -> None:
    for name in ("can0", "can1"):
        link(tmp_path, name, DOWN)
    assert [text for text, _ in told(tmp_path, interface="socketcan", channel="can0")] == [
        "can1 is plugged in but down"
    ]


@pytest.mark.parametrize("name", ["slcan0", "vcan0"])
def test_links_without_a_bit_rate(tmp_path: Path, name: str) -> None:
    link(tmp_path, name, DOWN)
    assert told(tmp_path) == [(f"{name} is plugged in but down", f"sudo ip link set {name} up")]


@pytest.mark.parametrize(("product", "name"), [("000c", "PCAN-USB"), ("0012", "PCAN-USB FD")])
def test_a_driver_that_is_not_loaded(tmp_path: Path, product: str, name: str) -> None:
    plug(tmp_path, "0C72", product)
    ((text, remedy),) = told(tmp_path)
    assert text == f"{name} is plugged in but is no CAN interface"
    assert remedy.startswith("sudo modprobe peak_usb;")


def test_every_product_of_kvaser(tmp_path: Path) -> None:
    plug(tmp_path, "0bfd", "0107")
    assert [adapter.kind.module for adapter in plugged_in(tmp_path)] == ["kvaser_usb"]


@pytest.mark.parametrize(("bitrate", "code"), [(1_000_000, "-s8"), (500_000, "-s6"), (125_000, "-s4")])
def test_slcan_is_attached_with_the_code_of_the_bit_rate(tmp_path: Path, bitrate: int, code: str) -> None:
    plug(tmp_path, "16d0", "117e", "tty/ttyACM3")
    ((_, remedy),) = told(tmp_path, bitrate_bitps=bitrate)
    assert remedy.startswith(f"sudo slcand -o {code} -t hw /dev/ttyACM3 slcan0 && ")


def test_slcan_without_code_or_port(tmp_path: Path) -> None:
    plug(tmp_path, "ad50", "60c4")
    assert "no serial port" in told(tmp_path)[0][1]
    (tmp_path / "sys/bus/usb/devices/1-4/1-4:1.0/tty/ttyACM0").mkdir(parents=True)
    assert told(tmp_path, bitrate_bitps=333_000)[0][1] == "slcan has no code for 333000 bit/s"


def test_slcan_that_is_attached_already(tmp_path: Path) -> None:
    plug(tmp_path, "16d0", "117e", "tty/ttyACM0")
    link(tmp_path, "slcan0", UP)
    assert told(tmp_path) == []


def test_an_adapter_without_a_driver_names_what_there_is(tmp_path: Path) -> None:
    plug(tmp_path, "04d8", "0053", "ttyUSB0")
    ((_, remedy),) = told(tmp_path)
    assert "canalystii" in remedy
    assert "plain Python loop" in remedy


def test_a_device_that_goes_while_it_is_looked_at(tmp_path: Path) -> None:
    (tmp_path / "sys/bus/usb/devices/1-4").mkdir(parents=True)
    (tmp_path / "sys/class/net/can0").mkdir(parents=True)
    assert told(tmp_path) == []
