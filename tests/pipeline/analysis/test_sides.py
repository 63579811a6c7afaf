"""The rule that tells sides from sections."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from pipeline.analysis.sides import Side, magnet_offset, side

STATES = ["psi1", "psi2", "psi1_dot", "psi2_dot"]

# Period-1 orbits of the preset, one section point each: frequency [Hz], side, state. The points were
# recomputed independently, by Newton's method on the stroboscopic map; the sides from the sign of the
# magnet's offset along an integrated period, which does not change on any of them.
ORBITS = [
    (2.2, Side.RIGHT, [0.014211184099229534, 0.1993226675017865, -2.748811274764373, 3.655123886349151]),
    (2.2, Side.LEFT, [-0.05565563078119063, -0.11675805156872061, -2.761171266407133, 3.6486697000820953]),
    (3.0, Side.LEFT, [-0.04674814347333117, -0.15086685843182748, -1.6778288632028906, 2.0684693921696917]),
]


def cells(sections, *, frequency=2.2, status=1, turns=None):
    """Cube of independent cells; `sections` is (cell, period_index, state) or lacks the rates."""
    section = np.zeros((len(sections), len(sections[0]), 4))
    given = np.asarray(sections, dtype=float)
    section[..., : given.shape[-1]] = given
    n = len(section)
    ds = xr.Dataset(
        {
            "section": (("initial_condition", "period_index", "state"), section),
            "status": ("initial_condition", np.broadcast_to(np.int8(status), n).copy()),
        },
        coords={"state": STATES, "frequency": frequency},
    )
    if turns is not None:
        ds["turns"] = (("initial_condition", "link"), np.asarray(turns, dtype=np.int32))
    return ds


@pytest.mark.parametrize(("frequency", "expected", "state"), ORBITS)
def test_side__reference_orbits(frequency, expected, state):
    assert side(cells([[state] * 3], frequency=frequency)).item() == expected


def test_side__classes():
    sections = [
        [[-0.1, -0.1], [-0.2, 0.1]],
        [[0.1, 0.1], [-0.1, 0.3]],
        [[0.1, 0.1], [-0.1, -0.1]],
        [[0.1, 0.1], [0.1, 0.1]],
    ]
    label = side(cells(sections, turns=[[0, 0], [0, 0], [0, 0], [0, -3]]))
    assert label.values.tolist() == [Side.LEFT, Side.RIGHT, Side.STRADDLING, Side.ROTATING]
    assert label.dtype == np.int8
    meanings = label.attrs["flag_meanings"].split()
    assert meanings[Side.STRADDLING] == "straddling"
    assert label.attrs["flag_values"].tolist() == list(range(len(meanings)))


@pytest.mark.parametrize("status", [0, 3, 4, 5, 6])
def test_side__nothing_to_judge(status):
    assert side(cells([[[0.1, 0.1]]], status=status)).item() == Side.UNKNOWN


def test_side__inferred_cell_is_judged_like_the_one_it_stands_for():
    for section in ([0.1, 0.1], [-0.1, -0.1]):
        assert side(cells([[section]], status=7)).item() == side(cells([[section]])).item() != Side.UNKNOWN


def test_side__nan_section_is_unknown():
    assert side(cells([[[0.1, 0.1], [np.nan, 0.1]]])).item() == Side.UNKNOWN


def test_side__slow_drive_is_undecided():
    sections = [[[0.1, 0.1], [0.1, 0.1]], [[0.1, 0.1], [-0.1, -0.1]], [[0.1, 0.1], [0.1, 0.1]]]
    ds = cells(sections, frequency=0.5, turns=[[0, 0], [0, 0], [1, 0]])
    assert side(ds).values.tolist() == [Side.UNDECIDED, Side.STRADDLING, Side.ROTATING]
    assert side(ds, slowest_hz=0.4).values[0] == Side.RIGHT
    assert side(ds.drop_vars("frequency").assign_attrs(frequency_hz=0.5)).values[0] == Side.UNDECIDED
    assert side(ds.drop_vars("frequency")).values[0] == Side.RIGHT


def test_side__mirror_image():
    rng = np.random.default_rng(3)
    ds = cells(rng.normal(0.1, 0.1, (60, 3, 2)))
    mirrored = side(ds.assign(section=-ds["section"])).values
    swap = np.array([Side.UNKNOWN, Side.RIGHT, Side.LEFT, Side.STRADDLING])
    assert set(swap) > set(mirrored) - {Side.STRADDLING}
    np.testing.assert_array_equal(swap[mirrored], side(ds).values)


def test_side__whole_turns_do_not_matter():
    ds = cells([[[0.1, 0.1]], [[-0.1, 0.0]]])
    shifted = ds["section"] + xr.DataArray([2 * np.pi, -2 * np.pi, 0.0, 0.0], dims="state")
    np.testing.assert_array_equal(side(ds.assign(section=shifted)), side(ds))


def test_side__lazy_cube_stays_lazy():
    ds = cells([[[0.1, 0.1]], [[-0.1, 0.0]]], turns=[[0, 0], [0, 0]])
    label = side(ds.chunk(initial_condition=1))
    assert label.chunks is not None
    np.testing.assert_array_equal(label.compute(), side(ds))


def test_magnet_offset__arms():
    section = cells([[[np.pi / 2, -np.pi / 6]]])["section"]
    assert magnet_offset(section, (2.0, 1.0)).item() == pytest.approx(1.5)
