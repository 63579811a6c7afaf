"""magpend: sweeps, continuations, attractors, basins and bifurcations of periodically forced systems.

    import magpend

    run = magpend.run("quickstart")              # a name, a path, TOML text or a dict; shows what to do next
    ds = run.cube()                              # an xarray.Dataset
    found = run.attractors()                     # an analysis, kept in the run directory
    found.magpend.table()                        # a row per attractor and parameter point, as pandas
    ax = run.plot.bifurcation()                  # matplotlib axes, to go on with
    run.explore()                                # the interactive page, in a notebook
    duffing = magpend.load_model("duffing").load(amplitude=0.4)
    magpend.sections(duffing, 0.2, [[0.1, 0.0]], n_transient=300, n_keep=50)

Every name is imported when it is first used; ``dir(magpend)`` lists them. Analyses are methods of a `Run`, and
functions that take a run directory; both have the options of ``magpend analyse``. ``plot_`` functions take datasets.
Datasets have the accessor ``ds.magpend``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

_HOMES = {
    "magpend_core.models": ("import_model", "load_preset", "model_names", "preset_names"),
    "magpend_core.models.model": ("Model", "Parameters"),
    "magpend_core.models.parameters": ("ParameterError",),
    "magpend_core.models.preset_writing": ("write_preset",),
    "magpend_core.sections": ("Sections", "run_branches", "sections"),
    "magpend_core.trajectory": ("trajectory",),
    "magpend_core.sampling": ("Drive",),
    "magpend_core.recorded_drive": ("evaluate_recorded", "recorded_sections", "recorded_trajectory"),
    "pipeline.specification.drive_files": ("load_drive",),
    "magpend_core.orbits": ("PeriodicOrbits", "polish_orbits"),
    "magpend_core.lyapunov": ("LyapunovExponents", "lyapunov_exponents"),
    "magpend_core.engine.system": ("System",),
    "magpend_core.pointwise": ("evaluate", "jacobian", "rates"),
    "magpend_core.status": ("Status",),
    "pipeline.specification.problems": ("SpecError",),
    "magpend._runs": ("Run", "open_run", "run"),
    "pipeline.compute.simulate": ("simulate",),
    "pipeline.runs.building": ("Spec",),
    "pipeline.runs.python": ("table",),
    "pipeline.specification.inputs": ("load_model", "model"),
    "pipeline.runs.status": ("state",),
    "pipeline.runs.verify": ("verify_run",),
    "pipeline.runs.extend": ("extend",),
    "pipeline.runs.zoom": ("zoom",),
    "pipeline.runs.derive": ("derive", "prune"),
    "pipeline.runs.drawing": ("figure",),
    "pipeline.runs.filming": ("animation",),
    "pipeline.plots.films": ("save_animation",),
    "pipeline.explorer.notebook.showing": ("explorer",),
    "pipeline.rig.identify.identification": ("identify",),
    "pipeline.rig.recordings": ("findings_of", "load_mapping", "read_recording", "smooth", "window", "write_recording"),
    "pipeline.rig.recordings.figure": ("plot_recording",),
    "pipeline.analysis.chaos.dimensions": ("correlation_dimension", "kaplan_yorke_dimension"),
    "pipeline.analysis.chaos.zero_one": ("zero_one_test",),
    "pipeline.analysis.chaos.lyapunov": ("spectrum_of_jacobians",),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}


def _analysis(name: str) -> Callable[..., Any]:
    """Make the public function for an analysis, with a docstring that lists its options."""
    from magpend._analyses import Analyses
    from pipeline.products.product import default_of
    from pipeline.products.registry import ANALYSES
    from pipeline.runs.arguments import options_in_errors
    from pipeline.runs.derive import derive

    analysis = ANALYSES[name]

    def found(source: Any, *, echo: Any = None, workers: Any = None, scheduler: Any = None, **options: Any) -> Any:
        with options_in_errors(analysis.options):
            return derive(source, name, options, echo=echo, workers=workers, scheduler=scheduler)

    model = analysis.options
    lines = [f"    {k} = {default_of(model, k)!r}: {info.description}" for k, info in model.model_fields.items()]
    found.__name__ = found.__qualname__ = name
    found.__signature__ = _with_source(getattr(Analyses, name))  # type: ignore[attr-defined]
    found.__doc__ = "\n".join([analysis.help, "", "Options:", *lines])
    return found


def _with_source(method: Callable[..., Any]) -> Any:
    """Return the signature of a method with ``source`` in the place of ``self``."""
    import inspect

    own = inspect.signature(method)
    _, *options = own.parameters.values()
    source = inspect.Parameter("source", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation="str | Path | Run")
    return own.replace(parameters=[source, *options])


def _naming_arguments(value: Any, home: str) -> Any:
    """Wrap a function of the pipeline so that its errors name its arguments; return other values unchanged."""
    from types import FunctionType

    if not isinstance(value, FunctionType) or not home.startswith("pipeline."):
        return value
    from pipeline.runs.arguments import names_arguments

    wrapped = names_arguments(value)
    wrapped.__module__ = "magpend"  # where pickle finds it
    return wrapped


def _analysis_names() -> tuple[str, ...]:
    from pipeline.products.registry import COMMANDS

    return COMMANDS


def _plot_names() -> list[str]:
    import pipeline.plots

    return pipeline.plots.__all__


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib import metadata

        return metadata.version("magpend")
    if name in _HOME_OF:
        value = _naming_arguments(getattr(import_module(_HOME_OF[name]), name), _HOME_OF[name])
    elif not name.startswith("_") and name in _analysis_names():
        value = _analysis(name)
    elif not name.startswith("_") and name in _plot_names():
        value = _naming_arguments(getattr(import_module("pipeline.plots"), name), "pipeline.plots")
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*_HOME_OF, *_analysis_names(), *_plot_names(), "__version__", "__doc__"})


class _AccessorRegistration:
    """An import hook that registers ``ds.magpend`` once xarray is imported; importing xarray here would be slow."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        """Return the spec of xarray, such that its module registers the accessor at its end; None for others."""
        if name != "xarray":
            return None
        from importlib.util import find_spec

        sys.meta_path.remove(self)
        spec = find_spec(name)
        loader: Any = spec.loader if spec is not None else None
        if loader is not None:
            execute = loader.exec_module

            def execute_and_register(module: Any) -> None:
                execute(module)
                import_module("magpend._accessor")

            loader.exec_module = execute_and_register
        return spec


if "xarray" in sys.modules:
    import_module("magpend._accessor")
else:
    sys.meta_path.insert(0, _AccessorRegistration())
