"""What CiA 301 numbers: the identifiers of the predefined connection set (7.3.5), NMT commands and NMT states.

An NMT command and the state that it leads to are different numbers.  The virtual drive states all of them by itself.
"""

from __future__ import annotations

from enum import IntEnum

# of all nodes
NMT_ID = 0x000
SYNC_ID = 0x080
# to be added to the node number
EMERGENCY_ID = 0x080
TPDO1_ID, TPDO2_ID = 0x180, 0x280
TPDO_IDS = (TPDO1_ID, TPDO2_ID, 0x380, 0x480)
RPDO1_ID, RPDO2_ID = 0x200, 0x300
RPDO_IDS = (RPDO1_ID, RPDO2_ID, 0x400, 0x500)
SDO_ANSWER_ID, SDO_REQUEST_ID = 0x580, 0x600
HEARTBEAT_ID = 0x700
# of an identifier of 11 bits
FUNCTION_MASK, NODE_MASK = 0x780, 0x07F
HIGHEST_NODE = 127
# transmission types of PDOs (7.5.2.35): up to the first at SYNC, from the second on at an event or on receipt
LAST_SYNCHRONOUS, EVENT_DRIVEN = 240, 254


class NmtCommand(IntEnum):
    """First byte of an NMT message; the second is the node, 0 for all (7.2.8.3.1)."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


class NmtState(IntEnum):
    """The byte of a heartbeat without its highest bit (7.2.8.3.2.2)."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127
