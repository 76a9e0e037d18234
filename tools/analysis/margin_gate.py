"""The gate before enabling: a loop without enough phase margin is refused, with what would mend it."""

from __future__ import annotations

from jointctl.drivers.errors import MarginError
from jointctl.tools.analysis.advice import Remedy, longest_delay_s, remedies
from jointctl.tools.analysis.learning_loop import Convergence, LearningSettings, learning_convergence
from jointctl.tools.analysis.linear_loop import LoopSettings
from jointctl.tools.analysis.loop_settings import loop_settings
from jointctl.tools.analysis.margins import Margins, margins
from jointctl.tools.configuration.config import Config


def require_margin(config: Config, delay_s: float | None = None, *, allow_low_margin: bool = False) -> Margins:
    """For `run`, before enabling: `MarginError` if the margin is too small with this measured loop delay.

    `allow_low_margin` is the user's explicit override; it never lets an unstable loop pass.
    """
    minimum_deg = config.margin.min_phase_margin_deg
    settings, _ = loop_settings(config, delay_s)
    found = margins(settings)
    refuse_diverging_learning(learning_of(config, settings))
    if not meets(found, minimum_deg) and not (found.stable and allow_low_margin):
        raise refusal(settings, found, minimum_deg, remedies(settings, minimum_deg))
    return found


def learning_of(config: Config, settings: LoopSettings) -> Convergence | None:
    """How iterative learning converges; None where there is none."""
    learning = config.control.learning
    if learning is None:
        return None
    numbers = LearningSettings(learning.gain, learning.error_gain_ps2, learning.lead_cycles, learning.half_width_cycles)
    return learning_convergence(settings, numbers)


def refuse_diverging_learning(found: Convergence | None) -> None:
    if found is not None and not found.worst_factor < 1.0:
        raise MarginError(
            f"iterative learning would diverge: factor {found.worst_factor:.2f} from one repetition to the next "
            f"at {found.worst_Hz:.1f} Hz, below 1 is needed",
            "lower control.learning.gain or error_gain_ps2, or raise half_width_cycles",
        )


def meets(found: Margins, minimum_deg: float) -> bool:
    return found.stable and found.phase_margin_deg >= minimum_deg


def refusal(settings: LoopSettings, found: Margins, minimum_deg: float, changes: list[Remedy]) -> MarginError:
    filtered = f"{settings.cutoff_Hz:g} Hz filter" if settings.cutoff_Hz > 0.0 else "no filter"
    where = (
        f"at {1.0 / settings.period_s:g} Hz with {settings.delay_s * 1e3:g} ms loop delay, "
        f"{settings.lag_s * 1e3:g} ms current lag, {filtered}"
    )
    if found.stable:
        what = f"phase margin (={found.phase_margin_deg:.1f} deg) must be at least {minimum_deg:g} deg"
    else:
        what = f"the control loop is unstable; a phase margin of at least {minimum_deg:g} deg is required"
    texts = [f"{r.text} gives {r.phase_margin_deg:.1f} deg" for r in changes]
    longest_s = longest_delay_s(settings, minimum_deg)
    if longest_s is not None and longest_s > 0.0:
        texts.append(f"a loop delay of {longest_s * 1e3:g} ms or less")
    hint = "any one of: " + "; ".join(texts) if texts else "no single setting reaches it: lower kp, kv and q together"
    return MarginError(f"{what}: {where}", hint)
