"""The Foxglove server: `python -m jointctl.tools.scoping.foxglove_server`, started by --foxglove.

Joint states, events and every field of the log record as they stand in the log, gains as parameters, STOP as a service,
set-points as what a client publishes.  What a client sends is passed on and judged by
the supervisor; nothing here is trusted to keep it off, and what it sends that means nothing is refused by the library.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import replace

import foxglove
import numpy as np
from foxglove import Channel, Schema
from foxglove.websocket import (
    Capability,
    Client,
    ClientChannel,
    MessageSchema,
    Parameter,
    ParameterType,
    ServerListener,
    Service,
    ServiceRequest,
    ServiceSchema,
    StatusLevel,
    WebSocketServer,
)

from jointctl.tools.recording.ros_messages import CDR_HEADER, EVENT_TOPIC, JOINT_STATE_TOPIC, RECORD_TOPIC, Topic
from jointctl.tools.recording.run_log import Event
from jointctl.tools.scoping.remote import RemoteOrder
from jointctl.tools.scoping.supervisor_link import NOT_TAKEN, LiveView, WayBack, serve_order
from jointctl.tools.session.set_points import RemoteSetPoint

BACKLOG = 256  # messages for a client that does not read: 1 s of all topics
GAIN = "control."  # before the name of a gain
REFUSED = "set-point"  # id of the status that reports a refusal
REFUSED_S = 0.2  # between two reports
MOST_CLIENTS = 32  # in one report
CLOSED = "{} can be changed only where --allow-remote was given at the bench"
_KEYS = ("position_rad", "velocity_radps", "acceleration_radps2", "torque_Nm", "time_s")
_TRIGGER = "std_srvs/srv/Trigger"
_ANSWER = {"type": "object", "properties": {"success": {"type": "boolean"}, "message": {"type": "string"}}}


def client_name(number: int) -> str:
    """What a client is called in events and refusals."""
    return f"Foxglove client {number}"


def set_point_of(who: str, data: bytes) -> RemoteSetPoint:
    """Of a JSON object with the arguments of `Joint.command`, or `Arm.command`; `ValueError` tells what is wrong."""
    found = json.loads(data)
    if not isinstance(found, dict) or "position_rad" not in found:
        raise ValueError("it must be an object with position_rad")
    for key, value in found.items():
        if key not in _KEYS:
            raise ValueError(f"{str(key)[:40]!r} is none of {', '.join(_KEYS)}")
        listed = value if isinstance(value, list) and key != "time_s" else [value]
        if value is not None and not all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in listed):
            raise ValueError(f"{key} (={str(value)[:40]}) must be a number")
    values = {key: value for key, value in found.items() if value is not None}
    if "position_rad" not in values:
        raise ValueError("position_rad must be a number")
    return RemoteSetPoint(who, **values)


def _channel(topic: Topic) -> Channel:
    schema = Schema(name=topic.schema, encoding="ros2msg", data=topic.definition.encode())
    return Channel(topic.name, schema=schema, message_encoding="cdr")


def _json_schema(name: str, schema: Mapping[str, object]) -> MessageSchema:
    return MessageSchema(
        encoding="json", schema=Schema(name=name, encoding="jsonschema", data=json.dumps(schema).encode())
    )


class FoxgloveView(ServerListener):
    """See `Publisher`; and what clients may do."""

    def __init__(self, order: RemoteOrder) -> None:
        self._order = order
        self.view = LiveView(self, order.names)
        self.way = WayBack(order, self.view, self._refused)
        self._server: WebSocketServer | None = None
        self._topics: dict[tuple[int, int], ClientChannel] = {}
        self._shown: dict[str, float] = {}  # gains, as clients have them
        self._refusals: dict[str, str] = {}  # the newest of each client, not yet reported
        self._told_s, self._lock = 0.0, threading.Lock()
        self._states, self._events = _channel(JOINT_STATE_TOPIC), _channel(EVENT_TOPIC)
        alone = len(order.names) == 1
        topics = [replace(RECORD_TOPIC, name=RECORD_TOPIC.name + ("" if alone else f"/{name}")) for name in order.names]
        self._records = [] if order.only_states else [_channel(topic) for topic in topics]

    def start(self) -> None:
        order = self._order
        host, _, port = order.place.rpartition(":")
        capabilities, services = [Capability.Time], []
        if not order.only_states:
            capabilities.append(Capability.Services)
            if len(order.names) == 1:  # nobody changes the gains of an arm: the SDK says so to a client that tries
                capabilities.append(Capability.Parameters)
            schema = ServiceSchema(
                _TRIGGER,
                request=_json_schema(f"{_TRIGGER}_Request", {"type": "object"}),
                response=_json_schema(f"{_TRIGGER}_Response", _ANSWER),
            )
            services = [Service(f"/{order.joint}/stop", schema=schema, handler=self._stop)]
        if order.allow_remote:
            capabilities.append(Capability.ClientPublish)
        self._server = foxglove.start_server(
            name=f"jointctl {order.title}", host=host, port=int(port), capabilities=capabilities, services=services,
            server_listener=self, supported_encodings=["json"], message_backlog_size=BACKLOG,
        )  # fmt: skip

    # --- Publisher ---

    def states(self, records: np.ndarray, body: bytes, wall_ns: int) -> None:
        self._tell_refusals()
        self._states.log(body, log_time=wall_ns)
        for channel, record in zip(self._records, records, strict=False):  # none of them with joint states alone
            channel.log(CDR_HEADER + record.tobytes(), log_time=wall_ns)

    def event(self, event: Event, body: bytes, wall_ns: int) -> None:
        self._events.log(body, log_time=wall_ns)

    def settings(self) -> None:
        """See `Publisher`: gains that have changed go to the clients."""
        gains = self._gains()
        if gains != self._shown and self._server is not None:
            self._shown = gains
            self._server.publish_parameter_values(self._parameters())

    def _gains(self) -> dict[str, float]:
        return {name: float(now) for name, (_, now, _) in self.view.settings.get("gains", {}).items()}

    def _parameters(self) -> list[Parameter]:
        return [
            Parameter(f"{GAIN}{name}", value=value, type=ParameterType.Float64) for name, value in self._gains().items()
        ]

    # --- what clients ask for ---

    def _refused(self, who: str, words: str) -> None:
        self._report(who, f"set-point of {who} refused: {words}")

    def _report(self, who: str, text: str) -> None:
        """Every client gets to know, but no client can flood the others by what it is refused.

        The SDK's server cuts off a client that does not keep up, and its STOP with it.
        """
        with self._lock:
            if who in self._refusals or len(self._refusals) < MOST_CLIENTS:
                self._refusals[who] = text
        self._tell_refusals()

    def _tell_refusals(self) -> None:
        with self._lock:
            now_s = time.monotonic()
            if not self._refusals or now_s - self._told_s < REFUSED_S:
                return
            refusals, self._refusals, self._told_s = self._refusals, {}, now_s
        for text in refusals.values():
            if self._server is not None:
                self._server.publish_status(text, StatusLevel.Warning, REFUSED)

    def _stop(self, request: ServiceRequest) -> bytes:
        taken, words = self.way.stop(client_name(request.client_id))
        return json.dumps({"success": taken, "message": words}).encode()

    def on_get_parameters(
        self, client: Client, param_names: list[str], request_id: str | None = None
    ) -> list[Parameter]:
        """Gains in force."""
        return [found for found in self._parameters() if not param_names or found.name in param_names]

    def on_set_parameters(
        self, client: Client, parameters: list[Parameter], request_id: str | None = None
    ) -> list[Parameter]:
        """New gains go to the supervisor's gate; what is returned is in force until the loop has taken them."""
        given = {found.name.removeprefix(GAIN): found.get_value() for found in parameters}
        if not self._order.allow_remote:
            self._report(client_name(client.id), CLOSED.format("gains"))
        elif not self.way.ask("gains", client_name(client.id), given):
            self._report(client_name(client.id), f"gains {NOT_TAKEN}")
        return [found for found in self._parameters() if found.name.removeprefix(GAIN) in given]

    def on_client_advertise(self, client: Client, channel: ClientChannel) -> None:
        self._topics[client.id, channel.id] = channel
        if channel.topic != self._command_topic or channel.encoding != "json":
            who = client_name(client.id)
            self._report(who, f"{who}: {channel.topic[:80]} ({channel.encoding[:20]}) means nothing here; "
                         f"set-points are JSON on {self._command_topic}")  # fmt: skip

    def on_client_unadvertise(self, client: Client, client_channel_id: int) -> None:
        self._topics.pop((client.id, client_channel_id), None)

    @property
    def _command_topic(self) -> str:
        return f"/{self._order.joint}/command"

    def on_message_data(self, client: Client, client_channel_id: int, data: bytes) -> None:
        channel, who = self._topics.get((client.id, client_channel_id)), client_name(client.id)
        if channel is None or channel.topic != self._command_topic or channel.encoding != "json":
            return
        try:
            point = set_point_of(who, data)
        except (ValueError, RecursionError) as error:
            self._refused(who, f"not understood: {str(error)[:200]}")
            return
        self.way.set_point(point)


def serve(order: RemoteOrder) -> None:
    """Until the run ends."""
    foxglove.set_log_level("CRITICAL")  # what a client does wrong is no news of the run
    view = FoxgloveView(order)
    view.start()
    view.way.ready()
    view.way.run()


if __name__ == "__main__":
    sys.exit(serve_order(serve))
