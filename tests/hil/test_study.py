"""Studies: the same seed gives the same plants and figures, whatever the number of processes."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest

from jointctl.drivers.errors import INTERRUPTED, ConfigurationError, DataError
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.load import shipped_config
from jointctl.tools.drawing import save_png
from jointctl.tools.experiments.controller_study import (
    EnsembleSettings,
    PlantResult,
    StudyResult,
    StudySettings,
    checked,
    load_study,
    quantile,
    random_plant,
    run_study,
    study_controllers,
    study_figure,
    write_csv,
)
from jointctl.tools.experiments.many_runs import Workers
from jointctl.tools.experiments.scenarios import FAILED, TABLE, ErrorFigures, controller_config, named
from jointctl.tools.lockstep import DirectBus
from jointctl.tools.output import Output
from jointctl.tools.verbs.study import study, with_plants
from tests.configurations import shipped
from tests.page_figures import foreign_colours, svgs
from tests.places import CONFIGS


@pytest.fixture
def base() -> Config:
    """configs/precise.toml with a short trajectory."""
    return shipped("precise", trajectory__duration_s=3.0)


def short_study(base: Config, seed: int, workers: int) -> StudyResult:
    controllers = named(("paper", "precise"))
    return run_study(base, controllers, StudySettings(plants=3, seed=seed, after_s=1.0), workers=Workers(workers))


# --- the plants ---
def test_a_plant_depends_on_seed_and_index_only(base: Config) -> None:
    settings = EnsembleSettings()
    assert random_plant(base, settings, 4, 7) == random_plant(base, settings, 4, 7)
    assert random_plant(base, settings, 4, 7) != random_plant(base, settings, 5, 7)
    assert random_plant(base, settings, 4, 7) != random_plant(base, settings, 4, 8)


def test_plants_fill_their_ranges_and_stay_inside(base: Config) -> None:
    settings = EnsembleSettings()
    plants = [random_plant(base, settings, 1, index) for index in range(400)]
    values = [plant.virtual for plant in plants]
    for name, (low, high) in (
        ("friction_positive_scale", settings.friction_scale),
        ("bristle_stiffness_Nmprad", settings.bristle_stiffness_Nmprad),
        ("current_lag_s", settings.current_lag_s),
        ("command_delay_s", settings.command_delay_s),
        ("friction_ripple", settings.friction_ripple),
        ("inertia_scale", settings.inertia_scale),
    ):
        drawn = np.array([getattr(value, name) for value in values])
        assert low <= drawn.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < drawn.max() <= high
    slipping = sum(value is not None and value.friction_kind == "stick_slip" for value in values)
    assert slipping / 400 == pytest.approx(0.25, abs=0.06)
    assert {round(math.log2(plant.encoder.counts_per_turn)) for plant in plants} == {17, 18, 19, 20}


def test_loaded_plants_are_the_same_but_for_pendulum_temperature_and_what_friction_owes_to_them() -> None:
    base, plain = shipped("precise"), EnsembleSettings(flexible=True)
    loaded = plain.model_copy(update={"loaded": True})
    for index in range(20):
        without, with_load = random_plant(base, plain, 4, index), random_plant(base, loaded, 4, index)
        true = with_load.virtual
        assert true is not None
        assert true.friction.temperature is not None
        assert 0.03 <= true.friction.load.coulomb <= 0.2
        assert 15.0 <= true.ambient_degC <= 55.0
        assert with_load.joint.gravity_Nm == true.gravity_Nm <= 20.0
        assert with_load.friction == without.friction
        same = {"friction": None, "gravity_Nm": 0.0, "ambient_degC": 25.0}
        assert true.model_copy(update=same) == without.virtual
    assert with_plants(StudySettings(), ["loaded"]).plant.loaded
    assert not with_plants(StudySettings(), ["loaded", "realistic"]).plant.loaded
    with pytest.raises(ConfigurationError, match=r"plant.loaded \(=true\) needs \[friction\]"):
        random_plant(base.changed(friction=None), loaded, 4, 0)


# --- running ---
def test_same_seed_same_result_with_one_process_and_with_two(base: Config) -> None:
    alone = short_study(base, 1, 1)
    assert short_study(base, 1, 2) == alone
    assert [plant.index for plant in alone.plants] == [0, 1, 2]
    assert short_study(base, 2, 1).plants[0].figures != alone.plants[0].figures


def test_no_bit_depends_on_how_long_commissioning_took(base: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy computer hands frames over later, and the device's clock goes on meanwhile."""
    quick = short_study(base, 1, 1)
    waits_ns = itertools.cycle((0, 1_234_567, 50_000, 777_777))
    sleep = DirectBus.sleep

    def slow(bus: DirectBus, seconds: float) -> None:
        bus.now_ns += next(waits_ns)
        sleep(bus, seconds)

    monkeypatch.setattr(DirectBus, "sleep", slow)
    assert short_study(base, 1, 1) == quick


