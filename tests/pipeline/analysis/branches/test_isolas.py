"""Detached branches: a linear oscillator with a nonlinear energy sink, against a harmonic balance of the tests' own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import fsolve

import magpend
from pipeline.analysis.branches.analysis import branches_table, cut_of, isolas_of
from pipeline.analysis.branches.exploring import Scope, explore
from pipeline.analysis.branches.kinds import KINDS, PITCHFORK
from pipeline.analysis.branches.searching import VERDICTS, places_of
from pipeline.layout.own_words import with_plain_names
from pipeline.layout.vocabulary import parameters_of
from pipeline.runs.derive import shown_table
from tests.pipeline.analysis.cubes import swept
from tests.pipeline.analysis.response.test_response import cycles_run

pytestmark = pytest.mark.usefixtures("long_steps_of_a_file")
OMEGA = 2.0 * np.pi
EPS, XI, LAM, K = 0.05, 0.4, 0.2, 4.0 / 3.0
"""Mass ratio, dampings and stiffness; the model and eps, lam and k are those of Starosvetsky and Gendelman, J. Sound
Vib. 315, 2008, 746."""
SEARCHED = {"isolas": 8, "generations": 0}
"""Options of the search, the same in all tests, so that its result is computed once."""


def sink(tmp_path_factory):
    model = magpend.model(
        "x'' = -eps*xi*x' - x - eps*c + eps*A*cos(2*pi*f*t)\ny'' = c\nc = lam*(x' - y') + k*(x - y)**3",
        name="sink", eps=EPS, xi=XI, lam=LAM, k=K, A=0.75,
    )  # fmt: skip
    out = tmp_path_factory.mktemp("sink") / "run"
    return swept(model, out, [(0.0, 0.0, 0.0, 0.0)], (400, 4), frequency_hz=(0.85 / OMEGA, 1.1 / OMEGA, 6))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run whose cells all start at rest, and so never end on the isola."""
    return sink(tmp_path_factory)


@pytest.fixture(scope="module")
def found(run):
    return with_plain_names(run.branches(**SEARCHED))


class Balance:
    """Harmonic balance of w = x - y, to which the linear oscillator is condensed, with given orders."""

    def __init__(self, orders):
        self.orders, self.n = np.asarray(orders), len(orders)
        self.phases = np.exp(1j * np.outer(np.arange(128) * OMEGA / 128, self.orders))

    def wave(self, packed):
        return (self.phases @ (packed[: self.n] + 1j * packed[self.n :])).real

    def residual(self, packed, omega, force):
        return self.equations(packed, K * self.wave(packed) ** 3, omega, force)

    def equations(self, packed, spring, omega, force):
        """The equations of motion with a given wave of the spring's force, in which they are linear; times the squared
        frequency, so that order 0 says that the spring's mean is 0."""
        c, w = packed[: self.n] + 1j * packed[self.n :], self.orders * omega
        speed = (self.phases @ (1j * w * c)).real
        coupling = 2.0 * (self.phases.conj().T @ (LAM * speed + spring)) / 128
        primary = 1.0 - w**2 + 1j * EPS * XI * w
        drive = np.where(self.orders == 1, EPS * force, 0.0)
        own = w**2 * c - w**2 * drive / primary - coupling * (1.0 - EPS * w**2 / primary)
        imaginary = np.where(self.orders == 0, packed[self.n :], own.imag)  # a mean is real
        return np.concatenate([own.real, imaginary])

    def orbits(self, omega, force, starts=60):
        """Different solutions, as waves, from random starts."""
        generator, known = np.random.default_rng(0), []
        decay = np.tile(2.0 / (1.0 + self.orders) ** 2, 2)
        for _ in range(starts):
            start = decay * generator.normal(size=2 * self.n)
            packed, about, flag, _ = fsolve(self.residual, start, (omega, force), xtol=1e-12, full_output=True)
            wave = self.wave(packed)
            if flag == 1 and abs(about["fvec"]).max() < 1e-9 and all(abs(wave - w).max() > 1e-5 for w in known):
                known.append(wave)
        return known

    def fold(self, omega, force):
        """Angular frequency, close to a given one, at which two solutions meet."""
        size = 2 * self.n

        def bordered(z):
            packed, kernel, omega = z[:size], z[size:-1], z[-1]
            spring = 3.0 * K * self.wave(packed) ** 2 * self.wave(kernel)
            slope = self.equations(kernel, spring, omega, 0.0)
            return np.concatenate([self.residual(packed, omega, force), slope, [kernel @ kernel - 1.0]])

        waves = self.orbits(omega[1], force)  # just inside, where the two are close
        pairs = [(abs(a - b).max(), a, b) for i, a in enumerate(waves) for b in waves[:i]]
        _, a, b = min(pairs, key=lambda pair: pair[0])
        both = [2.0 * (self.phases.conj().T @ w) / 128 for w in (a, b)]
        first, second = (np.concatenate([c.real, c.imag]) for c in both)
        kernel = (first - second) / np.linalg.norm(first - second)
        start = np.concatenate([0.5 * (first + second), kernel, [omega[0]]])
        z, _, flag, message = fsolve(bordered, start, xtol=1e-12, full_output=True)
        assert flag == 1, message
        return float(z[-1])


