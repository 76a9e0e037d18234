"""scan, info and monitor on the virtual drive of this process: what they find, and that they only ever read."""

from __future__ import annotations

import json
import re
import threading
import time
from types import SimpleNamespace
from typing import Any

import can
import pytest

from jointctl.drivers.canopen.eds import standard_type
from jointctl.drivers.errors import ConfigurationError, NoDeviceError
from jointctl.tools.configuration.canopen import eds_path
from jointctl.tools.configuration.drive_section import GivenPlace
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.inspection import subject as node_scan
from jointctl.tools.inspection.drive_info import drive_info, pdo_maps, ratings
from jointctl.tools.inspection.objects import Objects, standard_variable
from jointctl.tools.inspection.subject import (
    Ear,
    SdoReader,
    Subject,
    canopen_network,
    subject_of_config,
    subject_of_flags,
)
from jointctl.tools.verbs.info import info_table
from jointctl.tools.verbs.info import node_info as info
from jointctl.tools.verbs.monitor import MonitorOptions, Selection, selection_of
from jointctl.tools.verbs.monitor import monitor_bus as monitor
from jointctl.tools.verbs.scan import scan
from tests.device_on_bus import sent_every_10_ms
from tests.sessions import output

SDO_READ = (0x40, 0x60, 0x70)  # initiate upload, upload segment with either toggle bit


def subject(device: Any, node: int | None = 1, **more: Any) -> Subject:
    return Subject("virtual", device.channel, None, node, **more)


@pytest.fixture
def quick_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_scan, "PACE_S", 0.0)


def only_reads(device: Any) -> bool:
    return all(identifier & 0x780 == 0x600 and data[0] in SDO_READ for identifier, data in device.requests)


@pytest.mark.usefixtures("quick_scan")
class TestScan:
    def test_finds_the_one_node(self, joint: Any) -> None:
        told, out, _ = output(json=True)
        assert scan(subject(joint, None), told, listen_s=0.0) == 0
        found = json.loads(out.getvalue())
        (node,) = found["nodes"]
        assert (node["node"], node["answers_sdo"], node["drive_state"]) == (1, True, "switch on disabled")
        assert node["name"] == "jointctl virtual joint"
        assert node["device_type"] == "00020192h, CiA 402 (drives)"
        assert found["controller_active"] is False
        assert only_reads(joint)
        assert {identifier for identifier, _ in joint.requests} == set(range(0x601, 0x680))

    def test_asks_one_node_only_if_told_so(self, joint: Any) -> None:
        told, out, _ = output()
        assert scan(subject(joint, 1), told, listen_s=0.0) == 0
        assert "jointctl virtual joint" in out.getvalue()
        assert {identifier for identifier, _ in joint.requests} == {0x601}

    @pytest.mark.parametrize("active", [True, False])
    def test_beside_a_controller_its_heartbeat_is_explained(self, joint: Any, active: bool) -> None:
        told, _, err = output()
        with sent_every_10_ms("virtual", joint.channel, 0x80 if active else 0x7E5):
            assert scan(subject(joint, 1), told, listen_s=0.3) == 0
        assert ("may be the heartbeat of that controller" in err.getvalue()) is active

    def test_passive_sends_nothing_and_hears_heartbeats(self, joint: Any) -> None:
        def beat() -> None:
            with can.Bus(interface="virtual", channel=joint.channel) as bus:
                for _ in range(20):
                    bus.send(can.Message(arbitration_id=0x709, data=[4], is_extended_id=False))
                    time.sleep(0.02)

        thread = threading.Thread(target=beat)
        thread.start()
        told, out, _ = output(json=True)
        assert scan(subject(joint, None), told, listen_s=0.2, passive=True) == 0
        thread.join()
        (node,) = json.loads(out.getvalue())["nodes"]
        assert (node["node"], node["nmt_state"], node["answers_sdo"]) == (9, "stopped", False)
        assert {identifier for identifier, _ in joint.requests} == {0x709}

    def test_nobody_there(self, empty_bus: Any) -> None:
        with pytest.raises(NoDeviceError, match="no frame came, no node answered") as caught:
            scan(subject(empty_bus, 5), output()[0], listen_s=0.0)
        assert "bit rate" in caught.value.hint

    @pytest.mark.parametrize(
        ("message", "words"),
        [
            (can.Message(arbitration_id=0x123456, is_extended_id=True), "1 frames came .* but no CANopen node"),
            (can.Message(is_error_frame=True), "only error frames .*the bit rate is likely wrong"),
        ],
    )
    def test_what_is_likely_wrong(self, empty_bus: Any, message: can.Message, words: str) -> None:
        with can.Bus(interface="virtual", channel=empty_bus.channel) as bus:
            timer = threading.Timer(0.1, lambda: bus.send(message))
            timer.start()
            with pytest.raises(NoDeviceError, match=words):
                scan(subject(empty_bus, None), output()[0], listen_s=0.3, passive=True)
            timer.join()

    def test_an_answer_to_somebody_else_does_not_count(self) -> None:
        ear = Ear()
        ear.on_message_received(can.Message(arbitration_id=0x583, data=bytes(8), is_extended_id=False))
        assert ear.nodes() == {3}

        class Silent:
            def send_message(self, *_: Any) -> None:
                pass

        network: Any = Silent()
        assert node_scan.ask_everybody(network, ear, [3], sleep=lambda _: None) == set()


