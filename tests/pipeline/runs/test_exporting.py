"""Results as files of other programs: AUTO's table and start, MAT-files, NetCDF, CSV; read back independently."""

from __future__ import annotations

import math

import numpy as np
import pytest
import xarray as xr
from scipy.io import loadmat

import magpend
from pipeline.runs import auto_files
from pipeline.runs.exporting import FORMATS, format_of, save
from pipeline.specification.problems import SpecError


def read_auto(path):
    """Read a file ``b.NAME`` by the columns in which AUTO writes it: I4, I6, I4, I5, then numbers of 19 characters."""
    blocks, names = [], []
    for line in path.read_text().splitlines():
        if int(line[:4]) == 0:
            if " PT " in line:
                assert line[:20] == "   0    PT  TY  LAB "
                names = [line[k : k + 19].strip() for k in range(20, len(line), 19)]
                blocks.append([])
            continue
        branch, point, kind, label = (int(line[a:b]) for a, b in ((0, 4), (4, 10), (10, 14), (14, 19)))
        numbers = [float(line[k : k + 19]) for k in range(19, len(line), 19)]
        head = {"BR": branch, "PT": point, "TY": kind, "LAB": label}
        blocks[-1].append({**head, **dict(zip(names, numbers, strict=True))})
    return blocks


def run_of(tmp_path_factory, spec):
    place = tmp_path_factory.mktemp("runs") / "run"
    return magpend.run(spec, place, workers=0, echo=lambda line: None)


@pytest.fixture(scope="module")
def hopf(tmp_path_factory):
    """The normal form: rest up to mu = 0, then a circle of radius sqrt(mu) and period 2 pi."""
    model = magpend.model("x' = mu*x - y - x*(x**2 + y**2)\ny' = x + mu*y - y*(x**2 + y**2)", mu=0.5)
    spec = magpend.Spec("sweep", model).with_axis("mu", -0.4, 0.8, 7).with_section(of="y", value=0.0, longest=50.0)
    spec = spec.with_start_random(n=2, x=(0.5, 1.0), y=(-0.5, 0.5), seed=0)
    return run_of(tmp_path_factory, spec.with_integration(n_transient=60, n_keep=8))


@pytest.mark.slow
def test_auto__a_hopf_point_with_its_cycles(hopf, tmp_path):
    ds = hopf.branches()
    blocks = read_auto(ds.magpend.save(tmp_path / "b.hopf"))
    assert [len(block) for block in blocks] >= ds.n_points.values.tolist()
    for k, block in enumerate(blocks):
        is_cycle = bool(ds.orbit_period[k])
        names = ["MAX x", "MAX y"] if is_cycle else ["x", "y"]
        assert list(block[0]) == ["BR", "PT", "TY", "LAB", "mu", "L2-NORM", *names, *["PERIOD"] * is_cycle]
        assert {row["BR"] for row in block} == {-(k + 1) if is_cycle else k + 1}
        assert [abs(row["PT"]) for row in block] == list(range(1, len(block) + 1))
        assert (block[0]["TY"], block[-1]["TY"]) == (9, 9)
        # the points of the branch, in their order
        own = [row for row in block if row["TY"] in (0, 9)]
        n = int(ds.n_points[k])
        assert [row["mu"] for row in own] == pytest.approx(ds.mu.values[k, :n].tolist(), rel=1e-10, abs=1e-12)
        assert [row["PT"] < 0 for row in own] == (ds.n_unstable.values[k, :n] == 0).tolist()
        for row in own:
            if is_cycle:
                radius = math.sqrt(row["mu"])
                assert [row[n] for n in ("L2-NORM", "MAX x", "MAX y")] == pytest.approx(
                    [radius] * 3, rel=1e-8, abs=1e-6
                )  # at mu = 0 a cycle has no size
                assert row["PERIOD"] == pytest.approx(2.0 * math.pi, rel=1e-9)
            else:
                assert [row[n] for n in ("L2-NORM", "x", "y")] == pytest.approx([0.0] * 3, abs=1e-9)
    labels = [row["LAB"] for block in blocks for row in block if row["TY"]]
    assert labels == list(range(1, len(labels) + 1))
    assert all(row["LAB"] == 0 for block in blocks for row in block if not row["TY"])
    (bifurcation,) = [row for block in blocks for row in block if row["TY"] == 3]
    assert bifurcation["mu"] == pytest.approx(0.0, abs=1e-8)


