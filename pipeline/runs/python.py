"""Define functions of ``import magpend``: `run` computes and opens a run, `table` returns a pandas table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.products.product import function_of
from pipeline.products.registry import ANALYSES
from pipeline.runs import notebook
from pipeline.runs.arguments import names_arguments
from pipeline.runs.run import run as complete
from pipeline.runs.stopping import InterruptedRunError, interrupt
from pipeline.specification.spec import Spec
from pipeline.store.run import Run

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


def run(
    spec: str | Path | Mapping[str, Any] | Spec,
    out: str | Path | None = None,
    *,
    smoke: bool = False,
    echo: Callable[[str], None] = print,
    **options: Any,
) -> Run:
    """Compute the missing cells of a specification's run, and return the opened run.

    Parameters
    ----------
    spec
        A `Spec`, the path of a TOML file, the name of a shipped workflow, TOML text, or a table (a dict).
    out
        Run directory; by default ``runs/<name>``. For a text or a table the name is its model's with a
        digest, so that the same specification continues its run.
    smoke
        Whether to apply the specification's ``[smoke]`` table.
    echo
        Function that prints a line. In a notebook a bar shows the progress instead of lines.
    options
        ``workers``, ``scheduler``, ``cluster`` and ``dashboard``, see `pipeline.runs.run.run`.

    Returns
    -------
    Run
        The run, for `attractors` and the other analyses, and for `figure`; ``run.cube()`` is the Dataset.

    Raises
    ------
    SpecError
        If the specification is wrong; before anything is computed, with all problems.
    KeyboardInterrupt
        After Ctrl-C, or an interrupt of the notebook's kernel. The finished cells stay, unfinished tasks write
        nothing any more, and the same call goes on from there.
    Exception
        See `pipeline.runs.run.run`.

    Examples
    --------
    >>> run("quickstart").cube().section.sel(frequency=2.2)  # doctest: +SKIP
    """
    parsed = Spec.read(spec, smoke=smoke)
    if out is None:
        out = parsed.directory
    try:
        with notebook.progress():
            names_arguments(complete)(parsed, out, smoke=smoke, echo=echo, **options)
    except InterruptedRunError:
        raise interrupt(f"Stopped. The finished cells stay in {out}; the same call goes on from there.") from None
    return Run.open(out)


def table(found: xr.Dataset) -> pd.DataFrame:
    """Return the result of an analysis as a pandas table, as ``magpend analyse NAME --csv`` writes it.

    Parameters
    ----------
    found
        Result of `attractors`, `basins`, `branches`, ...

    Returns
    -------
    DataFrame
        For `attractors`, a row for each attractor at each parameter point. Numbers are in SI units,
        unrounded.

    Raises
    ------
    ValueError
        If `found` is not the result of an analysis with a table.
    """
    import pandas as pd

    name = str(found.attrs.get("derived_product", ""))
    if name not in ANALYSES or not ANALYSES[name].table:
        known = ", ".join(key for key, analysis in ANALYSES.items() if analysis.table)
        raise ValueError(f"the Dataset is not the result of an analysis that has a table ({known}).")
    return pd.DataFrame(function_of(ANALYSES[name].table)(found).rows)
