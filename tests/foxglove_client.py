"""A client of the Foxglove WebSocket protocol, written from its specification with `websockets`; nothing of the SDK."""

from __future__ import annotations

import base64
import json
import struct
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Self

import websockets.sync.client as websockets

SUBPROTOCOL = "foxglove.sdk.v1"
MESSAGE, TIME, RESPONSE = 1, 2, 3  # first byte of what the server sends in binary
PUBLISH, CALL = 1, 2  # and of what a client does


class FoxgloveClient:
    """Everything that has been announced is kept; messages are given out in order."""

    def __init__(self, port: int, timeout_s: float = 20.0) -> None:
        give_up_s = time.monotonic() + timeout_s
        self._stack = ExitStack()
        while True:
            try:
                connection = websockets.connect(
                    f"ws://127.0.0.1:{port}", subprotocols=[websockets.Subprotocol(SUBPROTOCOL)], max_size=None
                )
                self.socket = self._stack.enter_context(connection)
                break
            except OSError:
                assert time.monotonic() < give_up_s
                time.sleep(0.05)
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        self.services: dict[str, dict[str, Any]] = {}
        self.parameters: dict[str, float] = {}
        self.statuses: list[str] = []
        self.messages: deque[tuple[str, int, bytes]] = deque()  # topic, time, body
        self.responses: dict[int, dict[str, Any]] = {}
        self._subscribed: dict[int, str] = {}
        self._calls = 0
        self.until(lambda: self.info)

    def _take(self, timeout_s: float) -> None:
        try:
            found = self.socket.recv(timeout_s)
        except TimeoutError:
            return
        if isinstance(found, bytes):
            self._take_binary(found)
            return
        message = json.loads(found)
        match message["op"]:
            case "serverInfo":
                self.info = message
            case "advertise":
                self.channels |= {channel["topic"]: channel for channel in message["channels"]}
            case "advertiseServices":
                self.services |= {service["name"]: service for service in message["services"]}
            case "parameterValues":
                self.parameters |= {found["name"]: found["value"] for found in message["parameters"]}
            case "status":
                self.statuses.append(message["message"])
            case "serviceCallFailure":
                self.responses[message["callId"]] = message

    def _take_binary(self, data: bytes) -> None:
        if data[0] == MESSAGE:
            subscription, time_ns = struct.unpack_from("<IQ", data, 1)
            self.messages.append((self._subscribed[subscription], time_ns, data[13:]))
        elif data[0] == RESPONSE:
            _, call, length = struct.unpack_from("<III", data, 1)
            self.responses[call] = json.loads(data[13 + length :])

    def until(self, done: Callable[[], object], timeout_s: float = 30.0) -> Self:
        """Take messages until it is so."""
        give_up_s = time.monotonic() + timeout_s
        while not done():
            assert time.monotonic() < give_up_s, (self.statuses, self.parameters)
            self._take(0.1)
        return self

    def say(self, **message: Any) -> None:
        self.socket.send(json.dumps(message))

    def subscribe(self, *topics: str) -> Self:
        self.until(lambda: all(topic in self.channels for topic in topics))
        for topic in topics:
            number = len(self._subscribed) + 1
            self._subscribed[number] = topic
            self.say(op="subscribe", subscriptions=[{"id": number, "channelId": self.channels[topic]["id"]}])
        return self

    def definition(self, topic: str) -> tuple[str, str]:
        """Name and text of the schema of a topic."""
        channel = self.channels[topic]
        assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
        text = channel["schema"]
        return channel["schemaName"], text if "\n" in text else base64.b64decode(text).decode()

    def newest(self, topic: str) -> bytes:
        """The next message of a topic."""
        self.messages.clear()
        self.until(lambda: any(found[0] == topic for found in self.messages))
        return [body for name, _, body in self.messages if name == topic][-1]

    def call(self, name: str) -> dict[str, Any]:
        """The answer of a service without arguments."""
        self.until(lambda: name in self.services)
        self._calls += 1
        head = struct.pack("<BIII", CALL, self.services[name]["id"], self._calls, 4)
        self.socket.send(head + b"json" + b"{}")
        return self.until(lambda: self._calls in self.responses).responses[self._calls]

    def get_parameters(self) -> dict[str, float]:
        self.say(op="getParameters", parameterNames=[], id="all")
        return self.until(lambda: self.parameters).parameters

    def set_parameter(self, name: str, value: Any) -> None:
        self.say(op="setParameters", parameters=[{"name": name, "value": value, "type": "float64"}], id="set")

    def advertise(self, topic: str, encoding: str = "json", number: int = 1) -> None:
        channel = {"id": number, "topic": topic, "encoding": encoding, "schemaName": ""}
        self.say(op="advertise", channels=[channel])

    def publish(self, body: bytes | dict[str, Any], number: int = 1) -> None:
        data = json.dumps(body).encode() if isinstance(body, dict) else body
        self.socket.send(struct.pack("<BI", PUBLISH, number) + data)

    def close(self) -> None:
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
