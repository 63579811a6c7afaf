"""Branches of limit cycles of flows, against what is known of them and an independent shooting method."""

from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve

from magpend_core.crossing import Crossing
from magpend_core.models.model import by_method
from magpend_core.models.sectioned import sectioned
from pipeline.analysis.branches.analysis import branches_table, table_of, windows_of
from pipeline.analysis.branches.arclength import Settings
from pipeline.analysis.branches.curves import curves_dataset, curves_from
from pipeline.analysis.branches.dataset import dataset_of
from pipeline.analysis.branches.exploring import Scope, explore
from pipeline.analysis.branches.figure import plot_branches
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.limits import LimitSettings, fit_law, grows_without_bound, logarithm, root
from pipeline.analysis.branches.starting_orbits import family_of
from tests.core.cells import scipy_end
from tests.core.flows import BAUTIN, HOPF, LORENZ, PAIR, ROSSLER, flow, table

pytestmark = pytest.mark.slow


def followed(
    equations,
    of,
    state,
    parameter,
    low,
    high,
    *,
    max_period=1,
    level=0.0,
    longest=50.0,
    step=0.02,
    method="dopri5",
    **values,
):
    """Branches from a limit cycle near a state, in steps that are as long as the bounds of the test allow."""
    parameters = sectioned(by_method(flow(equations), method), Crossing(of, level, longest=longest)).load(**values)
    model = parameters.model
    family = family_of(model.system, 1, model.crossing.frequency_hz, parameters.pack(), parameter, high - low)
    start = Start(family, np.array(state, float), parameters[parameter])
    scope = Scope(low, high, max_period, 2, settings=Settings(longest_step=step))
    return dataset_of(explore([start], scope), parameter, parameters)


def test_explore__fold_of_cycles():
    """The cycles meet at mu = -1/4, where the squared radius is 1/2; the unstable one ends at mu = 0."""
    ds = followed(BAUTIN, "y", [1.0, 0.0], "mu", -0.4, 0.2, mu=0.1)
    (row,) = table_of(ds)
    assert row["type"] == "fold"
    assert row["mu"] == pytest.approx(-0.25, abs=1e-10)
    assert float(ds["bifurcation_section"][0, 0, 0]) ** 2 == pytest.approx(0.5, abs=1e-4)
    assert row["period_s"] == pytest.approx(np.pi, rel=1e-10)
    # the radius has the rate (3 r - 10 r^3) u^2 beside it, over a period of pi, whatever the section
    assert row["normal_form"] == pytest.approx(np.sqrt(2.0) * np.pi, rel=1e-7)
    (other,) = table_of(followed(BAUTIN, "y", [0.9, 0.4], "mu", -0.4, 0.2, mu=0.1, level=0.4))
    assert other["normal_form"] == pytest.approx(np.sqrt(2.0) * np.pi, rel=1e-7)
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
    # of the radius r' = -r^3, with r^2 = 2 |z|^2, over a period of pi
    assert row["normal_form"] == pytest.approx(-2.0 * np.pi, rel=1e-7)


def test_explore__folds_and_doublings_on_slanted_and_curved_sections():
    """What is known of the branches is as on a level of a state; the section moves with the parameter."""
    (fold,) = table_of(followed(BAUTIN, "y - 0.4*x**2 + mu", [1.0, 0.3], "mu", -0.4, 0.2, mu=0.1))
    assert fold["type"] == "fold"
    assert fold["mu"] == pytest.approx(-0.25, abs=1e-10)
    assert fold["period_s"] == pytest.approx(np.pi, rel=1e-10)
    assert fold["normal_form"] == pytest.approx(np.sqrt(2.0) * np.pi, rel=1e-6)
    found = []
    for of, state in (("x", [0.0, -4.34, 0.058]), ("x + 0.5*y", [2.0, -4.0, 0.1])):
        ds = followed(ROSSLER, of, state, "c", 2.4, 4.0, max_period=2, step=0.1, c=2.5)
        found.append([(row["type"], row["c"], row["normal_form"]) for row in table_of(ds)])
    assert [kind for kind, *_ in found[0]] == ["period_doubling", "period_doubling"]
    for (kind, c, form), (other, c_other, form_other) in zip(*found, strict=True):
        assert (kind, c) == (other, pytest.approx(c_other, abs=1e-8))  # located to 3e-9
        assert form == pytest.approx(form_other, rel=1e-5)


