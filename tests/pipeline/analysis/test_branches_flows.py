"""Branches of limit cycles of flows, against what is known of them and an independent shooting method."""

import numpy as np
import pytest
from scipy.optimize import fsolve

from magpend_core.crossing import Crossing
from magpend_core.models.sectioned import sectioned
from pipeline.analysis.branches.analysis import branches_table, table_of, windows_of
from pipeline.analysis.branches.curves import curves_dataset, curves_from
from pipeline.analysis.branches.dataset import dataset_of
from pipeline.analysis.branches.exploring import Scope, explore
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.starting_orbits import family_of
from pipeline.analysis.branches.stuck import grows_without_bound
from tests.core.cells import scipy_end
from tests.core.flows import BAUTIN, PAIR, ROSSLER, flow, table

pytestmark = pytest.mark.slow


def followed(equations, of, state, parameter, low, high, *, max_period=1, level=0.0, **values):
    """Branches from a limit cycle near a state."""
    parameters = sectioned(flow(equations), Crossing(of, level, longest=50.0)).load(**values)
    model = parameters.model
    family = family_of(model.system, 1, model.crossing.frequency_hz, parameters.pack(), parameter, high - low)
    start = Start(family, np.array(state, float), parameters[parameter])
    return dataset_of(explore([start], Scope(low, high, max_period, 2)), parameter, parameters)


def test_explore__fold_of_cycles():
    """The cycles meet at mu = -1/4, where the squared radius is 1/2; the unstable one ends at mu = 0."""
    ds = followed(BAUTIN, "y", [1.0, 0.0], "mu", -0.4, 0.2, mu=0.1)
    (row,) = table_of(ds)
    assert row["type"] == "fold"
    assert row["mu"] == pytest.approx(-0.25, abs=1e-10)
    assert float(ds["bifurcation_section"][0, 0, 0]) ** 2 == pytest.approx(0.5, abs=1e-4)
    assert row["period_s"] == pytest.approx(np.pi, rel=1e-10)
    ends = str(ds["first_end"].attrs["flag_meanings"]).split()
    first, last = (ends[int(ds[name][0])] for name in ("first_end", "last_end"))
    assert {first, last} == {"equilibrium", "bound"}
    values = ds["parameter"].values[0]
    smallest = values[0] if first == "equilibrium" else values[~np.isnan(values)][-1]
    assert abs(smallest) < 1e-4  # the radius there is below 0.002
    # with s the squared radius: exp(int div) over a period of pi
    s = ds["section"].values[0, :, 0, 0] ** 2
    known = np.exp(2.0 * np.pi * s * (1.0 - 2.0 * s))
    own = ds["multiplier_real"].values[0, :, 0]
    good = np.isfinite(own)
    np.testing.assert_allclose(own[good], known[good], atol=1e-8)
    np.testing.assert_allclose(ds["period_s"].values[0][good], np.pi, rtol=1e-9)
    # The fold stays at mu = -1/4 whatever the angular velocity, which changes the period alone
    parameters = sectioned(flow(BAUTIN), Crossing("y", longest=50.0)).load()
    found = curves_from(ds, parameters, "omega", ((-0.4, 0.2), (1.5, 2.5)), 1)
    curves = curves_dataset(found, "mu", "omega", parameters.model)
    assert curves.sizes["curve"] == 1
    np.testing.assert_allclose(curves["first"].values, -0.25, atol=1e-8)
    assert float(curves["second"].max() - curves["second"].min()) > 0.9


def test_explore__torus():
    """The second oscillator's growth rate passes 0: the pair exp((mu +- 0.7 i) pi) leaves the circle."""
    ds = followed(PAIR, "y", [1.0, 0.0, 0.0, 0.0], "mu", -0.2, 0.2, mu=-0.1)
    (row,) = table_of(ds)
    assert row["type"] == "neimark_sacker"
    assert row["mu"] == pytest.approx(0.0, abs=1e-8)
    critical = complex(row["multiplier_real"], row["multiplier_imag"])
    assert critical == pytest.approx(np.exp(0.7j * np.pi), abs=1e-8)
    assert (row["unstable_below"], row["unstable_above"]) == ("0", "2")


HOMOCLINIC = table(
    "homoclinic",
    {"x": "-x + 2*y + x**2", "y": "(2 - alpha)*x - y - 3*x**2 + 1.5*x*y"},
    {"alpha": 0.05},
    states={"x": {"escape": 10.0}, "y": {"escape": 10.0}},
)
"""Sandstede (1997): at alpha = 0 an orbit leaves the saddle 0, whose eigenvalues are 1 and -3, and comes
back: y**2 = x**2 - x**3 is invariant."""


