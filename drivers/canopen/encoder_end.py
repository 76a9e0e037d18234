"""The joint's encoder node as the drive's driver sees it; where there is none, every method does nothing."""

from __future__ import annotations

import canopen

from jointctl.drivers.canopen.eds import read_eds
from jointctl.drivers.canopen.encoder_node import EncoderFindings, commission_encoder, require_no_alarm
from jointctl.drivers.canopen.identifiers import NmtCommand
from jointctl.drivers.canopen.network import send_nmt
from jointctl.drivers.canopen.sdo import ObjectAccess
from jointctl.drivers.canopen.settings import CanopenSettings


class EncoderEnd:
    """One encoder node (CiA 406), or none.  `ConfigurationError` if its EDS cannot be read."""

    def __init__(self, network: canopen.Network, settings: CanopenSettings, timeout_s: float) -> None:
        encoder = settings.joint_encoder
        self._network, self._settings = network, settings
        self._node = encoder.node if encoder is not None else None
        self._objects: ObjectAccess | None = None
        self._eds_remarks: list[str] = []
        if encoder is not None and encoder.node is not None and encoder.eds_path is not None:
            eds = read_eds(encoder.eds_path, encoder.node, encoder=True)
            node = network.add_node(encoder.node, eds.dictionary)
            node.sdo.RESPONSE_TIMEOUT = timeout_s
            self._eds_remarks = eds.all_remarks()
            self._objects = ObjectAccess(node, eds.name, eds.unusable)

    def tell(self, command: NmtCommand) -> None:
        """An NMT command."""
        if self._node is not None:
            send_nmt(self._network, command, self._node)

    def commission(self) -> tuple[EncoderFindings, list[str]] | None:
        """Identify, check and map; findings and remarks."""
        encoder = self._settings.joint_encoder
        if self._objects is None or encoder is None:
            return None
        self.tell(NmtCommand.ENTER_PRE_OPERATIONAL)
        self._objects.forget_verified()
        self._objects.remarks.clear()
        found = commission_encoder(self._objects, encoder, self._settings.rate_Hz, self._settings.heartbeat_s)
        return found, self._eds_remarks + self._objects.remarks

    def verify_again(self) -> None:
        """See `ObjectAccess.verify_again`; `DeviceError` as well if the encoder has an alarm by now.

        Its EMCY may have come while nobody listened.
        """
        if self._objects is not None and self._node is not None:
            self._objects.verify_again()
            require_no_alarm(self._objects, self._node)
