"""Chaos of cells and of attractors: exponents, transients, dimensions; what is printed and refused."""

import csv
import re

import numpy as np
import pytest
import xarray as xr

from pipeline import open_run
from pipeline.analysis.attractors.attractors import identify
from pipeline.analysis.chaos.analysis import chaos_of, chaos_table, chaotic_cells, dimension_table, section_dimension
from pipeline.analysis.chaos.convergence_figure import plot_convergence
from pipeline.analysis.chaos.dimension_figure import plot_dimension
from pipeline.analysis.chaos.lyapunov import CellMotion, pooled_mean
from pipeline.analysis.chaos.per_attractor import Nature
from pipeline.cli.console import Exit
from pipeline.layout.vocabulary import (
    ABSENT,
    ATTRACTS,
    BOUNDED_SET,
    EVIDENCE,
    KINDS,
    PERIODIC_ORBIT,
    STABILITIES,
    TRANSIENT,
    UNSTABLE,
)
from pipeline.results.ragged import dense
from pipeline.runs.derive import derive
from tests.pipeline.analysis.cubes import artists, exponents_cube, sweep
from tests.pipeline.analysis.dense_sets import rows_of

SPREAD = np.array([0.0, -0.4, -0.9, -1.5])


def made_up(first, frequency=(2.0,), n_keep=5):
    """Cube with exponents; `first` are the largest, shape (frequency, cell)."""
    first = np.atleast_2d(np.asarray(first, float))
    cells = np.arange(first.shape[1])
    cube = exponents_cube(first, n_blocks=16, frequency=list(frequency), initial_condition=cells)
    section = np.random.default_rng(0).uniform(-1, 1, (*first.shape, n_keep, 4))
    return cube.drop_dims("period_index").assign(
        section=(("frequency", "initial_condition", "period_index", "state"), section)
    )


def attractors_of(cube, ids, kinds, periods=None, multipliers=None, verdicts=None):
    """Attractors by hand: `ids` of the cells (frequency, cell), `kinds` (frequency, attractor)."""
    ids, kinds = np.atleast_2d(ids), np.atleast_2d(kinds)
    periods = np.where(kinds == PERIODIC_ORBIT, 1, 0) if periods is None else np.atleast_2d(periods)
    mu = np.full((*kinds.shape, 4), np.nan) if multipliers is None else np.asarray(multipliers, float)
    at, cells = ("frequency", "attractor"), ("frequency", "initial_condition")
    counts = np.stack([(ids == i).sum(1) for i in range(kinds.shape[1])], 1)
    stability = np.where(np.isfinite(mu[..., 0]) & (np.abs(mu).max(-1) >= 1), UNSTABLE, ATTRACTS)
    stability = np.where(kinds == ABSENT, ABSENT, stability) if verdicts is None else np.atleast_2d(verdicts)
    unknown = np.full(kinds.shape, np.nan)
    dense_sets = xr.Dataset(
        {
            "attractor_id": (cells, ids.astype(np.int32)),
            "status": (cells, cube["status"].values),
            "kind": (at, kinds.astype(np.int8), {"flag_meanings": " ".join(KINDS)}),
            "orbit_period": (at, periods.astype(np.int32)),
            "n_cells": (at, counts),
            "share": (at, counts / ids.shape[1]),
            "multiplier_real": ((*at, "multiplier"), mu),
            "multiplier_imag": ((*at, "multiplier"), np.where(np.isfinite(mu), 0.0, np.nan)),
            "stability": (at, stability.astype(np.int8), {"flag_meanings": " ".join(STABILITIES)}),
            "evidence": (at, np.zeros(kinds.shape, np.int8), {"flag_meanings": " ".join(EVIDENCE)}),
            "n_sampled": (at, np.full(kinds.shape, 4)),
            "n_left": (at, np.where(stability == TRANSIENT, 4, 0)),
            "lifetime_low": (at, np.full(kinds.shape, 99.0)),
            **{f"lyapunov_{end}": (at, unknown) for end in ("max", "low", "high")},
            "period_s": (at, periods / np.atleast_1d(cube["frequency"].values)[:, None]),
        },
        coords={"frequency": cube["frequency"], "attractor": np.arange(kinds.shape[1])},
    )
    return rows_of(dense_sets)


