"""What a model's classifier says of a cube's cells, by the parameters of the run."""

import numpy as np
import pytest
import xarray as xr

from magpend_core.models import load_model
from magpend_core.models.pendulum.sides import Side, magnet_offset
from pipeline.results.sides import classify
from tests.pipeline.analysis.cubes import ORBITS, STATES, attributes_of

PENDULUM = load_model("pendulum").load()

# Period-1 orbits of the preset: frequency [Hz], side, one section point; the first two are reference orbits. The
# sides are the sign of the magnet's offset along an integrated period, which does not change on any of them.
PERIOD_1 = [
    (2.2, Side.RIGHT, ORBITS[0]["section"]),
    (2.2, Side.LEFT, ORBITS[1]["section"]),
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
        attrs=attributes_of(PENDULUM),
    )
    if turns is not None:
        ds["turns"] = (("initial_condition", "link"), np.asarray(turns, dtype=np.int32))
    return ds


@pytest.mark.parametrize(("frequency", "expected", "state"), PERIOD_1)
def test_classify__reference_orbits(frequency, expected, state):
    assert classify(cells([[state] * 3], frequency=frequency)).item() == expected


def test_classify__classes():
    sections = [
        [[-0.1, -0.1], [-0.2, 0.1]],
        [[0.1, 0.1], [-0.1, 0.3]],
        [[0.1, 0.1], [-0.1, -0.1]],
        [[0.1, 0.1], [0.1, 0.1]],
    ]
    label = classify(cells(sections, turns=[[0, 0], [0, 0], [0, 0], [0, -3]]))
    assert label.values.tolist() == [Side.LEFT, Side.RIGHT, Side.STRADDLING, Side.ROTATING]
    assert label.dtype == np.int8
    meanings = label.attrs["flag_meanings"].split()
    assert meanings[Side.STRADDLING] == "straddling"
    assert label.attrs["flag_values"].tolist() == list(range(len(meanings)))
    sections = [[[0.1, 0.1], [0.1, 0.1]], [[0.1, 0.1], [-0.1, -0.1]], [[0.1, 0.1], [0.1, 0.1]]]
    ds = cells(sections, frequency=0.5, turns=[[0, 0], [0, 0], [1, 0]])
    assert classify(ds).values.tolist() == [Side.UNDECIDED, Side.STRADDLING, Side.ROTATING]
    assert classify(ds.drop_vars("frequency").assign_attrs(frequency_hz=0.5)).values[0] == Side.UNDECIDED
    assert classify(ds.drop_vars("frequency")).values[0] == Side.RIGHT
    ds = cells([[[0.1, 0.1]], [[-0.1, 0.0]]], turns=[[0, 0], [0, 0]])
    label = classify(ds.chunk(initial_condition=1))
    assert label.chunks is not None
    np.testing.assert_array_equal(label.compute(), classify(ds))


@pytest.mark.parametrize("status", [0, 3, 4, 5, 6])
def test_classify__nothing_to_judge(status):
    assert classify(cells([[[0.1, 0.1]]], status=status)).item() == Side.UNKNOWN
    assert classify(cells([[[0.1, 0.1], [np.nan, 0.1]]])).item() == Side.UNKNOWN
    # an inferred cell is judged like the one that it stands for
    assert classify(cells([[[0.1, 0.1]]], status=7)).item() == Side.RIGHT


def test_classify__mirror_image_and_whole_turns():
    rng = np.random.default_rng(3)
    ds = cells(rng.normal(0.1, 0.1, (60, 3, 2)))
    shifted = ds["section"] + xr.DataArray([2 * np.pi, -2 * np.pi, 0.0, 0.0], dims="state")
    np.testing.assert_array_equal(classify(ds.assign(section=shifted)), classify(ds))
    mirrored = classify(ds.assign(section=-ds["section"])).values
    swap = np.array([Side.UNKNOWN, Side.RIGHT, Side.LEFT, Side.STRADDLING])
    assert set(swap) > set(mirrored) - {Side.STRADDLING}
    np.testing.assert_array_equal(swap[mirrored], classify(ds).values)


def test_classify__by_the_links_of_the_run():
    """With a second link twice as long as the preset's, psi2 decides."""
    ds = cells([[[0.2, -0.15, 0, 0]]])
    assert classify(ds).item() == Side.RIGHT
    long = PENDULUM.replace(l2=2 * PENDULUM["l2"])
    assert classify(ds.assign_attrs(attributes_of(long))).item() == classify(ds, parameters=long).item() == Side.LEFT
    # The frequency below which a side is undecided follows from the run's own links
    ds = cells([[[0.1, 0.1, 0, 0]]], frequency=1.0)
    assert classify(ds).item() == Side.RIGHT
    assert classify(ds, parameters=PENDULUM.replace(g=20.0)).item() == Side.UNDECIDED
    assert classify(cells([[[0.1, 0.1]]]).assign_attrs(model="duffing")) is None
    assert magnet_offset(np.array([np.pi / 2, -np.pi / 6]), {"l1": 2.0, "l2": 1.0}) == pytest.approx(1.5)


@pytest.mark.parametrize("lazy", [False, True])
def test_classify__swept_arm_length(lazy):
    ds = cells([[[0.2, -0.15, 0, 0]], [[0.2, 0.15, 0, 0]]])
    swept = ds.expand_dims(l2=[PENDULUM["l2"], 2 * PENDULUM["l2"]]).transpose("initial_condition", "l2", ...)
    label = classify(swept.chunk(l2=1) if lazy else swept)
    assert label.dims == ("initial_condition", "l2")
    assert (label.chunks is not None) == lazy
    assert label.values.tolist() == [[Side.RIGHT, Side.LEFT], [Side.RIGHT, Side.RIGHT]]
    assert classify(swept.isel(l2=1)).values.tolist() == [Side.LEFT, Side.RIGHT]
