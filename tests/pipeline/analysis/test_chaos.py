"""Chaos of a cube's cells: motion, means with errors, transients; what is printed and refused."""

from __future__ import annotations

import csv
import re

import numpy as np
import pytest
import xarray as xr

from magpend_core import Status, load_preset, polish_orbits
from pipeline import open_run
from pipeline.analysis.chaos.chaos import chaos, section_dimension
from pipeline.analysis.chaos.lyapunov import pooled_mean
from pipeline.cli.analyse import CHAOS_OPTIONS, DIMENSION_OPTIONS
from pipeline.cli.exits import Exit
from pipeline.plots import plot_convergence, plot_dimension
from pipeline.products import derived
from pipeline.products import tables as report

STATES = ["psi1", "psi2", "psi1_dot", "psi2_dot"]
SPREAD = np.array([0.0, -0.4, -0.9, -1.5])


def made_up(first, frequency=(2.0,), *, stderr=0.02, n_blocks=16, n_keep=5):
    """Cube with exponents; `first` are the largest, shape (frequency, cell)."""
    first = np.atleast_2d(np.asarray(first, float))
    spectrum = first[..., None] + SPREAD
    wave = 0.05 * np.resize([1.0, -1.0], n_blocks)
    cells = ("frequency", "initial_condition")
    rng = np.random.default_rng(0)
    return xr.Dataset(
        {
            "section": ((*cells, "period_index", "state"), rng.uniform(-1, 1, (*first.shape, n_keep, 4))),
            "status": (cells, np.full(first.shape, Status.BOUNDED, np.int8)),
            "orbit_period": (cells, np.zeros(first.shape, np.int16)),
            "lyapunov": ((*cells, "exponent"), spectrum, {"units": "1/s"}),
            "lyapunov_stderr": ((*cells, "exponent"), np.full(spectrum.shape, stderr)),
            "lyapunov_blocks": ((*cells, "block", "exponent"), spectrum[..., None, :] + wave[:, None]),
            "divergence": (cells, spectrum.sum(-1)),
            "lyapunov_flag": (cells, np.ones(first.shape, np.int8)),
        },
        coords={
            "frequency": ("frequency", list(frequency), {"units": "Hz"}),
            "state": STATES,
            "exponent": np.arange(1, 5),
        },
    )


def test_chaos__means_by_motion():
    found = chaos(made_up([0.3, 0.36, -0.2, 0.01]))
    assert found.n_cells.values.tolist() == [[0, 1, 1, 2, 0, 2]]
    chaotic = found.isel(frequency=0).sel(kind="chaotic")
    assert chaotic.mean_lyapunov.values == pytest.approx(0.33 + SPREAD)
    # two cells 0.06 apart with errors of 0.02: variance 0.0018 between, of which 0.0004 is explained
    assert chaotic.mean_lyapunov_stderr.values == pytest.approx(np.sqrt(0.0018 / 2))
    assert chaotic.mean_lyapunov_between.values == pytest.approx(np.sqrt(0.0014))
    assert chaotic.mean_lyapunov_per_period.values == pytest.approx((0.33 + SPREAD) / 2.0)
    assert chaotic.mean_lyapunov_per_period_stderr.values == pytest.approx(np.sqrt(0.0018 / 2) / 2.0)
    # one cell has its own error
    assert found.mean_lyapunov_stderr.sel(kind="regular").values == pytest.approx(0.02)
    # sums 0.3, 0.2, -0.4 and 0.36, 0.32, -0.22
    dimensions = [2 + 0.2 / 0.6, 2 + 0.32 / 0.54]
    assert found.kaplan_yorke_dimension.values[0, :3] == pytest.approx([*dimensions, 0.0])
    assert chaotic.mean_kaplan_yorke.item() == pytest.approx(np.mean(dimensions))


def test_pooled_mean__covers_what_it_says():
    """Standard errors against the scatter of the means of many made-up samples."""
    rng = np.random.default_rng(1)
    for between, within in ((0.0, 0.3), (0.5, 0.3), (0.5, 0.0)):
        errors = within * rng.uniform(0.5, 1.5, (4000, 8))
        values = 2.0 + between * rng.standard_normal((4000, 8)) + errors * rng.standard_normal((4000, 8))
        mean, stderr, apart = pooled_mean(values, errors, np.ones((4000, 8), bool))
        assert np.sqrt((stderr**2).mean()) == pytest.approx(mean.std(), rel=0.2 if between == 0 else 0.05)
        if between:
            assert np.sqrt((apart**2).mean()) == pytest.approx(between, rel=0.05)