@pytest.mark.parametrize(("plants", "workers", "least", "most"), [(3, 1, 2, 2), (40, 2, 1, 39)])
def test_an_interruption_keeps_what_is_done_and_ends_the_other_processes_too(
    base: Config, plants: int, workers: int, least: int, most: int
) -> None:
    def interrupt(done: float) -> None:
        if workers > 1 or done == 2.0:
            raise KeyboardInterrupt

    settings = StudySettings(plants=plants, seed=1, after_s=1.0)
    result = run_study(base, named(("paper",)), settings, workers=Workers(workers), progress=interrupt)
    assert result.interrupted
    assert least <= len(result.plants) <= most


def test_a_file_whose_drive_closes_its_loops_brings_them_along(tmp_path: Path) -> None:
    alone = tmp_path / "alone.toml"
    alone.write_text((CONFIGS / "csp.toml").read_text().replace("_offset = true", "_offset = false"))
    found = run_study(shipped("csp", trajectory__duration_s=3.0), named(("csp", str(alone))),
                      StudySettings(plants=2, seed=1, after_s=2.0))  # fmt: skip
    assert np.min(found.values("alone", "rmse_mrad")) > 10.0 * np.max(found.values("csp", "rmse_mrad"))


def test_a_file_whose_drive_closes_its_loops_is_not_taken_for_a_law_on_torque(base: Config) -> None:
    with pytest.raises(ConfigurationError, match="controller csp needs a --base"):
        run_study(base, named(("csp",)), StudySettings(plants=1, after_s=1.0))


def test_a_time_after_the_end_is_refused(base: Config) -> None:
    with pytest.raises(ConfigurationError, match=r"after_s \(=3\) must be in \[0\.\.3\), .*duration_s.*--after"):
        run_study(base, named(("paper",)), StudySettings(plants=1, seed=1, after_s=3.0), workers=Workers(1))


# --- quantiles, files ---
def test_a_run_that_failed_counts_as_infinitely_bad() -> None:
    good, failed = ErrorFigures("", 1.0, 0.5, -1.0, 1.0, 1.0, 0.5, 0.0, 20.0), ErrorFigures("following_error", *FAILED)
    plants = tuple(PlantResult(i, "lugre", 19, (failed if i == 0 else good,)) for i in range(10))
    result = StudyResult(("law",), plants, False)
    assert result.faults("law") == 1
    values = result.values("law", "peak_mrad")
    assert quantile(values, 0.5) == 1.0
    assert quantile(values, 0.95) == math.inf


def test_quantiles_are_linear_where_everything_is_finite() -> None:
    assert quantile(np.array([0.0, 1.0]), 0.25) == pytest.approx(0.25)
    assert quantile(np.full(5, math.inf), 0.5) == math.inf


def test_csv_has_a_line_for_each_run_and_the_figure_is_drawn(base: Config, tmp_path: Path) -> None:
    result = short_study(base, 1, 1)
    write_csv(result, tmp_path / "deep" / "runs.csv")
    lines = list(csv.DictReader((tmp_path / "deep" / "runs.csv").read_text().splitlines()))
    assert len(lines) == 6
    assert {line["controller"] for line in lines} == {"paper", "precise"}
    assert float(lines[0]["peak_mrad"]) == result.plants[0].figures[0].peak_mrad
    picture = save_png(study_figure(result, "three plants"), tmp_path / "box.png")
    assert picture.read_bytes().startswith(b"\x89PNG")


