"""`jointctl` as its users start it: processes in a folder of their own, on a virtual bus of a name of its own."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import time
import uuid
from pathlib import Path
from typing import Any

import can
import canopen

from jointctl.tools.configuration.arm import SHIPPED_ARM, load_arm
from jointctl.tools.configuration.load import load_config
from jointctl.tools.recording.run_log_reader import read_run_log
from tests.configurations import written
from tests.python_process import Finished
from tests.real_time_joint import real_time_joint
from tests.started import Started


def processes_in(folder: Path) -> list[int]:
    """Process ids of all others whose working directory is there."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # ended in the meantime, or somebody else's
            if (entry / "cwd").readlink() == folder.resolve() and int(entry.name) != os.getpid():
                found.append(int(entry.name))
    return found


def client(channel: str) -> canopen.Network:
    """An independent CANopen client on a virtual bus."""
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.02
    network.connect(interface="jointctl", channel=channel)
    return network


class Bench:
    """A folder, a bus of its own name, and `jointctl` as a user types it there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.channel = f"test-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        self._started: list[Started] = []
        self._joints = contextlib.ExitStack()

    def config(self, name: str = "joint.toml", base: str = "virtual", **changes: Any) -> str:
        """A shipped configuration with a short trajectory and no way to its start; None removes a key."""
        short = {
            "bus__channel": self.channel, "trajectory__duration_s": 1.0, "virtual__initial_position_rad": 0.0,
            "log__picture": False,  # test_demo.py looks at one
            # a busy computer must not be the fault that is seen
            "limits__sample_age_max_s": 0.15, "limits__skipped_max_s": 0.15,
        }  # fmt: skip
        return written(self.folder / name, base, **{**short, **changes}).name

    def arm(self, **changes: Any) -> Path:
        """The shipped arm's files on this bus; `changes`: keys of any of them."""
        folder = self.folder / "arm"
        shutil.copytree(SHIPPED_ARM.parent, folder)
        values = {"channel": f'"{self.channel}"', "sample_age_max_s": 0.15, "skipped_max_s": 0.15, **changes}
        for path in folder.glob("*.toml"):
            text = path.read_text()
            for key, value in values.items():
                text = re.sub(rf"(?m)^{key} = \S+", f"{key} = {value}", text)
            path.write_text(text)
        return folder / "arm.toml"

    def start(self, *arguments: str, **options: Any) -> Started:
        self._started.append(Started(self.folder, arguments, **options))
        return self._started[-1]

    def run(self, *arguments: str, timeout_s: float = 180.0, **options: Any) -> Finished:
        return self.start(*arguments, **options).finished(timeout_s)

    def program(self, text: str) -> Started:
        """A program of the user's own, as a file in the folder."""
        script = self.folder / "program.py"
        script.write_text(text)
        return self.start(script=script)

    def joint(self, config: str) -> Any:
        """The virtual joint in this process, for tests that need one and no more."""
        return self._joints.enter_context(real_time_joint(load_config(self.folder / config)))

    def with_joint(self, name: str = "joint.toml", base: str = "virtual", **changes: Any) -> str:
        """A configuration as of `config`, and its virtual joint in this process."""
        config = self.config(name, base, **changes)
        self.joint(config)
        return config

    def arm_joints(self, path: Path) -> None:
        """Those of an arm, likewise."""
        self._joints.enter_context(real_time_joint(load_arm(path)))

    def joint_process(self, config: str) -> Started:
        """`jointctl hil`, ready for others."""
        return self.start("hil", config).saw("Ctrl-C ends it")

    def network(self) -> Any:
        return client(self.channel)

    def status_word(self, node: int = 1) -> int:
        """6041 as an independent client reads it; NMT first, since a stopped node answers no SDO.

        Where no answer comes, once more: some time after a loop has gone the watchdog puts the node into Stopped, which
        may be between the NMT command and the request.
        Not while a program of ours has the drive and no loop runs: it would take these frames for another controller's.
        """
        network = self.network()
        try:
            remote = network.add_node(node)
            remote.sdo.RESPONSE_TIMEOUT = 3.0  # the drive may wait for a processor that the files of tests share
            network.send_message(0, [128, node])
            with contextlib.suppress(canopen.SdoCommunicationError):
                return int.from_bytes(remote.sdo.upload(0x6041, 0), "little")
            network.send_message(0, [128, node])
            return int.from_bytes(remote.sdo.upload(0x6041, 0), "little")
        finally:
            network.disconnect()

    def disabled(self, node: int = 1) -> bool:
        """Switch On Disabled or Fault: the power stage is off."""
        return self.status_word(node) & 0x4F in (0x40, 0x08)

    def is_pre_operational(self, node: int = 1) -> bool:
        """By the drive's own heartbeat; nothing is sent."""
        with can.Bus(interface="jointctl", channel=self.channel) as bus:
            for _ in range(1000):
                message = bus.recv(1.0)
                assert message is not None
                if message.arbitration_id == 0x700 + node:
                    return bool(message.data[0] == 127)
        return False

    def log(self) -> Any:
        """The newest run log."""
        return read_run_log(max(self.folder.glob("runs/*.mcap"), key=lambda path: path.stat().st_mtime_ns))

    def end(self) -> None:
        """Nothing of it runs on: a loop whose supervisor is killed would go on for seconds, beside the next test."""
        with self._joints:
            for started in self._started:
                started.end()
            give_up_s = time.monotonic() + 10.0
            while left := processes_in(self.folder):
                for pid in left:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
                assert time.monotonic() < give_up_s, left
                time.sleep(0.01)
