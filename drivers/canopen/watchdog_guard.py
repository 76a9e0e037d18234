"""What stops the drive when this computer dies must stay as it was proven: read again while the loop runs.

Another program may write the drive's objects at any time.  Before the loop may enable, four are read back in NMT
operational: who is watched (1016:1), the RPDO's deadline (1400:5), the reaction (6007), the mode (6061); and again once
a second as long as the loop runs, which costs four SDO uploads.
"""

from __future__ import annotations

from collections.abc import Callable

from jointctl.drivers.canopen.pdo import COMMUNICATION_RPDO, EVENT_TIMER, LAST_PDO
from jointctl.drivers.canopen.sdo import ObjectAccess, SdoReads, object_name
from jointctl.drivers.errors import DeviceError

PERIOD_S = 1.0
MISSED = 3  # reads in a row without an answer, until it is an error before enabling and a warning afterwards
_HINT = "another program uses this drive: find it; the run is over, and the drive is off"


class WatchdogGuard:
    """`poll` it; a `DeviceError` ends the run."""

    def __init__(
        self, objects: ObjectAccess, reads: SdoReads, node: int, mode: int, refuse_others: Callable[[], None]
    ) -> None:
        """After commissioning has set what is to be kept, when the node is operational.

        `refuse_others` raises where another controller has sent a command, or has written what matters, since.
        """
        self._reads, self._node, self._refuse_others = reads, node, refuse_others
        self._changed = ""
        self._missed: dict[str, tuple[int, str]] = {}
        self._warned: set[str] = set()
        self._unread: set[str] = set()  # not yet read back in operational
        expected = {place: found for place, found in objects.verified().items() if is_kept(*place)}
        expected[0x6061, 0] = (mode, "modes of operation display")
        for (index, sub), (value, what) in expected.items():
            name = f"object {object_name(index, sub)} ({what})"
            data = objects.encoded(index, sub, value, what=what)
            self._unread.add(name)
            reads.add(index, sub, PERIOD_S, self._judge(name, data, value))

    def _judge(self, name: str, expected: bytes, value: int) -> Callable[[int, bytes | None, str], None]:
        def on_answer(_: int, data: bytes | None, problem: str) -> None:
            if data is None:
                self._missed[name] = self._missed.get(name, (0, ""))[0] + 1, problem
                return
            self._missed.pop(name, None)
            self._unread.discard(name)
            if data[: len(expected)] != expected:
                found = int.from_bytes(data[: len(expected)], "little")
                self._changed = self._changed or (
                    f"node {self._node}: {name} was changed to {found} ({found:X}h) by another program, {value} was set"
                )

        return on_answer

    @property
    def confirmed(self) -> bool:
        """Whether everything has been read back in NMT operational: before that nothing may be enabled."""
        return not self._unread

    def poll(self, *, may_ask: bool = True) -> list[str]:
        """What is to be warned of; `DeviceError` where something was changed, or cannot be read before enabling.

        Without `may_ask` it only listens, and takes the answers that come.
        """
        self._refuse_others()
        self._reads.poll(may_ask=may_ask)
        if self._changed:
            raise DeviceError(self._changed, _HINT)
        warnings = []
        for name, (count, problem) in self._missed.items():
            if count < MISSED:
                continue
            text = f"node {self._node}: {name} cannot be read any more: {problem}"
            if not self.confirmed:
                raise DeviceError(text, "without it nothing proves that the drive stops when this computer dies")
            if name not in self._warned:
                self._warned.add(name)
                warnings.append(text)
        return warnings


def is_kept(index: int, sub: int) -> bool:
    """Whether an object belongs to what stops the drive when it is left alone."""
    return (index, sub) in ((0x1016, 1), (0x6007, 0)) or (
        0 <= index - COMMUNICATION_RPDO <= LAST_PDO and sub == EVENT_TIMER
    )
