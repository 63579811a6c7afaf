"""Define the class for a variable of a result cube; `pipeline.layout.schema` lists the variables of every cube."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Variable:
    """Declaration of a variable of a result cube: name, dims, data type, fill value, units.

    Attributes
    ----------
    name : str
        Name in the cube.
    own_dims : tuple of str
        Dims after the cell dims.
    dtype : str
        Data type in the store.
    fill : float or int
        Value of a pending cell.
    units : str
        Unit; empty if the elements have different ones.
    long_name : str
        Description in words.
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
        """Return all attributes of the variable as written to the store."""
        units = {"units": self.units} if self.units else {}
        return {**units, "long_name": self.long_name, **self.attrs}

    def itemsize(self, sizes: Mapping[str, int]) -> int:
        """Return the uncompressed size of the variable per cell [bytes]."""
        import numpy as np

        return int(np.dtype(self.dtype).itemsize) * math.prod(sizes[d] for d in self.own_dims)


def flag_attrs(codes: Any) -> dict[str, Any]:
    """Return the CF flag attributes of a variable that holds codes of an `IntEnum`. Each member of the enum must have a
    ``sentence``.
    """
    return {
        "flag_values": [int(s) for s in codes],
        "flag_meanings": " ".join(s.name.lower() for s in codes),
        "comment": "; ".join(f"{int(s)} {s.name.lower()}: {s.sentence}" for s in codes),
    }