def test_explore__cycles_from_a_hopf_point_on_a_slanted_section():
    """Small cycles are followed on the section through the equilibrium, with the squared radius mu."""
    ds = followed(HOPF, "x + y", [0.4, -0.4], "mu", -0.2, 0.5, level=0.0, mu=0.32)
    values = ds["parameter"].values[0]
    radius = (ds["section"].values[0, :, 0] ** 2).sum(axis=1)
    good = np.isfinite(values)
    np.testing.assert_allclose(radius[good], values[good], atol=1e-9)
    assert values[good].min() < 1e-3


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
    ds = followed(HOMOCLINIC, "x", [0.5, 0.345], "alpha", -0.1, 0.1, level=0.5, step=0.005, alpha=0.05)
    alpha, seconds = ds["parameter"].values[0], ds["period_s"].values[0]
    near = alpha < 1e-3
    assert alpha[near].min() < 1e-6
    assert ds["section"].values[0, np.nanargmin(alpha), 0, 1] ** 2 == pytest.approx(0.5**2 - 0.5**3, abs=1e-6)
    slope, _ = np.polyfit(-np.log(alpha[near]), seconds[near], 1)
    assert slope == pytest.approx(1.0, abs=0.01)
    (row,) = table_of(ds)
    assert (row["label"], row["type"], row["unstable_above"], row["unstable_below"]) == (
        "HOM",
        "homoclinic",
        "0",
        "none",
    )
    assert abs(row["alpha"]) < 2.0 * row["bracket"] < 1e-8
    assert row["saddle_quantity"] == pytest.approx(1.0 - 3.0, abs=1e-8)
    assert np.nanmax(ds["limit_slope"].values) == pytest.approx(1.0, abs=0.005)
    lines = branches_table(ds).lines
    assert any("homoclinic to the saddle at x 0, y 0; alpha_h = 0.0000" in line for line in lines)
    assert any("saddle quantity -2 1/s: a stable cycle ends there" in line for line in lines)
    assert windows_of(ds)[0]["begins"] == "homoclinic"
    names = {text.get_text() for text in plot_branches(ds).axes[0].texts}
    assert "HOM" in names
    assert "branch 0 at" not in str(ds.attrs["left_out"])


def ends_of(ds):
    """Names of the two ends of the first branch."""
    names = str(ds["first_end"].attrs["flag_meanings"]).split()
    return [names[int(ds[end][0])] for end in ("first_end", "last_end")]


def test_explore__towards_a_saddle_on_the_section():
    """On y = 0 the cycles of the same branch slow down beside the saddle, though they stay as large as the loop."""
    ds = followed(HOMOCLINIC, "y", [0.15, 0.0], "alpha", -0.1, 0.1, level=0.0, alpha=0.05)
    assert ends_of(ds) == ["homoclinic", "bound"]
    assert np.nanmin(ds["section"].values[0, :, 0, 0]) < 1e-5
    (row,) = table_of(ds)
    assert abs(row["alpha"]) < 2.0 * row["bracket"] < 1e-8
    assert row["saddle_quantity"] == pytest.approx(-2.0, abs=1e-8)


@pytest.mark.parametrize(("level", "end"), [(0.05, "tangent"), (0.02, "tangent"), (0.0, "equilibrium")])
def test_explore__a_touch_is_no_equilibrium(level, end):
    """Cycles with the squared radius mu touch the section where the radius is its distance from the equilibrium."""
    ds = followed(HOPF, "y", [np.sqrt(0.25 - level**2), level], "mu", -0.2, 0.5, level=level)
    assert ends_of(ds) == [end, "bound"]
    assert np.nanmin(ds["parameter"].values[0]) == pytest.approx(level**2, abs=1e-5)


MORRIS_LECAR = table(
    "morris_lecar",
    {"v": "y - 0.5*(v + 0.5) - 2*w*(v + 0.7) - m*(v - 1)", "w": "1.15*(winf - w)*tau"},
    {"y": 0.075},
    define={
        "m": "(1 + tanh((v + 0.01)/0.15))/2",
        "winf": "(1 + tanh((v - 0.1)/0.145))/2",
        "tau": "cosh((v - 0.1)/0.29)",
    },
)


