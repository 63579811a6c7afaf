"""Chaos indicators against maps whose numbers are known."""

import numpy as np
import pytest
import xarray as xr

from magpend_core.status import Status
from pipeline.analysis.chaos.dimensions import correlation_dimension, kaplan_yorke_dimension
from pipeline.analysis.chaos.zero_one import zero_one_test
from pipeline.products.lyapunov import LyapunovFlag
from pipeline.results.sets import Geometry
from tests.pipeline.analysis.maps import henon

LINE, PLANE = Geometry((False,), (1.0,)), Geometry((False, False), (1.0, 1.0))
CIRCLE, TORUS = Geometry((True,), (1.0,)), Geometry((True, True), (1.0, 1.0))
GOLDEN = 2.0 * np.pi * 0.5 * (np.sqrt(5.0) - 1.0)


def cube(section, status=None):
    """Cube of cells from sections (cell, period_index, state)."""
    section = np.asarray(section, float)
    ds = xr.Dataset({"section": (("initial_condition", "period_index", "state"), section)})
    if status is not None:
        ds["status"] = ("initial_condition", np.array(status, np.int8))
    return ds.assign_coords(state=[f"x{i}" for i in range(section.shape[-1])])


def logistic(rates, n):
    rates = np.asarray(rates)
    x, section = np.full(len(rates), 0.4), np.empty((len(rates), n, 1))
    for i in range(-1000, n):
        x = rates * x * (1.0 - x)
        if i >= 0:
            section[:, i, 0] = x
    return section


def circle(n, rotation=GOLDEN):
    """A motion that is conjugate to a rotation, as it runs on: angles not brought back."""
    angle = rotation * np.arange(n)
    return (angle + 0.4 * np.sin(angle))[None, :, None]


# ---- 0-1 test ----------------------------------------------------------------------------------


def test_zero_one_test__logistic_windows_and_chaos():
    # periods 2, 4, 8, the window of period 3; then chaos, the last with exponents .35 to ln 2
    regular, chaotic = [3.2, 3.5, 3.55, 3.83], [3.7, 3.8, 3.9, 3.97, 4.0]
    found = zero_one_test(cube(logistic(regular + chaotic, 1000)), geometry=LINE)
    assert all({"long_name", "units"} <= v.attrs.keys() for v in found.data_vars.values())
    k = found["zero_one"].values
    assert abs(k[: len(regular)]).max() < 0.05
    assert k[len(regular) :].min() > 0.98
    assert abs(found["zero_one_half"].values - k).max() < 0.06
    assert (found["zero_one_low"] <= found["zero_one"]).all()
    assert (found["zero_one"] <= found["zero_one_high"]).all()
    # Gottwald and Melbourne's Eqs. with loops, and their oscillating term instead of our centring
    phi = logistic([3.65], 400)[0, :, 0]
    n, n_cut = len(phi), len(phi) // 10
    rates = []
    for c in np.random.default_rng(7).uniform(np.pi / 5, 4 * np.pi / 5, 20):
        j = np.arange(1, n + 1)
        p, q = np.cumsum(phi * np.cos(j * c)), np.cumsum(phi * np.sin(j * c))
        displacement = []
        for lag in range(1, n_cut + 1):
            moved = [(p[i + lag] - p[i]) ** 2 + (q[i + lag] - q[i]) ** 2 for i in range(n - n_cut)]
            oscillation = phi.mean() ** 2 * (1 - np.cos(lag * c)) / (1 - np.cos(c))
            displacement.append(np.mean(moved) - oscillation)
        rates.append(np.corrcoef(np.arange(n_cut), displacement)[0, 1])
    found = zero_one_test(cube(phi[None, :, None]), n_frequencies=20, seed=7, geometry=LINE)
    # both forms agree but for terms that vanish as n grows
    assert found["zero_one"].item() == pytest.approx(np.median(rates), abs=0.02)
    low, high = np.percentile(rates, [25, 75])
    assert found["zero_one_low"].item() == pytest.approx(low, abs=0.03)
    assert found["zero_one_high"].item() == pytest.approx(high, abs=0.03)


