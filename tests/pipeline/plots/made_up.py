"""Made-up results in the form of cubes and analyses, and what a figure shows of them."""

from __future__ import annotations

import numpy as np
import xarray as xr

from magpend_core.models import load_model
from magpend_core.models.pendulum.sides import Side
from magpend_core.status import Status
from pipeline.analysis.basins import regimes_figure
from pipeline.layout.vocabulary import ATTRACTS, PERIODIC_ORBIT
from tests.pipeline.analysis.dense_sets import rows_of

VALUES = load_model("pendulum").load().as_dict()
STATES = ["psi1", "psi2", "psi1_dot", "psi2_dot"]


def attrs_of(model):
    """Attributes of a cube of a model with its default parameters."""
    parameters = "\n".join(f"{k} = {v!r}" for k, v in load_model(model).load().as_dict().items())
    return {"model": model, "parameters": parameters}


PENDULUM, DUFFING = attrs_of("pendulum"), attrs_of("duffing")


def make_attractors(ids, dims, coords=(), *, attrs=PENDULUM, status=None):
    """Result of the form of `match`, from the ids of the cells: orbits of period 1, the pendulum's on the left."""
    ids, states = np.asarray(ids, np.int32), list(load_model(attrs["model"]).state_names)
    n = int(ids.max()) + 1
    outer = [d for d in dims if not (d == "initial_condition" or d == "branch" or d.endswith("_0"))]
    shape = tuple(ids.shape[dims.index(d)] for d in outer)
    flat = np.moveaxis(ids, [dims.index(d) for d in outer], range(len(outer))).reshape(*shape, -1)
    counts = np.stack([(flat == i).sum(axis=-1) for i in range(n)], axis=-1)
    here, per = counts > 0, (*outer, "attractor")
    points = np.full((*shape, n, 3, len(states)), np.nan)
    points[here, 0] = 0.1 * (1.0 + np.nonzero(here)[-1])[:, None]
    default = np.where(ids >= 0, Status.PERIODIC, Status.BOUNDED).astype(np.int8)
    ds = xr.Dataset(
        {
            "attractor_id": (dims, ids),
            "status": (dims, default if status is None else status),
            "decision": (dims, (ids >= 0).astype(np.int8)),
            "kind": (per, np.where(here, PERIODIC_ORBIT, 0).astype(np.int8)),
            "stability": (per, np.where(here, ATTRACTS, 0).astype(np.int8)),
            "orbit_period": (per, here.astype(np.int32)),
            "n_cells": (per, counts),
            "share": (per, counts / flat.shape[-1]),
            "attractor_points": ((*per, "point", "state"), points),
        },
        coords={"state": states, "attractor": np.arange(n, dtype=np.int32), **dict(coords)},
        attrs=attrs,
    )
    if attrs["model"] != "pendulum":
        return ds
    turns = np.where(here, 0.0, np.nan)[..., None] * np.ones(2)
    return ds.assign(side=(per, np.where(here, Side.LEFT, 0).astype(np.int8)), rotation=((*per, "link"), turns))


def make_portraits(n, states=STATES, turning=()):
    """Circles of different size; those named turn over once with the second state."""
    phase = 2 * np.pi * np.linspace(0.0, 1.0, 50)
    half = len(states) // 2
    orbit = np.empty((n, 50, len(states)))
    for i in range(n):
        size = 0.1 * (i + 1)
        orbit[i] = np.column_stack([size * np.cos(phase)] * half + [size * np.sin(phase)] * half)
        if i in turning:
            orbit[i, :, 1] = phase
    return xr.Dataset(
        {
            "orbit": (("attractor", "sample", "state"), orbit),
            "attractor_points": (("attractor", "point", "state"), orbit[:, :1]),
            "share": ("attractor", 1.0 / (1.0 + np.arange(n)) / 10),
            "stability": ("attractor", np.full(n, ATTRACTS, np.int8)),
        },
        coords={"attractor": np.arange(n), "state": list(states), "frequency": 2.2},
    )


def make_trajectory(n=401, frequency=2.0):
    """A closed motion of the pendulum's states."""
    time = np.linspace(0.0, 2.0, n)
    phase = 2 * np.pi * frequency * time
    values = (0.1 * np.cos(phase), 0.2 * np.sin(phase), -0.1 * np.sin(phase), 0.2 * np.cos(phase))
    factors = (1.0, 1.0, 2 * np.pi * frequency, 2 * np.pi * frequency)
    states = {name: ("time", f * v) for name, f, v in zip(STATES, factors, values, strict=True)}
    return xr.Dataset(states, coords={"time": time}, attrs={"frequency_hz": frequency})


def legend_texts(fig):
    """Texts of the legends, unfolded."""
    return [" ".join(text.get_text().split()) for legend in fig.legends for text in legend.get_texts()]


def caption_of(fig):
    """The line above the axes, unfolded."""
    return " ".join(fig.axes[0].get_title(loc="left").split())


def by_gid(fig, axes=None):
    """All artists of some axes that have an identifier, the last of each."""
    return {a.get_gid(): a for ax in (fig.axes if axes is None else axes) for a in ax.findobj() if a.get_gid()}


def plot_regimes(ds, **options):
    """Draw the map of a result whose sets are on the dim ``attractor``."""
    return regimes_figure.plot_regimes(rows_of(ds), **options)