class TestInfo:
    def test_everything_by_name_and_nothing_written(self, joint: Any) -> None:
        told, out, _ = output(json=True)
        config = load_config(shipped_config("virtual"))
        assert info(subject(joint, eds=eds_path(config)), told) == 0
        found = json.loads(out.getvalue())
        assert found["identity"]["name"] == "jointctl virtual joint"
        assert found["state"]["drive_state"] == "switch on disabled"
        assert "cyclic synchronous torque (CST)" in found["state"]["supported_modes"]
        assert found["ratings"]["torque_constant_NmpA"] == pytest.approx(0.1)
        assert found["errors"]["error_code"] == "0000h, no error"
        limits = {row["object"]: row for row in found["limits"]}
        assert limits["6072"]["unit"] == "permille of rated torque"
        assert limits["6085"]["unit"] == "units of 6064 per s2, unless scaled"
        assert found["supervision"]["on_quick_stop"].startswith("2 quick stop ramp")
        (tpdo,) = [row for row in found["pdos"] if row["pdo"] == "TPDO2"]
        assert (tpdo["cob_id"], tpdo["enabled"], tpdo["transmission"]) == ("281h", False, "every SYNC")
        assert tpdo["objects"][1] == "6064 Position actual value (32 bit)"
        assert only_reads(joint)

    def test_what_positions_count_in_and_the_polarity(self) -> None:
        class Drive:
            @staticmethod
            def value(index: int, sub: int = 0) -> int | None:
                return {(0x6092, 1): 720_000, (0x6092, 2): 2, (0x607E, 0): 0xC0}.get((index, sub))

        reader: Any = Drive()
        found = ratings(reader)
        assert found["feed_constant"] == "720000 units of 6064 for 2 turns of the shaft"
        told, out, _ = output()
        told.result(info_table({"ratings": found}))
        assert re.search(r"polarity +C0h inverts positions, velocities", out.getvalue())

    def test_without_an_eds_the_standard_names_do(self, joint: Any) -> None:
        joint.device.objects.store(0x1016, 1, (126 << 16 | 200).to_bytes(4, "little"))
        told, out, _ = output()
        assert info(subject(joint), told) == 0
        assert re.search(r"watched heartbeats +node 126, 200 ms", out.getvalue())
        assert "Max torque" in out.getvalue()
        assert "6041 Statusword (16 bit)" in out.getvalue()

    def test_the_error_history(self, joint: Any) -> None:
        joint.stop()
        joint.device.device[0].inject_fault_code = 0x2310
        for _ in range(20):
            joint.now_ns += 1_000_000
            joint.device.advance(joint.now_ns)
        joint._ended.clear()
        joint._thread = threading.Thread(target=joint._run, daemon=True)
        joint._thread.start()
        with canopen_network(subject(joint)) as network:
            found = drive_info(SdoReader(network, 1, Objects()))
        assert found["state"]["drive_state"] == "fault"
        assert found["errors"]["error_code"] == "2310h, continuous overcurrent"
        assert found["errors"]["history"][0].startswith("2310h, continuous overcurrent")

    def test_a_silent_node(self, joint: Any) -> None:
        with pytest.raises(NoDeviceError, match="node 7 does not answer"):
            info(subject(joint, 7), output()[0])

    def test_no_node_is_named(self, joint: Any) -> None:
        with pytest.raises(ConfigurationError, match="which node"):
            info(subject(joint, None), output()[0])

    def test_an_absent_object_is_left_out(self, joint: Any) -> None:
        with canopen_network(subject(joint)) as network:
            reader = SdoReader(network, 1)
            assert reader.value(0x2345) is None
            refusal: Any = reader.upload(0x2345)
            assert refusal.absent
            assert "06020000h Object does not exist" in str(refusal)
            assert len(pdo_maps(reader)) == 8

    def test_a_pdo_beyond_the_fourth_is_shown_where_the_eds_lists_it(self) -> None:
        held = {(0x1404, 1): 0x205, (0x1404, 2): 1, (0x1604, 0): 1, (0x1604, 1): 0x60400010}
        reader: Any = SimpleNamespace(node=1, value=lambda index, sub=0: held.get((index, sub)))
        reader.objects = Objects(dict.fromkeys((0x1000, 0x1404, 0x1604)))  # type: ignore[arg-type]
        (found,) = pdo_maps(reader)
        assert (found.name, found.cob_id, found.enabled) == ("RPDO5", 0x205, True)
        reader.objects = Objects()
        assert pdo_maps(reader) == []

    @pytest.mark.parametrize("data", ["Müller".encode(), "Müller".encode("latin-1") + b"\0"])
    def test_a_name_beyond_ascii(self, data: bytes) -> None:
        assert Objects().value(0x1008, 0, data) == "Müller"


