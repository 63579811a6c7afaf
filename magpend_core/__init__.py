"""Integrate forced systems of ordinary differential equations, many trajectories at a time.

Names are found where they are defined when they are first used, so that codes, parameters and models can be
read without the compiler.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magpend_core.crossing import Crossing
    from magpend_core.lyapunov import LyapunovExponents, lyapunov_exponents
    from magpend_core.models import ModelError, load_model, load_preset, model_names, preset_names, preset_provenance
    from magpend_core.models.model import Model, Parameters
    from magpend_core.models.parameters import ParameterError
    from magpend_core.models.pendulum.mechanics import Torques, accelerations, energy, torques
    from magpend_core.orbits import PeriodicOrbits, polish_orbits
    from magpend_core.pointwise import evaluate, jacobian, rates
    from magpend_core.sections import Sections, run_branches, sections
    from magpend_core.status import Status
    from magpend_core.trajectory import trajectory

__all__ = [
    "Crossing",
    "LyapunovExponents",
    "Model",
    "ModelError",
    "ParameterError",
    "Parameters",
    "PeriodicOrbits",
    "Sections",
    "Status",
    "Torques",
    "accelerations",
    "energy",
    "evaluate",
    "jacobian",
    "load_model",
    "load_preset",
    "lyapunov_exponents",
    "model_names",
    "polish_orbits",
    "preset_names",
    "preset_provenance",
    "rates",
    "run_branches",
    "sections",
    "torques",
    "trajectory",
]

_HOMES = {
    "crossing": ("Crossing",),
    "lyapunov": ("LyapunovExponents", "lyapunov_exponents"),
    "models": ("ModelError", "load_model", "load_preset", "model_names", "preset_names", "preset_provenance"),
    "models.model": ("Model", "Parameters"),
    "models.parameters": ("ParameterError",),
    "models.pendulum.mechanics": ("Torques", "accelerations", "energy", "torques"),
    "orbits": ("PeriodicOrbits", "polish_orbits"),
    "pointwise": ("evaluate", "jacobian", "rates"),
    "sections": ("Sections", "run_branches", "sections"),
    "status": ("Status",),
    "trajectory": ("trajectory",),
}
_HOME_OF = {name: f"{__name__}.{module}" for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Package(ModuleType):
    """Module type of the package. It keeps the functions `sections` and `trajectory` when submodules of the same names
    are imported.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOME_OF and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
