"""Ends of chaotic sets, tori and orbits: intermittency, locking and grazing, against closed forms and shooting."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve

import magpend
from pipeline.analysis.branches.kinds import DOUBLING, FOLD
from pipeline.analysis.events import grazing, passages
from pipeline.analysis.events.passages import PassageSettings, Phases, phases, rotation_of, scaling
from pipeline.results.sets import Geometry

LOGISTIC = magpend.model("x' = r*x*(1 - x)", name="logistic", kind="map", r=3.83)
# odd maps whose orbits of period 1 lose stability at e = 0, subcritically, and that come back to 0 from afar
FLIP = magpend.model("x' = -((1 + e)*x + 1.5*x**3 - x**5)", name="flip", kind="map", e=0.1)
SPIRAL = magpend.model(
    "x' = H*(0.54*x - S*y)\ny' = H*(S*x + 0.54*y)\nR = x**2 + y**2\nH = 1 + e + 1.5*R - R**2\nS = sqrt(1 - 0.54**2)",
    name="spiral", kind="map", e=0.1,
)  # fmt: skip
STUART = magpend.model(
    "x' = x*(1 - R) - w*y + F*cos(omega*t)\ny' = y*(1 - R) + w*x + F*sin(omega*t)\nR = x**2 + y**2",
    name="stuart", w=1.0, F=0.2,
)  # fmt: skip
FORCED = magpend.model("x'' = mu*(1 - x**2)*x' - x + A*cos(omega*t)", name="forced", mu=0.1, A=0.04)
# polar coordinates: th' = th + O - K sin th, r' = sqrt(r)
RING = magpend.model(
    "x' = G*(x*cos(a) - y*sin(a))\ny' = G*(x*sin(a) + y*cos(a))\na = O - K*y/sqrt(R)\nG = R**(-0.25)\nR = x**2 + y**2",
    name="ring", kind="map", O=1.0, K=0.6,
)  # fmt: skip

ALONG_R = xr.Dataset(attrs={"parameter": "r"})
LONG = {"n_transient": 2000, "n_keep": 200}


def sweep(model, folder, starts, integration=None, n=8, **axes):
    spec = magpend.Spec("sweep", model)
    for name, values in axes.items():
        spec = spec.with_axis(name, values=[float(x) for x in values])
    spec = spec.with_start_random(n=n, seed=0, **starts).with_integration(**(integration or LONG))
    return magpend.run(spec, folder / "run", workers=0)


def of(table, what):
    """Values, errors, exponents and rotations of the events of one name."""
    rows = table[table["what"] == what]
    (error, _) = [column for column in rows if column.endswith("_error")]
    columns = [error.removesuffix("_error"), error, "exponent", "exponent_error", "rotation"]
    return [tuple(row) for row in rows[columns].to_numpy()]


NORMAL = {
    # the window of period 3 opens at 1 + sqrt(8)
    "intermittency_i": (LOGISTIC, {"x": (0.1, 0.9)}, {"r": np.linspace(3.8231, 3.8381, 6)}, 1.0 + np.sqrt(8.0), 0.5),
    "intermittency_ii": (SPIRAL, {"x": (-0.05, 0.05), "y": (-0.05, 0.05)}, {"e": [-0.031, -0.01, 0.011]}, 0.0, 1.0),
    "intermittency_iii": (FLIP, {"x": (-0.05, 0.05)}, {"e": [-0.031, -0.01, 0.011]}, 0.0, 1.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", NORMAL)
def test_events__intermittency(name, tmp_path):
    model, starts, axes, known, exponent = NORMAL[name]
    table = sweep(model, tmp_path, starts, **axes).table("events")
    ((value, error, found, spread, _),) = of(table, name)
    assert abs(value - known) <= error < 1e-8
    assert abs(found - exponent) <= 2.0 * spread <= 2.0 * PassageSettings.largest_error
    assert not (table["what"] == "not_decided").any()


def locked(force):
    """Detuning at which the forced Stuart-Landau oscillator locks: fold of R ((1 - R)**2 + d**2) = F**2 over R."""

    def rest(d):
        r = (2.0 + np.sqrt(1.0 - 3.0 * d**2)) / 3.0
        return r * ((1.0 - r) ** 2 + d**2) - force**2

    return brentq(rest, 0.0, 0.5)


@pytest.mark.slow
@pytest.mark.usefixtures("long_steps")
def test_events__tongue_of_stuart_landau(tmp_path):
    starts = {"x": (-1, 1), "y": (-1, 1)}
    run = sweep(
        STUART, tmp_path, starts, {"n_transient": 400, "n_keep": 200}, omega=[1.0], w=[0.72, 0.77, 1.0, 1.23, 1.28]
    )
    table = run.table("events", parameter="w")
    edges = of(table, "locking")
    d = locked(0.2)
    assert [x[0] for x in edges] == pytest.approx([1.0 - d, 1.0 + d], abs=1e-9)
    assert [x[4] for x in edges] == ["0/1", "0/1"]
    # and the orbit ends at both edges in the same folds
    assert sorted(table[table["what"] == "fold"]["w"]) == pytest.approx([1.0 - d, 1.0 + d], abs=1e-9)
    assert not (table["what"] == "not_decided").any()


def fold_of_forced(mu, force, period, x, v, omega):
    """Frequency near one at which an orbit of some drive periods has the multiplier 1, by shooting with DOP853."""

    def rates(t, u, omega):
        x, v = u[:2]
        slopes = np.array([[0.0, 1.0], [-2.0 * mu * x * v - 1.0, mu * (1.0 - x * x)]]) @ u[2:].reshape(2, 2)
        return [v, mu * (1.0 - x * x) * v - x + force * np.cos(omega * t), *slopes.ravel()]

    def singular(y):
        time, start = 2.0 * np.pi * period / y[2], [*y[:2], 1.0, 0.0, 0.0, 1.0]
        end = solve_ivp(rates, (0.0, time), start, "DOP853", args=(y[2],), rtol=1e-11, atol=1e-12).y[:, -1]
        return [*(end[:2] - y[:2]), np.linalg.det(end[2:].reshape(2, 2) - np.eye(2))]

    return fsolve(singular, [x, v, omega], xtol=1e-12)[2]


WEAK, STRONG = (0.1, 0.04, 1), (1.0, 1.5, 3)
TONGUES = {
    "0/1": (WEAK, [0.97, 0.98, 1.0, 1.015, 1.03], [(1.971, -0.224, 0.9893), (-1.966, -0.184, 1.0094)]),
    "1/3": (STRONG, [2.62, 2.65, 2.8, 2.99, 3.02], [(1.319, -0.575, 2.6798), (1.843, 0.653, 2.9616)]),
}


@pytest.mark.slow
@pytest.mark.usefixtures("long_steps")
@pytest.mark.parametrize("tongue", TONGUES)
def test_events__tongues_of_van_der_pol(tongue, tmp_path):
    (mu, force, period), values, folds = TONGUES[tongue]
    axes = {"mu": [mu], "A": [force], "omega": values}
    run = sweep(FORCED, tmp_path, {"x": (-2, 2), "x_dot": (-2, 2)}, {"n_transient": 300, "n_keep": 200}, n=2, **axes)
    run.branches(parameter="omega", stable=True)
    table = run.table("events", parameter="omega")
    known = [fold_of_forced(mu, force, period, *one) for one in folds]
    edges, ends = of(table, "locking"), of(table, "fold")
    assert [x[4] for x in edges] == [tongue] * 2
    for found in (edges, ends):
        assert [x[0] for x in sorted(found)] == pytest.approx(known, abs=1e-8)
    assert not (table["what"] == "not_decided").any()
    if tongue == "0/1":
        # averaged over a period: x = 2 Re(u exp(i omega t)), u' = (1 - |u|**2) u + i s u - i F in the time mu t/2, with
        # s = (1 - omega**2)/(mu omega) and F = A/(2 mu omega), about the frequency 1 - mu**2/16
        d = locked(force / (2.0 * mu))
        averaged = np.array([-d, d]) * mu / 2.0 + np.hypot(1.0, d * mu / 2.0) - mu**2 / 16.0
        assert known == pytest.approx(averaged, abs=0.2 * mu**3)


@pytest.mark.slow
def test_events__tongues_of_the_circle_map(tmp_path):
    """The tongue 0/1 ends at O = K; the edges of 1/2 are the folds of the map's second iterate."""
    starts = {"x": (0.5, 1.5), "y": (-1.0, 1.0)}
    run = sweep(RING, tmp_path, starts, O=[0.4, 0.55, 0.6543, 0.7071, 2.9817, 3.0213, 3.14, 3.2519, 3.3031])
    edges = of(run.table("events"), "locking")

    def second(y):
        th, o = y
        one = th + o - 0.6 * np.sin(th)
        slope = (1.0 - 0.6 * np.cos(th)) * (1.0 - 0.6 * np.cos(one))
        return [one + o - 0.6 * np.sin(one) - th - 2.0 * np.pi, slope - 1.0]

    halves = {round(fsolve(second, [th, o])[1], 8) for o in (3.0, 3.3) for th in np.linspace(0.1, 6.2, 9)}
    halves = sorted(x for x in halves if 2.9 < x < 3.4)
    assert len(halves) == 2
    assert [x[4] for x in edges] == ["0/1", "1/2", "1/2"]
    assert [x[0] for x in edges] == pytest.approx([0.6, *halves], abs=1e-8)


