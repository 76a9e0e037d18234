"""`jointctl demo` on a computer that stands still now and then."""

from __future__ import annotations

from jointctl.tools.configuration.load import load_config
from jointctl.tools.verbs.demo import with_patience
from tests.places import CONFIGS


def test_a_busy_computer_ends_no_demo_before_the_drive_would() -> None:
    config = load_config(CONFIGS / "virtual.toml")
    limits = with_patience(config).limits
    assert limits.sample_age_max_s == limits.skipped_max_s == 0.15 < config.canopen.heartbeat_s


def test_a_shorter_heartbeat_leaves_less_patience() -> None:
    config = load_config(CONFIGS / "virtual.toml")
    drive = config.canopen.model_copy(update={"heartbeat_s": 0.1})
    limits = with_patience(config.model_copy(update={"drive": drive})).limits
    assert limits.sample_age_max_s == 0.75 * 0.1


def test_limits_that_are_wider_stay() -> None:
    config = load_config(CONFIGS / "virtual.toml")
    wide = config.limits.model_copy(update={"sample_age_max_s": 0.4})
    assert with_patience(config.model_copy(update={"limits": wide})).limits.sample_age_max_s == 0.4