def one_set(cube):
    """All cells on one bounded set."""
    shape = cube["status"].shape
    return attractors_of(cube, np.zeros(shape, int), np.full((shape[0], 1), BOUNDED_SET))


def test_chaos__exponents_of_each_attractor():
    """Two sets side by side: no mean over both, and no bias by which cells count as chaotic."""
    cube = made_up([0.3, 0.36, 0.8, 0.8])
    found = chaos_of(cube, attractors_of(cube, [0, 0, 1, 1], [BOUNDED_SET] * 2)).isel(frequency=0)
    assert found.attractor_lyapunov.values[0] == pytest.approx(0.33 + SPREAD)
    assert found.attractor_lyapunov.values[1] == pytest.approx(0.8 + SPREAD)
    # two cells 0.06 apart with errors of 0.02: variance 0.0018 between, of which 0.0004 is explained
    assert found.attractor_lyapunov_stderr.values[0] == pytest.approx(np.sqrt(0.0018 / 2))
    assert found.attractor_lyapunov_between.values[0] == pytest.approx(np.sqrt(0.0014))
    assert found.nature.values.tolist() == [Nature.CHAOTIC, Nature.HYPERCHAOTIC]
    assert found.exponents_from.values.tolist() == [2, 2]
    # sums 0.33, 0.26, -0.31
    assert found.attractor_kaplan_yorke.values[0] == pytest.approx(2 + 0.26 / 0.57)
    assert found.kaplan_yorke_dimension.values[:2] == pytest.approx([2 + 0.2 / 0.6, 2 + 0.32 / 0.54])
    assert found.share.values.tolist() == [0.5, 0.5]
    row = chaos_table(chaos_of(cube, one_set(cube))).rows[0]
    assert row["lyapunov_1_per_period"] == pytest.approx(row["lyapunov_1"] / 2.0)


def test_chaos__of_closed_cells():
    cube = made_up([[-0.2, -0.3]])[["section", "status", "orbit_period"]].isel(period_index=slice(0, 1))
    cube = cube.isel(period_index=np.zeros(200, int))
    cube["status"][:] = 1
    cube["orbit_period"][:] = 2
    mu = np.array([[[0.9, -0.5, 0.2, 0.1]]])
    found = chaos_of(cube, attractors_of(cube, [0, 0], [PERIODIC_ORBIT], [2], mu)).isel(frequency=0, set=0)
    assert found.attractor_lyapunov.values == pytest.approx(np.log([0.9, 0.5, 0.2, 0.1]) * 2.0 / 2)
    assert found.exponents_from == 1
    assert found.attractor_kaplan_yorke == 0
    assert found.nature == Nature.REGULAR
    # It closed on an unstable orbit or by chance: not regular, and said so
    cube = made_up([0.736, -0.2, 0.01])
    cube["status"][:] = 1
    cube["orbit_period"][:] = 3
    cells = chaotic_cells(cube)
    assert cells.motion.values.tolist() == [[CellMotion.UNDECIDED, CellMotion.REGULAR, CellMotion.REGULAR]]
    assert cells.contradicts.values.tolist() == [[1, 0, 0]]
    table = chaos_table(chaos_of(cube, attractors_of(cube, [0, 0, 0], [PERIODIC_ORBIT])))
    assert table.rows[0]["n_contradicting"] == 1
    assert "1 closed with a positive exponent" in "\n".join(table.lines)


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
    found = chaos_of(cube, one_set(cube)).isel(frequency=0, set=0)
    assert found.attractor_lyapunov.values == pytest.approx([0.33, -0.1, -0.6, -1.2])
    assert int(found.n_unresolved) == 1
    cube["lyapunov_flag"][0, 1] = 4
    found = chaos_of(cube, one_set(cube)).isel(frequency=0, set=0)
    assert int(found.n_failed) == 1
    assert found.attractor_lyapunov.values[0] == pytest.approx(0.3)