def test_explore__towards_a_homoclinic_orbit():
    """The period is -ln(alpha) over the smaller eigenvalue, 1, and a constant. The end names the saddle."""
    ds = followed(HOMOCLINIC, "x", [0.5, 0.345], "alpha", -0.1, 0.1, level=0.5, alpha=0.05)
    alpha, seconds = ds["parameter"].values[0], ds["period_s"].values[0]
    near = alpha < 1e-3
    assert alpha[near].min() < 1e-6
    assert ds["section"].values[0, np.nanargmin(alpha), 0, 1] ** 2 == pytest.approx(0.5**2 - 0.5**3, abs=1e-6)
    slope, _ = np.polyfit(-np.log(alpha[near]), seconds[near], 1)
    assert slope == pytest.approx(1.0, abs=0.01)
    (line,) = str(ds.attrs["stuck"]).splitlines()
    assert "the period grows faster and faster" in line
    own = np.linalg.eigvals([[-1.0, 2.0], [2.0, -1.0]])
    assert f"a saddle at x 0, y 0 with eigenvalues {own.max():.5g}, {own.min():.5g} [1/s]" in line
    assert line.endswith("this suggests a homoclinic bifurcation")
    assert f"  {line}" in branches_table(ds).lines


@pytest.mark.parametrize("ratio", [0.3, 0.6, 0.8])
@pytest.mark.parametrize(
    ("period", "grows"),
    [
        (lambda d: 5.0 - np.log(d), True),  # homoclinic
        (lambda d: d**-0.5, True),  # saddle-node on the cycle
        (lambda d: 5.0 - d**0.5, False),  # a touch
        (lambda d: 5.0 - d**0.25, False),
        (lambda d: 5.0 - d, False),
        (lambda d: 5.0 + np.log(d), False),
    ],
)
def test_grows_without_bound__by_the_law_of_the_period(period, grows, ratio):
    away = 0.1 * ratio ** np.arange(int(np.log(1e-7) / np.log(ratio)))
    unknowns = np.stack([1.0 + 0.3 * away, away], axis=1)
    assert grows_without_bound(unknowns, period(away)) == grows
    assert not grows_without_bound(unknowns[:2], period(away)[:2])


def shot(c, guess):
    """Limit cycle of the Rossler equations, a = b = 0.2, by shooting with another integrator; multipliers."""

    def rates(t, w, c=c):
        x, y, z = w[:3]
        jacobian = np.array([[0.0, -1.0, -1.0], [1.0, 0.2, 0.0], [z, 0.0, x - c]])
        return np.concatenate([[-y - z, x + 0.2 * y, 0.2 + z * (x - c)], (jacobian @ w[3:].reshape(3, 3)).ravel()])

    def end(y, z, time):
        start = np.concatenate([[0.0, y, z], np.eye(3).ravel()])
        return scipy_end(rates, start, time, 1e-11)

    y, z, time = fsolve(lambda u: end(*u)[:3] - [0.0, u[0], u[1]], guess, xtol=1e-11)
    return time, np.linalg.eigvals(end(y, z, time)[3:].reshape(3, 3))


def test_explore__roessler_doublings():
    ds = followed(ROSSLER, "x", [0.0, -4.35, 0.07], "c", 2.4, 4.0, max_period=4, c=2.5)
    rows = [row for row in table_of(ds) if row["type"] == "period_doubling"]
    assert [row["period"] for row in rows] == [1, 2]
    assert [row["criticality"] for row in rows] == ["supercritical"] * 2
    # to the digits that the literature gives for a = b = 0.2
    assert rows[0]["c"] == pytest.approx(2.832, abs=1e-3)
    assert rows[1]["c"] == pytest.approx(3.837, abs=1e-3)
    for k, row in zip(np.argsort(ds["value"].values), rows, strict=True):
        _, y, z = ds["bifurcation_section"].values[k, 0]
        time, multipliers = shot(row["c"], [y, z, row["period_s"]])
        assert time == pytest.approx(row["period_s"], rel=1e-8)
        # one along the flow, one at the doubling, one that has all but vanished
        assert np.abs(multipliers - 1.0).min() < 1e-5
        assert np.abs(multipliers + 1.0).min() < 1e-4
    assert [w["period"] for w in windows_of(ds)][:2] == [1, 2]
