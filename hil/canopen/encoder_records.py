"""Memory of the virtual encoder node (CiA 406): its objects as typed fields, and the state of the compiled core."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from jointctl.firmware_py.schema import array_of, f8, i4, i8, record, u1, u2, u4

MAPPED = 2


@record
class EncoderObjects:
    error_register: u1
    sync_cob_id: u4
    emcy_cob_id: u4
    heartbeat_ms: u2
    tpdo_cob_id: u4
    tpdo_type: u1
    tpdo_inhibit_100us: u2
    tpdo_timer_ms: u2
    tpdo_count: u1
    tpdo_mapping: Annotated[np.ndarray, array_of(u4, MAPPED)]
    units_per_turn: u4
    range_counts: u4
    position: u4
    cyclic_timer_ms: u2
    alarms: u2
    warnings: u2


@record
class EncoderNode:
    """One element inside `Device`: it sits on the joint of that drive and on its bus.  node_id 0 = there is none."""

    objects: EncoderObjects
    default_objects: EncoderObjects
    node_id: i4
    counts_prad: f8  # with the sign of its direction
    offset_counts: f8
    nmt: i4  # NmtState
    boot_pending: i4
    heartbeat_due_ns: i8
    tpdo_due_ns: i8
    syncs: i4
    resets: i8  # how often the defaults were restored
    sent_error: i4  # EMCY error code that the bus knows of
    # faults
    error_code: i4  # EMCY error code of what is wrong; 0 = nothing
    stuck: i4
    stuck_counts: i8
    error_rad: f8  # added to the true angle


FIELDS = {
    (0x1001, 0): "error_register",
    (0x1005, 0): "sync_cob_id",
    (0x1014, 0): "emcy_cob_id",
    (0x1017, 0): "heartbeat_ms",
    (0x1800, 1): "tpdo_cob_id",
    (0x1800, 2): "tpdo_type",
    (0x1800, 3): "tpdo_inhibit_100us",
    (0x1800, 5): "tpdo_timer_ms",
    (0x1A00, 0): "tpdo_count",
    (0x1A00, 1): "tpdo_mapping[0]",
    (0x1A00, 2): "tpdo_mapping[1]",
    (0x6001, 0): "units_per_turn",
    (0x6002, 0): "range_counts",
    (0x6004, 0): "position",
    (0x6200, 0): "cyclic_timer_ms",
    (0x6503, 0): "alarms",
    (0x6505, 0): "warnings",
}