# --- the verb ---
def test_the_results_never_replace_the_settings_or_a_controller(base: Config, tmp_path: Path) -> None:
    file, law = tmp_path / "study.toml", tmp_path / "law.toml"
    file.write_text("plants = 1\n")
    law.write_text(shipped_config("paper").read_text())
    settings = checked({"plants": 1, "controllers": [str(law)]}, "test")
    before = file.read_bytes(), law.read_bytes()
    for target in (file, law):
        with pytest.raises(DataError, match=rf"{target.name}: is an input of this command"):
            study(settings, Output(stdout=io.StringIO()), file=file, csv=target)
    assert (file.read_bytes(), law.read_bytes()) == before


def test_the_verb_prints_json_and_says_when_it_was_interrupted(
    base: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jointctl.tools.configuration.load.load_config", lambda _: base)
    settings = checked({"plants": 2, "after_s": 1.0, "controllers": ["precise"]}, "test")
    out, err = io.StringIO(), io.StringIO()
    page = tmp_path / "a.html"
    shown = Output(json=True, stdout=out, stderr=err)
    assert study(settings, shown, workers=Workers(1), csv=tmp_path / "a.csv", report=page) == 0
    assert [foreign_colours(svg) for svg in svgs(page.read_text())] == [set()]
    data = json.loads(out.getvalue())
    assert data["plants_done"] == 2
    assert 0.0 < data["controllers"]["precise"]["rmse_mrad"]["median"] < 1.0
    assert data["settings"]["plant"]["encoder_bits"] == [17, 20]
    assert "a.csv" in err.getvalue()

    partial = StudyResult(("precise",), short_study(base, 1, 1).plants[:1], True)
    partial = StudyResult(("precise",), tuple(PlantResult(0, "lugre", 19, p.figures[:1]) for p in partial.plants), True)
    monkeypatch.setattr("jointctl.tools.experiments.controller_study.run_study", lambda *_, **__: partial)
    out, err = io.StringIO(), io.StringIO()
    assert study(settings, Output(stdout=out, stderr=err)) == INTERRUPTED
    assert "interrupted: only 1 of 2 plants" in err.getvalue()
    assert "INTERRUPTED: 1 of 2 plants" in out.getvalue()
    assert "[mrad]" in out.getvalue()
    assert "[s]" in out.getvalue()
    assert "chatter:" in out.getvalue()
    assert "stuck" not in out.getvalue()  # a figure that this motion does not have is not explained either


# --- settings and controllers ---
def test_a_flexible_plant_is_the_rigid_one_with_a_reducer_and_a_second_encoder(base: Config) -> None:
    rigid, flexible = EnsembleSettings(), EnsembleSettings(flexible=True)
    for index in range(20):
        before, after = random_plant(base, rigid, 1, index), random_plant(base, flexible, 1, index)
        assert after.virtual.friction_kind == before.virtual.friction_kind
        assert after.virtual.current_lag_s == before.virtual.current_lag_s
        assert after.joint_encoder.counts_per_turn == before.encoder.counts_per_turn
        assert after.encoder.side == "motor"
        assert before.joint_encoder is None


def test_flexible_plants_fill_their_ranges_and_stay_inside(base: Config) -> None:
    settings = EnsembleSettings(flexible=True)
    plants = [random_plant(base, settings, 1, index) for index in range(400)]
    values = [plant.virtual for plant in plants if plant.virtual is not None]
    inertia = np.array([plant.virtual.inertia_scale * plant.joint.inertia_kgm2 for plant in plants if plant.virtual])
    motor = np.array([value.motor_side_inertia_kgm2 for value in values])
    stiffness = np.array([value.reducer_stiffness_Nmprad for value in values])
    damping = np.array([value.reducer_damping_Nmspr for value in values])
    for drawn, (low, high) in (
        (inertia / base.joint.inertia_kgm2, settings.flexible_inertia_scale),
        ((inertia - motor) / motor, settings.inertia_ratio),
        (damping / (2.0 * np.sqrt(stiffness * motor * (inertia - motor) / inertia)), settings.reducer_damping),
        (np.array([value.hysteresis_width_rad for value in values]), settings.hysteresis_width_rad),
        (np.array([value.kinematic_error_rad[0] for value in values]), settings.kinematic_error_rad),
        (np.array([value.link_friction_share for value in values]), settings.link_friction_share),
    ):
        assert low * (1.0 - 1e-9) <= drawn.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < drawn.max() <= high * (1.0 + 1e-9)
    assert set(stiffness) == {1.0e4, 1.6e4, 3.1e4}
    assert {round(math.log2(plant.encoder.counts_per_turn)) for plant in plants} == {14, 15, 16, 17}


def test_what_the_controller_believes_of_a_reducer_is_wrong_by_as_much_as_is_said(base: Config) -> None:
    for index in range(40):
        plant = random_plant(base, EnsembleSettings(flexible=True), 3, index)
        true, believed = plant.virtual, plant.reducer
        assert true is not None
        assert believed is not None
        link = true.inertia_scale * plant.joint.inertia_kgm2 - true.motor_side_inertia_kgm2
        for belief, truth, error in (
            (believed.motor_inertia_kgm2, true.motor_side_inertia_kgm2, 0.15),
            (plant.joint.inertia_kgm2 - believed.motor_inertia_kgm2, link, 0.15),
            (believed.stiffness_Nmprad, true.reducer_stiffness_Nmprad, 0.15),
            (believed.map.kinematic_error_rad[0], true.kinematic_error_rad[0], 0.05),
        ):
            assert belief == pytest.approx(truth, rel=error)
            assert belief != truth
    blind = random_plant(base, EnsembleSettings(flexible=True, maps=False), 3, 0)
    assert blind.reducer.map is None


def test_every_named_controller_is_a_valid_configuration(base: Config) -> None:
    for controller in named():
        assert controller_config(base, controller).control == controller.control
    assert [c.name for c in named()] == [*TABLE, "precise"]


def test_a_study_file(tmp_path: Path) -> None:
    path = tmp_path / "study.toml"
    path.write_text(
        'plants = 5\nseed = 9\ncontrollers = ["paper"]\n[plant]\nencoder_bits = [14, 16]\n'
        '[variants.damped]\nof = "precise"\nkv = 180.0\n'
    )
    settings = load_study(path)
    assert (settings.plants, settings.seed, settings.plant.encoder_bits) == (5, 9, (14, 16))
    assert settings.plant.friction_scale == EnsembleSettings().friction_scale
    first, second = study_controllers(settings)
    assert (first.name, second.name, second.control.kv) == ("paper", "damped", 180.0)
    assert second.control.learning is not None


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"plant": {"reducer_sizes": [18]}}, "reducer_sizes .*must be some of 17, 20, 25"),
        ({"plants": 0}, r"plants \(=0\): must be in \[1\.\.100000\]"),
        ({"plant": {"encoder_bit": [1, 2]}}, "plant.encoder_bit is not a known key: did you mean encoder_bits"),
        ({"plant": {"friction_scale": [1.1, 0.9]}}, "friction_scale .* two numbers in ascending order"),
        ({"scenario": "storm"}, r"scenario \(=storm\)"),
        ({"seeds": 1}, "seeds is not a known key: did you mean seed"),
    ],
)
def test_a_bad_study_is_one_clear_line(data: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words) as caught:
        checked(data, "study.toml")
    assert caught.value.message.startswith("study.toml: ")


