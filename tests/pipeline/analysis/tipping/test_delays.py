"""Delays of trajectories behind a moving parameter: closed forms, angles, and what is refused."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from magpend_core.models.drift.ramps import LINEAR, Ramp
from pipeline.analysis.tipping.declaration import DELAY_COLUMNS, DelayOptions
from pipeline.analysis.tipping.delay import delay, delay_table, lags, left_at, moving_parameter, needs_sections
from pipeline.layout.columns import described
from pipeline.layout.vocabulary import model_attribute
from tests.core.flows import model_of

MODEL = model_of({"x": "mu*x"}, {"mu": {"value": 0.0, "unit": "1/s"}})
SLOW = 0.02
"""Rate of the moving parameter per section."""


def passing(begin: float, n: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Return mu = begin + SLOW t at the sections t = 1, 2, ..., and x of x' = mu x from 1e-3.

    x(t) = 1e-3 exp((mu^2 - begin^2)/(2 SLOW)) comes back to its start at mu = -begin: the delay is the way before.
    """
    mu = begin + SLOW * np.arange(1, n + 1)
    with np.errstate(over="ignore"):
        return mu, np.minimum(1e-3 * np.exp((mu**2 - begin**2) / (2.0 * SLOW)), 1e6)


def run_of(begins: list[float], ramps: tuple[str, ...] = ("mu",), n_keep: int = 400) -> SimpleNamespace:
    """Return as much of a run with a moving parameter as delays ask for: a cell for each begin of its ramp."""
    courses = [passing(begin, n_keep) for begin in begins]
    over = ("mu_from", "initial_condition")
    cube = xr.Dataset(
        {
            "status": (over, np.zeros((len(begins), 1), np.int8)),
            "section": ((*over, "period_index", "state"), np.stack([x for _, x in courses])[:, None, :, None]),
            "mu_at_section": (("mu_from", "period_index"), np.stack([mu for mu, _ in courses])),
        },
        coords={"mu_from": begins, "state": ["x"]},
        attrs={"model": model_attribute(MODEL)},
    )
    moving = tuple(Ramp(name, LINEAR, (("to", 1.0), ("rate_per_s", SLOW))) for name in ramps)
    spec = SimpleNamespace(ramps=moving, integration=SimpleNamespace(n_keep=n_keep))
    return SimpleNamespace(spec=spec, cube=lambda: cube)


def test_delay__is_the_way_before_the_bifurcation() -> None:
    """Entry and exit of a slow passage are symmetrical about mu = 0 (Neishtadt, 1987)."""
    begins = [-0.5, -1.0, -1.5]
    ds = delay(run_of(begins), DelayOptions(distance=5e-4, static=0.0))
    # steps of 1e-3 (exp(SLOW mu .../SLOW) - 1) pass 5e-4 where x is about its start again: two sections more or less
    np.testing.assert_allclose(ds["left"].values[:, 0], -np.array(begins), atol=3.0 * SLOW + 0.02)
    np.testing.assert_allclose(ds["delay"], ds["left"])
    assert described(ds, DELAY_COLUMNS, MODEL)["left"].attrs["units"] == "1/s"
    index = ds["left_index"].values[:, 0]
    for begin, i in zip(begins, index, strict=True):
        mu, x = passing(begin)
        assert abs(x[i] - x[i - 1]) > 5e-4
        assert (np.abs(np.diff(x[5:i])) <= 5e-4).all()
        assert mu[i] == ds["left"].sel(mu_from=begin).item()


def test_delay__counts_from_the_static_value() -> None:
    ds = delay(run_of([-1.0]), DelayOptions(distance=5e-4, static=0.25))
    assert ds["delay"].item() == pytest.approx(ds["left"].item() - 0.25)
    assert "delay" not in delay(run_of([-1.0]), DelayOptions(distance=5e-4))


def test_delay__a_cell_that_stays_has_none() -> None:
    ds = delay(run_of([-3.0], n_keep=100), DelayOptions(distance=5e-4))  # mu ends at -1
    assert np.isnan(ds["left"].item())
    assert ds["left_index"].item() == -1


def test_lags__turn_with_angles_and_count_in_scales() -> None:
    model = model_of({"th": "v", "v": "-sin(th)"}, states={"th": {"on_circle": True}, "v": {"scale": 4.0}})
    section = np.zeros((1, 3, 2))
    section[0, :, 0] = [np.pi - 0.05, -np.pi + 0.05, np.pi - 0.05]
    np.testing.assert_allclose(lags(section, 1, model)[0, 1:], 0.1)
    np.testing.assert_allclose(lags(section, 2, model)[0, 2:], 0.0, atol=1e-12)
    section[0, :, 0], section[0, :, 1] = 0.0, [0.0, 2.0, 4.0]
    np.testing.assert_allclose(lags(section, 1, model)[0, 1:], 0.5)
    assert np.isnan(lags(section, 2, model)[0, :2]).all()


@pytest.mark.parametrize(
    ("lag", "index"),
    [
        ([np.nan, 0.9, 0.0, 0.0, 0.9, 0.0], 4),  # comes to the orbit, and leaves it
        ([np.nan, 0.0, 0.5, 0.9], 3),  # 0.5 is the distance itself
        ([np.nan, 0.9, 0.9, 0.9], -1),  # never was on it
        ([np.nan, 0.0, 0.0, 0.0], -1),  # stays on it
        ([np.nan, np.nan, 0.1, np.nan, 0.6], 4),
    ],
)
def test_left_at__is_the_first_far_section_after_a_near_one(lag, index) -> None:
    assert left_at(np.array(lag), 0.5) == index


def test_moving_parameter__must_be_one_that_moves() -> None:
    one, two = (tuple(Ramp(name, LINEAR) for name in names) for names in (["q"], ["q", "r"]))
    assert moving_parameter(one, "") == "q"
    assert moving_parameter(two, "r") == "r"
    for ramps, wanted, words in (
        ((), "", "no parameter moves"),
        (one, "r", "r does not move in this run; moving: q"),
        (two, "", "choose with --moving=q or --moving=r"),
    ):
        with pytest.raises(ValueError, match=words):
            moving_parameter(ramps, wanted)


def test_needs_sections__of_the_time_in_which_the_parameter_moves() -> None:
    needs_sections(run_of([-1.0], n_keep=5), DelayOptions(period=2))
    with pytest.raises(ValueError, match=r"keep the sections of the ramp \(n_keep\)"):
        needs_sections(run_of([-1.0], n_keep=4), DelayOptions(period=2))
    still = run_of([-1.0])
    still.cube()["mu_at_section"][:] = 1.0
    with pytest.raises(ValueError, match="mu does not move over the kept sections"):
        needs_sections(still, DelayOptions())


def test_delay_table__summarises_the_cells_of_a_point() -> None:
    left = np.array([[0.5, 0.7, np.nan, 0.9], [np.nan] * 4])
    attrs = {"moving": "mu", "period": 2, "distance": 0.01, "static": 0.2}
    ds = xr.Dataset({"left": (("rate", "initial_condition"), left)}, {"rate": [1.0, 2.0]}, attrs)
    table = delay_table(ds)
    first, second = table.rows
    assert (first["n_cells"], first["n_left"], first["low"], first["median"], first["high"]) == (4, 3, 0.5, 0.7, 0.9)
    assert first["delay"] == pytest.approx(0.5)
    assert second["n_left"] == 0
    assert np.isnan(second["delay"])
    assert "2 periods apart first differ by more than 0.01" in table.lines[0]
