"""Records of the bristles and of the friction that adapts; see `friction_adaptation`."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from jointctl.firmware_py.schema import array_of, f8, i4, record

BRISTLES = 4  # of different stiffness, that the adaptation of the friction weighs
RIPPLES = 2  # sines of the motor angle that it finds
ADAPTED_PARTS = 2 * BRISTLES + 2 * RIPPLES


@record
class LuGreConstants:
    """Bristle stiffness and damping at the joint; the sliding curve comes from (11)."""

    stiffness_Nmprad: f8
    damping_Nmspr: f8


@record
class AdaptationConstants:
    """See `friction_adaptation`."""

    enabled: i4
    ripples: i4  # sines in use
    friction_error: f8  # of the weight of each kind of bristles at first, 1 = the configured friction
    reach: f8  # by which all of them together may leave the configured friction
    ripple_Nm: f8  # of the sines at first
    ripple_max_Nm: f8
    ripple_turns_prad: Annotated[np.ndarray, array_of(f8, RIPPLES)]  # order per joint turn / 2 pi


@record
class AdaptationState:
    weights: Annotated[np.ndarray, array_of(f8, ADAPTED_PARTS)]
    covariance: Annotated[np.ndarray, array_of(f8, ADAPTED_PARTS, ADAPTED_PARTS)]
    gain: Annotated[np.ndarray, array_of(f8, ADAPTED_PARTS)]
    filtered_Nm: Annotated[np.ndarray, array_of(f8, ADAPTED_PARTS)]
    desired_deflection_rad: Annotated[np.ndarray, array_of(f8, BRISTLES)]
    deflection_rad: Annotated[np.ndarray, array_of(f8, BRISTLES)]  # as measured
    bristle: LuGreConstants  # of one kind of bristles, while they are computed
    fed_filtered_Nm: f8
    rest_disturbance_Nm: f8  # the observer's, when the desired motion came to rest
    resting: i4
    cycle: i4
