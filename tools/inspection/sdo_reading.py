"""Reading objects of a node over SDO with the `canopen` library.  Nothing is ever written.

A node has one SDO channel for every master: reading beside a run works, because the run itself uses it only before
and after its motion, and for a temperature only when it is quiet.  An answer that got mixed up is asked for again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import canopen
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from jointctl.drivers.errors import NoDeviceError
from jointctl.tools.inspection.objects import Objects, Place

TIMEOUT_S = 0.3
ATTEMPTS = 2
new_dictionary: Any = canopen.ObjectDictionary
NO_OBJECT = (0x06020000, 0x06090011)  # object, sub-index do not exist


def abort_text(code: int) -> str:
    """`06020000h Object does not exist`."""
    return f"{code:08X}h {SdoAbortedError.CODES.get(code, 'not in the standard')}"


@dataclass(frozen=True)
class Refusal:
    """The node answered with an abort, or not at all (`code` None)."""

    code: int | None

    def __str__(self) -> str:
        return "no answer" if self.code is None else abort_text(self.code)

    @property
    def absent(self) -> bool:
        """The node says that it has no such object."""
        return self.code in NO_OBJECT


class SdoReader:
    """Objects of one node."""

    def __init__(
        self, network: canopen.Network, node: int, objects: Objects | None = None, timeout_s: float = TIMEOUT_S
    ) -> None:
        self.objects = Objects() if objects is None else objects
        self.node = node
        dictionary = self.objects.dictionary
        self.remote = network.add_node(node, new_dictionary() if dictionary is None else dictionary)
        self.remote.sdo.RESPONSE_TIMEOUT = timeout_s

    def upload(self, index: int, sub: int = 0) -> bytes | Refusal:
        """The bytes of an object."""
        for _ in range(ATTEMPTS):
            try:
                return bytes(self.remote.sdo.upload(index, sub))
            except SdoAbortedError as error:
                return Refusal(error.code)
            except SdoCommunicationError:
                continue
        return Refusal(None)

    def value(self, index: int, sub: int = 0) -> Any:
        """The value of an object; None where the node has none to give."""
        data = self.upload(index, sub)
        return None if isinstance(data, Refusal) else self.objects.value(index, sub, data)

    def text(self, index: int, sub: int = 0) -> str | None:
        """The value in words; None where the node has none to give."""
        data = self.upload(index, sub)
        return None if isinstance(data, Refusal) else self.objects.text(index, sub, data)

    def require_answer(self) -> int:
        """The device type; `NoDeviceError` if the node is silent."""
        data = self.upload(0x1000)
        if isinstance(data, Refusal) and data.code is None:
            raise NoDeviceError(
                f"node {self.node} does not answer at {Place(0x1000)} (device type)",
                "`jointctl scan` shows who does; a node in NMT state stopped answers no SDO",
            )
        return 0 if isinstance(data, Refusal) else int.from_bytes(data, "little")
