"""Two encoders on one joint: a sample counts once both have answered the same SYNC.

So the loss of either ends the run as a stale sample.  An encoder node that reports an error (EMCY) or that has
restarted is not believed: no sample counts any more.
"""

from __future__ import annotations

from jointctl.drivers.can.frames import Frame
from jointctl.drivers.canopen.port import AlignTo, CanopenPort, SecondPosition
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import ENCODER_RESTARTED, Sample

SEEN_FIRST, SEEN_SECOND = 1, 2
_BOTH = SEEN_FIRST | SEEN_SECOND


@kernel
def centred(counts: int, range_counts: int) -> int:
    """`counts` modulo the range, in [-range/2, range/2)."""
    half = range_counts // 2
    return (counts + half) % range_counts - half


@kernel
def take_second_counts(second: SecondPosition, reading: int) -> None:
    """Unwrap the reading: the joint moves less than half the range between two samples.

    The first one is taken as the angle nearest to zero, so that a range of one turn may run over beside it.
    """
    if second.primed == 0:
        second.primed = 1
        second.counts = centred(reading - second.zero_counts, second.range_counts)
    else:
        second.counts += centred(reading - second.last_counts, second.range_counts)
    second.last_counts = reading


@kernel
def watch_second(second: SecondPosition, frame: Frame, sample: Sample) -> None:
    """EMCY and heartbeat of an encoder node."""
    if frame.can_id == second.emergency_id:
        if frame.length >= 2:
            low, high = int(frame.payload[0]), int(frame.payload[1])
            second.error = low | high << 8
            if second.lost == 0:
                sample.encoder_error = second.error
    elif frame.length >= 1 and frame.payload[0] & 0x7F == 0:
        second.lost = 1
        sample.encoder_error = ENCODER_RESTARTED


@kernel
def publish_sample(port: CanopenPort, sample: Sample, now_ns: int) -> bool:
    """The sample, if it is complete: with a second encoder, both positions of this cycle."""
    second = port.second
    if second.tpdo_id == 0:
        sample.position_rad = port.first_rad
        sample.time_ns = now_ns
        sample.count += 1
        return True
    if port.seen != _BOTH or second.error != 0 or second.lost != 0:
        return False
    second_rad = second.counts * second.radpcount
    if second.aligned == 0:
        second.aligned = 1
        if second.align == AlignTo.FIRST:
            second.offset_rad = port.first_rad - second_rad
        elif second.align == AlignTo.SECOND:
            port.first_offset_rad = second_rad - port.first_rad
    first_rad = port.first_rad + port.first_offset_rad
    second_rad += second.offset_rad
    sample.position_rad = second_rad if second.feeds_law != 0 else first_rad
    sample.second_position_rad = first_rad if second.feeds_law != 0 else second_rad
    sample.time_ns = now_ns
    sample.count += 1
    return True