@pytest.mark.slow
def test_auto__an_orbit_as_start(hopf, tmp_path):
    ds = hopf.branches()
    (branch,) = np.flatnonzero(ds.orbit_period)
    point = int(ds.n_points[branch]) - 2
    series = ds.magpend.orbit(branch, point, samples=100)
    table = np.loadtxt(series.magpend.save(tmp_path / "hopf.dat"))
    radius = math.sqrt(float(ds.mu[branch, point]))
    assert table.shape == (101, 3)
    assert (table[:, 0] == series.time.values).all()  # to the bit
    assert (table[:, 1:] == np.column_stack([series.x, series.y])).all()
    assert table[-1, 0] == pytest.approx(2.0 * math.pi, rel=1e-9)
    assert table[-1, 1:] == pytest.approx(table[0, 1:], abs=1e-9)
    angle = np.arctan2(table[:, 2], table[:, 1]) - np.arctan2(table[0, 2], table[0, 1])
    assert np.unwrap(angle) == pytest.approx(table[:, 0], abs=1e-8)
    assert np.hypot(table[:, 1], table[:, 2]) == pytest.approx(radius, rel=1e-9)
    (rest,) = np.flatnonzero(ds.orbit_period == 0)
    for place, said in (((rest, 0), "equilibria"), ((branch, 10**6), "points"), ((99, 0), "there are 2 branches")):
        with pytest.raises(SpecError, match=said):
            ds.magpend.orbit(*place)


@pytest.mark.slow
def test_auto__a_driven_oscillator_in_the_word_of_its_specification(tmp_path_factory, tmp_path, command):
    """Amplitudes of x'' + x'/5 + x = cos(omega t) are known, and so is the norm of state and rate."""
    model = magpend.model("x'' = cos(omega*t) - 0.2*x' - x")
    spec = magpend.Spec("sweep", model).with_axis("omega", 0.5, 1.5, 3).with_start_random(n=1, x=(0.0, 1.0), x_dot=0.0)
    run = run_of(tmp_path_factory, spec.with_integration(n_transient=100, n_keep=4))
    for name in ("b.forced", "b.forced", "forced.nc", "forced.nc", "forced.mat", "forced.mat"):  # its own are replaced
        command(tmp_path, "analyse", "branches", run.name, "--out", name, "--quiet")
    (block,) = read_auto(tmp_path / "b.forced")
    assert len(block) > 5
    for row in block:
        omega = row["omega"]
        size = 1.0 / math.hypot(1.0 - omega**2, 0.2 * omega)
        assert row["MAX x"] == pytest.approx(size, rel=1e-7)
        assert row["L2-NORM"] == pytest.approx(size * math.sqrt(0.5 * (1.0 + omega**2)), rel=1e-7)
        assert row["PERIOD"] == pytest.approx(2.0 * math.pi / omega, rel=1e-9)
        assert row["PT"] < 0


