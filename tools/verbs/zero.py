"""`jointctl zero CONFIG`: where the joint stands now becomes its angle 0, or another one; the drive is only read.

The zero lives in the configuration (`zero_counts`), not in the drive: no object is written, so no other program's
homing is disturbed, and the old value is in the file's history.
"""

from __future__ import annotations

import codecs
import math
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jointctl.drivers.errors import DECLINED, ConfigurationError, DeviceError
from jointctl.tools.verbs.verb_options import JointOnBus, VerbOutput

if TYPE_CHECKING:
    from jointctl.tools.configuration.config import Config
    from jointctl.tools.inspection.subject import SdoReader

POSITION, ENCODER_POSITION = (0x6064, 0), (0x6004, 0)
_APART_S = 0.2  # two readings, to see that the joint stands
_NOISE_COUNTS = 8  # of a joint at rest


@dataclass(frozen=True)
class Zero:
    """One encoder: its present reading, and its zero before and after."""

    section: str
    counts: int
    before: int
    after: int
    rad_per_count: float

    @property
    def angle_rad(self) -> float:
        """The angle here, with the zero as it was."""
        return (self.counts - self.before) * self.rad_per_count


def zero(
    config: JointOnBus,
    output: VerbOutput,
    *,
    angle_rad: Annotated[float, typer.Option("--angle", help="rad that the joint shall have where it stands")] = 0.0,
    assume_yes: Annotated[bool, typer.Option("-y", "--yes", help="write without asking")] = False,
) -> int:
    """Set the joint's zero: the angle here becomes 0, or --angle.  Moves nothing, writes the configuration only."""
    from jointctl.tools.configuration.config import refuse_shipped
    from jointctl.tools.session.plan import agreed, require_terminal
    from jointctl.tools.written_file import refuse_read_only, replace_file

    refuse_shipped(config)
    refuse_read_only(config.path)
    if not -math.tau * 100.0 <= angle_rad <= math.tau * 100.0:
        raise ConfigurationError(f"--angle (={angle_rad:g}) must be in [-628..628] rad")
    if not assume_yes:
        require_terminal("this changes where the limits are and there is no terminal to ask on", "give -y")
    found = _readings(config, angle_rad)
    for each in found:
        output.note(f"[{each.section}] zero_counts {each.before} -> {each.after} (it reads {each.counts})")
        output.note(f"  the angle here {each.angle_rad:+.4f} rad -> {angle_rad:+.4f} rad")
    moved_rad = found[0].angle_rad - angle_rad
    limits = config.limits
    output.note(
        f"limits.position_*_rad stay {limits.position_min_rad:+.4f} .. {limits.position_max_rad:+.4f} rad: at the "
        f"joint that is {moved_rad:+.4f} rad from where they were, {limits.position_min_rad - angle_rad:+.4f} .. "
        f"{limits.position_max_rad - angle_rad:+.4f} rad from here"
    )
    data = {
        "angle_before_rad": found[0].angle_rad, "angle_after_rad": angle_rad,
        "zero_counts": {each.section: {"before": each.before, "after": each.after} for each in found},
    }  # fmt: skip
    if not limits.position_min_rad <= angle_rad <= limits.position_max_rad:
        output.warning(
            f"at {angle_rad:+.4f} rad the joint is outside of limits.position_*_rad, and will not be enabled"
        )
    _with_zeros(config.path, found)  # what cannot be done is refused before the question
    if not assume_yes:
        if not agreed(output, f"Write {config.path}?"):
            output.note("nothing was changed")
            return DECLINED
        _require_still(config, _readings(config, angle_rad), [each.counts for each in found])
    replace_file(config.path, _with_zeros(config.path, found))  # of the file as it is by now
    output.result(f"{config.path}: the joint is at {angle_rad:+.4f} rad here", data)
    return 0


def _with_zeros(path: Path, found: Sequence[Zero]) -> bytes:
    """The file with the new zeros, and everything else as it is; `ConfigurationError` where that cannot be."""
    from jointctl.firmware_py.input_file import parse_toml
    from jointctl.tools.configuration.load import config_of, read_document
    from jointctl.tools.inspection.first_files import filled

    text, wanted = read_document(path)
    for each in found:
        wanted[each.section]["zero_counts"] = each.after
    text = filled(text, {(each.section, "zero_counts"): each.after for each in found}, marked=False)
    try:
        as_wanted = parse_toml(text) == wanted
    except tomllib.TOMLDecodeError:
        as_wanted = False
    if not as_wanted:
        places = " and ".join(f"`zero_counts = {each.before}` below [{each.section}]" for each in found)
        raise ConfigurationError(
            f"{path}: zero_counts is written in a way that is not understood", f"write it as {places}, and try again"
        )
    config_of(path, text, wanted)  # as it will be read: the number may be too large
    return (codecs.BOM_UTF8 if path.read_bytes().startswith(codecs.BOM_UTF8) else b"") + text.encode()


def _readings(config: Config, angle_rad: float) -> list[Zero]:
    """Of [encoder] and, where it is there, [joint_encoder]; `DeviceError` if the joint moves."""
    from jointctl.tools.configuration.canopen import canopen_section, encoder_eds_path
    from jointctl.tools.configuration.conversions import joint_rad_per_count
    from jointctl.tools.configuration.sections import index_and_sub
    from jointctl.tools.inspection.objects import Objects, read_dictionary
    from jointctl.tools.inspection.subject import SdoReader, canopen_network, subject_of_config

    node, second = canopen_section(config).node, config.joint_encoder
    places = [("encoder", node, POSITION, config.encoder.zero_counts, joint_rad_per_count(config))]
    if second is not None:
        of_drive = second.source == "drive" or second.node is None
        place = index_and_sub(second.object) if of_drive else ENCODER_POSITION
        scale = second.direction * math.tau / second.counts_per_turn
        second_node = node if second.node is None or of_drive else second.node
        places.append(("joint_encoder", second_node, place, second.zero_counts, scale))
    with canopen_network(subject_of_config(config)) as network:
        readers = {node: SdoReader(network, node)}
        eds = encoder_eds_path(config)
        if second is not None and second.node is not None and eds is not None:
            readers[second.node] = SdoReader(network, second.node, Objects(read_dictionary(eds, second.node)))
        first = [_counts(readers[number], *place) for _, number, place, _, _ in places]
        time.sleep(_APART_S)
        counts = [_counts(readers[number], *place) for _, number, place, _, _ in places]
    found = [
        Zero(section, now, was, round(now - angle_rad / scale), scale)
        for (section, _, _, was, scale), now in zip(places, counts, strict=True)
    ]
    _require_still(config, found, first, f" in {_APART_S:g} s")
    return found


def _require_still(config: Config, found: Sequence[Zero], before: Sequence[int], within: str = "") -> None:
    """`DeviceError` where an encoder has other counts than `before`, by more than its noise."""
    for each, counts in zip(found, before, strict=True):
        travel = max(abs(each.counts - counts) - _NOISE_COUNTS, 0) * abs(each.rad_per_count)
        if travel > config.limits.standstill_radps * _APART_S:
            raise DeviceError(
                f"the joint moves: [{each.section}] went from {counts} to {each.counts}{within}", "hold it"
            )


def _counts(reader: SdoReader, index: int, sub: int) -> int:
    reader.require_answer()
    value = reader.value(index, sub)
    if not isinstance(value, int):
        raise DeviceError(f"node {reader.node} does not tell its position ({index:04X}:{sub})")
    return value