@pytest.mark.slow
def test_orbits__are_as_many_as_those_of_harmonic_balance(run, found):
    balance = Balance(np.arange(8))
    assert found.sizes["searched"] == 8
    for k in range(8):
        expected = balance.orbits(OMEGA * float(found["searched_value"][k]), 0.75)
        assert int(found["n_orbits"][k, 0]) == len(expected)
    assert (found["index_sum"] == 1).all()
    assert (found["index_verdict"] == VERDICTS.index("agrees")).all()
    assert 3 in found["n_orbits"]
    # cells at rest do not lead there: without a search there is no isola
    assert isolas_of(run.branches(generations=0)) == []
    assert len(isolas_of(found)) == 1


@pytest.mark.slow
def test_isola__ends_at_folds_of_harmonic_balance(found):
    (isola,) = isolas_of(found)
    own = np.flatnonzero(found["of_branch"].values == isola)
    ends = sorted(OMEGA * float(found["value"][k]) for k in own)
    assert len(ends) == 2
    balance = Balance(np.arange(1, 14, 2))
    for end, inside in zip(ends, (1e-3, -1e-3), strict=True):
        assert balance.fold((end, end + inside), 0.75) == pytest.approx(end, rel=1e-9)
    line = OMEGA * found["parameter"].values[isola, : int(found["n_points"][isola])]
    assert ends[0] - 1e-4 < line.min() < line.max() < ends[1] + 1e-4
    assert any("isolas" in text for text in branches_table(found).lines)
    # a closed curve that springs from another branch, or that a pitchfork connects to one, is no isola
    assert isolas_of(found.assign(origin=found["origin"] * 0)) == []
    kinds = np.where(found["of_branch"] == isola, KINDS.index(PITCHFORK), found["kind"])
    assert isolas_of(found.assign(kind=("bifurcation", kinds))) == []


@pytest.mark.slow
def test_cut_isola__is_detached_within_the_interval(run, found):
    """Up to 0.15 Hz the isola leaves the interval twice; the main curve passes from bound to bound."""
    part = with_plain_names(run.branches(high=0.15, isolas=4, generations=0))
    assert isolas_of(part) == []
    (cut,) = cut_of(part)
    line = part["parameter"].values[cut, : int(part["n_points"][cut])]
    assert line.max() == pytest.approx(0.15, rel=1e-12)
    assert line.min() == pytest.approx(float(found["parameter"].values[isolas_of(found)[0]].min()), abs=1e-5)
    assert any("widen" in text for text in branches_table(part).lines)
    assert cut_of(found) == []


@pytest.mark.slow
def test_fold_curve__holds_the_isola_from_its_birth_on(run):
    """The curve of its folds in the plane of frequency and force has its least force where the isola is born."""
    run.branches(**SEARCHED)
    plane = {"second": "A", "second_low": 0.55, "second_high": 0.8}
    curves = run.curves(**plane)
    balance = Balance(np.arange(8))
    nearest = min(range(curves.sizes["curve"]), key=lambda i: float(np.nanmin(curves["frequency"][i])))
    f, force = (curves[name].values[nearest] for name in ("frequency", "A"))
    birth = int(np.nanargmin(force))
    assert 0 < birth < int(curves["n_points"][nearest]) - 1
    at = OMEGA * float(f[birth])
    # one orbit below, three above
    assert len(balance.orbits(at, 0.995 * float(force[birth]))) == 1
    assert len(balance.orbits(at, 1.005 * float(force[birth]), 200)) == 3


