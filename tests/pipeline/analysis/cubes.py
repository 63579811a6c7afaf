"""Cubes of what the engine found, as a run stores them."""

import json
from pathlib import Path

import numpy as np
import xarray as xr

import magpend
from magpend_core import Status, load_preset
from magpend_core.models.sectioned import sectioned
from pipeline.compute.integrate import rest_states
from pipeline.layout.vocabulary import section_attributes
from tests.core.cells import run_cells
from tests.core.flows import flow

ORBITS = json.loads((Path(__file__).parents[2] / "core" / "data" / "orbits.json").read_text("utf-8"))
"""Orbits of the preset, the right and the left one at 2.2 Hz first."""
WELLS = np.array([[-0.7790549287, 0.0274168155], [1.2100908241, 0.0552949542]])
"""Section points of x'' = .2 cos t + x - x^3 - .15 x': DynamicalSystemsBase.jl, issue 139, recomputed independently."""
OWN = {"section": ("period_index", "state"), "turns": ("link",), "status": (), "orbit_period": (), "n_periods": ()}
STATES = ["psi1", "psi2", "psi1_dot", "psi2_dot"]


def attributes_of(parameters):
    """The model and the parameters as attributes of a cube."""
    return {"model": parameters.model.name, "parameters": "\n".join(f"{k} = {v!r}" for k, v in parameters.items())}


def integrated(parameters, frequency_hz, states, **options):
    """Result of `run_branches` for cells at one parameter point."""
    return run_cells(parameters.model.system, parameters.pack(), frequency_hz, states, **{"rtol": 1e-9, **options})


def cube_of(found, states, cells=("initial_condition",), shape=None, **coords):
    """Cube of a result of `sections`, or of `run_branches` with one point per branch."""
    data = {}
    for name, dims in OWN.items():
        values = np.asarray(getattr(found, name))
        values = values[:, 0] if np.ndim(found.status) == 2 else values
        data[name] = ((*cells, *dims), values.reshape(*(shape or values.shape[:1]), *values.shape[1:]))
    return xr.Dataset(data, coords={"state": list(states), **coords})


def flow_cube(table, states, *, crossing=None, frequency_hz=1.0, n_transient=200, n_keep=20, values=()):
    """Cells of a flow at one parameter point, by crossings or at even times, as a run stores them."""
    model = flow(table) if crossing is None else sectioned(flow(table), crossing)
    parameters = model.load(**dict(values))
    rate = frequency_hz if crossing is None else crossing.frequency_hz
    found = integrated(parameters, rate, states, n_transient=n_transient, n_keep=n_keep)
    ds = cube_of(found, model.state_names)
    if crossing is None:
        ds = ds.assign_coords(frequency=float(frequency_hz))
    else:
        ds["rest_state"] = (("initial_condition", "state"), rest_states(found)[:, 0])
    own = {
        "model": json.dumps(model.reference),
        "closure_tolerance": 1e-6,
        "n_transient": n_transient,
        "n_keep": n_keep,
    }
    return ds.assign_attrs({**attributes_of(parameters), **own, **section_attributes(model.crossing)})


def sweep(model, starts, *, axes=(), frequency_hz=None, lengths=(200, 8), tolerance=1e-9, closes=0.0, **more):
    """A sweep as plain data: starts are points or a grid, `lengths` n_transient and n_keep.

    Cells stop once they close within `closes`, if it is given.
    """
    grid = starts if isinstance(starts, dict) else {"kind": "list", "points": starts}
    integration = {"rtol": tolerance, "atol": tolerance, "n_transient": lengths[0], "n_keep": lengths[1]}
    if closes:
        integration |= {"stop_when_closed": True, "closure_tolerance": closes}
    if frequency_hz is not None:
        more["parameters"] = {"frequency_hz": frequency_hz, **more.get("parameters", {})}
    spec = {"kind": "sweep", "model": model, "initial_conditions": grid, "integration": integration, **more}
    return {**spec, "axes": dict(axes)} if axes else spec


def swept(model, out, starts, lengths, *, section=None, parameters=None, **axes):
    """Run a sweep from listed starts, or from four random ones in ranges of the states.

    Axes are lists of values, or their first and last value and their number; a section is a state and a direction.
    """
    spec = magpend.Spec("sweep", model)
    for name, values in axes.items():
        spec = spec.with_axis(name, *values) if isinstance(values, tuple) else spec.with_axis(name, values=values)
    if parameters is not None:
        spec = spec.with_parameters(**parameters)
    if section is not None:
        spec = spec.with_section(of=section[0], value=0.0, direction=section[1])
    is_random = isinstance(starts, dict)
    spec = spec.with_start_random(n=4, seed=0, **starts) if is_random else spec.with_start_list(points=starts)
    return magpend.run(spec.with_integration(n_transient=lengths[0], n_keep=lengths[1]), out, workers=0)


def line(start, stop, num):
    """Values of an axis at even distances."""
    return {"start": start, "stop": stop, "num": num}


def artists(figure, gid):
    """Artists of a figure with an id."""
    return figure.findobj(lambda a: getattr(a, "get_gid", lambda: None)() == gid)


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