def test_bad_controllers_are_named() -> None:
    with pytest.raises(ConfigurationError, match=r"controller \(=no_such\) must be a configuration file or one of"):
        named(("no_such",))
    with pytest.raises(ConfigurationError, match=r"controller \(=paper\) must be named once"):
        named(("paper", "paper"))
    with pytest.raises(ConfigurationError, match=r"variants.x: kv \(=-1.0\): must be in"):
        study_controllers(StudySettings(variants={"x": {"of": "paper", "kv": -1.0}}))
    with pytest.raises(ConfigurationError, match=r"variants\.x\.of is missing"):
        study_controllers(StudySettings(variants={"x": {"kv": 1.0}}))
    with pytest.raises(ConfigurationError, match=r"variants\.paper must not have the name of another"):
        study_controllers(StudySettings(variants={"paper": {"of": "paper"}}))


@pytest.mark.parametrize(
    ("words", "plants", "flexible"),
    [([], 40, False), (["7"], 7, False), (["realistic"], 40, True), (["realistic", "7"], 7, True)],
)
def test_plants_are_a_number_or_an_ensemble_or_both(words: list[str], plants: int, flexible: bool) -> None:
    settings = with_plants(StudySettings(), words)
    assert (settings.plants, settings.plant.flexible) == (plants, flexible)


