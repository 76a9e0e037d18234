"""Cores are kept awake only while the block lasts; without the right, the refusal is told and nothing else happens."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from jointctl.tools.wake_up import cores_awake


def open_files() -> set[str]:
    return {
        os.readlink(f"/proc/self/fd/{fd}")
        for fd in os.listdir("/proc/self/fd")
        if os.path.exists(f"/proc/self/fd/{fd}")
    }


def test_zero_latency_is_asked_for_and_held(tmp_path: Path) -> None:
    device = tmp_path / "latency"
    device.touch()
    with cores_awake(device) as refused:
        assert refused == ""
        assert device.read_bytes() == b"\0\0\0\0"
        assert str(device) in open_files()
    assert str(device) not in open_files()


def test_it_is_given_back_when_the_block_fails(tmp_path: Path) -> None:
    device = tmp_path / "latency"
    device.touch()
    with pytest.raises(RuntimeError), cores_awake(device):
        raise RuntimeError
    assert str(device) not in open_files()


def test_a_refusal_is_told(tmp_path: Path) -> None:
    with cores_awake(tmp_path / "absent") as refused:
        assert refused == f"{tmp_path / 'absent'}: No such file or directory"
    with cores_awake(Path("/dev/full")) as refused:
        assert refused == "/dev/full: No space left on device"