def test_zero_one_test__circle_henon_point_and_failed_cells():
    quasi = zero_one_test(cube(circle(1000)), geometry=CIRCLE)
    assert abs(quasi["zero_one"].item()) < 0.02
    section = henon(4, 400)
    # a point, but for the noise of an integration
    section[1] = [0.3, 0.2] + 1e-8 * np.random.default_rng(0).normal(size=section[1].shape)
    section[2] = np.nan
    status = [Status.BOUNDED, Status.PERIODIC, Status.DIVERGED, Status.PENDING]
    found = zero_one_test(cube(section, status), geometry=PLANE)
    assert found["zero_one"].values[:2] == pytest.approx([1.0, 0.0], abs=0.01)
    for name in found:
        assert np.isnan(found[name].values[2:]).all(), name
    assert found["oversampling"].values[1] == 0.0
    # A small quasi-periodic motion about pi is regular though its angle changes sign all the time
    angle = np.pi + 0.2 * np.cos(GOLDEN * np.arange(600))
    wrapped = angle - 2.0 * np.pi * np.ceil((angle - np.pi) / (2.0 * np.pi))
    assert np.ptp(wrapped) > 6.0
    found = zero_one_test(cube(wrapped[None, :, None]), geometry=CIRCLE)
    assert abs(found["zero_one"].item()) < 0.02
    assert found["oversampling"].item() < 3.0


def test_zero_one_test__oversampling_hides_chaos_and_is_flagged():
    """Henon's x, held for 40 steps and joined by straight lines: a signal sampled too often."""
    x = henon(1, 200)[0, :, 0]
    slow = np.interp(np.arange(0, 199, 1 / 40), np.arange(200), x)[None, :, None]
    flagged = zero_one_test(cube(slow), geometry=LINE)
    assert flagged["zero_one"].item() < 0.5
    assert flagged["oversampling"].item() > 10.0
    coarse = cube(np.tile(henon(1, 8000)[:, :, :1], 1))
    assert zero_one_test(coarse, stride=10, geometry=LINE)["zero_one"].item() > 0.98
    ds = cube(logistic([3.6], 400))
    tests = [zero_one_test(ds, n_frequencies=40, seed=seed, geometry=LINE) for seed in range(40)]
    scatter = np.std([t["zero_one"].item() for t in tests], ddof=1)
    stated = np.mean([t["zero_one_stderr"].item() for t in tests])
    assert 0.6 < stated / scatter < 1.7


def test_zero_one_test__does_not_depend_on_neighbours_or_blocks(monkeypatch):
    section = np.concatenate([henon(5, 250)[..., :1], logistic([3.5, 3.6], 250)])
    whole = zero_one_test(cube(section), geometry=LINE)
    monkeypatch.setattr("pipeline.analysis.chaos.zero_one.STEP_BYTES", 1)
    alone = zero_one_test(cube(section), geometry=LINE)
    xr.testing.assert_allclose(whole, alone, rtol=1e-9)
    named = zero_one_test(cube(henon(1, 250)), state="x1", geometry=PLANE)
    assert named["zero_one"].item() > 0.9


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stride": 2}, "too few"),
        ({"stride": 0}, "stride is 0"),
        ({"n_frequencies": 3}, "n_frequencies is 3"),
        ({"state": "psi1"}, "psi1"),
        ({"geometry": PLANE}, "geometry"),
    ],
)
def test_zero_one_test__bad_input(options, message):
    with pytest.raises(ValueError, match=message):
        zero_one_test(cube(logistic([4.0], 300)), **{"geometry": LINE, **options})


# ---- Kaplan-Yorke dimension --------------------------------------------------------------------


def kaplan_yorke(*rows, **more):
    """Dimensions of spectra."""
    options = {k: more.pop(k) for k in ("flow", "zero") if k in more}
    return kaplan_yorke_dimension(spectra(*rows, **more), **options)["kaplan_yorke_dimension"].values


def spectra(*rows, stderr=None, n_states=None):
    ds = xr.Dataset({"lyapunov": (("cell", "exponent"), np.array(rows, float))})
    if stderr is not None:
        ds["lyapunov_stderr"] = (("cell", "exponent"), np.array(stderr, float))
    return ds if n_states is None else ds.assign_coords(state=np.arange(n_states))