def test_flexible_plants_get_the_joint_and_the_laws_that_are_made_for_them() -> None:
    settings = with_plants(StudySettings(), ["realistic"])
    assert (settings.base, settings.controllers[-1]) == ("realistic", "realistic")
    given = checked({"base": "precise", "controllers": ["paper"], "plant": {"flexible": True}}, "test")
    assert (given.base, given.controllers) == ("precise", ("paper",))
    assert checked({"plant": {"flexible": False}}, "test").base == "precise"
    with pytest.raises(ConfigurationError, match=r"test: plant"):
        checked({"plant": 3}, "test")


def test_a_law_for_flexible_joints_may_be_run_on_any_base_that_gets_a_reducer() -> None:
    settings = checked({
        "plants": 1, "after_s": 0.5, "base": "precise", "controllers": ["realistic"], "plant": {"flexible": True},
    }, "test")  # fmt: skip
    assert study(settings, Output(stdout=io.StringIO(), stderr=io.StringIO()), workers=Workers(1)) == 0


def test_rigid_joints_are_not_drawn_from_a_base_with_a_soft_reducer() -> None:
    settings = checked({"plants": 1, "base": "realistic", "controllers": ["precise"]}, "test")
    with pytest.raises(ConfigurationError, match=r"base \(=realistic\) has a \[reducer\], .* --plants realistic"):
        study(settings, Output(stdout=io.StringIO(), stderr=io.StringIO()), workers=Workers(1))


@pytest.mark.parametrize("word", ["0", "-1", "many", "1.5", ""])
def test_plants_that_are_neither_are_refused(word: str) -> None:
    with pytest.raises(ConfigurationError, match=r"plants \(="):
        with_plants(StudySettings(), [word])


def test_a_law_for_flexible_joints_gets_gains_for_each_of_them(base: Config) -> None:
    controllers = named(("realistic", "paper"))
    found = {}
    for choose in (True, False):
        plant = {"flexible": True, "choose_gains": choose}
        settings = checked({"plants": 2, "seed": 5, "after_s": 1.0, "plant": plant}, "test")
        found[choose] = run_study(base, controllers, settings, workers=Workers(1))
        assert found[choose].faults("realistic") == 0
        assert np.max(found[choose].values("realistic", "true_rmse_mrad")) < 0.25
        assert np.max(found[choose].values("realistic", "chatter_Nm")) < 1.0
    differ = [found[choose].values("realistic", "true_rmse_mrad").tolist() for choose in (True, False)]
    assert differ[0] != differ[1]
    same = [found[choose].values("paper", "true_rmse_mrad").tolist() for choose in (True, False)]
    assert same[0] == same[1]


@pytest.mark.parametrize(("law", "rmse_mrad"), [("encoder", 0.4), ("joint_encoder_alone", 1.0)])
def test_with_one_encoder_the_gains_are_those_of_that_encoder(base: Config, law: str, rmse_mrad: float) -> None:
    settings = checked({"plants": 2, "seed": 5, "after_s": 1.0, "plant": {"flexible": True, "law": law}}, "test")
    found = run_study(base, named(("realistic",)), settings, workers=Workers(1))
    assert found.faults("realistic") == 0
    assert np.max(found.values("realistic", "true_rmse_mrad")) < rmse_mrad
    assert np.max(found.values("realistic", "chatter_Nm")) < 1.0
    assert np.min(found.values("realistic", "phase_margin_deg")) > 20.0