@pytest.mark.slow
def test_chaos__transients_and_drift():
    cube = made_up([0.3, 0.3, 0.3])
    cube["lyapunov_blocks"][0, 0, 11:, 0] -= 0.8  # chaos for 11 of 16 blocks, then decay
    cube["lyapunov_blocks"][0, 1, 8:, 0] += 0.5  # drifts, but stays chaotic
    found = chaos_of(cube, one_set(cube)).isel(frequency=0, set=0)
    assert found.is_transient.values.tolist() == [1, 0, 0]
    assert (int(found.n_transient), int(found.n_drifting), int(found.n_cells)) == (1, 2, 3)
    assert found.nature == Nature.CHAOTIC
    gone = chaos_of(cube.isel(initial_condition=[0]), one_set(cube.isel(initial_condition=[0])))
    assert gone.nature.item() == Nature.TRANSIENT
    # an orbit with complex multipliers, on which chaos ends: means of -0.1 among swings of 0.2
    cube["lyapunov_blocks"][0, 2, 8:, 0] = -0.1 + 0.2 * np.resize([1.0, -1.0], 8)
    assert chaotic_cells(cube).is_transient.values.tolist() == [[1, 0, 1]]
    # lasting chaos that is weaker at the end, and an orbit from the beginning
    cube["lyapunov_blocks"][0, 0, 12:, 0] = 0.02
    cube["lyapunov_blocks"][0, 2, :, 0] = -0.1 + 0.2 * np.resize([1.0, -1.0], 16)
    # and one about zero, whose swings are no evidence
    step = np.repeat([0.1, -0.1], 8)  # 2 standard errors of the difference
    cube["lyapunov_blocks"][0, 1, :, 0] = step + 0.12 * np.resize([1.0, -1.0], 16)
    # an orbit that is approached along a slower direction first
    cube["lyapunov_blocks"][0, 0, :, 0] = np.repeat([-0.01, -0.3], 8) + 1e-3 * np.resize([1.0, -1.0], 16)
    assert chaotic_cells(cube).is_transient.values.tolist() == [[0, 0, 0]]
    few = chaotic_cells(cube.isel(block=slice(0, 11)))
    assert few.is_transient.values.tolist() == [[-1, -1, -1]]


def test_chaos__zero_one_needs_sections():
    cube = made_up([0.3])
    short = chaos_of(cube, one_set(cube))
    assert "0-1 test: 5 sections, and it needs 200; raise n_keep" in short.attrs["not_computed"]
    assert "zero_one" not in short
    cube = made_up([0.3], n_keep=400)
    noise = chaos_of(cube, one_set(cube))
    assert noise.attrs["not_computed"] == ""
    assert noise.zero_one.values[0, 0] > 0.9
    assert noise.median_zero_one.item() == noise.zero_one.values[0, 0]
    cube = made_up([0.3, -0.2], n_keep=256)[["section", "status", "orbit_period"]]
    cube["orbit_period"][0, 1] = 2
    found = chaos_of(cube, attractors_of(cube, [0, 1], [BOUNDED_SET, PERIODIC_ORBIT]))
    assert "run it with [products] lyapunov" in found.attrs["not_computed"]
    assert found.motion.values.tolist() == [[CellMotion.UNKNOWN, CellMotion.REGULAR]]
    # K near 1 alone tells, and says what it rests on
    assert found.nature.values.tolist() == [Nature.CHAOTIC_BY_TEST, Nature.REGULAR]
    assert "chaotic (by the 0-1 test)" in "\n".join(chaos_table(found).lines)
    with pytest.raises(ValueError, match=r"nothing to compute\. Lyapunov exponents.*0-1 test: 128 sections"):
        chaos_of(cube, one_set(cube).assign_attrs(identify_polish=0), stride=2)


@pytest.mark.slow
def test_chaos__correlation_dimension_of_enough_points():
    cube = on_a_plane()
    found = chaos_of(cube, attractors_of(cube, [0] * 8 + [1, 1], [BOUNDED_SET] * 2), n_max=4000).isel(frequency=0)
    assert found.attractor_correlation.values[0] == pytest.approx(2.0, abs=0.15)
    assert np.isnan(found.attractor_correlation.values[1])
    without = chaos_of(cube, one_set(cube), n_max=0)
    assert np.isnan(without.attractor_correlation.values).all()
    cube = on_a_plane()
    found = section_dimension(
        cube,
        attractors_of(
            cube, [0] * 8 + [1, 2], [BOUNDED_SET, BOUNDED_SET, PERIODIC_ORBIT], verdicts=[ATTRACTS, TRANSIENT, ATTRACTS]
        ),
        at={"frequency": 2.0},
    )
    assert found.n_points.values.tolist() == [4000, 0, 0]
    assert float(found.correlation_dimension[0]) == pytest.approx(2.0, abs=0.1)
    # what leaves has none, whatever its sections fill
    assert np.isnan(found.correlation_dimension.values[1:]).all()
    assert found.reason.values.tolist() == [1, 3, 2]
    lines = dimension_table(found).lines
    assert re.search(r"none: not shown to attract", lines[3])
    assert "4 of 4 left" in lines[3]


