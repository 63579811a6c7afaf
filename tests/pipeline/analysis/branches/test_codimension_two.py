"""Points of codimension two on bifurcation curves, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from magpend_core.crossing import Crossing
from magpend_core.models import load_model
from magpend_core.models.sectioned import sectioned
from pipeline.analysis.branches import codimension_two
from pipeline.analysis.branches.analysis import curves_table
from pipeline.analysis.branches.curves import continue_curves, curves_dataset
from pipeline.analysis.branches.exploring import Scope, explore
from pipeline.analysis.branches.kinds import KINDS, LABELS, LIMITS
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.problems import Family
from tests.core.flows import model_of, table

# z' = (1 + i w0) z - |z|^2 z + F exp(i W t) for z = x + i y
STUART_LANDAU = load_model(
    table(
        "stuart_landau",
        {"x": "x - w0*y - (x^2 + y^2)*x + F*cos(2*pi*f*t)", "y": "w0*x + y - (x^2 + y^2)*y + F*sin(2*pi*f*t)"},
        {"w0": 1.3, "F": 0.2},
    )
)

# three oscillators that do not feel each other: u in a frame that turns by half a turn per period, so that its
# multiplier is -exp(mu T); the radius of (p, q); and z with a fold
UNCOUPLED = load_model(
    table(
        "uncoupled",
        {
            "x": "growth*u*c + v*s - pi*f*y",
            "y": "growth*u*s - v*c + pi*f*x",
            "p": "radius*p - 1.7*q",
            "q": "1.7*p + radius*q",
            "z": "m - z^2",
        },
        {"mu": -0.1, "a": -1.0, "nu": -0.1, "b": -1.0, "m": 0.3},
        define={
            "c": "cos(pi*f*t)",
            "s": "sin(pi*f*t)",
            "u": "x*c + y*s",
            "v": "y*c - x*s",
            "growth": "mu + a*u^2 - u^4",
            "radius": "nu + b*(p^2 + q^2) - (p^2 + q^2)^2",
        },
    )
)

FREQUENCY = 0.5


def curves_through(kind, state, free, values, bounds, max_period=1, **parameters):
    """Follow the curve of a bifurcation of the uncoupled oscillators."""
    model = UNCOUPLED
    scales = tuple(high - low for low, high in bounds)
    family = Family(model.system, 1, FREQUENCY, model.load(**parameters).pack(), free, scales)
    start = family.unknowns(np.array(state, float), values)
    return continue_curves([(0, family, kind, start)], bounds, max_period=max_period)


def located(curves):
    """Return the kind and the values of all points of codimension two, each once."""
    ds = curves_dataset(curves, "first", "second")
    names = ds["special_kind"].attrs["flag_meanings"].split()
    values = np.stack([ds["special_first"].values, ds["special_second"].values], axis=1)
    return [(names[k], value) for k, value in zip(ds["special_kind"].values, values, strict=True)]


@pytest.fixture(scope="module")
def stuart_landau():
    """All curves of the forced Stuart-Landau oscillator, from the folds along F at w0 - W = 0.3."""
    model, sigma, force = STUART_LANDAU, 0.3, 1.2
    frequency = 1.0 / (2.0 * np.pi)
    rho = max(r.real for r in np.roots([1.0, -2.0, 1.0 + sigma**2, -(force**2)]) if abs(r.imag) < 1e-9)
    z = force / (rho - 1.0 - 1j * sigma)
    packed = model.load(w0=1.0 + sigma).pack()
    family = Family(model.system, 1, frequency, packed, ("F",), (1.0,))
    (branch,) = explore([Start(family, np.array([z.real, z.imag]), force)], Scope(0.05, 1.5, 1))
    both = Family(model.system, 1, frequency, packed, ("w0", "F"), (1.9, 1.45))
    starts = [
        (k, both, one.kind, both.unknowns(family.state(one.point.u), [1.0 + sigma, family.values(one.point.u)[0]]))
        for k, one in enumerate(branch.bifurcations)
    ]
    return continue_curves(starts, ((0.05, 1.95), (0.05, 1.5)), max_period=1)


@pytest.mark.slow
def test_stuart_landau__curves(stuart_landau):
    """Folds (1 - rho)(1 - 3 rho) + sigma^2 = 0; the Neimark-Sacker curves spring from R1."""
    assert sorted(c.kind for c in stuart_landau) == ["fold", "neimark_sacker", "neimark_sacker"]
    for curve in stuart_landau:
        sigma, force = curve.values[:, 0] - 1.0, curve.values[:, 1]
        rho = np.array([np.sum(curve.family.state(p.u) ** 2) for p in curve.points])
        np.testing.assert_allclose(rho * ((1.0 - rho) ** 2 + sigma**2), force**2, atol=1e-7)
        if curve.kind == "fold":
            np.testing.assert_allclose((1.0 - rho) * (1.0 - 3.0 * rho) + sigma**2, 0.0, atol=1e-7)
        else:
            np.testing.assert_allclose(force**2, (0.25 + sigma**2) / 2.0, atol=1e-7)
            assert "resonance" in curve.ends
            assert curve.start == -1


@pytest.mark.slow
def test_stuart_landau__points(stuart_landau):
    """Cusps, R1, and the other resonances where the angle is 2 pi sqrt(sigma^2 - 1/4)."""
    expected = [("cusp", s / np.sqrt(3.0), np.sqrt(8.0 / 27.0)) for s in (-1.0, 1.0)]
    expected += [("r1", s / 2.0, 0.5) for s in (-1.0, 1.0)]
    # angles of a half, a third and a quarter turn, and of two thirds and three quarters
    for kind, share in (("r2", 1 / 2), ("r3", 1 / 3), ("r4", 1 / 4), ("r3", 2 / 3), ("r4", 3 / 4)):
        sigma = np.sqrt(0.25 + share**2)
        expected += [(kind, s * sigma, np.sqrt((0.25 + sigma**2) / 2.0)) for s in (-1.0, 1.0)]
    found = [(kind, value[0] - 1.0, value[1]) for kind, value in located(stuart_landau)]
    assert len(found) == len(expected)
    for one, other in zip(sorted(found), sorted(expected), strict=True):
        assert one[0] == other[0]
        assert one[1:] == pytest.approx(other[1:], abs=1e-7)
    ds = curves_dataset(stuart_landau, "w0", "F", STUART_LANDAU)
    shown = curves_table(ds)
    points = [row for row in shown.rows if row["type"] == "cusp"]
    assert len(points) == 2
    assert set(points[0]) >= {"type", "w0", "F", "period", "error"}
    assert all(0.0 <= row["error"] < 1e-6 for row in points)
    assert any("cusp" in line for line in shown.lines)
    # The Neimark-Sacker curves end at R1, where the coefficient has no meaning; farther away it has
    (r1, *_) = [one for curve in stuart_landau for one in curve.special if one.kind == "r1"]
    u = r1.point.u + np.array([0.0, 0.0, 1e-8, 0.0])
    beside = replace(r1, kind="chenciner", point=replace(r1.point, u=u))
    away = replace(beside, point=replace(r1.point, u=u + [0.0, 0.0, 1e-3, 0.0]))
    assert [one.kind for one in codimension_two.merged({0: [beside, r1, away]})] == ["r1", "chenciner"]


@pytest.mark.slow
def test_duffing__cusp():
    """x'' + .1 x' + x + x^3 = F cos wt: cusp at w = 1.0901095, F = .0513635."""
    model = load_model("duffing")
    packed = model.load(damping=0.1, linear=1.0, cubic=1.0, amplitude=0.4).pack()
    omega = 1.4 / (2.0 * np.pi)
    family = Family(model.system, 1, omega, packed, ("amplitude",), (2.0,))
    (branch, *_) = explore([Start(family, np.zeros(2), 0.011)], Scope(0.01, 2.0, 1))
    both = Family(model.system, 1, omega, packed, ("frequency", "amplitude"), (0.3, 2.0))
    one = branch.bifurcations[0]
    start = both.unknowns(family.state(one.point.u), [omega, family.values(one.point.u)[0]])
    ((kind, value),) = located(continue_curves([(0, both, one.kind, start)], ((0.1, 0.4), (0.01, 2.0))))
    assert kind == "cusp"
    assert 2.0 * np.pi * value[0] == pytest.approx(1.0901095, abs=1e-7)
    assert value[1] == pytest.approx(0.0513635, abs=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(("q", "share"), [(0.1, 0.5), (0.1, 1 / 6), (0.3, 0.6), (0.03, 0.5)])
def test_cusp_of_cycles__none_where_they_shrink(q, share):
    """mu + c s + q s^2 - s^3 = 0 with the squared radius s: a cusp at s = q/3, and the folds end with s = 0."""
    rates = {"x": "g*x - 2*y", "y": "2*x + g*y"}
    define = {"s": "x^2 + y^2", "g": "mu + c*s + q*s^2 - s^3"}
    model = sectioned(model_of(rates, {"mu": 0.0, "c": 0.0, "q": 0.3}, define=define), Crossing("y", longest=50.0))
    bounds = ((-2.0 * q**3, 2.0 * q**3), (-2.0 * q**2, 2.0 * q**2))
    scales = tuple(high - low for low, high in bounds)
    family = Family(model.system, 1, model.crossing.frequency_hz, model.load(q=q).pack(), ("mu", "c"), scales)
    s = share * q
    c = 3.0 * s**2 - 2.0 * q * s
    u = family.unknowns(np.array([np.sqrt(s), 0.0]), [s**3 - q * s**2 - c * s, c])
    ((kind, value),) = located(continue_curves([(0, family, "fold", u)], bounds))
    assert kind == "cusp"
    np.testing.assert_allclose(value, [q**3 / 27.0, -(q**2) / 3.0], rtol=1e-6)


@pytest.mark.slow
def test_generalised_doubling__and_the_folds_that_spring_from_it():
    """u' = u (mu + a u^2 - u^4): the doubling is degenerate at a = 0; folds of twice the period at mu = -a^2/4."""
    bounds = ((-0.5, 0.5), (-1.0, 1.5))
    curves = curves_through(
        "period_doubling", [0, 0, 0, 0, np.sqrt(0.3)], ("mu", "a"), [0.0, -0.4], bounds, max_period=2
    )
    ((kind, value),) = located(curves)
    assert kind == "generalised_doubling"
    np.testing.assert_allclose(value, 0.0, atol=1e-7)
    doubling, fold = curves
    np.testing.assert_allclose(doubling.values[:, 0], 0.0, atol=1e-7)
    assert (fold.kind, fold.family.period) == ("fold", 2)
    assert np.ptp(fold.values[:, 1]) > 1.0
    np.testing.assert_allclose(fold.values[:, 0], -(fold.values[:, 1] ** 2) / 4.0, atol=1e-7)


@pytest.mark.slow
def test_chenciner(monkeypatch):
    """r' = r (nu + b r^2 - r^4)."""
    given = ("neimark_sacker", [0, 0, 0, 0, np.sqrt(0.3)], ("nu", "b"), [0.0, -0.4], ((-0.5, 0.5), (-1.0, 1.0)))
    curves = curves_through(*given)
    ((kind, value),) = located(curves)
    assert kind == "chenciner"
    np.testing.assert_allclose(value, 0.0, atol=1e-7)
    # A sign change without a located zero is told, not dropped

    def nothing(*words):
        return None
        yield

    monkeypatch.setattr(codimension_two, "find_root", nothing)
    curves = curves_through(*given)
    ds = curves_dataset(curves, "nu", "b", UNCOUPLED)
    assert ds["n_missed"].values.tolist() == [1]
    assert any("1 sign change of test functions could not be located" in line for line in curves_table(ds).lines)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "free", "bifurcations"),
    [
        ("fold_flip", ("mu", "m"), ("fold", "period_doubling")),
        ("fold_neimark_sacker", ("nu", "m"), ("fold", "neimark_sacker")),
        ("doubling_neimark_sacker", ("mu", "nu"), ("period_doubling", "neimark_sacker")),
    ],
)
def test_two_bifurcations_at_once(kind, free, bifurcations):
    """Both curves are found from the one, and cross at the origin."""
    z = 0.0 if "m" in free else np.sqrt(0.3)
    values = [-0.3, 0.0] if free[0] != "mu" or "m" in free else [0.0, -0.3]
    curves = curves_through(bifurcations[0], [0, 0, 0, 0, z], free, values, ((-0.5, 0.5), (-0.4, 0.4)))
    assert {c.kind for c in curves} == set(bifurcations)
    assert {name for name, _ in located(curves)} == {kind}
    for _, value in located(curves):
        np.testing.assert_allclose(value, 0.0, atol=1e-7)


def test_labels__each_kind_has_one():
    assert set(LABELS) == {*KINDS, *LIMITS, *codimension_two.POINT_KINDS}
