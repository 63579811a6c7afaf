"""On which side of the fixed magnet a motion stays, told from its stored sections.

The rule
--------
The moving magnet hangs at the horizontal distance ::

    dx = l1 sin(psi1) + l2 sin(psi2)

from the vertical line through the pivot, on which the fixed magnet stands; the repelling torque
changes its sign there. A motion is one-sided if `dx` never changes its sign. What the cube has of a
motion is one point per drive period, the kept sections; so a cell counts as

* rotating, if a link made full turns, net, over the kept periods;
* left or right, if `dx` is negative or positive at every kept section;
* straddling, if it is neither: kept sections lie on both sides;
* undecided, if all kept sections lie on one side but the drive is slower than `slowest_hz`: between
  two sections the pendulum then has time to cross over and come back;
* unknown, if there is nothing to judge: pending, failed, or not reached.

The sign of `psi1` at the sections is no substitute: it would call 360 of the 5089 one-sided closed
orbits below straddling.

Evidence
--------
Preset ``wojna2018``; each kept section was integrated over the period that follows it, and the sign of
`dx` along the way compared with the label.

* 2 to 3 Hz, up and down continuation, 16 branches of 401 frequencies, 64 kept sections: all 5089
  closed orbits are one-sided and labelled as they move. Of 1327 cells that are not closed, 1 is called
  one-sided though it steps across between two sections; with 12 kept sections, 65 are that straddle
  within 64 periods.
* 2.2 to 3 Hz, 1500 random initial states with angles up to pi, 64 kept sections: no wrong label.
* 0.1 to 2 Hz, 8 branches of 191 frequencies, 32 kept sections: every motion straddles or rotates. At
  0.72 Hz and below 167 of them show all their kept sections on one side, above that none does. Hence
  `SLOWEST_HZ`.

The torque of the fitted magnet changes its sign at ``psi1 - m psi_rel - n = 0`` instead of ``dx = 0``;
judging the motions by that line moved 1 of these 9444 cells to another class. `dx` is used because it
needs no magnet model and has no jump where an angle passes pi.

Limits
------
One section per period is a sample: a motion that crosses over and back within every period at the same
phase is not seen (hence undecided), a chaotic one that crosses rarely needs many kept sections, and
turns that cancel over the kept periods are not rotation here.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import xarray as xr

ARM_LENGTHS = (0.174, 0.1788)
"""Distances [m] from joint 1 to joint 2 and from joint 2 to the moving magnet, preset ``wojna2018``."""

SLOWEST_HZ = 0.926
"""Slower small-angle mode [Hz] of the preset without magnets: its period is the time of a full swing."""

_COMPUTED = (1, 2, 7)  # PERIODIC, BOUNDED, INFERRED of magpend_core.status


class Side(IntEnum):
    """Label of a cell."""

    UNKNOWN = 0
    LEFT = 1
    RIGHT = 2
    STRADDLING = 3
    ROTATING = 4
    UNDECIDED = 5


def magnet_offset(section: xr.DataArray, lengths: tuple[float, float] = ARM_LENGTHS) -> xr.DataArray:
    """Horizontal distance of the moving magnet from the fixed one [m], positive to the right.

    Parameters
    ----------
    section
        States with dim `state` that holds ``psi1`` and ``psi2`` [rad].
    lengths
        Distances [m] from joint 1 to joint 2, and from there to the moving magnet.

    Returns
    -------
    DataArray
        As `section`, without `state`.
    """
    offset: xr.DataArray = sum(
        length * xr.apply_ufunc(np.sin, section.sel(state=name, drop=True), dask="allowed")
        for length, name in zip(lengths, ("psi1", "psi2"), strict=True)
    )
    return offset


def side(
    ds: xr.Dataset, *, lengths: tuple[float, float] = ARM_LENGTHS, slowest_hz: float = SLOWEST_HZ
) -> xr.DataArray:
    """Label each cell by the side of the fixed magnet on which it moves.

    The rule, what supports it and where it fails are in the text of this module. Lazy where `ds` is.

    Parameters
    ----------
    ds
        Cube with `section` and `status`; `turns` tells rotation, and without it no cell is called
        rotating. The drive frequency [Hz] is the coordinate `frequency`, else the attribute
        `frequency_hz`; if neither is there, no cell is undecided.
    lengths
        See `magnet_offset`. The class depends on their ratio alone. Not taken from `ds`.
    slowest_hz
        Drive frequency [Hz] below which one section per period cannot show one-sidedness.

    Returns
    -------
    DataArray of int8
        Codes of `Side`, on the dims of `status`; attributes `flag_values` and `flag_meanings`.
    """
    offset = magnet_offset(ds["section"], lengths)
    left = (offset < 0.0).all("period_index")
    right = (offset > 0.0).all("period_index")
    label = xr.full_like(left, Side.STRADDLING, dtype=np.int8)
    label = label.where(~left, np.int8(Side.LEFT)).where(~right, np.int8(Side.RIGHT))
    label = label.where(~(left | right) | ~_is_slow(ds, slowest_hz), np.int8(Side.UNDECIDED))
    if "turns" in ds:
        turns = ds["turns"]
        links = [dim for dim in turns.dims if dim not in ds["status"].dims]
        label = label.where(~(turns != 0).any(links), np.int8(Side.ROTATING))
    known = ds["status"].isin(_COMPUTED) & offset.notnull().all("period_index")
    label = label.where(known, np.int8(Side.UNKNOWN)).transpose(*ds["status"].dims)
    return label.rename("side").assign_attrs(
        long_name="side of the fixed magnet on which the motion stays",
        flag_values=np.array(list(Side), dtype=np.int8),
        flag_meanings=" ".join(s.name.lower() for s in Side),
    )


def _is_slow(ds: xr.Dataset, slowest_hz: float) -> xr.DataArray:
    """Say where the drive is too slow for one section per period."""
    frequency = ds.coords.get("frequency")
    if frequency is None:
        frequency = xr.DataArray(ds.attrs.get("frequency_hz", np.inf))
    return frequency < slowest_hz
