"""Physics and kernels of magpend: the forced double pendulum with magnets, many at a time."""

from magpend_core.engine.jit import source_digest as kernel_version
from magpend_core.engine.lyapunov import LyapunovExponents, lyapunov_exponents
from magpend_core.models.pendulum.mechanics import Torques, accelerations, energy, jacobian, torques
from magpend_core.models.pendulum.parameters import (
    ParameterError,
    Parameters,
    load_preset,
    preset_names,
    preset_provenance,
)
from magpend_core.orbits import PeriodicOrbits, polish_orbits
from magpend_core.sections import Sections, run_branches, sections
from magpend_core.status import Status
from magpend_core.trajectory import trajectory

__all__ = [
    "LyapunovExponents",
    "ParameterError",
    "Parameters",
    "PeriodicOrbits",
    "Sections",
    "Status",
    "Torques",
    "accelerations",
    "energy",
    "jacobian",
    "kernel_version",
    "load_preset",
    "lyapunov_exponents",
    "polish_orbits",
    "preset_names",
    "preset_provenance",
    "run_branches",
    "sections",
    "torques",
    "trajectory",
]