def test_chaos__attractors_of_another_cube():
    cube = made_up([0.3, 0.3])
    with pytest.raises(ValueError, match="other cells"):
        chaos_of(cube, one_set(cube.isel(initial_condition=[0])))
    cube = made_up([0.3, 0.3], n_keep=50)
    closed = section_dimension(cube, attractors_of(cube, [0, 0], [PERIODIC_ORBIT]))
    assert "all sets close" in dimension_table(closed).lines[1]
    few = section_dimension(cube, one_set(cube))
    assert "none: too few points" in dimension_table(few).lines[2]


def test_chaos_table__a_summary_if_there_are_many_points():
    frequency = np.arange(8) * 0.5 + 1.0
    rates = np.full((8, 2), -0.2)
    rates[[0, 1, 4], 0] = [0.3, 0.38, 0.33]
    cube = made_up(rates, frequency)
    table = chaos_table(chaos_of(cube, attractors_of(cube, np.tile([0, 1], (8, 1)), np.full((8, 2), BOUNDED_SET))))
    assert table.lines[0] == "16 cells at 8 parameter points"
    assert re.search(r"^  regular +0, 1 +13 +8 +1 to 4\.5$", table.lines[2])
    assert re.search(r"^  chaotic +0 +3 +3 +1 to 1\.5, 3$", table.lines[3])
    assert table.lines[4] == (
        "  largest exponent: 0.380 ± 0.020 per s, 0.253 ± 0.013 per drive period, attractor 0, chaotic, "
        "at frequency 1.5 Hz"
    )
    assert table.lines[5] == "  cells flagged: none"


def test_chaos__lyapunov_max_of_attractors_is_the_first_exponent():
    """Both leave transients out, and take cells of which the first exponent alone is resolved."""
    cube = made_up([0.3, 0.34, 0.9, 0.5]).assign_attrs(closure_tolerance=1e-6)
    cube["section"][0] = cube["section"].values[0, 0] + 1e-3
    cube["lyapunov_flag"][0, 1] = 3
    cube["lyapunov_flag"][0, 2] = 2
    cube["lyapunov_blocks"][0, 3, 11:, 0] -= 1.2
    found = identify(cube, polish=False)
    assert found.sizes["set"] == 1
    own = chaos_of(cube, found)
    assert found["lyapunov_max"].item() == pytest.approx(0.32)
    assert own["attractor_lyapunov"].values[0, 0] == pytest.approx(found["lyapunov_max"].item())


BOX = {"kind": "random", "n": 4, "seed": 7, "psi1_deg": [-20.0, 20.0], "psi2_deg": [-20.0, 20.0]}
RUN = sweep(
    "pendulum",
    BOX,
    axes={"frequency_hz": {"values": [2.2, 2.4]}},
    lengths=(600, 200),
    tolerance=1e-7,
    products={"lyapunov": {"n_transient": 100, "n_periods": 400, "n_blocks": 16}},
)


@pytest.fixture(scope="module")
def run(computed):
    """Order at 2.2 Hz, chaos at 2.4 Hz."""
    return computed(RUN)


