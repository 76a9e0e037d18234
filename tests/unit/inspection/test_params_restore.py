"""params restore on the virtual drive of this process: read back, refused, or nothing written at all."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path
from typing import Any

import can
import pytest

from jointctl.drivers.errors import DECLINED, BusError, ConfigurationError, DeviceError, UsageError
from jointctl.tools.inspection.objects import Place
from jointctl.tools.verbs.params import place_index, restore_file
from tests.unit.inspection.parameter_verbs import OLDER_DUMP, change, output, read, subject, writes


def restored(device: Any, file: Path, **how: Any) -> int:
    return restore_file(subject(device), file, output()[0], **{"assume_yes": True, "skip": [], **how})


class TestRestore:
    def test_only_what_differs_is_written_and_read_back(self, device_on_bus: Any, file: Path) -> None:
        change(file, o6072="700", o6065="12345")
        assert restored(device_on_bus, file) == 0
        assert sorted(writes(device_on_bus)) == [(0x6065, 0), (0x6072, 0)]
        found = read(device_on_bus)
        assert (found.parameters[Place(0x6072)], found.parameters[Place(0x6065)]) == (700, 12345)

    def test_nothing_differs_nothing_is_sent_but_reads(self, device_on_bus: Any, file: Path) -> None:
        assert restored(device_on_bus, file) == 0
        assert not writes(device_on_bus)
        assert {identifier for identifier, _ in device_on_bus.requests} == {0x601}

    def test_readings_and_commands_are_never_written(self, device_on_bus: Any, file: Path) -> None:
        change(file, o6071="300", o6040="15", o6064="5", o60FF="99", o6072="700")
        assert restored(device_on_bus, file) == 0
        assert writes(device_on_bus) == [(0x6072, 0)]

    def test_a_toml_dump_of_an_older_version_is_restored(self, device_on_bus: Any, tmp_path: Path) -> None:
        path = tmp_path / "older.toml"
        text = OLDER_DUMP.read_text().replace("6072 = 1000 ", "6072 = 700 ")
        path.write_text(text.replace("[parameters]", "[parameters]\n6071 = 300\n60C1 = 5"))  # commands, not settings
        assert restored(device_on_bus, path) == 0
        assert (0x6072, 0) in writes(device_on_bus)
        assert not {index for index, _ in writes(device_on_bus)} & {0x6071, 0x60C1}
        assert read(device_on_bus).parameters[Place(0x6072)] == 700

    def test_a_mapping_is_restored_in_the_order_of_cia_301(self, device_on_bus: Any, file: Path) -> None:
        change(file, o1A01="1", o1A01_1="0x606C0020", o1801_2="255", o1801_1="0x281")
        assert restored(device_on_bus, file) == 0
        order = writes(device_on_bus)
        assert order == [(0x1801, 2), (0x1A01, 0), (0x1A01, 1), (0x1A01, 0), (0x1801, 1)]
        found = read(device_on_bus).parameters
        assert (found[Place(0x1A01, 0)], found[Place(0x1A01, 1)], found[Place(0x1801, 1)]) == (1, 0x606C0020, 0x281)

    def test_a_refused_value_is_told_and_the_others_are_written(self, device_on_bus: Any, file: Path) -> None:
        change(file, o605A="77", o6072="700")
        told, out = output(json=True)
        with pytest.raises(DeviceError, match="1 of 2 parameters were not taken"):
            restore_file(subject(device_on_bus), file, told, assume_yes=True, skip=[])
        report = json.loads(out.getvalue())
        assert report["restored"] == ["6072"]
        assert report["failed"][0]["object"] == "605A"
        assert "0609" in report["failed"][0]["reason"]

    @pytest.mark.parametrize(("word", "refused"), [(0x0237, True), (0x0217, True), (0x0233, False), (0x0250, False)])
    def test_a_drive_under_power_is_left_alone(self, device_on_bus: Any, file: Path, word: int, refused: bool) -> None:
        change(file, o6072="700")
        device_on_bus.answers[0x6041, 0] = word
        if refused:
            with pytest.raises(DeviceError, match="nothing is written into a drive under power"):
                restored(device_on_bus, file)
        else:
            assert restored(device_on_bus, file) == 0
        assert bool(writes(device_on_bus)) != refused

    def test_another_controller_is_left_alone(self, device_on_bus: Any, file: Path) -> None:
        change(file, o6072="700")
        with can.Bus(interface="virtual", channel=device_on_bus.channel) as bus:
            sender = bus.send_periodic(can.Message(arbitration_id=0x80, is_extended_id=False), 0.01)
            with pytest.raises(BusError, match="another controller"):
                restored(device_on_bus, file)
            sender.stop()
        assert not writes(device_on_bus)

    @pytest.mark.parametrize("other", [True, False])
    def test_another_device_only_if_told_so(self, device_on_bus: Any, file: Path, other: bool) -> None:
        change(file, o1018_2="9", o6072="700")
        if other:
            assert restored(device_on_bus, file, other_device=True) == 0
        else:
            with pytest.raises(DeviceError, match=r"product_code \(=9\) is not that of the drive \(=1\)"):
                restored(device_on_bus, file)
        assert bool(writes(device_on_bus)) == other

    @pytest.mark.parametrize("other", [True, False])
    def test_another_node_only_if_asked_for(self, device_on_bus: Any, file: Path, other: bool) -> None:
        change(file, o6072="700")
        file.write_text(file.read_text().replace("NodeID=1\n", "NodeID=5\n"))
        if other:
            assert restored(device_on_bus, file, other_device=True) == 0
        else:
            with pytest.raises(DeviceError, match=r"node \(=5\) is not that of the drive \(=1\)"):
                restored(device_on_bus, file)
        assert bool(writes(device_on_bus)) == other

    @pytest.mark.parametrize(("answer", "written"), [("y\n", True), ("n\n", False), ("", False)])
    def test_it_asks(
        self, device_on_bus: Any, file: Path, answer: str, written: bool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        class Terminal(io.StringIO):
            def isatty(self) -> bool:
                return True

        change(file, o6072="700")
        monkeypatch.setattr(sys, "stdin", Terminal(answer))
        assert restored(device_on_bus, file, assume_yes=False) == (0 if written else DECLINED)
        assert bool(writes(device_on_bus)) == written

    @pytest.mark.parametrize("what", ["SYNC", "under power", "nothing"])
    def test_what_came_while_the_question_was_open_is_seen(
        self, device_on_bus: Any, file: Path, what: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A joint that moves by now must not lose its controller: not even pre-operational is said."""

        class Terminal(io.StringIO):
            def isatty(self) -> bool:
                return True

            def readline(self, *_: Any) -> str:
                if what == "SYNC":
                    with can.Bus(interface="virtual", channel=device_on_bus.channel) as bus:
                        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
                elif what == "under power":
                    device_on_bus.answers[0x6041, 0] = 0x0237
                return "y\n"

        change(file, o6072="700")
        monkeypatch.setattr(sys, "stdin", Terminal())
        if what == "nothing":
            assert restored(device_on_bus, file, assume_yes=False) == 0
        else:
            with pytest.raises((BusError, DeviceError), match=r"another controller|under power"):
                restored(device_on_bus, file, assume_yes=False)
        pre_operational = (0, b"\x80\x01") in device_on_bus.requests
        assert (bool(writes(device_on_bus)), pre_operational) == ((True, True) if what == "nothing" else (False, False))

    def test_without_a_terminal_it_does_not_write(
        self, device_on_bus: Any, file: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        change(file, o6072="700")
        monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
        with pytest.raises(UsageError):
            restored(device_on_bus, file, assume_yes=False)
        assert not writes(device_on_bus)

    def test_skipped_objects(self, device_on_bus: Any, file: Path) -> None:
        change(file, o6072="700", o6065="12345")
        assert restored(device_on_bus, file, skip=[place_index("6072")]) == 0
        assert writes(device_on_bus) == [(0x6065, 0)]
        with pytest.raises(ConfigurationError, match="--skip"):
            place_index("12345")
