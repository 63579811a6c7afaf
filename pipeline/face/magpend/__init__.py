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
from functools import cache
from importlib import import_module
from pkgutil import resolve_name
from typing import Any


@cache
def _homes() -> dict[str, str]:
    """Return the place ``module:object`` of every public name, as the package's stub lists them."""
    import ast
    from pathlib import Path

    homes = {}
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            homes |= {alias.name: f"{node.module}:{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Assign):  # the functions of analyses are methods of `Run`
            homes[ast.unparse(node.targets[0])] = f"magpend._runs:{ast.unparse(node.value)}"
    return homes


def _naming_arguments(value: Any, home: str) -> Any:
    """Wrap a function of the pipeline so that its errors name its arguments; return other values unchanged."""
    from types import FunctionType

    if not isinstance(value, FunctionType) or not home.startswith("pipeline."):
        return value
    from pipeline.runs.arguments import names_arguments

    wrapped = names_arguments(value)
    wrapped.__module__ = "magpend"  # where pickle finds it
    return wrapped


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib import metadata

        return metadata.version("magpend")
    if name.startswith("_") or name not in _homes():
        if not name.startswith("_"):
            from magpend._methods import ANALYSES, analysis

            if name in ANALYSES.listed:  # of another package
                return analysis(name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = _naming_arguments(resolve_name(_homes()[name]), _homes()[name])
    return value


def __dir__() -> list[str]:
    return sorted({*_homes(), "__version__", "__doc__"})


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
