"""Cubes of what the engine found, as a run stores them."""

from __future__ import annotations

import numpy as np
import xarray as xr

from magpend_core import Status, load_preset, run_branches

OWN = {"section": ("period_index", "state"), "turns": ("link",), "status": (), "orbit_period": (), "n_periods": ()}
STATES = ["psi1", "psi2", "psi1_dot", "psi2_dot"]


def attributes_of(parameters):
    """The model and the parameters as attributes of a cube."""
    return {"model": parameters.model.name, "parameters": "\n".join(f"{k} = {v!r}" for k, v in parameters.items())}


def integrated(parameters, frequency_hz, states, **options):
    """Result of `run_branches` for cells at one parameter point."""
    n, states = len(states), np.asarray(states, float)
    packed, options = np.tile(parameters.pack(), (n, 1, 1)), {"rtol": 1e-9, "atol": 1e-9, **options}
    return run_branches(packed, np.full((n, 1), frequency_hz), states, system=parameters.model.system, **options)


def cube_of(found, states, cells=("initial_condition",), shape=None, **coords):
    """Cube of a result of `sections`, or of `run_branches` with one point per branch."""
    data = {}
    for name, dims in OWN.items():
        values = np.asarray(getattr(found, name))
        values = values[:, 0] if np.ndim(found.status) == 2 else values
        data[name] = ((*cells, *dims), values.reshape(*(shape or values.shape[:1]), *values.shape[1:]))
    return xr.Dataset(data, coords={"state": list(states), **coords})


def exponents_cube(rates, *, n_exponents=4, n_blocks=8, **dims):
    """Cube of made-up exponents of the pendulum; `rates` are the largest, with the given dims."""
    names, shape = list(dims), tuple(len(v) for v in dims.values())
    rates = np.asarray(rates, float).reshape(shape)
    spectrum = rates[..., None] + np.array([0.0, -0.4, -0.9, -1.5])[:n_exponents]
    wave = 0.05 * np.resize([1.0, -1.0], n_blocks)
    return xr.Dataset(
        {
            "section": ((*names, "period_index", "state"), np.full((*shape, 5, 4), 0.3)),
            "status": (names, np.full(shape, Status.BOUNDED, np.int8)),
            "orbit_period": (names, np.zeros(shape, np.int16)),
            "turns": ((*names, "link"), np.zeros((*shape, 2), np.int32)),
            "lyapunov": ((*names, "exponent"), spectrum, {"units": "1/s"}),
            "lyapunov_stderr": ((*names, "exponent"), np.full(spectrum.shape, 0.02)),
            "lyapunov_blocks": ((*names, "block", "exponent"), spectrum[..., None, :] + wave[:, None]),
            "divergence": (names, spectrum.sum(-1) + 0.001),
            "lyapunov_flag": (names, np.ones(shape, np.int8)),
        },
        coords={
            **dims,
            "frequency": ("frequency", np.asarray(dims["frequency"], float), {"units": "Hz"}),
            "state": STATES,
            "exponent": np.arange(1, n_exponents + 1),
        },
        attrs=attributes_of(load_preset()),
    )