@pytest.mark.slow
def test_analyse_chaos__order_and_chaos(main, run, tmp_path):
    code, out, err = main("analyse", "chaos", run, "--csv", tmp_path / "c.csv")
    assert code == 0, err
    at = out.index("frequency 2.4 Hz:")
    assert re.search(r"regular +1 +\d+ ", out[:at])
    assert re.search(r"chaotic +- +\d+ +[01]\.\d+ +0\.\d+ ± 0\.\d+, ", out[at:])
    with (tmp_path / "c.csv").open() as file:
        rows = list(csv.DictReader(file))
    closed = [row for row in rows if row["nature"] == "regular"]
    found = dense(derive(run, "attractors"), points=True)
    for row in closed:  # the logarithm of the largest multiplier, and close to what was measured
        one = found.sel(frequency=float(row["frequency"]), attractor=int(row["attractor_id"]))
        assert float(row["lyapunov_1"]) == pytest.approx(float(one["lyapunov_max"]), rel=1e-12)
        cells = open_run(run).sel(frequency=float(row["frequency"]))
        own = cells.lyapunov.isel(exponent=0).values[one["attractor_id"].values == int(row["attractor_id"])]
        assert float(row["lyapunov_1"]) == pytest.approx(own.mean(), abs=5e-3)  # 400 periods
    for row in rows:
        per_period = float(row["lyapunov_1"]) / float(row["frequency"])
        assert float(row["lyapunov_1_per_period"]) == pytest.approx(per_period, rel=1e-12)
    assert "chaos: taken from" in main("analyse", "chaos", run)[2]
    assert "chaos: computed" in main("analyse", "chaos", run, "--least", "0.01")[2]


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


def test_rows__of_no_set_have_the_variables_of_others():
    """A block of parameter points may have no set; it is joined with others."""
    cube = made_up([0.3, 0.3], n_keep=50)
    nothing = attractors_of(cube, [-1, -1], [ABSENT])
    for analyse, table in ((chaos_of, chaos_table), (section_dimension, dimension_table)):
        none, one = analyse(cube, nothing), analyse(cube, one_set(cube))
        assert (none.sizes["set"], one.sizes["set"]) == (0, 1)
        assert {k: (v.dims, v.dtype) for k, v in none.items()} == {k: (v.dims, v.dtype) for k, v in one.items()}
        assert table(none).rows == []


@pytest.mark.slow
def test_plot_dimension__curve_fit_and_slope():
    cube = on_a_plane()
    ds = section_dimension(cube, attractors_of(cube, [0] * 8 + [-1, -1], [BOUNDED_SET]))
    (curve,), (fit,) = (artists(plot_dimension(ds), g) for g in ("correlation_sum", "fit"))
    one = ds.isel(set=0)
    known = np.isfinite(one.log_correlation_sum.values)
    assert np.log(curve.get_ydata()) == pytest.approx(one.log_correlation_sum.values[known])
    x, y = np.log(fit.get_xdata()), np.log(fit.get_ydata())
    assert np.polyfit(x, y, 1)[0] == pytest.approx(float(one.correlation_dimension))
    with pytest.raises(ValueError, match="frequency has several"):
        plot_dimension(xr.concat([ds, ds], "frequency", data_vars="minimal"))
    with pytest.raises(ValueError, match="without a period"):
        plot_dimension(section_dimension(cube, attractors_of(cube, [0] * 10, [PERIODIC_ORBIT])))


# ---- convergence -------------------------------------------------------------------------------


@pytest.mark.slow
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
    second = plot_convergence(cube, at={"frequency": 2.0}, exponent=2)
    assert second.data["exponent_value"].values == pytest.approx([-0.1, -0.04, -0.6])


@pytest.mark.slow
def test_commands__dimension_and_figures(main, run, tmp_path):
    few = ("--at", "frequency=2.4")
    assert main("analyse", "attractors", run, "--n-sample", "4", "--budget", "0.5")[0] == 0
    code, out, err = main("analyse", "dimension", run, *few, "--csv", tmp_path / "d.csv")
    assert code == 0, err
    assert re.search(r"^  2\.4 +\d +\d+ ", out, re.MULTILINE)
    near = ("--at", "frequency_hz=2.4")
    assert "dimension: taken from" in main("analyse", "dimension", run, *near)[2]
    code, out, err = main("plot", "convergence", run, "--at", "frequency=2.4")
    assert code == 0, err
    for arguments, message in (
        (["plot", "dimension", run], "a correlation sum is drawn of one parameter point"),
        (["plot", "convergence", run, "--at", "frequency=9"], "lies off its axis"),
        (["plot", "convergence", run, "--at", "frequency=2.4", "--exponent", "5"], "exponent is 5"),
        (["analyse", "dimension", run, "--n-max", "99"], "n_max = 99"),
        (["analyse", "dimension", run, "--at", "q=1"], "unknown axis 'q'"),
    ):
        code, _, err = main(*arguments)
        assert code == Exit.REFUSED
        assert message in err
        assert "Traceback" not in err
