"""What another controller sends is noticed, before anything is sent to the drive and until the end of a run."""

from __future__ import annotations

import struct
from typing import cast

import can
import pytest

from jointctl.drivers.can import open as open_module
from jointctl.drivers.can.virtual_bus import VirtualBus
from jointctl.drivers.canopen.drive import CanopenDrive
from jointctl.drivers.canopen.network import (
    FAILURE_PAUSE_S,
    LISTEN_S,
    BusFailure,
    OtherControllers,
    new_network,
    receive_beside_loop,
)
from jointctl.drivers.errors import BusError
from jointctl.hil.virtual_bus import VirtualBusHub
from jointctl.tools.configuration.drive_section import GivenPlace
from jointctl.tools.configuration.load import load_config, moved
from jointctl.tools.session.canopen_drive import CanopenSession
from tests.places import CONFIGS

NODE, MASTER = 5, 126


def listening(own_loop: bool = False) -> OtherControllers:
    others = OtherControllers([NODE, 9], MASTER, lambda: 0.0)
    if own_loop:
        others.own_loop_begins()
    return others


def heard(others: OtherControllers, identifier: int, data: bytes | None = b"") -> str:
    """`data` None: a remote request."""
    others.on_message_received(
        can.Message(arbitration_id=identifier, data=data, is_remote_frame=data is None, is_extended_id=False)
    )
    return others.found()


CONTROLLER = [
    (0x080, b"", "1 x SYNC (080h)"),
    (0x000, bytes([128, NODE]), "1 x NMT 'enter pre operational' to node 5"),
    (0x000, bytes([1, 0]), "1 x NMT 'start' to all nodes"),
    (0x000, bytes([77, 9]), "1 x NMT 'unknown' to node 9"),
    (0x600 + NODE, bytes(8), "1 x SDO request to node 5 (605h)"),
    (0x200 + NODE, bytes(4), "1 x RPDO to node 5 (205h)"),
    (0x500 + 9, bytes(4), "1 x RPDO to node 9 (509h)"),
    (0x700 + MASTER, b"\x05", "1 x heartbeat of node 126, which is our own (drive.master_node)"),
    (0x700 + NODE, None, "1 x node guarding of node 5 (705h)"),
    (0x700 + 9, None, "1 x node guarding of node 9 (709h)"),
    (0x180 + NODE, None, "1 x remote request for a TPDO of node 5 (185h)"),
    (0x480 + NODE, None, "1 x remote request for a TPDO of node 5 (485h)"),
]


@pytest.mark.parametrize(("identifier", "data", "words"), CONTROLLER)
def test_what_only_a_controller_sends_refuses_the_run(identifier: int, data: bytes | None, words: str) -> None:
    others = listening()
    assert heard(others, identifier, data) == words
    with pytest.raises(BusError, match="another controller is active on this bus"):
        others.refuse()


@pytest.mark.parametrize(
    ("identifier", "data"),
    [
        (0x580 + NODE, bytes(8)), (0x180 + NODE, bytes(8)), (0x080 + NODE, bytes(8)), (0x700 + NODE, b"\x05"),
        (0x000, bytes([1, 7])), (0x000, b"\x01"), (0x600 + 7, bytes(8)), (0x200 + 7, bytes(8)), (0x100, bytes(6)),
    ],
)  # fmt: skip
def test_its_twins_are_the_drives_own_and_those_of_other_nodes(identifier: int, data: bytes) -> None:
    others = listening()
    assert heard(others, identifier, data) == ""
    others.refuse()


def answered(requests: int, *values: int) -> None:
    """Our requests for a serial number, and then the answers of node 5 to them."""
    others = listening()
    for _ in range(requests):
        others.sent(0x600 + NODE, struct.pack("<BHB4x", 0x40, 0x1018, 4))
    for value in values:
        heard(others, 0x580 + NODE, struct.pack("<BHBI", 0x43, 0x1018, 4, value))
    others.refuse()


def test_two_devices_that_answer_as_one_node_refuse_the_run() -> None:
    with pytest.raises(BusError, match="two devices answer as node 5: both would take the commands of one"):
        answered(1, 17, 18)


@pytest.mark.parametrize(
    ("requests", "values"), [(1, (17, 17)), (2, (17, 18))], ids=["repeated by the wire", "changed"]
)
def test_its_twins_one_device_answers_each_request_once(requests: int, values: tuple[int, ...]) -> None:
    answered(requests, *values)


@pytest.mark.parametrize("kind", ["is_extended_id", "is_error_frame"])
def test_frames_with_long_identifiers_and_those_of_errors_are_no_ones_command(kind: str) -> None:
    others = listening()
    others.on_message_received(can.Message(arbitration_id=0x080, **{"is_extended_id": False, kind: True}))
    assert others.found() == ""


@pytest.mark.parametrize("identifier", [0x700 + 7, 0x180 + 7, 0x580 + NODE, 0x700])
def test_its_twin_who_asks_other_nodes_has_not_this_drive(identifier: int) -> None:
    others = listening()
    assert heard(others, identifier, None) == ""
    assert others.heartbeats == set()  # it is not node 7 that has sent it


def test_heartbeats_of_other_nodes_are_kept_as_such() -> None:
    others = listening()
    for node in (7, 3, 7, 1, 127, NODE):
        assert heard(others, 0x700 + node, b"\x05") == ""
    for identifier in (0x700, 0x780):  # of no node
        assert heard(others, identifier, b"\x05") == ""
    assert others.heartbeats == {1, 3, 7, 127}


