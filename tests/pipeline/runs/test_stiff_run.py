"""Analyses of a run by the method for stiff systems: the same conclusions as by an explicit one, to their accuracy."""

import numpy as np
import pytest

from pipeline.runs.derive import AnalysedRun
from pipeline.runs.run import run
from pipeline.store.run import RunDirectory
from tests.pipeline.factories import silent
from tests.pipeline.runs.test_golden_bits import DRIVE, DUFFING, RUNS

SPEC = """kind = "sweep"
[model]
name = "relaxation"
states = { x = {}, v = {} }
parameters = { mu = 20.0, A = 5.0 }
equations = { x = "v", v = "mu*(1 - x**2)*v - x + 0.05*A*mu*cos(2*pi*f*t)" }
[initial_conditions]
kind = "list"
points = [[2.0, 0.0], [-1.0, 0.3], [0.5, 1.0]]
[axes]
frequency_hz = { start = 0.05, stop = 0.12, num = 8 }
[integration]
n_transient = 40
n_keep = 12
rtol = 1e-9
atol = 1e-9
method = "METHOD"
[products]
lyapunov = { n_transient = 8, n_periods = 32, n_blocks = 4 }
"""

WATCHED = f'{DUFFING}[products]\nextremes = {{ quantities = ["x"] }}\n'


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """Runs by the explicit and by the stiff method, with a list of the methods that integrated in each."""
    folder, found = tmp_path_factory.mktemp("stiff"), {}
    for method in ("dopri5", "rodas5p"):
        (folder / "spec.toml").write_text(SPEC.replace("METHOD", method), "utf-8")
        run(folder / "spec.toml", folder / method, workers=0, echo=silent)
        found[method] = RunDirectory.open(folder / method)
    return found


def of(both, analysis, **options):
    return [AnalysedRun.of(one).derive(analysis, **options) for one in both.values()]


def test_systems__of_a_stiff_run_have_its_method(both):
    explicit, stiff = (one.spec.model for one in both.values())
    assert (explicit.system.method, stiff.system.method) == ("dopri5", "rodas5p")
    assert stiff.digest == explicit.digest


@pytest.mark.slow
def test_attractors__of_a_stiff_run_are_those_of_an_explicit_one(both):
    explicit, stiff = of(both, "attractors")
    for name in ("decision", "stability", "kind", "status"):
        assert (stiff[name].values == explicit[name].values).all(), name
    for name, near in (("state_min", 1e-5), ("state_max", 1e-5), ("multiplier_real", 1e-7), ("multiplier_imag", 1e-7)):
        np.testing.assert_allclose(stiff[name].values, explicit[name].values, atol=near)
    first, second = (one.cube() for one in both.values())
    # what contracts by much within a step is damped as the method damps it
    np.testing.assert_allclose(second.lyapunov, first.lyapunov, rtol=2e-3)
    np.testing.assert_allclose(second.lyapunov[..., 0], first.lyapunov[..., 0], rtol=1e-5)


@pytest.mark.slow
def test_bifurcations__of_a_stiff_run_are_those_of_an_explicit_one(both):
    explicit, stiff = of(both, "branches")
    np.testing.assert_allclose(stiff.value.values, explicit.value.values, rtol=1e-8)
    for part in ("real", "imag"):
        values = [one[f"bifurcation_multiplier_{part}"].values for one in (explicit, stiff)]
        np.testing.assert_allclose(*values, atol=1e-6)
    explicit, stiff = of(both, "events")
    assert (stiff.what.values == explicit.what.values).all()
    np.testing.assert_allclose(stiff.value.values, explicit.value.values, rtol=1e-8)
    explicit, stiff = of(both, "curves", second="A", second_low=4.0, second_high=6.0)
    for name, near in (("special_first", 1e-6), ("special_second", 1e-4), ("first_end", 1e-8)):
        np.testing.assert_allclose(stiff[name].values, explicit[name].values, rtol=near)
    explicit, stiff = of(both, "sensitivities")
    for name, near in (("derivative", 1e-5), ("elasticity", 1e-5)):
        np.testing.assert_allclose(stiff[name].values, explicit[name].values, rtol=near)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["drift", "recorded drive", "friction", "watched"])
def test_cells__of_a_stiff_run_are_those_of_an_explicit_one(tmp_path, name):
    (tmp_path / "drive.csv").write_text(DRIVE, "utf-8")
    found = []
    for method in ("dopri5", "rodas5p"):
        text = (
            {**RUNS, "watched": WATCHED}[name]
            .replace("[integration]", f'[integration]\nmethod = "{method}"')
            .replace("1e-7", "1e-10")
            .replace("= 6", "= 0")
        )
        (tmp_path / "spec.toml").write_text(text, "utf-8")
        run(tmp_path / "spec.toml", tmp_path / method, workers=0, echo=silent)
        found.append(RunDirectory.open(tmp_path / method).cube())
    explicit, stiff = found
    assert (stiff.status.values == explicit.status.values).all()
    np.testing.assert_allclose(stiff.section.values, explicit.section.values, atol=2e-5)
    assert (stiff.n_steps.values != explicit.n_steps.values).any()
    if name == "watched":
        np.testing.assert_allclose(stiff.extremes.values, explicit.extremes.values, atol=1e-4)