def split(y):
    """Distance on v = 0.0365 between the saddle's unstable and stable manifold, by another integrator."""

    def rates(_, state):
        v, w = state
        m, inf = (0.5 * (1.0 + np.tanh(x)) for x in ((v + 0.01) / 0.15, (v - 0.1) / 0.145))
        drift = y - 0.5 * (v + 0.5) - 2.0 * w * (v + 0.7) - m * (v - 1.0)
        return np.array([drift, 1.15 * (inf - w) * np.cosh((v - 0.1) / 0.29)])

    saddle = fsolve(lambda u: rates(0.0, u), [-0.185, 0.019], xtol=1e-13)
    jacobian = np.array([rates(0.0, saddle + h) - rates(0.0, saddle - h) for h in 1e-6 * np.eye(2)]).T / 2e-6
    values, vectors = np.linalg.eig(jacobian)
    ends = []
    for sign in (1.0, -1.0):
        own = vectors[:, np.argmax(sign * values)]

        def level(_, state):
            return state[0] - 0.0365

        # forwards the flow crosses the level downwards where both manifolds do
        level.direction, level.terminal = -sign, True
        start = saddle + 1e-6 * own * np.sign(own[0 if sign > 0.0 else 1])
        flow_of = partial(lambda s, t, u: s * rates(t, u), sign)
        found = solve_ivp(flow_of, (0.0, 200.0), start, "DOP853", events=level, rtol=1e-11, atol=1e-13)
        ends.append(found.y_events[0][0, 1])
    return ends[0] - ends[1]


def test_explore__morris_lecar():
    """The stable cycle ends at the saddle where the saddle's manifolds meet."""
    ds = followed(MORRIS_LECAR, "v", [0.0365, 0.1], "y", 0.06, 0.09, level=0.0365, y=0.075)
    (row,) = [row for row in table_of(ds) if row["type"] == "homoclinic"]
    known = brentq(split, 0.0725, 0.0735, xtol=1e-11)
    assert row["y"] == pytest.approx(known, abs=1e-9)
    assert row["bracket"] < 1e-9
    assert row["saddle_quantity"] < 0.0


def lorenz_loop(low, high):
    """Bracket rho at which the origin's unstable manifold comes back to it: beyond, its first turn crosses x = 0."""

    def crossing(_, state):
        return state[0]

    crossing.terminal = True
    for _ in range(30):
        rho = 0.5 * (low + high)
        own = 0.5 * (-11.0 + np.sqrt(121.0 + 40.0 * (rho - 1.0)))
        start = 1e-7 * np.array([1.0, 1.0 + own / 10.0, 0.0])

        def rates(_, u, rho=rho):
            return [10.0 * (u[1] - u[0]), u[0] * (rho - u[2]) - u[1], u[0] * u[1] - 8.0 / 3.0 * u[2]]

        found = solve_ivp(rates, (0.0, 15.0), start, "DOP853", events=crossing, rtol=1e-11, atol=1e-13)
        low, high = (low, rho) if len(found.t_events[0]) else (rho, high)
    return 0.5 * (low + high)


def test_explore__unstable_cycle_of_lorenz():
    """The cycles end at the origin, at rho = 13.926 (Sparrow 1982). They are unstable, so that the period grows as
    -ln(d) over the smaller eigenvalue, 8/3, which is the stable one.
    """
    ds = followed(LORENZ, "z", [8.91109, 13.3063, 10.0], "rho", 13.0, 16.5, level=10.0, step=0.01, rho=15.9959022)
    (row,) = [row for row in table_of(ds) if row["type"] == "homoclinic"]
    known = lorenz_loop(13.5, 14.5)
    assert known == pytest.approx(13.926, abs=1e-3)
    assert abs(row["rho"] - known) < row["bracket"] < 2e-5
    # the multiplier exceeds 1e4: steps do not crawl, as they do where the slope by the parameter is wrong
    assert int(ds["parameter"].notnull().sum()) < 300
    assert row["saddle_quantity"] == pytest.approx(
        0.5 * (-11.0 + np.sqrt(121.0 + 40.0 * (known - 1.0))) - 8.0 / 3.0, abs=1e-3
    )
    assert (row["unstable_above"], row["unstable_below"]) == ("1", "none")
    assert np.nanmax(ds["limit_slope_expected"].values) == pytest.approx(3.0 / 8.0)
    assert any("saddle quantity 4.4" in line and "an unstable cycle" in line for line in branches_table(ds).lines)


