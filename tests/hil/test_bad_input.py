"""Everything that `jointctl run` refuses: one line, its own exit code, and a joint that was never enabled."""

from __future__ import annotations

import re
from typing import Any

from jointctl.hil.virtual_bus import VirtualBusHub, default_socket_path
from tests.places import EDS

CONTROL_WORD_ID = 0x201  # RPDO1 of node 1: only the loop sends it
TPDO_ID = 0x181


def eds_without(text: str, index: str) -> str:
    """The EDS text without the section of one object and without its line in the object lists."""
    text = re.sub(rf"(?ms)^\[{index}\]\n.*?(?=^\[)", "", text)
    return re.sub(rf"(?mi)^\d+=0x{index}\n", "", text)


class Witness:
    """Looks on at the bus: whether the drive was ever told to, or said that it would, apply torque."""

    def __init__(self, bench: Any) -> None:
        self.enabled = 0
        self.network = bench.network()
        self.network.subscribe(CONTROL_WORD_ID, self._on_command)
        self.network.subscribe(TPDO_ID, self._on_status)
        self.network.subscribe(0x601, self._on_sdo)

    def _on_command(self, _: int, data: bytearray, timestamp_s: float) -> None:
        self.enabled += data[0] & 0x0F == 0x0F

    def _on_status(self, _: int, data: bytearray, timestamp_s: float) -> None:
        self.enabled += data[0] & 0x6F == 0x27

    def _on_sdo(self, _: int, data: bytearray, timestamp_s: float) -> None:
        self.enabled += bytes(data[1:4]) == b"\x40\x60\x00" and data[0] & 0xE0 == 0x20 and data[4] & 0x0F == 0x0F


def test_no_bus_names_it_and_tells_what_to_do(bench: Any) -> None:
    done = bench.run("run", bench.config(), "-y")
    done.refused(4, bench.channel, "hint: ", "jointctl hil")
    bench.run("run", bench.config(), "-y", "-i", "socketcan", "-c", "nocan7").refused(4, "CAN", "hint: ")
    bench.run("run", bench.config(), "-y", "-i", "nonsense").refused(4, "nonsense", "socketcan")


def test_a_bus_without_a_device(bench: Any) -> None:
    with VirtualBusHub(default_socket_path(bench.channel)):
        bench.run("run", bench.config(), "-y").refused(5, "node 1 does not answer, and neither does any other", "power")


def test_refusals_of_one_joint(bench: Any) -> None:
    """One virtual joint, many configurations that do not fit it; the power stage stays off all the time."""
    bench.with_joint(virtual__initial_position_rad=0.1)
    (bench.folder / "short.eds").write_text(eds_without(EDS.read_text(), "6072"))
    (bench.folder / "file").write_text("a file where a folder should be")
    witness = Witness(bench)

    def refuse(code: int, *words: str, arguments: tuple[str, ...] = ("-y",), **changes: Any) -> None:
        bench.run("run", bench.config("other.toml", **changes), *arguments).refused(code, *words)
        assert bench.disabled()

    refuse(2, "no terminal", "-y", arguments=())
    refuse(5, "node 9 does not answer; these do: 1", drive__node=9)
    refuse(6, "short.eds", "6072", "max torque", drive__eds="short.eds")
    refuse(6, "drive.rated_current_A (=6)", "5 A", drive__rated_current_A=6.0)
    refuse(8, "file/runs", log__folder="file/runs")
    refuse(7, "POSITION_LIMIT", "0.1000 rad", "limits.position", limits__position_max_rad=0.09,
           trajectory__amplitude_rad=0.01)  # fmt: skip
    assert witness.enabled == 0
    witness.network.disconnect()


def test_the_witness_sees_a_joint_that_is_enabled(bench: Any) -> None:
    """The twin of the refusals: a good configuration does enable."""
    name = bench.with_joint()
    witness = Witness(bench)
    assert bench.run("run", name, "-y").code == 0
    assert witness.enabled > 100
    witness.network.disconnect()