def test_chaos__exponents_after_the_first_are_of_good_cells():
    cube = made_up([0.3, 0.36])
    cube["lyapunov_flag"][0, 1] = 3
    found = chaos(cube).isel(frequency=0).sel(kind="chaotic")
    assert found.mean_lyapunov.values == pytest.approx([0.33, -0.1, -0.6, -1.2])
    assert int(found.n_unresolved) == 1
    cube["lyapunov_flag"][0, 1] = 4
    found = chaos(cube).isel(frequency=0)
    assert found.n_failed.sel(kind="unknown") == 1
    assert found.mean_lyapunov.sel(kind="chaotic").values[0] == pytest.approx(0.3)


def test_chaos__transients_and_drift():
    cube = made_up([0.3, 0.3, 0.3])
    cube["lyapunov_blocks"][0, 0, 11:, 0] -= 0.8  # chaos for 11 of 16 blocks, then decay
    cube["lyapunov_blocks"][0, 1, 8:, 0] += 0.5  # drifts, but stays chaotic
    found = chaos(cube).isel(frequency=0)
    assert found.is_transient.values.tolist() == [1, 0, 0]
    row = found.sel(kind="chaotic")
    assert (int(row.n_transient), int(row.n_drifting), int(row.n_cells)) == (1, 2, 3)
    # an orbit with complex multipliers, on which chaos ends: means of -0.1 among swings of 0.2
    cube["lyapunov_blocks"][0, 2, 8:, 0] = -0.1 + 0.2 * np.resize([1.0, -1.0], 8)
    assert chaos(cube).is_transient.values.tolist() == [[1, 0, 1]]
    # lasting chaos that is weaker at the end, and an orbit from the beginning
    cube["lyapunov_blocks"][0, 0, 12:, 0] = 0.02
    cube["lyapunov_blocks"][0, 2, :, 0] = -0.1 + 0.2 * np.resize([1.0, -1.0], 16)
    # and one about zero, whose swings are no evidence
    step = np.repeat([0.1, -0.1], 8)  # 2 standard errors of the difference
    cube["lyapunov_blocks"][0, 1, :, 0] = step + 0.12 * np.resize([1.0, -1.0], 16)
    # an orbit that is approached along a slower direction first
    cube["lyapunov_blocks"][0, 0, :, 0] = np.repeat([-0.01, -0.3], 8) + 1e-3 * np.resize([1.0, -1.0], 16)
    assert chaos(cube).is_transient.values.tolist() == [[0, 0, 0]]
    few = chaos(cube.isel(block=slice(0, 11)))
    assert few.is_transient.values.tolist() == [[-1, -1, -1]]


def test_chaos__hyperchaotic_and_chaotic_cells_together():
    # the second exponents are 0.05 and 0.2, with errors of 0.02
    ds = chaos(made_up([0.45, 0.6]))
    assert ds.n_cells.values.tolist() == [[0, 0, 0, 1, 1, 2]]
    assert ds.mean_lyapunov.sel(kind="all_chaotic").values[0, 0] == pytest.approx(0.525)
    assert [row["motion"] for row in report.chaos_rows(ds)] == ["chaotic", "hyperchaotic", "all_chaotic"]
    one = chaos(made_up([0.3, 0.36]))
    assert [row["motion"] for row in report.chaos_rows(one)] == ["chaotic"]


def test_chaos__zero_one_needs_sections():
    short = chaos(made_up([0.3]))
    assert "0-1 test: 5 sections, and it needs 200; raise n_keep" in short.attrs["not_computed"]
    assert "zero_one" not in short
    noise = chaos(made_up([0.3], n_keep=400))
    assert noise.attrs["not_computed"] == ""
    assert noise.zero_one.values[0, 0] > 0.9
    assert noise.median_zero_one.sel(kind="chaotic").item() == noise.zero_one.values[0, 0]