CANARD = table("canard", {"x": "(y - x**3/3 + x)/eps", "y": "a - x"}, {"a": 0.95, "eps": 0.02})
"""Van der Pol's oscillator with a constant force: relaxation cycles for a < a_c, rest for a > 1 (Hopf point at 1)."""


@pytest.mark.parametrize("method", ["dopri5", "rodas5p"])
def test_explore__through_a_canard_explosion(method):
    """The cycles shrink at a_c = 1 - eps/8 - 3 eps^2/32 - 173 eps^3/1024 (Zvonkin and Shubin 1984) within exp(-1/eps),
    and their section point stands still while the period grows.
    """
    ds = followed(CANARD, "x", [1.0, 0.8956], "a", 0.9, 1.01, level=1.0, longest=20.0, method=method, a=0.95)
    ends = str(ds["first_end"].attrs["flag_meanings"]).split()
    assert [ends[int(ds[name][0])] for name in ("first_end", "last_end")] == ["bound", "equilibrium"]
    assert int(ds["n_points"][0]) < 600
    assert not table_of(ds)
    a, seconds = (ds[name].values[0, : int(ds["n_points"][0])] for name in ("parameter", "period_s"))
    eps, longest = 0.02, int(np.argmax(seconds))
    known = 1.0 - eps / 8.0 - 3.0 * eps**2 / 32.0 - 173.0 * eps**3 / 1024.0
    assert a[longest] == pytest.approx(known, abs=eps**4)
    assert np.ptp(a[np.abs(np.arange(len(a)) - longest) < 10]) < 1e-10
    assert seconds[longest] > 4.8
    # a cycle of the branch beside Hopf's point, by scipy
    near = longest + int(np.argmin(np.abs(a[longest:] - 0.9995)))

    def rates(_, u):
        return [(u[1] - u[0] ** 3 / 3.0 + u[0]) / eps, a[near] - u[0]]

    state = ds["section"].values[0, near, 0]
    assert solve_ivp(rates, (0.0, seconds[near]), state, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1] == pytest.approx(
        state, abs=1e-8
    )


HODGKIN_HUXLEY = table(
    "hodgkin-huxley",
    {
        "v": "I - 120*m**3*h*(v - 115) - 36*n**4*(v + 12) - 0.3*(v - 10.599)",
        "m": "0.1*(25 - v)/(exp((25 - v)/10) - 1)*(1 - m) - 4*exp(-v/18)*m",
        "h": "0.07*exp(-v/20)*(1 - h) - h/(exp((30 - v)/10) + 1)",
        "n": "0.01*(10 - v)/(exp((10 - v)/10) - 1)*(1 - n) - 0.125*exp(-v/80)*n",
    },
    {"I": 7.0},
)


def test_explore__cycles_whose_peak_is_a_removable_singularity():
    """The unstable cycles of Hodgkin and Huxley's model turn at I = 7.8465 and 7.9220, between two doublings
    (Guckenheimer and Oliva, SIAM J. Appl. Dyn. Syst. 1, 2002, 105); before, at 8.2337, their peak passes v = 10, where
    a rate is 0/0. Towards the second turn a multiplier passes -4e4, so that rounding decides what a whole period gives.
    Collocation (`tests/test_gallery.py`) gives the folds 7.84654712019 and 7.92198549435, the doublings 7.84953739785
    and 7.92197767573.
    """
    state, current = [3.5, 0.07794908, 0.4168789, 0.39370776], 9.278217390498842
    ds = followed(HODGKIN_HUXLEY, "v", state, "I", 7.84, 9.4, level=3.5, longest=100.0, I=current)
    assert "stuck" not in ds.attrs["left_out"]
    found = [(row["type"], row["I"]) for row in table_of(ds)]
    known = {"fold": [7.84654712, 7.92198549], "period_doubling": [7.84953740, 7.92197768]}
    for kind, values in known.items():
        assert [x for what, x in found if what == kind] == pytest.approx(values, abs=2e-8), kind
    # the product of the matrices holds no digit of the small multipliers there
    assert ds["multiplier_real"].max() > 2e7


