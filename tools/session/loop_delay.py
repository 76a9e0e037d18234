"""The delay of the control loop as measured on the bus, while the drive is still off.

From the position sample (SYNC) to the moment at which the torque computed from it takes effect in the drive.
"""

from __future__ import annotations

import math

import numpy as np

from jointctl.drivers.can.frames import worst_frame_bits
from jointctl.drivers.canopen.identifiers import EVENT_DRIVEN
from jointctl.firmware_py.cycle import Histogram

RPDO_BYTES = 4
QUANTILE = 0.99
MICROSECOND = 1e-6


def quantile_s(histogram: np.ndarray, quantile: float) -> float:
    """Upper edge [s] of the bin that holds the quantile of one histogram row; nan when it is empty."""
    total = int(histogram.sum())
    if total == 0:
        return math.nan
    bin_us = int(np.searchsorted(np.cumsum(histogram), quantile * total))
    return (bin_us + 1) * MICROSECOND


def measured_delay_s(histograms: np.ndarray, rpdo_transmission_type: int, period_s: float, bit_s: float) -> float:
    """Loop delay [s] from the histograms of the first cycles; `bit_s` is the duration of one bit on the bus.

    Round trip and work at their 99th percentile, and the RPDO on the wire.  A synchronous RPDO waits for the next
    SYNC (transmission type n > 1: for the n-th), so that its delay is a whole number of periods.
    """
    rpdo_s = worst_frame_bits(RPDO_BYTES) * bit_s
    path_s = (
        quantile_s(histograms[Histogram.ROUND_TRIP], QUANTILE)
        + quantile_s(histograms[Histogram.WORK], QUANTILE)
        + rpdo_s
    )
    if rpdo_transmission_type >= EVENT_DRIVEN:
        return path_s
    periods = math.ceil(path_s / period_s)
    return period_s * max(periods, rpdo_transmission_type, 1)