def test_kaplan_yorke_dimension__known_values_and_edges():
    log3 = np.log(0.3)
    rows = [
        (0.4192, log3 - 0.4192),  # Henon
        (log3 - 0.4192, 0.4192),  # in any order
        (0.158, -0.358),  # Duffing, per unit time
        (-0.1, -0.2),
        (0.0, -0.3),
        (0.3, -0.3),  # conservative
        (0.3, 0.1),
        (np.nan, -1.0),
    ]
    found = kaplan_yorke(*rows)
    expected = [1.2583, 1.2583, 1 + 0.158 / 0.358, 0.0, 1.0, 2.0, 2.0, np.nan]
    assert found == pytest.approx(expected, abs=1e-4, nan_ok=True)
    # The zero of a flow is left out, wherever noise has put it: Rossler, Lorenz, a limit cycle, rest
    rows = [(0.0714, 2e-5, -5.3943), (0.9056, -1e-4, -14.5723), (3e-6, -0.2, -0.3), (-0.1, -0.2, -0.3)]
    found = kaplan_yorke(*rows, flow=True)
    # Sprott (2003): 2.0132 and 2.062 for the attractors, one more than for their sections
    assert found == pytest.approx([1.0132, 1.0621, 0.0, 0.0], abs=1e-4)
    # j = 2 of 4, and a sum that is 0 at j = 2; the unit cancels
    rows = np.array([(0.5, 0.1, -0.9, -4.0), (0.5, -0.5, -1.0, -2.0), (0.2, -0.1, -0.05, -3.0)])
    expected = [2 + 0.6 / 0.9, 2.0, 3 + 0.05 / 3.0]
    for unit in (1.0, 2.0 * np.pi):
        found = kaplan_yorke(*(unit * rows))
        assert found == pytest.approx(expected, abs=1e-12)
    quasi = spectra((-1e-6, -0.4))
    assert kaplan_yorke_dimension(quasi)["kaplan_yorke_dimension"].item() == 0.0
    assert kaplan_yorke_dimension(quasi, zero=1e-4)["kaplan_yorke_dimension"].item() == 1.0
    # the largest alone: a negative one settles it, a positive one does not
    part = kaplan_yorke((0.3,), (-0.3,), n_states=4)
    assert part == pytest.approx([np.nan, 0.0], nan_ok=True)
    ds = spectra((0.3, -0.6), (0.3, -0.6), (-0.3, -0.6))
    ds["lyapunov_flag"] = "cell", np.array([LyapunovFlag.GOOD, LyapunovFlag.UNRESOLVED, LyapunovFlag.FAILED])
    found = kaplan_yorke_dimension(ds)["kaplan_yorke_dimension"].values
    assert found == pytest.approx([1.5, np.nan, np.nan], nan_ok=True)


def test_kaplan_yorke_dimension__errors_are_carried_over():
    rates, errors = np.array([0.5, 0.1, -0.9, -4.0]), np.array([0.01, 0.02, 0.03, 0.5])
    found = kaplan_yorke_dimension(spectra(rates, stderr=[errors]))
    drawn = rates + errors * np.random.default_rng(1).normal(size=(4000, 4)) * 0.3
    scatter = kaplan_yorke(*drawn).std() / 0.3
    assert found["kaplan_yorke_dimension_stderr"].item() == pytest.approx(scatter, rel=0.05)
    assert np.isnan(kaplan_yorke_dimension(spectra(rates))["kaplan_yorke_dimension_stderr"].item())
    sure = kaplan_yorke_dimension(spectra((-0.1, -0.2), stderr=[(0.01, 0.01)]))
    assert sure["kaplan_yorke_dimension_stderr"].item() == 0.0
    with pytest.raises(ValueError, match="lyapunov"):
        kaplan_yorke_dimension(cube(henon(1, 10)))
    with pytest.raises(ValueError, match="zero"):
        kaplan_yorke_dimension(spectra(rates), zero=-1.0)


# ---- correlation dimension ---------------------------------------------------------------------


@pytest.mark.slow
def test_correlation_dimension__henon():
    # 1.21 +- .01 by Grassberger and Procaccia (1983), 1.220 by later work: local slopes wave by .07
    found = correlation_dimension(cube(henon(1, 8000)), geometry=PLANE)
    assert found["correlation_dimension"].item() == pytest.approx(1.215, abs=0.03)
    assert found["correlation_dimension_stderr"].item() < 0.015
    assert abs(found["correlation_dimension_spread"].item()) < 0.06
    assert found["n_points"].item() == 8000
    # the range is the documented one: ten neighbours, a twentieth of the pairs
    at = int(np.argmin(abs(found["log_radius"].values[0] - np.log(found["fit_high"].item()))))
    share = np.exp(found["log_correlation_sum"].values[0, at : at + 2])
    assert share[0] <= 0.05 < share[1]
    at = int(np.argmin(abs(found["log_radius"].values[0] - np.log(found["fit_low"].item()))))
    neighbours = np.exp(found["log_correlation_sum"].values[0, at - 1 : at + 1]) * 8000
    assert neighbours[0] < 10.0 <= neighbours[1] * (1.0 + 1e-3)
    # and the curve is there to see the slope in
    inside = (found["log_radius"] >= np.log(found["fit_low"]) - 1e-9) & (
        found["log_radius"] <= np.log(found["fit_high"]) + 1e-9
    )
    x, y = (found[f"log_{k}"].values[inside.values] for k in ("radius", "correlation_sum"))
    assert np.polyfit(x, y, 1)[0] == pytest.approx(found["correlation_dimension"].item(), abs=1e-9)
    ring = correlation_dimension(cube(circle(4000)), geometry=CIRCLE)
    assert ring["correlation_dimension"].item() == pytest.approx(1.0, abs=0.03)
    n = np.arange(6000)
    torus = np.stack([2 * np.pi * np.sqrt(2) * n, 2 * np.pi * np.sqrt(3) * n], axis=-1)
    found = correlation_dimension(cube(torus[None]), geometry=TORUS)
    assert found["correlation_dimension"].item() == pytest.approx(2.0, abs=0.08)
    # a uniform square, 2 pi wide, as a torus: C(r) = (r/pi)^2 exactly
    square = np.random.default_rng(0).uniform(-np.pi, np.pi, (1, 4000, 2))
    found = correlation_dimension(cube(square), geometry=TORUS)
    assert found["correlation_dimension"].item() == pytest.approx(2.0, abs=0.02)
    radius, share = np.exp(found["log_radius"].values[0]), np.exp(found["log_correlation_sum"].values[0])
    large = radius > 0.2
    assert share[large] == pytest.approx((radius[large] / np.pi) ** 2, rel=0.02)


