"""Physics and kernels of magpend: the forced double pendulum with magnets, many at a time."""

from magpend_core.engine.jit import source_digest as kernel_version
from magpend_core.engine.lyapunov import LyapunovExponents, lyapunov_exponents
from magpend_core.models import load_model, load_preset, model_names, preset_names, preset_provenance
from magpend_core.models.model import Model
from magpend_core.models.parameters import ParameterError, Parameters
from magpend_core.models.pendulum.mechanics import Torques, accelerations, energy, torques
from magpend_core.orbits import PeriodicOrbits, polish_orbits
from magpend_core.pointwise import evaluate, jacobian, rates
from magpend_core.sections import Sections, run_branches, sections
from magpend_core.status import Status
from magpend_core.trajectory import trajectory

__all__ = [
    "LyapunovExponents",
    "Model",
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
    "kernel_version",
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
