"""What a variable of a cube is; the registry of those that every cube has is `pipeline.layout.schema`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Variable:
    """One variable of the cube.

    Attributes
    ----------
    name : str
    own_dims : tuple of str
        Dims after the cell dims.
    dtype : str
        In the store.
    fill : float or int
        What a pending cell reads as.
    units : str
    long_name : str
    attrs : mapping
        Further attributes.
    """

    name: str
    own_dims: tuple[str, ...]
    dtype: str
    fill: float | int
    units: str
    long_name: str
    attrs: Mapping[str, Any] = field(default_factory=dict)

    def attributes(self) -> dict[str, Any]:
        """All attributes as written to the store."""
        units = {"units": self.units} if self.units else {}
        return {**units, "long_name": self.long_name, **self.attrs}

    def itemsize(self, sizes: Mapping[str, int]) -> int:
        """Bytes per cell, uncompressed."""
        import numpy as np

        return int(np.dtype(self.dtype).itemsize) * math.prod(sizes[d] for d in self.own_dims)


def flag_attrs(codes: Any) -> dict[str, Any]:
    """CF attributes of a variable of codes: an `IntEnum` whose members have a `sentence`."""
    return {
        "flag_values": [int(s) for s in codes],
        "flag_meanings": " ".join(s.name.lower() for s in codes),
        "comment": "; ".join(f"{int(s)} {s.name.lower()}: {s.sentence}" for s in codes),
    }
