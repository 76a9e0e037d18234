"""The verb validate: the error of a model on other data, and friction that has grown."""

import json
from pathlib import Path

import pytest

from jointctl.drivers.errors import DataError, UsageError
from jointctl.tools.verbs.validate import validate
from tests.unit.identification.sweep_files import output, write_sweep


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
