"""scan, info and monitor as a user starts them, on the virtual bus, beside a run that goes on undisturbed."""

from __future__ import annotations

import json
import signal
import time
from typing import Any

import pytest

from jointctl.firmware_py.states import AxisPhase


def lines(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


def test_a_run_goes_on_beside_monitor_info_and_scan(bench: Any) -> None:
    config = bench.with_joint(trajectory__duration_s=60.0)
    monitor = bench.start("monitor", config, "--json").saw("listening on")
    run = bench.start("run", config, "-y").saw("tracking")
    info = bench.run("info", config, "--json")
    assert info.code == 0, info
    state = json.loads(info.out)["state"]
    assert (state["drive_state"], state["mode_shown"][:3]) == ("operation enabled", "10 ")
    scan = bench.run("scan", "-i", "jointctl", "-c", bench.channel, "--json", "--listen", "0.3")
    assert scan.code == 0, scan
    found = json.loads(scan.out)
    assert found["controller_active"] is True
    assert {node["node"]: node["nmt_state"] for node in found["nodes"]}[1] == "operational"
    run.signal(signal.SIGINT)
    ended = run.finished()
    assert ended.code == 130, ended.err
    monitor.signal(signal.SIGINT)
    heard = monitor.finished(20.0)
    assert heard.code == 0, heard.err
    records = bench.log().records
    assert (records.fault == 0).all()
    assert (records.phase == AxisPhase.TRACKING).sum() > 1000
    traffic = lines(heard.out)
    kinds = {line["kind"] for line in traffic}
    assert {"nmt", "sync", "pdo", "sdo", "heartbeat"} <= kinds
    enabled = [line for line in traffic if line["kind"] == "pdo" and "operation enabled" in line["text"]]
    assert {"6041", "6064", "6077"} == set(enabled[-1]["values"])
    # info and scan have only read: the writes are those of commissioning and of the end, before and after SYNC
    syncs = [line["time_s"] for line in traffic if line["kind"] == "sync"]
    during = [line for line in traffic if line["kind"] == "sdo" and syncs[0] < line["time_s"] < syncs[-1]]
    assert during
    assert not [line for line in during if line["text"].startswith("> write")]


@pytest.mark.parametrize("verb", ["monitor", "scan"])
def test_ctrl_c_ends_cleanly(bench: Any, verb: str) -> None:
    bench.with_joint()
    options = ("--listen", "30") if verb == "scan" else ()
    started = bench.start(verb, "-i", "jointctl", "-c", bench.channel, *options).saw("listening on")
    time.sleep(0.2)
    started.signal(signal.SIGINT, group=True)
    ended = started.finished(10.0)
    assert ended.code == (0 if verb == "monitor" else 130), ended
    assert "Traceback" not in ended.err


def test_a_monitor_whose_bus_ends_says_so(bench: Any) -> None:
    joint = bench.joint_process(bench.config())
    monitor = bench.start("monitor", "-i", "jointctl", "-c", bench.channel).saw("listening on")
    joint.signal(signal.SIGTERM)
    monitor.finished(20.0).refused(4, "failed")
