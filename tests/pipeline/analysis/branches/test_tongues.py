"""Rotation numbers in a cube, and Arnold tongues: closed forms, and orbits integrated by DOP853."""

from fractions import Fraction

import numpy as np
import pytest
from scipy.optimize import root

from pipeline.analysis.branches.tongues import cells_of, fractions_between, tongues_table
from pipeline.analysis.branches.tongues_figure import plot_rotation, plot_tongues
from pipeline.products.rotation import RotationFlag
from pipeline.runs.derive import AnalysedRun
from pipeline.specification.problems import SpecError
from tests.core.cells import scipy_end
from tests.core.flows import table
from tests.pipeline.analysis.cubes import line, sweep
from tests.pipeline.factories import quietly


def locking(model, axes, start, *, tolerance=1e-8, closes=1e-6, lengths=(300, 8), rotation=(), **more):
    """A sweep from one start that computes rotation numbers."""
    options = {"axes": axes, "tolerance": tolerance, "closes": closes, "lengths": lengths, **more}
    return sweep(model, [start], products={"rotation": dict(rotation)}, **options)


UNIT_FREQUENCY = 0.15915494309189535
EQUATIONS = {"x": "x - w0*y - (x^2 + y^2)*x + F*cos(2*pi*f*t)", "y": "w0*x + y - (x^2 + y^2)*y + F*sin(2*pi*f*t)"}
STUART_LANDAU = locking(
    table("stuart_landau", EQUATIONS, {"w0": 1.0, "F": 0.4}),
    {"w0": line(0.4, 1.6, 25)},
    [0.5, 0.0],
    frequency_hz=UNIT_FREQUENCY,
    tolerance=1e-9,
    closes=1e-7,
    lengths=(200, 8),
    rotation={"of": ["y", "x"], "n_periods": 300},
)
VAN_DER_POL = locking(
    "forced-van-der-pol",
    {"frequency_hz": line(0.22, 0.48, 14), "A": {"values": [0.8, 1.0]}},
    [1.0, 0.0],
    rotation={"n_periods": 200},
)
STAIRCASE_HZ = 0.2801126998417
STAIRCASE = locking(
    "driven-pendulum",
    {"bias": line(0.9, 3.1, 45)},
    [0.0, 0.0],
    frequency_hz=STAIRCASE_HZ,
    parameters={"overrides": {"d": 1.576, "A": 1.0}},
)


@pytest.fixture(scope="module")
def stuart_landau(computed):
    return AnalysedRun.of(computed(STUART_LANDAU))


@pytest.fixture(scope="module")
def van_der_pol(computed):
    return AnalysedRun.of(computed(VAN_DER_POL))


def edge_of_stuart_landau(force):
    """Return w0 - W > 0 at the folds: rho [(1-rho)^2 + s^2] = F^2 and (1-rho)(1-3 rho) + s^2 = 0, upper branch."""
    rho = np.roots([-2.0, 2.0, 0.0, -(force**2)])  # s^2 = -(1-rho)(1-3 rho) put into the first
    rho = rho[np.abs(rho.imag) < 1e-12].real
    rho = rho[(rho > 2.0 / 3.0) & (rho < 1.0)]
    return float(np.sqrt(-(1.0 - rho) * (1.0 - 3.0 * rho))[0])


@pytest.mark.slow
def test_cube__rotation_numbers(stuart_landau):
    """Locked cells turn once per period exactly; far away the rate is near w0, and it is symmetric about 1."""
    cube = stuart_landau.cube().isel(initial_condition=0)
    inside = np.abs(cube["w0"].values - 1.0) < edge_of_stuart_landau(0.4)
    assert ((cube["orbit_period"].values == 1) == inside).all()
    assert (cube["rotation"].values[inside] == 1.0).all()
    assert (np.abs(cube["rotation"].values[~inside] - 1.0) > 1e-3).all()
    away = cube["rotation"].values - 1.0
    np.testing.assert_allclose(away, -away[::-1], atol=1e-5)
    assert (np.abs(away) <= np.abs(cube["w0"].values - 1.0) + 1e-6).all()
    assert (cube["rotation_flag"].values == RotationFlag.GOOD).all()
    assert (cube["rotation_error"].values < 1e-3).all()


