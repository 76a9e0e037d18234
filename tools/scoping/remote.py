"""Foxglove and ROS 2 beside a run, the supervisor's end: the processes that serve them, and what these may do.

Each is fed as the page is (`ScopeFeed`), by a server in a process of its own.  STOP always comes through; gains, enable
and set-points only with --allow-remote.  Set-points have a socket and a thread of their own, so that they are not
older than they need be when they come into the loop's ring.
"""

from __future__ import annotations

import contextlib
import json
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from jointctl.drivers.drive import Approval, CommissioningReport
from jointctl.drivers.errors import DataError, JointctlError
from jointctl.firmware_py.states import StopRequest
from jointctl.tools.configuration.config import Config
from jointctl.tools.output import Output
from jointctl.tools.recording.ros_messages import JOINT_NAMES
from jointctl.tools.scoping.feed import ScopeFeed, in_time, now_s, require_free, server_process
from jointctl.tools.scoping.remote_options import LISTEN_AT, ObserveOptions, RemoteOptions, check_remote, foxglove_place
from jointctl.tools.session.display import LONGEST_BYTES, Display, Displays, decoded
from jointctl.tools.session.plan import Consent
from jointctl.tools.session.result import run_title
from jointctl.tools.session.set_points import RemoteSetPoint, SetPointSources

if TYPE_CHECKING:
    from jointctl.tools.configuration.arm import ArmConfig

APPROVED_S = 300.0  # how long an approval at the terminal waits for the enable that it is for
POLL_S = 0.05
TELL_AGAIN_S = 1.0
READY = "ready"  # what a server says first
READY_S = 60.0  # how long it may take to load, on a busy computer


@dataclass(frozen=True)
class _Kind:
    """A kind of server, and what it may ask for where --allow-remote is given."""

    name: str
    module: str
    package: str  # that it needs
    extra: str  # that brings it
    takes: frozenset[str]
    states_s: float  # between two messages to it: seldom for eyes, often for other programs


FOXGLOVE = _Kind("Foxglove", "foxglove_server", "foxglove", "foxglove", frozenset({"gains"}), 0.1)
ROS2 = _Kind("ROS 2", "ros2_server", "zenoh", "ros2", frozenset({"enable"}), 0.05)


@dataclass(frozen=True)
class RemoteOrder:
    """Launch arguments of a server."""

    title: str
    joint: str  # the name of the node, and of its topics and services
    names: tuple[str, ...]  # of the joints in the joint states
    drive: str  # drive.kind
    place: str  # HOST:PORT, or a zenoh endpoint
    domain: int = 0
    allow_remote: bool = False
    only_states: bool = False  # there is no loop: joint states are all there is
    loop_cpu: int | None = None  # loop.cpu
    feed_fd: int = -1
    set_points_fd: int = -1


def joint_name(path: Path) -> str:
    """The name of the configuration, as ROS 2 allows it for a node."""
    name = re.sub(r"\W+", "_", path.stem, flags=re.ASCII).strip("_")
    return re.sub(r"__+", "_", name if name[:1].isalpha() else f"joint_{name}".rstrip("_"))


class Remote:
    """What is served beside a run, for the one who makes its session: displays, set-point sources, and the consent."""

    def __init__(
        self, feeds: Sequence[ScopeFeed], enabling: ScopeFeed | None, set_points: SetPointSources | None
    ) -> None:
        self.feeds, self._enabling, self.set_points = feeds, enabling, set_points

    def beside(self, display: Callable[[CommissioningReport], Display]) -> Callable[[CommissioningReport], Display]:
        return (lambda report: Displays([display(report), *self.feeds])) if self.feeds else display

    def consent(self, consent: Consent, output: Output) -> Consent:
        """With set-points from ROS 2 the terminal approves, and `~/enable` enables."""
        return consent if self._enabling is None else EnabledFromElsewhere(consent, self._enabling, output)


class EnabledFromElsewhere:
    """`Consent` of two: the user at the terminal, then one call of `~/enable` for it."""

    def __init__(self, consent: Consent, feed: ScopeFeed, output: Output) -> None:
        self._consent, self._feed, self._output = consent, feed, output

    @property
    def dry_run(self) -> bool:
        return self._consent.dry_run

    @property
    def brake(self) -> Approval | None:
        """See `Consent`: for the terminal alone."""
        return self._consent.brake

    def show(self, lines: Sequence[str]) -> None:
        self._consent.show(lines)

    def agreed(self, lines: Sequence[str]) -> bool:
        """See `Consent`; an enable that came before the approval is for nothing."""
        if not self._consent.agreed(lines):
            return False
        # a STOP that came before the approval still counts, an enable does not: it has not this number
        feed, number = self._feed, secrets.randbelow(1 << 48)
        self._output.note(f"approved; waiting up to {APPROVED_S:g} s for ~/enable, Ctrl-C ends it")
        told_s, give_up_s = -TELL_AGAIN_S, now_s() + APPROVED_S
        while feed.stop_request() is StopRequest.NONE and now_s() < give_up_s:
            for request in feed.requests():
                if request.kind == "enable" and request.values.get("number") == number:
                    if not in_time(request):
                        self._output.note(f"~/enable of {request.who} came late and was not taken")
                        continue
                    self._output.note(f"enabled by {request.who}")
                    feed.settings({"stage": "enabled"})
                    return True
            if feed.gone:
                raise JointctlError("the ROS 2 server has ended: nothing can enable the joint", "what it said is above")
            if now_s() - told_s > TELL_AGAIN_S:
                told_s = now_s()
                feed.settings({"stage": "approved", "number": number, "told_s": told_s})
            time.sleep(POLL_S)
        feed.settings({"stage": "declined"})
        return False


