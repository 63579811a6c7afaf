"""Group analyses and figures for lists of commands, with the run that each of them needs."""

from __future__ import annotations

from collections.abc import Mapping

Guide = Mapping[str, Mapping[str, str]]
"""By title of a group: what a product needs, by its name; an empty text for a product that takes any steady run."""

_POINT = "one parameter point (--at)"
_ONE, _TWO = "one swept parameter (--at chooses values of others)", "two swept parameters"
_NOISE, _DRIFT = "a run with [noise]", "a run with [drift]"
_ROTATION, _EXPONENTS = "the product rotation", "the product lyapunov"

ANALYSIS_GUIDE: Guide = {
    "Attractors, of any run without noise and drift": {
        "attractors": "",
        "settling": "",
        "hysteresis": "a continuation in both directions",
    },
    "Basins and shocks": {
        "basins": "a sweep; all numbers but fractions need starts on a grid",
        "resilience": "a sweep",
        "edge": "a sweep, and " + _POINT,
        "overlaps": "a sweep along the parameter that changes",
    },
    "Chaos": {"chaos": "", "dimension": ""},
    "Orbits and branches, stable or not": {
        "branches": "",
        "bands": "a posterior of magpend identify",
        "curves": "",
        "orbits": _POINT,
        "tongues": _ROTATION,
        "manifolds": _POINT,
        "tangency": _POINT + ", and two states",
    },
    "Moving parameters": {"tipping": _DRIFT, "delay": _DRIFT},
    "Noise": {"escapes": _NOISE, "density": _NOISE},
}

FIGURE_GUIDE: Guide = {
    "Sections and attractors": {
        "bifurcation": _ONE,
        "section": _POINT,
        "attractors": _ONE,
        "gallery": _POINT,
        "regimes": _TWO,
    },
    "Basins and shocks": {
        "basins": "a sweep with starts on a grid, and " + _POINT,
        "fractions": _ONE,
        "resilience": "a sweep, and at most " + _ONE,
        "edge": "a sweep, and " + _POINT,
    },
    "Chaos": {
        "lyapunov": f"{_EXPONENTS}, and {_ONE}; two with --map",
        "convergence": f"{_EXPONENTS}, and {_POINT}",
        "dimension": _POINT,
    },
    "Orbits and branches, stable or not": {
        "branches": "",
        "multipliers": "",
        "curves": "",
        "rotation": f"{_ROTATION}, and {_ONE}, or {_TWO}",
        "tongues": f"{_ROTATION}, and {_ONE}",
        "manifolds": _POINT,
    },
    "Moving parameters": {"drift": _DRIFT},
    "Noise": {"escapes": _NOISE, "density": _NOISE},
}