def test_chaos__without_exponents():
    cube = made_up([0.3, -0.2], n_keep=256)[["section", "status", "orbit_period"]]
    cube["orbit_period"][0, 1] = 2
    found = chaos(cube)
    assert "run it with [products] lyapunov" in found.attrs["not_computed"]
    assert found.n_cells.values.tolist() == [[1, 1, 0, 0, 0, 0]]
    assert np.isfinite(found.median_zero_one.sel(kind="unknown")).all()
    with pytest.raises(ValueError, match=r"nothing to compute\. Lyapunov exponents.*0-1 test: 128 sections"):
        chaos(cube, stride=2)


def test_options__are_those_of_the_analysis():
    assert {p.name: p.default for p in CHAOS_OPTIONS} == derived.chaos_defaults()


def test_chaos_lines__a_summary_if_there_are_many_points():
    frequency = np.arange(8) * 0.5 + 1.0
    rates = np.full((8, 2), -0.2)
    rates[[0, 1, 4], 0] = [0.3, 0.38, 0.33]
    ds = chaos(made_up(rates, frequency))
    lines = report.chaos_lines(ds, report.chaos_rows(ds))
    assert lines[0] == "motion of 16 cells at 8 parameter points"
    assert re.search(r"^  regular +13 +8 +1 to 4\.5$", lines[2])
    assert re.search(r"^  chaotic +3 +3 +1 to 1\.5, 3$", lines[3])
    assert lines[4] == (
        "  largest mean of exponent 1: 0.380 ± 0.020 per s, 0.253 ± 0.013 per drive period, chaotic, "
        "at frequency 1.5 Hz"
    )
    assert "-0.200 ± 0.0" in lines[5]
    assert lines[6] == "  cells flagged: none"


RUN = """
kind = "sweep"
[axes]
frequency_hz = { values = [2.2, 2.4] }
[initial_conditions]
kind = "random"
n = 4
seed = 7
psi1_deg = [-20.0, 20.0]
psi2_deg = [-20.0, 20.0]
[integration]
rtol = 1e-7
atol = 1e-7
n_transient = 600
n_keep = 200
[products]
lyapunov = { n_transient = 100, n_periods = 400, n_blocks = 16 }
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Order at 2.2 Hz, chaos at 2.4 Hz."""
    from pipeline.runs import run as runs

    folder = tmp_path_factory.mktemp("chaos")
    (folder / "spec.toml").write_text(RUN)
    runs.run(folder / "spec.toml", folder / "run", workers=0, echo=lambda _: None)
    return folder / "run"


def test_analyse_chaos__order_and_chaos(main, run, tmp_path):
    code, out, err = main("analyse", run, "chaos", "--csv", tmp_path / "c.csv")
    assert (code, err) == (0, "")
    at = out.index("frequency 2.4 Hz:")
    assert re.search(r"regular +4 +0 ", out[:at])
    assert re.search(r"chaotic +\d ", out[at:])
    assert re.search(r"chaotic +s +0\.\d+ ± 0\.\d+", out[at:])
    assert re.search(r"chaotic +drive period +0\.\d+ ± 0\.\d+", out[at:])
    with (tmp_path / "c.csv").open() as file:
        rows = list(csv.DictReader(file))
    regular = next(row for row in rows if row["motion"] == "regular")
    # the logarithms of the multipliers of the orbits, which are of several periods
    closed = open_run(run).sel(frequency=2.2)
    orbit = polish_orbits(
        np.tile(load_preset().pack(), (4, 1)), np.full(4, 2.2), closed.section.values[:, -1],
        closed.orbit_period.values,
    )  # fmt: skip
    growth = np.log(np.abs(orbit.multipliers)).max(axis=1) * 2.2 / closed.orbit_period.values
    assert float(regular["lyapunov_1"]) == pytest.approx(growth.mean(), abs=1e-4)
    for row in rows:
        per_period = float(row["lyapunov_1"]) / float(row["frequency"])
        assert float(row["lyapunov_1_per_period"]) == pytest.approx(per_period, rel=1e-12)
    assert main("analyse", run, "chaos")[1].startswith("chaos: taken from")
    assert main("analyse", run, "chaos", "--least", "0.01")[1].startswith("chaos: computed")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--n-sigma", "0"], "n_sigma = 0 is out of bounds: it must be greater than 0."),
        (["--least", "-1"], "least = -1 is out of bounds: it must be 0 or more."),
        (["--n-frequencies", "9"], "n_frequencies = 9 is out of bounds: it must be 10 or more."),
        (["--stride", "0"], "stride = 0 is out of bounds: it must be 1 or more."),
        (["--seed", "-1"], "seed = -1 is out of bounds: it must be 0 or more."),
        (["--least", "nan"], "least = nan: must be a number."),
        ([], "nothing to compute. Lyapunov exponents: the cube has none"),
    ],
)
def test_analyse_chaos__refused_before_computing(main, made, arguments, message):
    made.commit(0)
    code, out, err = main("analyse", made.info.directory, "chaos", *arguments)
    assert (code, out) == (Exit.REFUSED, "")
    assert message in err
    assert not (made.info.directory / "derived").exists()