class _Channel(threading.Thread):
    """Set-points of one server, to the sources of the run; refusals go back."""

    def __init__(self, end: socket.socket, sources: SetPointSources) -> None:
        super().__init__(name="set-points", daemon=True)
        self._end, self._sources = end, sources

    def run(self) -> None:
        """Until the server ends, or the run."""
        with contextlib.suppress(OSError):
            while message := self._end.recv(LONGEST_BYTES):
                try:
                    point = RemoteSetPoint(**json.loads(message))
                except (ValueError, TypeError):
                    continue
                if words := self._sources.take(point):
                    with contextlib.suppress(BlockingIOError):
                        self._end.send(json.dumps([point.who, words]).encode(), socket.MSG_DONTWAIT)


@contextmanager
def _served(kind: _Kind, order: RemoteOrder, sources: SetPointSources | None) -> Iterator[ScopeFeed]:
    feed, feeds_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    points, points_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    order = replace(order, feed_fd=feeds_end.fileno(), set_points_fd=points_end.fileno())
    takes = kind.takes if order.allow_remote else frozenset()
    with server_process(f"jointctl.tools.scoping.{kind.module}", order, [feeds_end, points_end], [feed, points]):
        _wait_ready(kind, feed)
        _Channel(points, sources or SetPointSources("no one: --allow-remote was not given")).start()
        yield ScopeFeed(feed, server=kind.name, takes=takes, states_s=kind.states_s)


def _wait_ready(kind: _Kind, feed: socket.socket) -> None:
    feed.settimeout(READY_S)
    try:
        word = decoded(feed.recv(LONGEST_BYTES))
    except OSError:
        word = None
    if word is None or word.kind != READY:
        raise DataError(f"{kind.name} cannot be served", "what its server said is above")


def require_package(kind: _Kind) -> None:
    """`DataError` where the extra is not installed."""
    if find_spec(kind.package) is None:
        raise DataError(
            f"{kind.name} needs the package {kind.package}, which is not installed", f"install the extra `{kind.extra}`"
        )


@contextmanager
def remote(
    options: ObserveOptions, config: Config | ArmConfig, output: Output, *,
    owner: str = "", motion: str = "", only_states: bool = False,
) -> Iterator[Remote]:  # fmt: skip
    """Serve what the options ask for.  `owner`: the program that the set-points of this run come from.  `motion`: what
    moves, where it is not the configured trajectory.

    `UsageError` for options that do not go together, `DataError` where a server cannot be had.
    """
    check_remote(options)
    allow = isinstance(options, RemoteOptions) and options.allow_remote
    sources = SetPointSources(owner) if allow else None
    first, names = (config, JOINT_NAMES) if isinstance(config, Config) else (config.joints[0], config.names)
    order = RemoteOrder(
        run_title(config, motion), joint_name(config.path), names,
        first.drive.kind, "", allow_remote=allow,
        only_states=only_states, loop_cpu=first.loop.cpu,
    )  # fmt: skip
    with ExitStack() as stack:
        feeds: list[ScopeFeed] = []
        enabling: ScopeFeed | None = None
        if options.foxglove is not None:
            require_package(FOXGLOVE)
            host, port = foxglove_place(options.foxglove)
            require_free("Foxglove", host, port, "choose another port behind --foxglove")
            place = replace(order, place=f"{host}:{port}")
            feeds.append(stack.enter_context(_served(FOXGLOVE, place, sources)))
            output.address(f"Foxglove: ws://{f'[{host}]' if ':' in host else host}:{port}")
        if options.ros2 is not None:
            require_package(ROS2)
            place = replace(order, place=options.ros2_listen or LISTEN_AT, domain=options.ros2)
            feeds.append(stack.enter_context(_served(ROS2, place, sources)))
            output.address(f"ROS 2: node /{order.joint} in domain {options.ros2}, zenoh listens on {place.place}")
            enabling = feeds[-1] if allow and not owner else None
        yield Remote(feeds, enabling, sources)