class TestMonitor:
    def test_listens_only(self, joint: Any) -> None:
        told, out, err = output(json=True)
        with sent_every_10_ms("virtual", joint.channel, 0x80):
            assert monitor(subject(joint), told, Selection(count=3, kinds=frozenset({"sync"}))) == 0
        lines = [json.loads(line) for line in out.getvalue().splitlines()]
        assert [line["kind"] for line in lines] == ["sync"] * 3
        assert {identifier for identifier, _ in joint.requests} == {0x80}
        assert "frames in" in err.getvalue()

    def test_asks_for_the_mapping_if_told_so(self, joint: Any) -> None:
        told, _, _ = output()
        assert monitor(subject(joint), told, Selection(duration_s=0.0), ask=True) == 0
        assert joint.requests
        assert only_reads(joint)

    def test_ends_in_time_on_a_silent_bus(self, empty_bus: Any) -> None:
        told, out, err = output()
        assert monitor(subject(empty_bus), told, Selection(duration_s=0.1)) == 0
        assert (out.getvalue(), "0 frames in 0.1 s" in err.getvalue()) == ("", True)

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [((("xyz",),), r"--cob-id \(=xyz\)"), (((), ("pdos",)), r"--kind \(=pdos\) must be one of nmt")],
    )
    def test_bad_filters(self, arguments: Any, words: str) -> None:
        with pytest.raises(ConfigurationError, match=words):
            selection_of(MonitorOptions(*arguments))

    def test_filters(self) -> None:
        chosen = selection_of(MonitorOptions(("0x181", "80h")))
        assert chosen.cob_ids == {0x181, 0x80}


class TestSubject:
    def test_flags_beat_the_environment(self) -> None:
        environ = {"CAN_INTERFACE": "socketcan", "CAN_CHANNEL": "can0", "CAN_BITRATE": "250000"}
        found = subject_of_flags(GivenPlace(), None, environ)
        assert (found.interface, found.channel, found.bitrate_bitps) == ("socketcan", "can0", 250_000)
        found = subject_of_flags(GivenPlace("slcan", "x", 500_000, node=3), None, environ)
        assert (found.interface, found.channel, found.bitrate_bitps, found.node) == ("slcan", "x", 500_000, 3)

    @pytest.mark.parametrize(("interface", "channel", "missing"), [(None, "x", "-i"), ("x", None, "-c")])
    def test_a_bus_must_be_named(self, interface: str | None, channel: str | None, missing: str) -> None:
        with pytest.raises(ConfigurationError, match=missing):
            subject_of_flags(GivenPlace(interface, channel), None, {})

    def test_a_serial_drive_has_no_bus(self) -> None:
        with pytest.raises(ConfigurationError, match=r"drive\.kind"):
            subject_of_config(load_config(shipped_config("elmo_serial")))


def test_the_types_of_the_standard_are_those_that_the_driver_measures_an_eds_by() -> None:
    """Two tables: what `monitor` and `info` can name without an EDS, and what the driver uses of a drive."""
    places = [(index, sub) for index in range(0x1000, 0x7000) for sub in range(9)]
    used = {place: kind for place in places if (kind := standard_type(*place)) is not None}
    found = {place: variable.data_type for place in used if (variable := standard_variable(*place)) is not None}
    assert found == used
    assert len(used) > 100