# ---- correlation dimension ---------------------------------------------------------------------


def on_a_plane(n_cells=8, n_keep=500):
    """Chaotic cells whose sections fill a square in (psi1, psi2), and a closed and a regular one."""
    rng = np.random.default_rng(2)
    cube = made_up([[0.3] * n_cells + [-0.2, 0.4]], n_keep=n_keep)
    section = np.zeros(cube.section.shape)
    section[0, :n_cells, :, :2] = rng.uniform(-1, 1, (n_cells, n_keep, 2))
    section[0, n_cells:] = rng.uniform(-1, 1, (2, n_keep, 4))
    cube["section"].values[:] = section
    cube["lyapunov_blocks"][0, -1, 11:, 0] -= 0.9  # a transient
    return cube


def test_section_dimension__pools_the_chaotic_cells():
    cube = on_a_plane()
    found = section_dimension(cube, at={"frequency": 2.0})
    assert (int(found.n_cells[0]), int(found.n_points[0])) == (8, 4000)
    assert float(found.correlation_dimension[0]) == pytest.approx(2.0, abs=0.1)
    # without exponents, the cells that do not close
    bare = cube[["section", "status", "orbit_period"]]
    bare["orbit_period"][0, 0] = 1
    found = section_dimension(bare)
    assert (int(found.n_cells[0]), int(found.n_points[0])) == (9, 4500)


def test_section_dimension__nothing_chaotic():
    ds = section_dimension(made_up([-0.2, -0.3], n_keep=50))
    rows = report.dimension_rows(ds)
    assert (rows[0]["n_cells"], rows[0]["n_points"]) == (0, 0)
    assert "no chaotic cell" in report.dimension_lines(ds, rows)[2]
    few = section_dimension(made_up([0.3, 0.3], n_keep=50))
    assert "too few points" in report.dimension_lines(few, report.dimension_rows(few))[2]


def test_dimension_options__are_those_of_the_analysis():
    assert {p.name: p.default for p in DIMENSION_OPTIONS} == derived.dimension_defaults()


def artists(fig, gid):
    return [a for a in fig.findobj(lambda a: getattr(a, "get_gid", lambda: None)() == gid)]


def test_plot_dimension__curve_fit_and_slope():
    ds = section_dimension(on_a_plane())
    fig = plot_dimension(ds)
    (curve,), (slope,), (fit,) = (artists(fig, g) for g in ("correlation_sum", "local_slope", "fit"))
    one = ds.isel(frequency=0)
    known = np.isfinite(one.log_correlation_sum.values)
    assert np.log(curve.get_ydata()) == pytest.approx(one.log_correlation_sum.values[known])
    low, high = (float(one[name]) for name in ("fit_low", "fit_high"))
    for span in artists(fig, "fit_range"):
        assert (span.get_x(), span.get_x() + span.get_width()) == pytest.approx((low, high))
    x, y = np.log(fit.get_xdata()), np.log(fit.get_ydata())
    assert np.polyfit(x, y, 1)[0] == pytest.approx(float(one.correlation_dimension))
    radius = np.asarray(slope.get_xdata())
    inside = (radius >= low) & (radius <= high)
    assert np.asarray(slope.get_ydata())[inside].mean() == pytest.approx(2.0, abs=0.1)
    # the line lies on the curve
    at = np.interp(np.log(radius[inside]), x, y)
    assert at == pytest.approx(np.log(curve.get_ydata())[inside], abs=0.05)
    with pytest.raises(ValueError, match="frequency has several"):
        plot_dimension(xr.concat([ds, ds], "frequency"))
    with pytest.raises(ValueError, match="no chaotic cell"):
        plot_dimension(section_dimension(made_up([-0.2])))


# ---- convergence -------------------------------------------------------------------------------