def test_correlation_dimension__pairs_are_those_of_the_definition():
    section = henon(3, 60)
    found = correlation_dimension(cube(section), pool=["initial_condition"], theiler=4, geometry=PLANE)
    points = section.reshape(-1, 2)
    distance = abs(points[:, None] - points[None]).max(axis=-1)
    cell, time = np.divmod(np.arange(180), 60)
    apart = (cell[:, None] != cell[None]) | (abs(time[:, None] - time[None]) > 4)
    # radii a little larger than their logarithm's rounding may tell
    for x, y in zip(found["log_radius"].values, found["log_correlation_sum"].values, strict=True):
        share = (distance[apart] <= np.exp(x) * (1 + 1e-12)).mean()
        assert (np.isnan(y) and share == 0.0) or np.exp(y) == pytest.approx(share, rel=1e-12)


@pytest.mark.slow
def test_correlation_dimension__closed_orbits_points_and_failed_cells():
    section = henon(5, 2000)
    section[0] = np.array([[0.1, 0.2], [0.5, -0.3], [-0.2, 0.0]])[np.arange(2000) % 3]
    section[1] = 0.3 + 1e-8 * np.random.default_rng(0).normal(size=section[1].shape)
    section[2] = np.nan
    status = [Status.PERIODIC, Status.PERIODIC, Status.DIVERGED, Status.PENDING, Status.BOUNDED]
    found = correlation_dimension(cube(section, status), geometry=PLANE)
    dimension = found["correlation_dimension"].values
    assert dimension[:2].tolist() == [0.0, 0.0]
    assert np.isnan(dimension[2:4]).all()
    assert dimension[4] == pytest.approx(1.2, abs=0.1)
    assert found["n_points"].values.tolist() == [2000, 2000, 0, 0, 2000]
    # too few points for two octaves: the curve, and no slope
    few = correlation_dimension(cube(henon(1, 60)), geometry=PLANE)
    assert np.isnan(few["correlation_dimension"].item())
    assert np.isfinite(few["log_correlation_sum"].values).any()


@pytest.mark.slow
def test_correlation_dimension__pooled_bound_and_scaled_and_its_error():
    pooled = correlation_dimension(cube(henon(60, 50)), pool=["initial_condition"], geometry=PLANE)
    assert pooled["correlation_dimension"].item() == pytest.approx(1.21, abs=0.05)
    assert pooled["n_points"].item() == 3000
    bound = correlation_dimension(cube(henon(1, 3000)), n_max=500, geometry=PLANE)
    last = correlation_dimension(cube(henon(1, 3000)[:, -500:]), geometry=PLANE)
    xr.testing.assert_identical(bound.drop_attrs(), last.drop_attrs())
    many = correlation_dimension(cube(henon(300, 2)), pool=["initial_condition"], n_max=100, geometry=PLANE)
    assert many["n_points"].item() == 100
    section = henon(1, 1500)
    plain = correlation_dimension(cube(section), geometry=PLANE)
    scaled = correlation_dimension(cube(section * [1.0, 10.0]), geometry=Geometry((False, False), (1.0, 10.0)))
    assert scaled["correlation_dimension"].item() == pytest.approx(plain["correlation_dimension"].item(), abs=1e-6)
    found = correlation_dimension(cube(henon(16, 2000)), geometry=PLANE)
    scatter = found["correlation_dimension"].values.std(ddof=1)
    stated = found["correlation_dimension_stderr"].values.mean()
    assert 0.5 < stated / scatter < 2.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pool": ["frequency"]}, "frequency"),
        ({"theiler": -1}, "theiler is -1"),
        ({"n_max": 10}, "n_max is 10"),
        ({"floor": 0.0}, "floor is 0"),
    ],
)
def test_correlation_dimension__bad_input(options, message):
    with pytest.raises(ValueError, match=message):
        correlation_dimension(cube(henon(1, 200)), geometry=PLANE, **options)