def second_touch(zeta=0.1, w=0.9, r=0.7):
    """Drive at which the orbit of three drive periods with one impact at x = 1 touches it a second time.

    Between impacts x is a damped oscillation beside the forced one; its later peak is 1.
    """
    wd, period = np.sqrt(1.0 - zeta**2), 6.0 * np.pi / w

    def flight(v, force, phase, t):
        z = force * np.exp(1j * (w * t + phase)) / (1.0 - w**2 + 2j * zeta * w)
        z0 = force * np.exp(1j * phase) / (1.0 - w**2 + 2j * zeta * w)
        a, b = 1.0 - z0.real, (-r * v - (1j * w * z0).real + zeta * (1.0 - z0.real)) / wd
        e, c, s = np.exp(-zeta * t), np.cos(wd * t), np.sin(wd * t)
        return (
            e * (a * c + b * s) + z.real,
            e * ((wd * b - zeta * a) * c - (zeta * b + wd * a) * s) + (1j * w * z).real,
        )

    def equations(u):
        v, phase, force, t = u
        ends, touches = flight(v, force, phase, period), flight(v, force, phase, t)
        return [ends[0] - 1.0, ends[1] - v, touches[0] - 1.0, touches[1]]

    v, phase = 0.335801, 0.456354  # of the orbit at A = 0.29
    times = np.linspace(0.3, period - 0.3, 2000)
    first = times[flight(v, 0.29, phase, times)[0].argmax()]
    return fsolve(equations, [v, phase, 0.29, first], xtol=1e-13)[2]