@pytest.mark.slow
def test_tongue__edges_in_closed_form(stuart_landau):
    """The folds of the 1/1 tongue on the row, and along the whole curve."""
    ds = stuart_landau.derive("tongues", parameter="w0", second="F", second_low=0.1, second_high=0.5, max_denominator=1)
    thin = tongues_table(ds.assign(tongue_error=ds["tongue_high"] - ds["tongue_low"]))
    assert thin.lines[-2:] == ["", "narrower than the error of its ends: 1/1"]
    (row,) = tongues_table(ds).rows
    edge = edge_of_stuart_landau(0.4)
    assert row["tongue"] == "1/1"
    assert [row["from"], row["to"]] == pytest.approx([1.0 - edge, 1.0 + edge], abs=1e-8)
    assert (row["begins"], row["ends"]) == ("fold", "fold")
    for i in range(ds.sizes["curve"]):
        n = int(ds["n_points"][i])
        s, force = ds["first"].values[i, :n] - 1.0, ds["second"].values[i, :n]
        np.testing.assert_allclose(np.abs(s), [edge_of_stuart_landau(f) for f in force], atol=1e-7)
        assert force.min() < 0.12
        assert force.max() > 0.48
    assert plot_tongues(ds).data["numerator"].values.tolist() == [1] * ds.sizes["curve"]


def section_map(state, frequency, force, periods, mu=1.0):
    """Return the image of a state after drive periods and its derivative, and the angle turned, by DOP853."""

    def rates(t, u):
        x, v, m = u[0], u[1], u[2:6].reshape(2, 2)
        a = np.array([[0.0, 1.0], [-2.0 * mu * x * v - 1.0, mu * (1.0 - x * x)]])
        acceleration = mu * (1.0 - x * x) * v - x + force * np.cos(2.0 * np.pi * frequency * t)
        turning = (v * v - x * acceleration) / (x * x + v * v)
        return [v, acceleration, *(a @ m).ravel(), turning]

    end = scipy_end(rates, [*state, 1.0, 0.0, 0.0, 1.0, 0.0], periods / frequency)
    return end[:2], end[2:6].reshape(2, 2), end[6] / (2.0 * np.pi)