@pytest.mark.parametrize(
    ("identifier", "data", "words"),
    [
        (0x000, bytes([2, NODE]), "1 x NMT 'stop' to node 5"),
        (0x600 + NODE, b"\x23\x16\x10\x01\0\0\0\0", "1 x SDO request to node 5 that writes object 1016"),
        (0x600 + NODE, b"\x2b\x40\x60\x00\x0f\0\0\0", "1 x SDO request to node 5 that writes object 6040"),
        (0x600 + NODE, b"\xc2\x00\x14\x05\0\0\0\0", "1 x SDO request to node 5 that writes object 1400"),
        (0x600 + NODE, b"\x23\x16\x10\x01", "1 x SDO request to node 5 that writes object 1016"),
        (0x600 + NODE, b"\x23\x16\x10", ""),  # too short to write anything
        (0x600 + 7, b"\x23\x16\x10\x01\0\0\0\0", ""),  # to another drive
        (0x600 + NODE, b"\x2b\x72\x60\x00\x0f\0\0\0", ""),  # 6072: it does not decide whether there is power
        (0x600 + NODE, b"\x40\x16\x10\x01\0\0\0\0", ""),  # a reading
        (0x080, b"", ""), (0x200 + NODE, bytes(4), ""), (0x700 + MASTER, b"\x05", ""),  # our own loop sends them
    ],
)  # fmt: skip
def test_beside_our_own_loop_commands_and_writes_that_matter_count(identifier: int, data: bytes, words: str) -> None:
    assert heard(listening(own_loop=True), identifier, data) == words


def test_rpdos_by_the_drives_own_word_count_from_the_beginning_and_once() -> None:
    others = listening()
    for _ in range(3):
        assert heard(others, 0x333, bytes(8)) == ""
    known = heard(others, 0x200 + NODE, bytes(4))
    assert known == "1 x RPDO to node 5 (205h)"
    others.add_rpdos([0x333, 0x334, 0x200 + NODE])
    assert others.found() == f"3 x RPDO of the drive (333h), {known}"
    heard(others, 0x334, bytes(8))
    assert "1 x RPDO of the drive (334h)" in others.found()


def test_four_kinds_of_frames_are_named_and_the_others_counted() -> None:
    others = listening()
    for identifier in (0x080, 0x080, 0x205, 0x305, 0x405, 0x505, 0x605):
        heard(others, identifier, bytes(8))
    found = others.found()
    assert found.startswith("2 x SYNC (080h), 1 x ")
    assert found.endswith(" and 2 other kinds")
    assert found.count(" x ") == 4


def test_a_bus_that_fails_is_left_alone_for_a_moment() -> None:
    pauses_s: list[float] = []
    BusFailure(pauses_s.append).on_error(can.CanOperationError("dead"))
    assert pauses_s == [FAILURE_PAUSE_S]


@pytest.mark.parametrize(("passed_s", "left_s"), [(0.0, LISTEN_S), (0.4, LISTEN_S - 0.4), (LISTEN_S, 0.0), (9.0, 0.0)])
def test_it_listens_for_a_second_from_its_making_on(passed_s: float, left_s: float) -> None:
    now = [100.0]
    others = OtherControllers([NODE], MASTER, lambda: now[0])
    now[0] += passed_s
    assert others.to_listen_s == pytest.approx(left_s)


def test_on_a_bus_of_its_own_it_waits_for_nothing_and_still_hears_another() -> None:
    others = OtherControllers([NODE], MASTER, lambda: 0.0, private=True)
    assert others.to_listen_s == 0.0
    others.refuse()
    others.on_message_received(can.Message(arbitration_id=0x080, is_extended_id=False))
    with pytest.raises(BusError, match="another controller is active on this bus: 1 x SYNC"):
        others.refuse()


def test_beside_our_own_loop_no_sync_and_no_pdo_is_handed_over(tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("b") / "bus.sock"
    heard = can.BufferedReader()
    with VirtualBusHub(path), VirtualBus(str(path)) as other:
        network = new_network(VirtualBus(str(path)), lambda _: None, heard)
        network.connect()
        receive_beside_loop(network, [NODE, 9])
        for identifier in [*range(0x800), 0]:
            other.send(can.Message(arbitration_id=identifier, is_extended_id=False), timeout=10.0)
        came: list[int] = []
        while came.count(0) < 2:
            message = heard.get_message(10.0)
            assert message is not None
            came.append(message.arbitration_id)
        network.disconnect()
    assert came == [0, 0x080 + NODE, 0x080 + 9, *range(0x580, 0x680), *range(0x700, 0x780), 0]


@pytest.mark.parametrize(("interface", "waits_s"), [("jointctl", 0.0), ("socketcan", LISTEN_S), ("virtual", LISTEN_S)])
@pytest.mark.parametrize("private", [True, False])
def test_a_bus_of_metal_is_listened_to_whatever_a_session_takes_it_for(
    monkeypatch: pytest.MonkeyPatch, interface: str, waits_s: float, private: bool
) -> None:
    config = moved(load_config(CONFIGS / "virtual.toml"), GivenPlace(interface, "here"), {})
    monkeypatch.setattr(open_module, "open_python_can", lambda *_: can.Bus("here", interface="virtual"))
    drive = cast(CanopenDrive, CanopenSession().open(config, private=private))
    try:
        assert drive._others._wanted_s == (waits_s if private else LISTEN_S)
    finally:
        drive.close()


@pytest.mark.parametrize("echoes", [True, False])
def test_our_own_frames_are_not_anothers_where_the_interface_hands_them_back(echoes: bool) -> None:
    others = listening()
    request = 0x600 + NODE, b"\x40\x00\x10\x00\0\0\0\0"
    for _ in range(3):
        others.sent(*request)
        if echoes:
            assert heard(others, *request) == ""
        heard(others, 0x580 + NODE, bytes(8))
    assert (
        heard(others, *request) == "1 x SDO request to node 5 (605h)"
    )  # the twin: the same frame once more is another's