@pytest.mark.slow
@pytest.mark.usefixtures("long_steps")
def test_events__grazing_of_the_impact_oscillator(tmp_path):
    """The linear oscillator touches the stop where its amplitude equals the gap; orbits with an impact touch again."""
    model = magpend.load_model("impact")
    starts, settings = {"x": (-0.9, 0.9), "v": (-0.5, 0.5)}, {"n_transient": 300, "n_keep": 40}
    run = sweep(model, tmp_path, starts, settings, omega=[0.9], A=[0.25, 0.26, 0.28, 0.3, 0.31])
    touches = of(run.table("events", parameter="A"), "grazing")
    known = [np.hypot(1.0 - 0.81, 2.0 * 0.1 * 0.9), second_touch()]
    for x in known:
        assert any(abs(value - x) <= error < 1e-8 for value, error, *_ in touches)
    assert len(touches) == 2


LINE = Geometry((False,), (1.0,))


def test_phases__of_known_runs():
    """Stays of 3, 5 and 3 sections between excursions; those that are cut off or shorter than 2 do not count."""
    near = np.array([1, 0, 1, 1, 1, 0, 1, 0, 1, 1, 1, 1, 1, 0, 1, 1, 1, 0, 1], float)
    sections = np.tile(1.0 - near, (1, PassageSettings.groups, 1))[..., None]
    found = phases(sections, np.zeros((1, 1)), 0.5, np.ones(1), LINE, 2)
    assert found.number == [3 * PassageSettings.groups]
    assert found.length == pytest.approx([(9 + 25 + 9) / (3 + 5 + 3)])


