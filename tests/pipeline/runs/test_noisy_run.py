"""Runs with noise: from the specification to tables and figures, extension, and what is refused."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad

from pipeline import open_run
from pipeline.layout.vocabulary import model_of, parameters_of
from pipeline.runs.derive import derive
from pipeline.runs.extend import extend
from pipeline.runs.noise import warn_of_steps
from pipeline.runs.run import run
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.store.run import RunDirectory
from tests.pipeline.factories import WELL, finished, quietly

S = (0.45, 0.55, 0.7)


def spec(**changes: Any) -> dict[str, Any]:
    """The specification as tables, with keys of tables replaced."""
    tables = tomllib.loads(WELL)
    for name, change in changes.items():
        tables[name] = {**tables.get(name, {}), **change} if isinstance(change, dict) else change
    return tables


def passage_time(s: float, end: float, start: float = -1.0) -> float:
    """Mean time in which dx = (x - x^3) dt + s dW first reaches `end`, by quadrature (Gardiner, eq. 5.5.19)."""

    def potential(x: float) -> float:
        return -0.5 * x * x + 0.25 * x**4

    def inner(y: float) -> float:
        def weight(z: float) -> float:
            return math.exp(2.0 * (potential(y) - potential(z)) / s**2)

        return quad(weight, -3.0, y, epsabs=1e-10, points=[min(-1.0, y)])[0]

    return 2.0 / s**2 * quad(inner, start, end, epsabs=1e-8, limit=200)[0]


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished(tmp_path_factory.mktemp("noise"), WELL)


@pytest.mark.slow
def test_escapes__mean_first_passage_time_by_quadrature(directory):
    ds = derive(directory, "escapes", {"high": {"x": 0.8}})
    for s in S:
        one = ds.sel(noise_x=s).isel(set=0)
        assert int(one["n_cells"]) == 200
        # cells are in the well at the first section; looked at the sections alone, times are 10 to 20 % longer
        assert float(one["rate_low"]) < 1.0 / passage_time(s, 0.8) < float(one["rate_high"])
        # halved steps are on the same path of the noise, and few cells pass elsewhere
        assert float(one["rate_halved"]) == pytest.approx(float(one["rate"]), rel=0.05)
        assert float(one["interval"]) == pytest.approx(0.2 / 8)
        assert one["exit_mean"].item() == pytest.approx(0.8, abs=0.05)
        # all but the censored cells leave
        assert int(one["n_left"]) > 190
        assert list(one["n_to"].values) == [0, int(one["n_left"])]


def test_escapes__kramers_fit_has_the_barrier(directory):
    ds = derive(directory, "escapes", {"high": {"x": 0.8}}).isel(set=0)
    # U = -x^2/2 + x^4/4 has a barrier of 1/4, and the exponent is twice that; the prefactor's own change with the
    # strength, 1 - 3 s^2/4 to first order, tilts the line by some .06 between these strengths
    assert float(ds["barrier_low"]) - 0.08 < 0.5 < float(ds["barrier_high"]) + 0.08
    # Kramers' formula with its next order, a factor 1 + 3 s^2/4 of the time: Larson and Kostin, J. Chem. Phys. 69
    # (1978) 4821
    s = 0.45
    corrected = math.pi * math.sqrt(2.0) * math.exp(0.5 / s**2) * (1.0 + 0.75 * s**2)
    one = ds.sel(noise_x=s)
    assert float(one["rate_low"]) < 1.0 / corrected < float(one["rate_high"])
    assert passage_time(s, 0.8) == pytest.approx(corrected, rel=0.06)  # what is beyond this order


@pytest.mark.slow
def test_density__of_the_double_well(directory):
    ds = derive(directory, "density", {"skip": 250, "bandwidth": 0.3}).sel(noise_x=0.7)
    value = ds["value"].values
    exact = np.exp(2.0 * (0.5 * value**2 - 0.25 * value**4) / 0.49)
    exact /= exact.sum() * (value[1] - value[0])
    # 200 cells: the share of a well is known to a few percent, the shape within to the histogram's noise
    assert np.abs(ds["density"].values - exact).max() < 0.06
    assert int(ds["n_peaks"]) == 2
    assert sorted(ds["peak"].values[:2]) == pytest.approx([-1.0, 1.0], abs=0.1)
    assert float(ds["variance"]) == pytest.approx(float((exact * value**2).sum() / exact.sum()), rel=0.05)


def test_run__stores_noise_and_errors(directory):
    cube = open_run(directory)
    assert cube["strong_error"].notnull().all()
    assert float(cube["strong_error"].max()) < 0.01
    assert model_of(cube).parameter_names == ("a", "noise_x", "realization")
    assert parameters_of(cube)["noise_x"] == 0.5
    # cells that differ in the realization alone have independent noise
    last = cube["section"].isel(period_index=5, state=0, noise_x=0, initial_condition=0).values
    assert len(np.unique(last)) == 200


SMALL: dict[str, Any] = {
    "axes": {"noise_x": {"values": [0.2]}, "realization": {"start": 0, "stop": 19, "step": 1}},
    "integration": {"n_transient": 2, "n_keep": 5},
}


@pytest.mark.slow
def test_extend__gives_the_bytes_of_a_longer_run(tmp_path, bytes_of):
    short = WELL.replace("[0.45, 0.55, 0.7]", "[0.2]").replace("stop = 199", "stop = 19")
    short = short.replace("n_transient = 0", "n_transient = 2").replace("n_keep = 1000", "n_keep = 5")
    longer = short.replace("[0.2]", "[0.2, 0.3]").replace("stop = 19", "stop = 24").replace("n_keep = 5", "n_keep = 9")
    for name, text in (("short", short), ("whole", longer)):
        (tmp_path / f"{name}.toml").write_text(text)
        quietly(tmp_path / f"{name}.toml", tmp_path / name)
    lines: list[str] = []
    extend(tmp_path / "short", tmp_path / "whole.toml", out=tmp_path / "wide", workers=0, echo=lines.append)
    assert any("30 cells are left to integrate" in line for line in lines), lines
    assert bytes_of(tmp_path / "whole") == bytes_of(tmp_path / "wide")
    # the first cells of the short run are kept as they were
    first, whole = (open_run(tmp_path / name)["section"].values for name in ("short", "whole"))
    np.testing.assert_array_equal(first[0], whole[0, :20, :, :5])


@pytest.mark.slow
def test_run__tasks_do_not_change_the_numbers(tmp_path):
    for n in (3, 20):
        quietly(spec(**SMALL, execution={"trajectories_per_task": n}), tmp_path / str(n))
    few, all_ = (open_run(tmp_path / str(n)) for n in (3, 20))
    np.testing.assert_array_equal(few["section"].values, all_["section"].values)


@pytest.mark.slow
def test_derive__refuses_analyses_of_the_other_kind(directory, tmp_path):
    with pytest.raises(SpecError, match="its cells have noise; attractors needs a run without"):
        derive(directory, "attractors")
    plain = {k: v for k, v in spec(**SMALL).items() if k != "noise"}
    plain["axes"] = {"a": {"values": [1.0]}}
    quietly(plain, tmp_path / "plain")
    with pytest.raises(SpecError, match="escapes needs a run with noise"):
        derive(tmp_path / "plain", "escapes", {"high": {"x": 0.8}})
    with pytest.raises(SpecError, match="has no classifier of motions"):
        derive(directory, "escapes")
    with pytest.raises(SpecError, match="'y' is not a state"):
        derive(directory, "escapes", {"high": {"y": 0.8}})


def test_run__refuses_steps_that_are_too_long(tmp_path):
    with pytest.raises(SpecError, match=r"noise.steps_per_period = 1: halving .* set steps_per_period = \d"):
        run(spec(**SMALL, noise={"steps_per_period": 1}, parameters={"frequency_hz": 1.0}), tmp_path / "a", workers=0)
    stiff = {"equations": {"x": "-x - tanh(2000*x)"}, "name": "dry", "parameters": {}}
    with pytest.raises(SpecError, match=r"contract at 2001 /s in a layer; steps must be shorter than 0.00125 s"):
        run(spec(**SMALL, model=stiff), tmp_path / "b", workers=0)
    assert not (tmp_path / "a").exists()
    assert not (tmp_path / "b").exists()


def test_warn_of_steps__counts_the_cells_above_the_tolerance(directory):
    lines: list[str] = []
    for tolerance in (0.01, 1e-9):
        run = SimpleNamespace(
            spec=Spec.parse(spec(noise={"tolerance": tolerance})), cube=RunDirectory.open(directory).cube
        )
        warn_of_steps(run, lines.append)
    assert len(lines) == 1
    assert lines[0].startswith("warning: in 600 of 600 cells the last period changes by more than noise.tolerance")


PROBLEMS = [
    ({"noise": {"strengths": {"y": 0.1}}}, r"noise.strengths.y: is not a state of well"),
    ({"noise": {"strengths": {"x": "a*x"}}}, r"noise.interpretation: missing"),
    ({"noise": {"strengths": {"x": -1.0}}}, r"noise.strengths.x = -1.0: must be 0 or greater"),
    ({"noise": {"strengths": {}}}, r"noise.strengths"),
    ({"noise": {"step": 0.1}}, r"noise: give steps_per_period or step, not both"),
    ({"section": {"of": "x"}}, r"noise: a noisy state crosses a level infinitely often"),
    ({"integration": {"stop_when_closed": True}}, r"integration.stop_when_closed: noisy cells do not close"),
    ({"products": {"lyapunov": {}}}, r"products.lyapunov: is defined for runs without noise"),
    ({"kind": "continuation", "continuation": {"path": "noise_x"}}, r"noise: a continuation follows an attractor"),
    ({"axes": {"noise_x": {"values": [-0.1, 0.2]}}}, r"axes.noise_x: .*0 or greater"),
]


def test_parse_spec__noise_problems():
    for changes, problem in PROBLEMS:
        with pytest.raises(SpecError, match=problem) as caught:
            Spec.parse(spec(**changes))
        if "noise" in changes:  # what only follows from it is not said
            assert not any("axes." in p for p in caught.value.problems)


def test_parse_spec__reads_back_what_it_writes():
    parsed = Spec.parse(spec(noise={"strengths": {"x": "0.1*a*x"}, "interpretation": "ito"}))
    again = Spec.parse(parsed.as_dict(), None)
    assert again.noise == parsed.noise
    assert again.model.digest == parsed.model.digest
    assert again.model.digest != Spec.parse(spec()).model.digest
    assert parsed.values["noise_x"] == 1.0