def test_explore__doubled_branch_of_steep_cycles():
    """One branch of period 2 joins both doublings of these cycles, though a multiplier is 9e6 where it begins. Along it
    the cycles double four times, and turn beside two of these points. At the first one scipy finds a multiplier -1.
    """
    state, current = [3.5, 0.07794908, 0.4168789, 0.39370776], 9.278217390498842
    ds = followed(
        HODGKIN_HUXLEY, "v", state, "I", 7.84, 9.4, max_period=2, level=3.5, longest=100.0, step=0.005, I=current
    )
    assert ds["orbit_period"].values.tolist() == [1, 2]
    rows = table_of(ds)
    found = {
        (kind, period): [row["I"] for row in rows if (row["type"], row["period"]) == (kind, period)]
        for kind, period in {(row["type"], row["period"]) for row in rows}
    }
    known = {
        ("fold", 1): [7.84654712, 7.92198549],
        ("period_doubling", 1): [7.84953740, 7.92197768],
        ("period_doubling", 2): [7.85068143, 7.85992281, 7.91100388, 7.92197365],
        ("fold", 2): [7.85992281, 7.91100414],
    }
    assert found == {key: pytest.approx(values, abs=2e-8) for key, values in known.items()}
    doublings = [row for row in rows if row["type"] == "period_doubling"]
    assert [row["to_branch"] for row in doublings if row["period"] == 1] == [1, 1]
    assert "period 2" not in ds.attrs["left_out"]
    (k,) = np.flatnonzero(np.abs(ds["value"].values - 7.85068143) < 1e-6)
    value, seconds = float(ds["value"][k]), float(ds["bifurcation_period_s"][k])

    def rates(_, u):
        v, m, h, n = u.reshape(4, -1)
        return np.concatenate(
            [
                value - 120 * m**3 * h * (v - 115) - 36 * n**4 * (v + 12) - 0.3 * (v - 10.599),
                0.1 * (25 - v) / np.expm1((25 - v) / 10) * (1 - m) - 4 * np.exp(-v / 18) * m,
                0.07 * np.exp(-v / 20) * (1 - h) - h / (np.exp((30 - v) / 10) + 1),
                0.01 * (10 - v) / np.expm1((10 - v) / 10) * (1 - n) - 0.125 * np.exp(-v / 80) * n,
            ]
        )

    start = state = ds["bifurcation_section"].values[k, 0]
    sizes, monodromy = 1e-5 * np.array([100.0, 1.0, 1.0, 1.0]), np.eye(4)
    for _ in range(40):
        beside = state[:, None] + np.hstack([np.zeros((4, 1)), np.diag(sizes), -np.diag(sizes)])
        ends = solve_ivp(rates, (0.0, seconds / 40), beside.ravel(), "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        state, *others = ends.reshape(4, -1).T
        monodromy = (np.subtract(others[:4], others[4:]).T / (2.0 * sizes)) @ monodromy
    assert state == pytest.approx(start, abs=1e-6)
    multipliers = np.linalg.eigvals(monodromy)
    assert np.abs(multipliers + 1.0).min() < 1e-3
    assert np.abs(multipliers - 1.0).min() < 1e-3
    assert np.abs(multipliers).max() == pytest.approx(1.9595e3, rel=1e-3)


def test_explore__cycles_that_come_to_touch_the_section():
    """Towards Hopf's point the same cycles shrink about z = rho - 1, until their lowest point is on z = 10."""
    ds = followed(LORENZ, "z", [8.91109, 13.3063, 10.0], "rho", 15.9, 24.0, level=10.0, rho=15.9959022)
    ends = str(ds["first_end"].attrs["flag_meanings"]).split()
    assert "tangent" in {ends[int(ds[name][0])] for name in ("first_end", "last_end")}
    assert int(ds["parameter"].notnull().sum()) < 2000
    last = int(np.nanargmax(ds["parameter"].values[0]))
    rho, state = float(ds["parameter"][0, last]), ds["section"].values[0, last, 0]

    def rates(_, u):
        return [10.0 * (u[1] - u[0]), u[0] * (rho - u[2]) - u[1], u[0] * u[1] - 8.0 / 3.0 * u[2]]

    found = solve_ivp(rates, (0.0, float(ds["period_s"][0, last])), state, "DOP853", rtol=1e-11, max_step=1e-3)
    assert found.y[:, -1] == pytest.approx(state, abs=1e-6)
    assert found.y[2].min() == pytest.approx(10.0, abs=1e-4)


CIRCLE = table(
    "circle",
    {"x": "x*(1 - s) - y*rate", "y": "y*(1 - s) + x*rate"},
    {"omega": 1.3},
    define={"s": "x**2 + y**2", "rate": "omega - y/sqrt(s)"},
)
"""The angle on the circle has the rate omega - sin: the period is 2 pi/sqrt(omega**2 - 1)."""


def test_explore__saddle_node_on_a_circle():
    ds = followed(CIRCLE, "y", [1.0, 0.0], "omega", 0.5, 1.5, omega=1.3)
    (row,) = table_of(ds)
    assert (row["label"], row["type"]) == ("SNIC", "snic")
    assert row["omega"] == pytest.approx(1.0, abs=1e-10)
    (end,) = np.flatnonzero(ds["limit_value"].notnull().values[0])
    np.testing.assert_allclose(ds["limit_state"].values[0, end], [[0.0, 1.0]], atol=1e-8)
    np.testing.assert_allclose(ds["limit_eigenvalue_real"].values[0, end], [0.0, -2.0], atol=1e-6)
    assert ds["limit_slope_expected"].values[0, end] == pytest.approx(np.sqrt(2.0) * np.pi, rel=1e-6)
    assert ds["limit_slope"].values[0, end] == pytest.approx(np.sqrt(2.0) * np.pi, rel=0.01)
    assert any("saddle node on an invariant circle, at x 0, y 1" in line for line in branches_table(ds).lines)


def test_explore__period_without_bound_by_another_law():
    """The period 2 pi/omega grows without bound, but at omega = 0 the cycle is a circle of equilibria."""
    ds = followed(HOPF, "y", [0.5, 0.0], "omega", -1.0, 2.0, longest=2000.0, omega=1.0)
    assert not table_of(ds)
    (line,) = [line for line in str(ds.attrs["left_out"]).splitlines() if line.startswith("branch 0 at")]
    assert "the period grows faster and faster" in line
    assert "not decided: " in line


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


@pytest.mark.parametrize(
    ("period", "follows_logarithm", "follows_root"),
    [
        (lambda d: 5.0 - 2.0 * np.log(d), True, False),
        (lambda d: 5.0 + 2.0 / np.sqrt(d), False, True),
        (lambda d: 5.0 + 2.0 / d, False, False),
    ],
)
def test_fit_law__tells_the_laws_apart(period, follows_logarithm, follows_root):
    away = 0.1 * 0.6 ** np.arange(25)
    seconds = period(away)
    for law, follows, reach in (
        (logarithm, follows_logarithm, seconds[-1] - 2.0 * np.array([3.0, 4.5])),
        (root, follows_root, seconds[-1] * np.exp([-1.5, -2.25])),
    ):
        value, error, slope, _, rest = fit_law(law, 0.7 + away, seconds, reach)
        assert (rest < LimitSettings.fits) == follows
        if follows:
            assert value == pytest.approx(0.7, abs=1e-9)
            assert error < 1e-9
            assert fit_law(law, 0.7 + away, seconds, reach, LimitSettings(least_range=20.0)) is None
            assert slope == pytest.approx(2.0, rel=1e-6)


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
    # the first one is the same on another section
    (row,) = table_of(followed(ROSSLER, "x", [1.0, -4.35, 0.07], "c", 2.6, 3.0, c=2.7, level=1.0))
    assert row["normal_form"] == pytest.approx(rows[0]["normal_form"], rel=1e-7)
