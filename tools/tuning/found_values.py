"""What a tune has found, put into a configuration: the one in use, and the file, whose comments stay.

The virtual joint is described relative to what its configuration believes.  A better belief must not move the joint
itself, so that [virtual] then says what it is: `inertia_scale` follows, and the friction is kept as [virtual.friction].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import tomlkit

from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.sections import Friction, FrictionDirection, Reducer
from jointctl.tools.configuration.written_sections import document_of
from jointctl.tools.tuning.excitation import SPEED_radps
from jointctl.tools.tuning.joint_fit import Estimate, JointFit

MARK = "# tuned by jointctl: "
SMALL_MOTION = 1.6  # stiffness of a small motion over that under a steady torque: hysteresis, 1.4 to 1.84
CRITICAL_SHARE = 0.04  # of the critical damping: what is more is hysteresis, which a small motion does not have
DIGITS = 5
STANDS_radps, KNEE_radps = 1e-3, 0.4  # of a friction of which no curve is known: static below, constant beyond


@dataclass(frozen=True)
class Found:
    """One value of the configuration with where it comes from."""

    section: tuple[str, ...]
    key: str
    value: Any
    source: str  # with the interval


def rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def values_of_fit(config: Config, fit: JointFit, source: str) -> list[Found]:
    """Inertia, delay, lag, and of a soft reducer its inertias, stiffness and damping."""

    def found(section: str, key: str, one: Estimate, value: float | None = None) -> Found:
        number = rounded(one.value if value is None else value)
        return Found((section,), key, number, f"{number:g} +- {one.half:.2g}, {source}")

    values = [
        found("joint", "inertia_kgm2", fit.inertia_kgm2),
        found("margin", "loop_delay_s", fit.delay_s, max(fit.delay_s.value, 0.0)),
        found("margin", "current_lag_s", fit.lag_s, max(fit.lag_s.value, 0.0)),
    ]
    if not fit.flexible:
        return values
    joint = fit.joint()
    values.append(found("reducer", "motor_inertia_kgm2", fit.link_kgm2, joint.motor_kgm2))
    values.append(found("reducer", "loop_stiffness_Nmprad", fit.stiffness_Nmprad))
    if config.reducer is None:
        steady = rounded(fit.stiffness_Nmprad.value / SMALL_MOTION)
        remark = f"{steady:g}, loop_stiffness_Nmprad / {SMALL_MOTION:g}: not measured"
        values.append(Found(("reducer",), "stiffness_Nmprad", steady, remark))
    reduced = joint.motor_kgm2 * joint.link_kgm2 / (joint.motor_kgm2 + joint.link_kgm2)
    damping = min(joint.damping_Nmspr, CRITICAL_SHARE * 2.0 * (joint.stiffness_Nmprad * reduced) ** 0.5)
    values.append(found("reducer", "damping_Nmspr", fit.damping_Nmspr, damping))
    return values


def with_values(config: Config, values: list[Found]) -> Config:
    """The configuration in use with these values; the virtual joint stays what it was."""
    sections: dict[str, dict[str, Any]] = {}
    for one in values:
        sections.setdefault(one.section[0], {})[one.key] = one.value
    update: dict[str, Any] = {}
    for name, keys in sections.items():
        own = getattr(config, name)
        if own is None and name == "reducer":
            update[name] = Reducer(**keys)
        else:
            update[name] = own.model_copy(update=keys)
    return _same_plant(config, config.model_copy(update=update))


def _same_plant(before: Config, after: Config) -> Config:
    virtual = before.virtual
    if virtual is None:
        return after
    scale = virtual.inertia_scale * before.joint.inertia_kgm2 / after.joint.inertia_kgm2
    kept = {"inertia_scale": scale, "friction": virtual.friction or before.friction}
    return after.model_copy(update={"virtual": virtual.model_copy(update=kept)})


def with_friction(config: Config, section: Mapping[str, Any]) -> Config:
    """The configuration in use with the friction that was identified; what it knew of bristles stays."""
    lugre = config.friction.lugre if config.friction is not None else None
    return _same_plant(
        config, config.model_copy(update={"friction": Friction.model_validate({**section, "lugre": lugre})})
    )


def without_friction(config: Config) -> Config:
    """The configuration in use before the friction is known."""
    control = config.control.model_copy(update={"feed_forward": "none", "adaptation": None})
    return _same_plant(config, config.model_copy(update={"friction": None, "control": control}))


def with_break_away(config: Config, torque_Nm: float) -> Config:
    """As `without_friction`, but what watches the reading knows the torque at which the joint began to move.

    Nothing of it is fed forward.  A joint that is pushed harder and does not move has an encoder that stands still.
    """
    friction = _straight(torque_Nm, (torque_Nm, torque_Nm), 0.0)
    return without_friction(config).model_copy(update={"friction": friction})


def with_sliding(config: Config, torque_Nm: float, sliding_Nm: tuple[float, float], slope_Nmspr: float) -> Config:
    """As `with_break_away`, and the friction of the response's legs is fed forward: a law that is soft needs it.

    `sliding_Nm` at SPEED_radps, with its sign, `slope_Nmspr` there.  What is more at lower speeds is not known yet, and
    beyond KNEE_radps nothing is added.
    """
    sizes = max(sliding_Nm[0], 0.0), max(-sliding_Nm[1], 0.0)  # a load may be more than the friction
    slope_Nmspr = min(max(slope_Nmspr, 0.0), 0.5 * min(sizes) / SPEED_radps)
    coulomb = (sizes[0] - SPEED_radps * slope_Nmspr, sizes[1] - SPEED_radps * slope_Nmspr)
    friction = _straight(torque_Nm, coulomb, slope_Nmspr)
    before = with_break_away(config, torque_Nm)
    control = before.control.model_copy(update={"feed_forward": "desired"})
    return before.model_copy(update={"friction": friction, "control": control})


def _straight(static_Nm: float, coulomb_Nm: tuple[float, float], slope_Nmspr: float) -> Friction:
    """Coulomb and viscous friction of either direction, at the joint; the static one counts at standstill alone."""

    def side(sign: float, coulomb: float) -> FrictionDirection:
        return FrictionDirection(
            tc_Nm=coulomb, ts_Nm=max(static_Nm, coulomb), ws=STANDS_radps, tv=slope_Nmspr,
            a0=sign * (coulomb + KNEE_radps * slope_Nmspr), a1=0.0, a2=0.0, a3=0.0, knee=sign * KNEE_radps, max=sign,
        )  # fmt: skip

    positive, negative = side(1.0, coulomb_Nm[0]), side(-1.0, coulomb_Nm[1])
    return Friction(
        velocity_unit="rad/s", velocity_side="joint", torque_side="joint", positive=positive, negative=negative
    )


def with_tuned(text: str, values: list[Found], sources: Mapping[str, list[str]]) -> str:
    """`text` with these values; a comment under the heading of each section says where they come from.

    Sections that are not there are added at the end.  Comments stay, but those of an earlier tune.
    """
    document, newline = document_of(text, MARK)
    inserted = set()  # headings
    for one in values:
        table: Any = document
        for name in one.section:
            if name not in table:
                table[name] = tomlkit.table()
                inserted.add(".".join(one.section))
            table = table[name]
        if one.value is None:
            table.pop(one.key, None)
        elif not (one.key in table and table[one.key] == one.value):
            table[one.key] = list(one.value) if isinstance(one.value, tuple) else one.value
    lines, section = [""], ""
    for line in tomlkit.dumps(document).splitlines(keepends=True):
        lines.append(line if line.endswith("\n") else line + newline)
        heading = line.split("#")[0].strip()
        if heading.startswith("[") and heading.endswith("]"):
            if section in inserted and lines[-2].strip():
                lines.insert(-1, newline)
            section = heading[1:-1].strip()
            lines += [MARK + source + newline for source in sources.get(section, ())]
    return "".join(lines)
