"""What the command leaves: a preset that gives the fitted torque in the model, a report, and exit codes."""

from __future__ import annotations

import json

import numpy as np
import pytest
from matplotlib.image import imread

from magpend_core import evaluate, load_model
from magpend_core.models.pendulum import magnet_torque as laws
from pipeline.rig.magnet.fitting import fit_measurement
from pipeline.rig.magnet.measurement import read_measurement
from pipeline.rig.magnet.results import summary_of, warnings_of, write_results

from .conftest import TRUE


def states(angle, locked):
    return np.stack([angle, angle + locked, 0 * angle, 0 * angle], axis=-1)


def test_write_results__the_preset_gives_the_measured_torque_in_the_model(fitted):
    m, rig = fitted.measured, fitted.rig
    p = load_model("pendulum").load(fitted.folder / "preset.toml")
    at = states(m.angle, m.locked)
    found = evaluate(["magnet_moment"], 0.0, at, p, 2.0)[:, 0]
    # the readings are without noise, and the fit finds their parameters to 1e-8
    np.testing.assert_allclose(found, rig.magnets, rtol=0, atol=1e-8)
    assert (p["l2"], p["h"], p["m1"]) == (0.18, 0.39, 4.275)
    # the generalised torques of Eq. 20 add up to what was measured, but for the regularised slope
    exact = p.replace(delta=1e-9)
    torques = evaluate(["magnet_torque1", "magnet_torque2"], 0.0, at, exact, 2.0)
    np.testing.assert_allclose(torques.sum(axis=1), rig.magnets, rtol=0, atol=1e-8)


def test_write_results__every_value_has_its_origin(fitted):
    found = load_model("pendulum").preset(fitted.folder / "preset.toml")
    assert found.title == "SYNTHETIC: a known torque"
    for name in TRUE:
        assert found.provenance[name].startswith("joint fit of 18 torque curves (SYNTHETIC readings, readings.csv")
    assert found.provenance["h"] == "ruler"
    assert found.provenance["delta"] == "calibrated"
    dipoles = load_model("pendulum-dipole").preset(fitted.folder / "preset-dipoles.toml")
    assert "R2 = " in dipoles.provenance["pole1"]
    assert dipoles.values["h"] == 0.39


def test_write_results__what_is_held_keeps_its_own_origin(rig, tmp_path):
    text = rig.path.read_text().replace("[columns]", 'hold = ["eps_mag"]\n[columns]', 1)
    text = text.replace("[parameters]", "[parameters]\neps_mag = 60.0")
    rig.path.write_text(text.replace("[provenance]", '[provenance]\neps_mag = "an older rig"'))
    outcome = fit_measurement(read_measurement(rig.path))
    write_results(outcome, tmp_path)
    found = load_model("pendulum").preset(tmp_path / "preset.toml")
    assert (found.values["eps_mag"], found.provenance["eps_mag"]) == (60.0, "an older rig")
    assert found.values["alpha1"] == outcome.joint.values["alpha1"] != pytest.approx(TRUE["alpha1"], rel=1e-3)
    report = json.loads((tmp_path / "fit.json").read_text())
    assert report["joint"]["held"] == ["eps_mag"]
    assert report["joint_with_nothing_held"]["values"] == pytest.approx(TRUE, rel=1e-8)
    assert any(line.startswith("joint fit, nothing held") for line in summary_of(outcome))


def test_report__holds_curves_joint_fit_and_dipoles(fitted):
    outcome = fitted.outcome
    report = json.loads((fitted.folder / "fit.json").read_text())
    assert report["synthetic"] is True
    assert report["n_readings"] == 378
    assert len(report["curves"]) == 18
    first = report["curves"][0]
    assert (first["psi_rel_deg"], first["side"], first["n"]) == (-32.0, "right", 21)
    assert set(first["values"]) == set(first["standard_errors"]) == {"A", "b", "c"}
    joint = report["joint"]
    assert joint["values"] == pytest.approx(TRUE, rel=1e-8)
    assert np.shape(joint["correlation"]["matrix"]) == (13, 13)
    assert set(joint["standard_errors"]) == set(joint["standard_errors_by_curve"]) == set(TRUE)
    assert joint["transition"]["slope"] == pytest.approx(laws.transition(TRUE).slope)
    assert report["point_dipoles"]["at_the_magnet"]["r2"] < 0.96 < joint["r2"]
    assert report["joint_with_nothing_held"] is None
    assert any("point dipoles" in line for line in summary_of(outcome))
    assert warnings_of(outcome) == []


@pytest.mark.slow
def test_fit_magnet__writes_all_and_says_where(main, rig, tmp_path):
    out = tmp_path / "fit"
    code, result, notes = main("fit-magnet", str(rig.path), "--out", str(out))
    assert code == 0, notes
    names = {"fit.json", "preset.toml", "preset-dipoles.toml"}
    names |= {f"fig{i}.{suffix}" for i in (6, 7, 8, 9) for suffix in ("png", "nc")}
    assert {path.name for path in out.iterdir()} == names
    assert "alpha1" in result
    assert "point dipoles" in result
    assert f'preset = "{out / "preset.toml"}"' in notes
    assert min(imread(out / "fig8.png").shape[:2]) > 300


def test_fit_magnet__json_is_the_report_and_the_preset_drives_a_simulation(main, rig, tmp_path):
    code, result, _ = main("fit-magnet", str(rig.path), "--out", str(tmp_path / "x"), "--json", "--no-figures")
    assert code == 0
    assert json.loads(result)["joint"] == json.loads((tmp_path / "x" / "fit.json").read_text())["joint"]
    assert not list((tmp_path / "x").glob("fig*"))
    series = tmp_path / "t.csv"
    words = ["--preset", str(tmp_path / "x" / "preset.toml"), "--periods", "2", "--out", str(series)]
    assert main("simulate", *words, "--no-figure")[0] == 0
    assert len(series.read_text().splitlines()) == 402


@pytest.mark.slow
def test_fit_magnet__takes_a_measurement_that_ships_by_name(main, tmp_path):
    code, result, notes = main("fit-magnet", "discs", "--no-figures")
    assert code == 0
    assert result.startswith("SYNTHETIC: two 33 mm x 10 mm N38 discs")
    assert "the law does not fit, and they are more than noise" in notes
    assert (tmp_path / "discs-fit" / "preset.toml").is_file()
    code, _, notes = main("fit-magnet", "disks")
    assert code == 2
    assert "did you mean discs" in notes


def test_fit_magnet__refuses_a_bad_measurement_and_writes_nothing(main, rig, tmp_path):
    rig.path.write_text(rig.path.read_text().replace('"torque"', '"moment"'))
    code, _, notes = main("fit-magnet", str(rig.path), "--out", str(tmp_path / "fit"))
    assert code == 2
    assert "columns.torque = 'moment': readings.csv has no such column" in notes
    assert not (tmp_path / "fit").exists()
    assert main("fit-magnet", str(rig.path), "--out", str(tmp_path / "no" / "fit"))[0] == 2
    assert main("fit-magnet", str(tmp_path / "absent.toml"))[0] == 2


def test_fit_magnet__a_fit_that_does_not_converge_is_no_result(main, rig, tmp_path):
    rig.table.write_text(rig.table.read_text().replace("right", "R").replace("left", "right").replace("R", "left"))
    code, _, notes = main("fit-magnet", str(rig.path), "--out", str(tmp_path / "fit"))
    assert code == 4
    assert "no peak of the expected sign" in notes
    assert not (tmp_path / "fit").exists()