@pytest.mark.slow
def test_auto__a_map_with_a_doubling(tmp_path_factory, tmp_path):
    model = magpend.model("x' = r*x*(1 - x)", kind="map", r=3.0)
    spec = magpend.Spec("sweep", model).with_axis("r", 2.5, 3.2, 4).with_start_random(n=1, x=(0.2, 0.8), seed=0)
    run = run_of(tmp_path_factory, spec.with_integration(n_transient=500, n_keep=16))
    blocks = read_auto(run.branches().magpend.save(tmp_path / "b.logistic"))
    first = next(block for block in blocks if any(row["TY"] == 7 for row in block))
    for row in first:
        assert row["BR"] > 0
        assert row["x"] == row["L2-NORM"] == pytest.approx(1.0 - 1.0 / row["r"], rel=1e-9)
        assert (row["PT"] < 0) == (row["r"] < 3.0) or row["TY"] == 7
    (doubling,) = [row for row in first if row["TY"] == 7]
    assert doubling["r"] == pytest.approx(3.0, abs=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cube", "branches", "attractors"])
def test_save__any_result_as_mat_and_netcdf(hopf, name, tmp_path):
    ds = hopf.cube() if name == "cube" else getattr(hopf, name)()
    found = loadmat(ds.magpend.save(tmp_path / f"{name}.mat"), simplify_cells=False)
    about = loadmat(tmp_path / f"{name}.mat", simplify_cells=True)["about"]
    names = {one["name"]: own for own, one in about["variables"].items()}
    assert set(names) == set(map(str, ds.variables))
    for variable, own in names.items():
        values = ds[variable].values
        assert np.atleast_1d(about["variables"][own]["dims"]).tolist() == list(ds[variable].dims)
        if values.dtype.kind in "biufc":
            assert found[own].reshape(values.shape).tobytes() == values.tobytes(), variable
        attributes = about["variables"][own]["attributes"]
        assert attributes["long_name"] == ds[variable].attrs["long_name"]
    assert about["attributes"]["model"] == ds.attrs["model"]
    with xr.open_dataset(ds.magpend.save(tmp_path / f"{name}.nc"), engine="scipy") as read:
        assert set(read.variables) == {n for n, v in ds.variables.items() if v.size}
        code = "status" if name == "cube" else "kind"
        assert (read[code].values == ds[code].values).all()


@pytest.mark.slow
def test_save__a_table_as_csv_is_that_of_the_command(hopf, tmp_path, command):
    command(tmp_path, "analyse", "attractors", hopf.name, "--csv", "one.csv", "--quiet")
    hopf.attractors().magpend.save(tmp_path / "other.csv")
    assert (tmp_path / "one.csv").read_text() == (tmp_path / "other.csv").read_text()


SERIES = xr.Dataset({"x": ("time", [1.0, 0.1], {"units": "m"})}, {"time": ("time", [2.0, 2.5], {"units": "s"})})


def test_format_of__names_all_formats(tmp_path):
    for name in ("a.NC", "a.mat", "a.csv", "a.dat", "b.lorenz"):
        assert format_of(tmp_path / name) in FORMATS
    assert format_of("b.mat").pattern == "*.mat"
    with pytest.raises(SpecError, match=r"a\.txt: the name must be one of \*\.csv .*\*\.mat \(MATLAB.*b\.\*"):
        format_of("a.txt")
    with pytest.raises(SpecError, match="no such folder"):
        format_of(tmp_path / "no" / "a.mat")


@pytest.mark.parametrize(
    ("name", "ds", "said"),
    [
        ("b.x", SERIES, "need the result of branches"),
        ("b.x", SERIES.assign_attrs(derived_product="branches"), "were not read from a run directory"),
        ("a.dat", xr.Dataset({"x": ("k", [1.0])}), "AUTO starts from a time series"),
        ("a.csv", xr.Dataset({"x": ("k", [1.0])}), "only tables of analyses and time series"),
    ],
)
def test_save__what_a_format_does_not_hold_is_refused(name, ds, said, tmp_path):
    with pytest.raises(SpecError, match=said):
        save(ds, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_columns__are_those_of_auto():
    text = auto_files._columns([0.0, -1.5, 1e-100, 12345678901.25, 5e-324])
    assert text == ("  0.0000000000E+000 -1.5000000000E+000  1.0000000000E-100  1.2345678901E+010  4.9406564584E-324")


def test_save__a_time_series_of_simulate(tmp_path):
    ds = magpend.simulate(0.2, [0.1, 0.0], model="duffing", n_periods=2, samples_per_period=10)
    table = np.loadtxt(save(ds, tmp_path / "duffing.dat"))
    assert table.shape == (21, 3)  # without quantities
    assert (table[:, 1] == ds.x.values).all()
    found = loadmat(save(ds, tmp_path / "duffing.mat"))
    assert found["x"].tobytes() == ds.x.values.tobytes()
    head, *rows = save(ds, tmp_path / "duffing.csv").read_text().splitlines()
    assert head.startswith("time_s,x_")
    assert len(rows) == 21