@pytest.mark.slow
def test_tongues__edges_by_another_integrator(van_der_pol):
    """At the edges the orbit closes after q periods, has turned p times, and has a multiplier 1."""
    plane = {"parameter": "frequency_hz", "second": "A", "second_low": 0.9, "second_high": 1.1}
    ds = van_der_pol.derive("tongues", **plane, max_denominator=3, at={"A": 1.0})
    rows = {row["tongue"]: row for row in tongues_table(ds).rows}
    assert list(rows) == ["1/3", "1/2", "2/3"]
    assert [rows["1/3"]["from"], rows["1/3"]["to"]] == pytest.approx([0.434667, 0.464610], abs=1e-6)
    seen = set()
    for i in range(ds.sizes["curve"]):
        n, p, q = (int(ds[name][i]) for name in ("n_points", "numerator", "denominator"))
        seen.add((p, q))
        for k in (0, n // 2, n - 1):
            state = ds["section"].values[i, k]
            image, slope, turned = section_map(state, float(ds["first"][i, k]), float(ds["second"][i, k]), q)
            assert image == pytest.approx(state, abs=1e-7)
            assert turned == pytest.approx(p, abs=1e-7)
            assert np.linalg.det(slope - np.eye(2)) == pytest.approx(0.0, abs=1e-6)
    assert seen == {(1, 3), (1, 2), (2, 3)}
    assert all(row["curves"] == 2 for row in rows.values())


def edge_of_step(state, bias, turns, periods):
    """Return the torque at which an orbit of the pendulum has a multiplier 1, by Newton's method and DOP853."""
    omega = 2.0 * np.pi * STAIRCASE_HZ

    def rates(t, u, torque):
        slope = np.array([[0.0, 1.0], [-np.cos(u[0]), -1.576]])
        acceleration = torque + np.cos(omega * t) - 1.576 * u[1] - np.sin(u[0])
        return [u[1], acceleration, *(slope @ u[2:].reshape(2, 2)).ravel()]

    def residual(z):
        start = [z[0], z[1], 1.0, 0.0, 0.0, 1.0]
        end = scipy_end(rates, start, periods / STAIRCASE_HZ, args=(z[2],))
        return [end[0] - z[0] - 2.0 * np.pi * turns, end[1] - z[1], np.linalg.det(end[2:].reshape(2, 2) - np.eye(2))]

    found = root(residual, [*state, bias], tol=1e-11)
    assert np.abs(residual(found.x)).max() < 1e-8
    return float(found.x[2])


@pytest.mark.slow
def test_tongues__steps_of_the_staircase(computed):
    """The edges of 0/1, 1/3, 1/2 and 1/1 of a damped pendulum, as docs/examples/driven-pendulum.md has them."""
    found = AnalysedRun.of(computed(STAIRCASE))
    ds = found.derive("tongues", parameter="bias", second="A", second_low=0.98, second_high=1.02, max_denominator=3)
    rows = {row["tongue"]: row for row in tongues_table(ds).rows}
    assert list(rows) == ["0/1", "1/3", "1/2", "2/3", "1/1"]
    assert rows["0/1"]["to"] == pytest.approx(0.9856034, abs=1e-7)
    for (turns, periods), ends in {
        (1, 3): (1.2912946, 1.3170055),
        (1, 2): (1.5963796, 1.6578605),
        (1, 1): (2.7336509, 2.9671389),
    }.items():
        row = rows[f"{turns}/{periods}"]
        assert [row["from"], row["to"]] == pytest.approx(ends, abs=1e-7)
        own = np.flatnonzero((ds["numerator"].values == turns) & (ds["denominator"].values == periods))
        assert len(own) == 2
        for i in own:
            k = int(np.nanargmin(np.abs(ds["second"].values[i] - 1.0)))
            edge = min(ends, key=lambda end, i=i, k=k: abs(end - float(ds["first"][i, k])))
            state = ds["section"].values[i, k]
            assert edge_of_step(state, edge + 1e-5, turns, periods) == pytest.approx(edge, abs=1e-7)


def test_tongues__thin_one_between_cells(van_der_pol):
    """2/3 is locked on 3e-4 Hz, between two cells .02 Hz apart; the search finds it."""
    cube = van_der_pol.cube()
    assert not (np.abs(cube["rotation"] - 2.0 / 3.0) < 1e-6).any()
    # A rotation number whose turns may be miscounted starts no search
    point = van_der_pol.cube().isel(A=0)
    flags = point["rotation_flag"].copy()
    flags[{"frequency": 3}] = RotationFlag.COARSE
    known = np.isfinite(cells_of(point.assign(rotation_flag=flags), "frequency").rotation)
    assert np.flatnonzero(~known.all(axis=1)).tolist() == [3]


@pytest.mark.slow
def test_figures(van_der_pol):
    """The map has the median over the cells; a line of it is a staircase."""
    cube = van_der_pol.cube()
    data = plot_rotation(cube).data
    assert data["rotation"].dims == ("A", "frequency")
    np.testing.assert_array_equal(data["rotation"].values, cube["rotation"].isel(initial_condition=0).values.T)
    texts = [text.get_text() for text in plot_rotation(cube, at={"A": 1.0}).axes[0].texts]
    assert "1/3" in texts
    with pytest.raises(ValueError, match="no rotation numbers"):
        plot_rotation(cube.drop_vars("rotation"))


def test_fractions_between():
    assert fractions_between(0.3, 0.5, 4) == [Fraction(1, 3), Fraction(1, 2)]
    assert fractions_between(-0.5, 0.0, 2) == [Fraction(-1, 2), Fraction(0)]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"of": ["y", "z"]}, "'z' is not a state"),
        ({"of": ["y"]}, "y is not an angle"),
        ({"of": ["y", "y"]}, "given twice"),
        ({"of": ["y", "x"], "n_periods": 3}, "at least 8"),
    ],
)
def test_specification__mistakes(tmp_path, given, message):
    with pytest.raises(SpecError, match=message):
        quietly({**STUART_LANDAU, "products": {"rotation": given}}, tmp_path / "run")


def test_tongues__needs_rotation_numbers(computed):
    short = {k: v for k, v in STUART_LANDAU.items() if k != "products"} | {"axes": {"w0": line(0.4, 1.6, 2)}}
    found = AnalysedRun.of(computed({**short, "integration": {**short["integration"], "n_transient": 2}}))
    with pytest.raises(SpecError, match="no rotation numbers"):
        found.derive("tongues", second="F", second_low=0.1, second_high=0.5)
