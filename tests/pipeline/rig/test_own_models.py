"""The rig with a model of one's own as text: recordings, a virtual rig, an identification."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from magpend_core.models import load_model
from pipeline.layout.vocabulary import model_of
from pipeline.rig.identify import identification
from pipeline.rig.identify.validation import check
from pipeline.rig.recordings import load_mapping, mapping_for, parse_mapping, read_recording, write_recording
from pipeline.rig.recordings.reading import recording_of
from pipeline.rig.virtual import load_rig, simulated
from pipeline.specification.problems import SpecError

from .identify.test_identification import MAPPING, TRUTH, oscillator, write_ringdowns

MODEL = """
name = "spring"
states = { x = "m", v = "m/s" }
parameters = { damping = 0.15, linear = 1.1, cubic = 0.4 }
equations = { x = "v", v = "-damping*v - linear*x - cubic*x**3" }
"""
SPEC = """
kind = "identification"
model = "spring.toml"
[identify.damping]
start = 0.1
bounds = [0.0, 1.0]
[identify.linear]
start = 1.0
[identify.cubic]
start = 0.5
[sensors]
zero = ["x"]
[[recordings]]
file = "swing.csv"
mapping = "mapping.toml"
[search]
n_starts = 1
profiles = false
"""
RIG = """
model = "spring.toml"
sampling_rate_hz = 20.0
duration_s = 20.0
initial_state = { x = 1.5 }
[sensors.x]
kind = "encoder"
noise = 0.002
"""


@pytest.fixture
def bench(tmp_path):
    """A folder with a model, a mapping and a recording by DOP853."""
    write_ringdowns(tmp_path / "swing.csv", 1, n_pieces=2)
    mapping = MAPPING.replace('"duffing"', '"spring.toml"')
    for name, text in (("spring", MODEL), ("mapping", mapping), ("spec", SPEC), ("rig", RIG)):
        (tmp_path / f"{name}.toml").write_text(text)
    return tmp_path


def test_mapping__keeps_the_text_of_its_model(bench):
    mapping = load_mapping(bench / "mapping.toml")
    assert mapping.system is load_model({"name": "spring", **tomllib.loads(MODEL)})
    (bench / "spring.toml").unlink()
    assert parse_mapping(mapping.toml()) == mapping
    with pytest.raises(SpecError, match=r"spring\.toml: cannot be read"):
        load_mapping(bench / "mapping.toml")
    with pytest.raises(SpecError, match="keeps the text"):
        parse_mapping(MAPPING.replace('"duffing"', '"spring.toml"'))


def test_read_recording__says_its_model_and_writes_it_back(bench):
    ds = read_recording(bench / "swing.csv", bench / "mapping.toml")
    assert json.loads(ds.attrs["model"])["name"] == "spring"
    assert model_of(ds).state("x").unit == "m"
    write_recording(ds, bench / "again.csv")
    again = read_recording(bench / "again.csv", mapping_for(ds, bench / "again.csv"))
    assert np.array_equal(again["x"], ds["x"])
    assert model_of(again) is model_of(ds)


@pytest.mark.slow
def test_load_rig__text_of_a_file(bench):
    raw, mapping = simulated(load_rig(bench / "rig.toml"))
    assert mapping.system.name == "spring"
    x = recording_of(raw, mapping)["x"].values
    t = np.arange(x.size) / 20.0
    wanted = solve_ivp(oscillator, (0.0, t[-1]), [1.5, 0.0], "DOP853", t, rtol=1e-10, atol=1e-10).y[0]
    assert np.std(x - wanted) == pytest.approx(0.002, rel=0.15)


@pytest.mark.slow
def test_identify__text_of_a_file_and_without_it_afterwards(bench):
    result = identification.identify(bench / "spec.toml", bench / "out", figures=False, echo=lambda line: None)
    for name, value in TRUTH.items():
        low, high = result["estimates"][name]["interval"]
        assert low - 0.5 * (high - low) < value < high + 0.5 * (high - low), name
    assert result["model"]["equations"]["x"] == "v"
    preset = load_model(result["model"]).preset(bench / "out" / "preset.toml")
    assert preset.values["linear"] == pytest.approx(1.1, rel=0.02)
    lines = []
    identification.identify(bench / "spec.toml", bench / "out", figures=False, echo=lines.append)
    assert any("nothing to do" in line for line in lines)
    for name in ("spring", "mapping", "spec"):
        (bench / f"{name}.toml").unlink()
    assert check(bench / "out", bench / "swing.csv")["rms"]["x"] == pytest.approx(0.004, rel=0.15)
