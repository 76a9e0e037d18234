"""The verbs identify and validate: what they write, what they leave alone, what they say."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import tomlkit

from jointctl.drivers.errors import ConfigurationError, DataError, UsageError
from jointctl.firmware_py.friction import DEGREE, friction_curve_Nm, paper_friction
from jointctl.tools.configuration.conversions import friction_constants
from jointctl.tools.configuration.found_values import MARK, friction_snippet, with_friction_section
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.identification import identification
from jointctl.tools.identification.identification import Options
from jointctl.tools.identification.swarm import SwarmSettings
from jointctl.tools.identification.tables import OURS, ForeignFormat
from jointctl.tools.output import Output
from jointctl.tools.verbs.identify import identify
from jointctl.tools.verbs.validate import validate
from tests.page_figures import foreign_colours, svgs
from tests.unit.identification.synthetic_friction import output, write_sweep

pytestmark = pytest.mark.usefixtures("undrawn")

# --- The verb identify: what it writes, what it leaves alone, what it says ---
QUICK = Options(folds=3, swarm=SwarmSettings(particles=80, iterations=120))
VALUES = {
    "velocity_unit": "deg/s", "velocity_side": "joint", "torque_side": "motor",
    "positive": {"tc_Nm": 0.1, "ts_Nm": 0.2, "ws": 1.5, "tv": 0.003, "a0": 0.1, "a1": 0.002, "a2": 0.0, "a3": 0.0,
                 "knee": 40.0, "max": 200.0},
    "negative": {"tc_Nm": 0.1, "ts_Nm": 0.2, "ws": 1.5, "tv": 0.003, "a0": -0.1, "a1": 0.002, "a2": 0.0, "a3": 0.0,
                 "knee": -40.0, "max": -200.0},
}  # fmt: skip


@pytest.fixture
def sweep(tmp_path):
    return write_sweep(tmp_path / "sweep.csv")


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir()}


@contextmanager
def refused(folder, error, words=None):
    """What is tried is refused, and leaves the folder as it was."""
    before = contents(folder)
    with pytest.raises(error, match=words) as caught:
        yield caught
    assert contents(folder) == before


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "joint.toml"
    shutil.copy(shipped_config("virtual"), path)
    return path


@pytest.mark.draws
def test_the_report_of_an_identification_holds_tables_pictures_and_section(sweep):
    out, page = output(), sweep.parent / "found.html"
    assert identify(sweep, out, options=QUICK, report=page) == 0
    html = page.read_text()
    assert [foreign_colours(svg) for svg in svgs(html)] == [set(), set()]
    for word in ("95 % interval", "held out", "(chosen)", "tc+", "[friction.positive]", "SHA-256"):
        assert word in html
    assert f"written: {page}" in out.stderr.getvalue()
    for wrong, told in ((sweep.parent / "found.txt", "must end in .html"), (sweep.parent / "no" / "a.html", "folder")):
        with refused(sweep.parent, DataError, told):
            identify(sweep, output(), options=QUICK, report=wrong)


def test_points_that_are_left_out_are_told_even_to_who_wants_no_progress(sweep):
    lines = sweep.read_text().splitlines()
    sweep.write_text("\n".join([*lines, lines[-1]]) + "\n")
    out = Output(quiet=True, stdout=io.StringIO(), stderr=io.StringIO())
    assert identify(sweep, out, options=QUICK) == 0
    assert "exact copy of another line, counted once" in out.stderr.getvalue()
    assert "written:" not in out.stderr.getvalue()


@pytest.mark.draws
def test_identify_writes_a_section_a_report_and_pictures_beside_the_data(sweep):
    out = output()
    assert identify(sweep, out, options=QUICK) == 0
    names = {p.name for p in sweep.parent.iterdir()} - {"sweep.csv", "sweep.json"}
    assert names == {
        "sweep.friction.toml", "sweep.friction.report.json", "sweep.friction.png", "sweep.friction.convergence.png"
    }  # fmt: skip
    report = json.loads((sweep.parent / "sweep.friction.report.json").read_text())
    section = tomlkit.parse((sweep.parent / "sweep.friction.toml").read_text()).unwrap()["friction"]
    assert section == report["friction"]
    assert len(report["data_sha256"]) == 64
    assert report["data_sha256"] in (sweep.parent / "sweep.friction.toml").read_text()
    for name in ("sweep.friction.png", "sweep.friction.convergence.png"):
        assert (sweep.parent / name).read_bytes().startswith(b"\x89PNG")
    shown = out.stdout.getvalue()
    for word in ("tc", "95 % interval", "weak", "held out", "stribeck", "coulomb-viscous", "RMSE"):
        assert word in shown


def test_the_identified_curve_comes_back_out_of_the_configuration(sweep, config):
    identify(sweep, output(), into=config, options=QUICK)
    loaded = load_config(config)
    constants = friction_constants(loaded.friction, loaded.joint.reduction_ratio)
    velocity = np.concatenate([np.linspace(-200.0, -3.0, 150), np.linspace(3.0, 200.0, 150)]) * DEGREE
    truth = friction_curve_Nm(paper_friction(), velocity)
    assert np.max(np.abs(friction_curve_Nm(constants, velocity) - truth)) < 0.03 * np.max(np.abs(truth))


@pytest.mark.parametrize("used", [False, True])
def test_a_law_that_does_not_use_what_was_identified_is_told(sweep, config, used):
    if not used:
        config.write_text(re.sub(r'feed_forward = "\w+"', 'feed_forward = "none"', config.read_text()))
    out = output()
    identify(sweep, out, into=config, options=QUICK)
    assert ("leaves the friction to the feedback" in out.stderr.getvalue()) != used


def test_comments_and_other_sections_of_the_configuration_stay(sweep, config):
    before = config.read_text()
    identify(sweep, output(), into=config, options=QUICK)
    identify(sweep, output(), into=config, options=QUICK)
    after = config.read_text()
    assert after.count(MARK) == 3  # those of the first time are gone
    old, new = before.splitlines(), [line for line in after.splitlines() if not line.startswith(MARK)]
    assert len(old) == len(new)
    changed = [a for a, b in zip(old, new, strict=True) if a != b]
    assert changed
    assert all(line.split("=")[0].strip() in VALUES["positive"] for line in changed)
    comments = [line.partition("#")[2] for line in old]
    assert comments == [line.partition("#")[2] for line in new]


def test_a_section_is_appended_where_there_is_none_and_lugre_is_kept():
    text = "# mine\n[joint]\nreduction_ratio = 121.0 # checked"
    added = with_friction_section(text, VALUES, ["from a test"])
    assert added.startswith(text + "\n")
    assert tomlkit.parse(added).unwrap()["friction"] == VALUES
    kept = with_friction_section(added + "\n[friction.lugre]\nstiffness_Nmprad = 8e4 # bench\n", VALUES, ["again"])
    assert tomlkit.parse(kept).unwrap()["friction"]["lugre"] == {"stiffness_Nmprad": 8e4}
    assert "# bench" in kept
    assert kept.count(MARK) == 1


def test_a_section_with_lugre_alone_is_completed():
    changed = with_friction_section("[friction.lugre]\nstiffness_Nmprad = 8e4 # bench\n", VALUES, ["x"])
    expected = {**VALUES, "lugre": {"stiffness_Nmprad": 8e4}}
    assert tomlkit.parse(changed).unwrap()["friction"] == expected
    assert "# bench" in changed


def test_windows_line_ends_stay():
    text = friction_snippet(VALUES, ["x"]).replace("\n", "\r\n")
    changed = with_friction_section(text, {**VALUES, "velocity_unit": "rad/s"}, ["y"])
    assert changed.count("\n") == changed.count("\r\n")
    assert tomlkit.parse(changed).unwrap()["friction"]["velocity_unit"] == "rad/s"


def test_the_snippet_is_what_the_configuration_reads():
    assert tomlkit.parse(friction_snippet(VALUES, [])).unwrap() == {"friction": VALUES}


def test_a_protected_configuration_is_refused_before_the_fit(sweep, config, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != config)
    monkeypatch.setattr("jointctl.tools.verbs.identify._from_plateaus", None)  # the fit
    with refused(config.parent, DataError, "cannot be written: no permission"):
        identify(sweep, output(), into=config, options=QUICK)


def test_a_configuration_without_friction_gets_it(sweep, config):
    text = config.read_text()
    document = tomlkit.parse(text.replace('"lugre_desired"', '"desired"'))
    del document["friction"]
    config.write_text(tomlkit.dumps(document))
    with pytest.raises(ConfigurationError, match=r"\[friction\] is missing"):
        load_config(config)
    out = output()
    identify(sweep, out, into=config, options=QUICK)
    assert load_config(config).friction is not None
    assert "cannot be compared" in out.stderr.getvalue()


def test_the_mode_of_the_file_stays_and_a_link_stays_a_link(sweep, config, tmp_path):
    config.chmod(0o640)
    link = tmp_path / "link.toml"
    link.symlink_to(config)
    identify(sweep, output(), into=link, options=QUICK)
    assert link.is_symlink()
    assert config.stat().st_mode & 0o777 == 0o640
    assert MARK in config.read_text()


def edited(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("spoil", "error"),
    [
        (lambda c, s: s.write_bytes(s.read_bytes()[:-40]), DataError),
        (lambda c, s: edited(s, ",500,1,", ",500,nan,"), DataError),
        (lambda c, s: write_sweep(s, factor=-1.0), DataError),
        (lambda c, s: write_sweep(s, factor=3.0), DataError),
        (lambda c, s: edited(s.with_suffix(".json"), "121.0", "100.0"), DataError),
        (lambda c, s: edited(c, "[loop]", "[loop"), ConfigurationError),
        (lambda c, s: edited(c, "[loop]", "[loop]\nspeed = 1"), ConfigurationError),
    ],
)
def test_nothing_is_written_after_an_error(sweep, config, spoil, error):
    spoil(config, sweep)
    with refused(sweep.parent, error):
        identify(sweep, output(), into=config, options=QUICK)


def test_a_result_that_the_configuration_refuses_leaves_it_alone(sweep, config, monkeypatch):
    monkeypatch.setattr(
        "jointctl.tools.identification.identification_report.section_values",
        lambda p, n: {**VALUES, "velocity_unit": "furlong"},
    )
    with refused(sweep.parent, ConfigurationError, r"joint.toml: friction.velocity_unit \(=furlong\)") as caught:
        identify(sweep, output(), into=config, options=QUICK)
    assert ".joint." not in str(caught.value)  # the temporary file is nobody's business


def test_an_interruption_writes_nothing(sweep, config, monkeypatch):
    monkeypatch.setattr(identification, "run_swarms", Mock(side_effect=KeyboardInterrupt))
    with refused(sweep.parent, KeyboardInterrupt):
        identify(sweep, output(), into=config, options=QUICK)


def test_a_shipped_configuration_is_not_written_into(sweep, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("precise", "precise.toml"):
        with pytest.raises(DataError, match=r"not written into \(`jointctl new FILE --from precise`"):
            identify(sweep, output(), into=Path(name), options=QUICK)


@pytest.mark.parametrize("name", ["sweep.csv", "sweep.json", "section"])
def test_the_section_goes_into_a_toml_file_only(sweep, name):
    with refused(sweep.parent, DataError, r"must end in \.toml"):
        identify(sweep, output(), out=sweep.parent / name, options=QUICK)


def test_the_inputs_are_never_overwritten_and_a_missing_folder_is_told(sweep, config):
    with refused(sweep.parent, DataError, "is an input of this command"):
        identify(sweep, output(), out=config, config=config, options=QUICK)
    with refused(sweep.parent, DataError, "no folder"):
        identify(sweep, output(), into=config, out=sweep.parent / "none" / "x.toml", options=QUICK)


def test_json_output_is_one_document(sweep):
    out = output(json=True)
    identify(sweep, out, options=QUICK)
    result = json.loads(out.stdout.getvalue())
    assert result["model"] == "multi-stage-continuous"  # the step at the knee is below the noise
    assert all(Path(p).exists() for p in result["files"])


def test_other_peoples_table_gives_the_same_model_as_our_own(sweep, tmp_path):
    identify(sweep, output(), out=tmp_path / "ours.toml", options=QUICK)
    rows = np.genfromtxt(sweep, delimiter=",", names=True)
    theirs = tmp_path / "theirs.txt"
    speed_rpm = rows["velocity_radps"] * 121.0 * 60.0 / (2.0 * np.pi)
    theirs.write_text("rpm;A\n" + "".join(f"{float(v)!r};{float(i)!r}\n" for v, i in
                                          zip(speed_rpm, rows["current_A"], strict=True)))  # fmt: skip
    told = ForeignFormat(velocity_column="rpm", current_column="A", velocity_unit="r/min", side="motor", ratio=121.0,
                         torque_constant_NmpA=0.1)  # fmt: skip
    identify(theirs, output(), out=tmp_path / "theirs.toml", given=told, options=QUICK)
    ours, other = (tomlkit.parse((tmp_path / f"{n}.toml").read_text()).unwrap()["friction"] for n in ("ours", "theirs"))
    assert other["positive"] == pytest.approx(ours["positive"], rel=1e-3, abs=1e-10)


# --- By which limits data are checked: a configuration's, else the sidecar's; without any, that is said ---
CONFIG = shipped_config("sweep_virtual")
JOINT_LIMITS = {"torque_max_Nm": 60.0, "velocity_max_radps": 3.88}
FOREIGN = {"velocity_column": "speed", "torque_column": "torque", "velocity_unit": "r/min", "side": "motor",
           "torque_side": "motor", "ratio": 121.0}  # fmt: skip
IN_AMPERE = {"torque_column": None, "torque_side": None, "current_column": "current"}


def foreign_file(folder):
    """Velocity in r/min of the motor, torque of the motor [Nm] and current [A] for 0.1 Nm/A."""
    path = folder / "theirs.csv"
    velocity = np.linspace(-200.0, 200.0, 120)
    torque = friction_curve_Nm(paper_friction(), velocity * DEGREE)
    rows = zip(velocity * 121.0 / 6.0, torque, torque / 0.1, strict=True)
    path.write_text("speed,torque,current\n" + "".join(f"{v:.9g},{t:.9g},{i:.9g}\n" for v, t, i in rows))
    return path


def said(path, given=OURS, config=None):
    out = output()
    assert identify(path, out, config=config, given=given, options=QUICK) == 0
    return out.stderr.getvalue().replace("\n", " ")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, None),
        ({**IN_AMPERE, "torque_constant_NmpA": 1.0},
         r"torque constant of the data \(=1 Nm/A\) differs from the configured one \(=0.1 in the drive's ampere"),
        ({"ratio": 100.0}, r"reduction ratio of the data \(=100\) differs from joint.reduction_ratio \(=121\)"),
        ({"side": "joint"}, r"highest joint speed \(=422.4 rad/s\) is 109 times limits.velocity_max_radps"),
        ({"velocity_unit": "rad/s"}, r"highest joint speed \(=33.33 rad/s\) is 8.59 times limits"),
        ({"velocity_unit": "deg/s"}, r"too few for the multi-stage model.*is 0.15 times limits.velocity_max_radps"),
        ({"torque_side": "joint"}, "times limits.torque_max_Nm: check torque constant, ratio, units and sides"),
    ],
)  # fmt: skip
def test_flags_are_checked_against_the_configuration(tmp_path, change, words):
    try:
        text = said(foreign_file(tmp_path), ForeignFormat(**{**FOREIGN, **change}), CONFIG)
    except DataError as error:
        text = error.message
    assert re.search(words, text) if words else "warning" not in text, text


@pytest.mark.parametrize(("factor", "config"), [(1.0, None), (1.0, CONFIG), (1.7, None), (1.9, None)])
def test_the_sidecars_limits_serve_where_no_configuration_is_given(tmp_path, factor, config):
    # 95 % of the points are below 41 Nm at the joint; 1.2 times the 60 Nm of the sidecar are allowed
    path = write_sweep(tmp_path / "own.csv", factor=factor, noise_Nm=0.0, limits=JOINT_LIMITS)
    if factor == 1.9:
        with pytest.raises(DataError, match=r"friction at the joint reaches .* times limits.torque_max_Nm"):
            said(path)
    else:
        text = said(path, config=config)
        assert ("times limits.torque_max_Nm" in text) is ("warning" in text) is (factor == 1.7)  # near the limit


def test_without_any_limits_it_is_said_that_nothing_was_checked(tmp_path):
    words = "no limits of the joint are known: sizes of torque and speed could not be checked"
    wrong = ForeignFormat(**{**FOREIGN, **IN_AMPERE, "torque_constant_NmpA": 10.0})
    assert words in said(foreign_file(tmp_path), wrong)
    assert words in said(write_sweep(tmp_path / "own.csv"))


def test_a_ratio_that_contradicts_the_sidecar_is_refused(tmp_path):
    path = write_sweep(tmp_path / "own.csv", noise_Nm=0.0, limits=JOINT_LIMITS)
    with pytest.raises(DataError, match=r"--ratio \(=100\) differs from reduction_ratio \(=121\)"):
        said(path, ForeignFormat(ratio=100.0))
    assert "warning" not in said(path, ForeignFormat(ratio=121.0))


@pytest.mark.parametrize("limits", [3, {"torque_max_Nm": -1.0, "velocity_max_radps": 1.0}, {"torque_max_Nm": 60.0}])
def test_damaged_limits_of_a_sidecar_are_named(tmp_path, limits):
    with pytest.raises(DataError, match=r"own.json: limits\.\w+ \(=.*\) must be a number"):
        said(write_sweep(tmp_path / "own.csv", limits=limits))


# --- The verb validate: the error of a model on other data, and friction that has grown ---
@pytest.mark.draws
def test_validate_reports_the_error_on_other_data(config, tmp_path):
    other = write_sweep(tmp_path / "other.csv", seed=9)
    out = output(json=True)
    assert validate(config, other, out) == 0
    result = json.loads(out.stdout.getvalue())
    assert result["rmse_Nm"] == pytest.approx(0.0046, rel=0.12)
    assert result["points"] == 224
    assert Path(result["picture"]).read_bytes().startswith(b"\x89PNG")


def test_validate_shows_a_joint_whose_friction_has_grown(config, tmp_path):
    out = output(json=True)
    validate(config, write_sweep(tmp_path / "other.csv", factor=1.1, noise_Nm=0.0), out)
    result = json.loads(out.stdout.getvalue())
    assert result["relative_rmse"] == pytest.approx(0.1 / 1.1, rel=1e-3)
    assert result["max_error_Nm"] == pytest.approx(0.035398, rel=1e-3)


def test_validate_needs_friction_and_believable_data(config, tmp_path):
    with pytest.raises(DataError, match="does not oppose the motion"):
        validate(config, write_sweep(tmp_path / "wrong.csv", factor=-1.0), output())
    assert not (tmp_path / "wrong.validation.png").exists()
    good = write_sweep(tmp_path / "data named.png")
    with pytest.raises(DataError, match="is an input"):
        validate(config, good, output(), figure=good)
    with pytest.raises(UsageError, match=r"x\.jpg\) must end in \.png"):
        validate(config, good, output(), figure=tmp_path / "x.jpg")


def test_validate_takes_data_of_one_direction(config, tmp_path):
    path = write_sweep(tmp_path / "half.csv")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], *lines[113:]]) + "\n")
    out = output(json=True)
    assert validate(config, path, out) == 0
    assert json.loads(out.stdout.getvalue())["points"] == 112