@pytest.mark.slow
def test_deflation__needs_fewer_starts(run):
    """Sixteen starts find all three orbits at each value, and do not without deflation."""
    cube = run.cube()
    base, ends = parameters_of(cube), (0.1440, 0.1520)
    whole = places_of(cube, base, "frequency", ends, 4)
    for place in whole:
        place.search(np.array([1]), (16,))
    assert [len(place.found) for place in whole] == [3, 3, 3, 3]
    # branches that pass a value bring the same orbits
    scope = Scope(*ends, max_period=1, max_generations=0)
    branches = explore([start for place in whole[:2] for start in place.starts()], scope)
    fresh = places_of(cube, base, "frequency", ends, 4)[3]
    fresh.add_branches(branches, 1)
    own, other = (sorted(tuple(one.points[0]) for one in place.found) for place in (fresh, whole[3]))
    np.testing.assert_allclose(own, other, atol=1e-8)
    # a sum that differs proves that an orbit is missing; the two orbits of an isola have opposite indices
    place = whole[0]
    saddle = next(one for one in place.found if one.index() == -1)
    place.found.remove(saddle)
    assert place.verdicts(np.array([1])) == ["missing"]
    assert replace(place, hindrance="diverged").verdicts(np.array([1])) == ["diverged"]


@pytest.mark.slow
def test_response__names_the_isola(run):
    run.branches(**SEARCHED)
    response = run.response()
    table = shown_table("response", response)
    assert [line for line in table.lines if line.endswith("isola")]
    assert {row["isola"] for row in table.rows} == {False, True}
    upper, _ = run.plot.response()
    assert [text.get_text() for text in upper.texts].count("isola") == 1


@pytest.mark.slow
def test_index_sums__per_row_of_a_run(tmp_path):
    """A hardening spring agrees; a softening one, from which cells escape, decides nothing."""
    model = magpend.model("x'' = -0.1*x' - x - b*x**3 + 0.3*cos(2*pi*f*t)", name="spring", b=1.0)
    axes = {"b": [-0.3, 1.0], "frequency_hz": (1.05 / OMEGA, 2.0 / OMEGA, 4)}
    run = swept(model, tmp_path / "run", {"x": (-3, 3), "x_dot": (-3, 3)}, (300, 4), **axes)
    ds = run.branches(parameter="frequency_hz", max_period=1, isolas=2)
    words = [VERDICTS[code] for code in ds["index_verdict"].values[:, 0]]
    assert ds["searched_b"].values.tolist() == [-0.3, -0.3, 1.0, 1.0]
    assert words == ["diverged", "diverged", "agrees", "agrees"]
    lines = "\n".join(shown_table("branches", ds).lines)
    assert "as if none is missing" in lines
    assert "says nothing: cells diverged" in lines


@pytest.mark.slow
def test_flow__cycles_but_no_equilibria(tmp_path):
    """r' = r (mu + r^2 - r^4): two cycles from mu = -1/4 to 0, one beyond; the equilibrium lies on the section too."""
    ds = cycles_run(tmp_path).branches(max_period=1, isolas=3)
    assert ds["n_orbits"].values[:, 0].tolist() == [2, 2, 1]
    assert {VERDICTS[code] for code in ds["index_verdict"].values.ravel()} == {"flow"}
    assert sorted(ds["orbit_period"].values.tolist()) == [0, 1]


@pytest.mark.slow
def test_index_sums__on_a_circle(tmp_path):
    """A pendulum hangs or stands: two orbits, whose indices add up to the Euler characteristic of a cylinder, 0."""
    states = {"th": {"unit": "rad", "on_circle": True}}
    model = magpend.model("th'' = -0.5*th' - sin(th) + 0.1*cos(2*pi*f*t)", name="pendulum", states=states)
    run = swept(model, tmp_path / "run", [(0.1, 0.0)], (100, 4), frequency_hz=(0.3, 0.5, 3))
    ds = run.branches(max_period=1, isolas=2)
    assert ds["n_orbits"].values[:, 0].tolist() == [2, 2]
    assert ds["index_sum"].values[:, 0].tolist() == [0, 0]
    assert (ds["index_verdict"] == VERDICTS.index("agrees")).all()
