"""Text of others in a message: shown, never obeyed, and not endless."""

from __future__ import annotations

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointctl.drivers.errors import (
    LONGEST_MESSAGE,
    LONGEST_VALUE,
    BusError,
    message_line,
    one_line,
    printable,
    shortened,
    text_Nm,
    text_radps,
)
from jointctl.tools.configuration.config import ConfigurationProblems

HARMFUL = [chr(code) for code in (*range(0x20), *range(0x7F, 0xA0), 0x202E, 0x2066, 0x200F, 0x2028, 0xFEFF, 0xDCFF)]


@pytest.mark.parametrize("character", HARMFUL, ids=lambda c: f"{ord(c):04x}")
def test_what_a_terminal_obeys_is_escaped(character: str) -> None:
    shown = printable(f"a{character}b")
    assert shown.isprintable()
    assert shown[0] + shown[-1] == "ab"
    assert shown[1] == "\\"
    assert character not in BusError(f"a{character}b").message
    assert character not in ConfigurationProblems([f"a{character}b", "second"]).problems[0]


def test_what_is_only_shown_stays() -> None:
    for text in (
        "25.0 .. 25.0 °C",
        "e = q · qd",
        "名前.toml",
        "a\\nb",
        "'quoted' [bold] <b>",
        "10\N{NO-BREAK SPACE}Nm",
    ):
        assert message_line(text) == text


def test_a_file_s_name_is_cut_and_a_sentence_with_values_before_its_colon_is_not() -> None:
    text = (
        "joint.torque_constant_NmpA (=100 in the drive's ampere) times drive.rated_current_A (=5) is 1e+03 times "
        "drive.rated_torque_Nm (=0.5): one of them is wrong, or rms and sine amplitude are mixed up"
    )
    assert len(text) > LONGEST_VALUE
    assert message_line(text) == text
    cut = message_line(f"{'long name ' * 40}.toml: no such file (=1)")
    assert len(cut) < LONGEST_VALUE + 30
    assert cut.endswith(".toml: no such file (=1)")


@given(st.text(max_size=400))
def test_twice_is_once_and_a_line_is_a_line(text: str) -> None:
    once = message_line(text)
    assert message_line(once) == once
    assert not any(unicodedata.category(c) in ("Cc", "Zl", "Zp", "Cs") for c in once)
    assert len(once.splitlines()) <= 1


def test_a_text_that_was_broken_and_indented_is_one_line_and_a_name_keeps_its_break() -> None:
    assert one_line("first\n   second") == "first second"
    assert one_line("evil\nerror: nothing is wrong.toml: no such file") == (
        "evil\\nerror: nothing is wrong.toml: no such file"
    )


@pytest.mark.parametrize(
    "message",
    [
        "x (={}) must be in [0..1]", "no column '{}'", 'must be "{}"', "{}: no such file", "Got unexpected argument {}",
    ],
)  # fmt: skip
@pytest.mark.parametrize("value", ["v" * 5000, "v w " * 1250, "/v" * 2500])
def test_a_value_is_cut(message: str, value: str) -> None:
    if " " in value and message.startswith("Got"):
        pytest.skip("nothing tells this value from the message")
    line = message_line(message.format(value))
    assert len(line) <= len(message) - 2 + LONGEST_VALUE
    assert line.startswith(message.partition("{")[0])
    assert line.endswith(message.partition("}")[2])
    assert "..." in line
    whole = message.format(value[:60])
    assert message_line(whole) == whole  # its twin, inside the limit


@pytest.mark.parametrize(("length", "cut"), [(LONGEST_VALUE, False), (LONGEST_VALUE + 1, True)])
def test_the_limit_is_the_one_that_is_documented(length: int, cut: bool) -> None:
    value = "a" * (length - 1) + "b"
    assert (shortened(value) != value) is cut
    assert len(shortened(value)) == min(length, LONGEST_VALUE)
    assert (message_line(f"x (={value}) must be 1") != f"x (={value}) must be 1") is cut
    assert shortened(value).endswith("ab")


def test_a_message_ends_somewhere() -> None:
    assert len(message_line("a word and " * 1000)) == LONGEST_MESSAGE
    apostrophes = "the drive's answer is not the controller's, " * 8
    assert message_line(apostrophes) == apostrophes  # no quotes


@pytest.mark.parametrize(
    ("torque_Nm", "text"),
    [
        (60.0, "60.0 Nm"),
        (1.0, "1.0 Nm"),
        (0.2, "0.20 Nm"),
        (-0.034, "-0.034 Nm"),
        (2e-4, "0.00020 Nm"),
        (0.0, "0.0 Nm"),
        (1e-9, "0.0 Nm"),
    ],
)
def test_torques_of_small_joints_keep_digits_that_count(torque_Nm: float, text: str) -> None:
    """A joint of 0.25 Nm was said to be limited to 0.2 Nm."""
    assert text_Nm(torque_Nm) == text


@pytest.mark.parametrize(("speed_radps", "text"), [(1.0, "1.00 rad/s"), (0.05, "0.050 rad/s"), (4e-3, "0.0040 rad/s")])
def test_slow_speeds_keep_digits_that_count(speed_radps: float, text: str) -> None:
    assert text_radps(speed_radps) == text
