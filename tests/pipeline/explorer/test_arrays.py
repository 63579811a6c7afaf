"""Arrays on their way to the page."""

import numpy as np
import pytest

from pipeline.explorer.data.arrays import DTYPES, pack_arrays, unpack_arrays


def test_arrays__come_back_as_they_were():
    given = {name: np.arange(-3, 4).astype(name)[:, None] * np.ones(2, name) for name in DTYPES}
    arrays, attrs = unpack_arrays(pack_arrays({**given, "none": np.empty((0, 3))}, {"title": "ψ <b>", "at": None}))
    assert attrs == {"title": "ψ <b>", "at": None}
    assert arrays.pop("none").shape == (0, 3)
    for name, values in given.items():
        assert arrays[name].dtype == name
        assert (arrays[name] == values).all()


def test_arrays__begin_where_a_typed_array_may():
    """A browser's typed arrays begin at multiples of their items' size."""
    data = pack_arrays({"a": np.zeros(3, np.int8), "b": np.zeros(2), "c": np.zeros(1, np.uint16)}, {"x": "ü"})
    assert (4 + int.from_bytes(data[:4], "little")) % 8 == 0
    assert len(data) % 8 == 0


@pytest.mark.parametrize(("arrays", "attrs"), [({"n": np.zeros(1, np.int64)}, {}), ({}, {"x": float("nan")})])
def test_arrays__refuse_what_a_browser_cannot_hold(arrays, attrs):
    with pytest.raises(ValueError):  # noqa: PT011
        pack_arrays(arrays, attrs)