@pytest.mark.parametrize(("kind", "exponent"), [(FOLD, -0.5), (DOUBLING, -1.0)])
def test_scaling__refuses_the_other_law(kind, exponent):
    d = 1e-3 * 0.5 ** np.arange(6)
    for other in (-0.5, -1.0):
        length = 20.0 * (d / d[0]) ** other - 2.0 * (kind == FOLD)
        found = Phases(d, length, np.full(6, 0.02), np.full(6, 500), np.full(6, 0.5))
        slope, error, chosen = scaling(found, kind, 1, passages.MEASURED[kind])
        assert slope == pytest.approx(other, abs=2e-3)
        assert len(chosen) >= PassageSettings.least_values
        told = passages._judged(ALONG_R, found, (slope, error, chosen), kind, "", 0.0, False)
        assert bool(told.what) == (other == exponent)
        assert not passages._judged(ALONG_R, found, (slope, error, chosen), kind, "", 0.0, True).what


def test_rotation_of__turns_of_the_section():
    """Clockwise turns by 2/5, slowly passed, are 2/5; turns of 0.3 are not of period 5."""
    n = np.arange(4000)
    for turn, text in ((0.4 + 1e-3, "2/5"), (0.33, "")):
        points = np.stack([np.cos(2 * np.pi * turn * n), -np.sin(2 * np.pi * turn * n)], axis=-1)[None]
        assert rotation_of(points, 5, Geometry((False, False), (1.0, 1.0))) == text


def test_peak__is_smooth_and_below_zero():
    """A bounce at the surface and a crossing are no peaks; a stay on the surface leaves none."""
    t = np.linspace(0.0, 4.0, 401)
    smooth, bounce = -0.1 - (t - 1.003) ** 2, -0.5 * np.abs(t - 3.004) - 1e-6
    h, rate = np.where(t < 2.0, smooth, bounce), np.where(t < 2.0, -2.0 * (t - 1.003), -0.5 * np.sign(t - 3.004))
    assert grazing._peak(h, rate, 0.01) == pytest.approx(-0.1, abs=1e-12)
    assert np.isnan(grazing._peak(np.sin(t), np.cos(t), 0.01))
    assert np.isnan(grazing._peak(np.where(t > 3.5, 0.0, h), rate, 0.01))


def test_stay__is_one_between_others():
    """A fall onto a surface and a leave along it, staying for 30 of 200 intervals; not at an end, twice, or never."""
    h = np.concatenate([1e-2 * np.arange(80, 0, -1), np.zeros(31), (1e-2 * np.arange(1, 91)) ** 2])
    assert grazing._stay(h) == pytest.approx(30 / 200)
    for other in (h[80:], h[:111], np.concatenate([h, h]), h + 1e-9):
        assert np.isnan(grazing._stay(other))


def test_touch__extrapolates_and_refuses():
    """Peaks -(c - x) - (c - x)**2 reach 0 at c; orbits that stay away, or of which one side is unknown, do not."""
    away = 1e-3 * 0.4 ** np.arange(7)[::-1]
    peaks = -away - away**2
    value, error, used = grazing._touch(2.0 - away, peaks)
    assert abs(value - 2.0) <= max(error, 1e-12)
    assert len(used) == 4
    assert grazing._touch(2.0 - away, peaks - 0.1) is None
    assert grazing._touch(2.0 - away, [np.nan] * 7) is None