def test_plot_convergence__lines_bands_and_transients():
    cube = made_up([[0.3, 0.36, -0.2], [0.1, 0.1, 0.1]], (2.0, 4.0)).assign_attrs(lyapunov_n_periods=320)
    cube["lyapunov_blocks"][0, 0, 11:, 0] -= 0.8
    fig = plot_convergence(cube, at={"frequency": 2.0}, per="period")
    lines = artists(fig, "running:chaotic")
    assert len(lines) == 2
    assert lines[0].get_xdata().tolist() == [20.0 * k for k in range(1, 17)]
    blocks = cube.lyapunov_blocks.values[0, 0, :, 0] / 2.0
    assert lines[0].get_ydata() == pytest.approx(np.cumsum(blocks) / np.arange(1, 17))
    band = artists(fig, "band:chaotic")[0]
    assert band.get_y() + 0.5 * band.get_height() == pytest.approx(0.33 / 2.0)
    assert band.get_height() == pytest.approx(2 * np.sqrt(0.0018 / 2) / 2.0)
    assert len(artists(fig, "running:regular")) == 1
    assert fig.data["exponent_stderr"].values == pytest.approx(0.01)
    assert artists(fig, "band:regular")[0].get_height() == pytest.approx(2 * 0.01)
    below = artists(fig, "in_block")
    assert below[0].get_ydata() == pytest.approx(blocks)
    assert below[0].get_xdata()[:2].tolist() == [10.0, 30.0]
    assert fig.axes[0].get_title(loc="left") == "frequency 2 Hz"
    second = plot_convergence(cube, at={"frequency": 2.0}, exponent=2)
    assert second.data["exponent_value"].values == pytest.approx([-0.1, -0.04, -0.6])


def test_plot_convergence__mistakes():
    cube = made_up([[0.3], [0.1]], (2.0, 4.0))
    for options, message in (
        ({}, r"one parameter point.*frequency \(2 values\).*--at frequency=4"),
        ({"at": {"q": 1.0}}, "unknown axis 'q'; values can be chosen of: frequency"),
        ({"at": {"frequency": 9.0}}, "lies off its axis"),
        ({"at": {"frequency": 2.0}, "exponent": 5}, "exponent is 5, and the cube has 1 to 4"),
        ({"at": {"frequency": 2.0}, "per": "year"}, "unknown unit"),
    ):
        with pytest.raises(ValueError, match=message):
            plot_convergence(cube, **options)
    with pytest.raises(ValueError, match="no Lyapunov exponents"):
        plot_convergence(cube.drop_vars("lyapunov"), at={"frequency": 2.0})


def test_commands__dimension_and_figures(main, run):
    code, out, err = main("analyse", run, "dimension", "--at", "frequency=2.4001", "--csv", "d.csv")
    assert (code, err) == (0, "")
    assert re.search(r"^  2\.4 +\d +\d+ ", out, re.MULTILINE)
    assert main("analyse", run, "dimension", "--at", "frequency=2.4")[1].startswith("dimension: taken from")
    code, out, err = main("plot", "convergence", run, "--at", "frequency=2.4")
    assert (code, err) == (0, "")
    with xr.open_dataset(run / "figures" / "convergence_1_frequency_2.4.nc", engine="scipy") as stored:
        assert stored["period"].values[-1] == 400.0
    code, out, err = main("plot", "dimension", run, "--at", "frequency=2.4")
    assert (code, err) == (0, "")
    assert out.startswith("dimension: taken from")
    for arguments, message in (
        (["plot", "dimension", run], "a correlation sum is drawn of one parameter point"),
        (["plot", "convergence", run], "convergence is drawn at one parameter point"),
        (["plot", "dimension", run, "--at", "frequency=2.2"], "no chaotic cell"),
        (["analyse", run, "dimension", "--theiler", "-1"], "theiler = -1 is out of bounds: it must be 0 or"),
        (["analyse", run, "dimension", "--n-max", "99"], "n_max = 99 is out of bounds: it must be 100 or"),
        (["analyse", run, "dimension", "--floor", "0"], "floor = 0 is out of bounds: it must be greater"),
        (["analyse", run, "dimension", "--at", "q=1"], "unknown axis 'q'"),
    ):
        code, _, err = main(*arguments)
        assert code == Exit.REFUSED
        assert message in err
        assert "Traceback" not in err
