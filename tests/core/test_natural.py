import math

import pytest

from magpend_core.sizes import natural_size


@pytest.mark.parametrize(
    ("bounds", "size"),
    [
        ((3e-9,), 1e-9),
        ((0.1,), 1.0),
        ((100.0,), 1.0),
        ((0.09,), 0.1),
        ((4e8,), 1e9),
        ((1e-5, 1e-3), 1e-4),
        ((0.03, 0.3), 1.0),
        ((90.0, 900.0), 1.0),
        ((0.0,), 1.0),
        ((math.nan,), 1.0),
        ((math.inf,), 1.0),
    ],
)
def test_natural_size__a_power_of_ten_or_1(bounds, size):
    assert natural_size(*bounds) == size
