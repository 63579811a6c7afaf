"""Define `Run`, the opened run of ``import magpend``, and the functions that return one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MethodType
from typing import TYPE_CHECKING, Any, Literal, Self, overload

from magpend._methods import analysis
from magpend._names import Analyses
from pipeline.products.product import Table
from pipeline.products.registry import ANALYSES, CELL_PRODUCTS
from pipeline.runs.arguments import names_arguments
from pipeline.runs.derive import shown_table, stale, stored_each
from pipeline.runs.progress import bar_in_notebook
from pipeline.runs.run import run as complete
from pipeline.runs.stopping import InterruptedRunError, interrupt
from pipeline.specification.problems import SpecError, unknown_name
from pipeline.specification.spec import Spec
from pipeline.store.run import RunDirectory

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from magpend._plots import Plots
    from pipeline.explorer.widget import Explorer
    from pipeline.runs.status import State
    from pipeline.store.checking import Verification


class Run(Analyses, RunDirectory):
    """An opened run directory with its analyses as methods and its figures under `plot`.

    A run holds the commit records found when it was opened, so that all its results use the same cells. Open it
    again to see cells that were computed later.

    Attributes
    ----------
    info : RunInfo
        Files of the directory, and content of ``run.json``.
    spec : Spec
        Specification of the run.
    plan : Plan
        Plan of the run: its cells, tasks and chunks.
    commits : Records
        Valid commit records by task.

    Examples
    --------
    >>> run = Run.open("runs/quickstart")                                # doctest: +SKIP
    >>> run.attractors().magpend.table()                                 # doctest: +SKIP
    >>> ax = run.plot.bifurcation(degrees=True)                         # doctest: +SKIP
    """

    if not TYPE_CHECKING:  # which knows no analyses of other packages

        def __getattr__(self, name: str) -> Any:
            if name.startswith("_") or name not in ANALYSES.listed:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            return MethodType(analysis(name), self)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *ANALYSES.listed})

    def cube(self, chunks: Any = None, *, check: bool | None = None) -> xr.Dataset:
        """Open the run's result cube as an xarray dataset; see `magpend.open_run`."""
        import magpend._accessor  # noqa: F401 -- registers ds.magpend
        from pipeline.layout.own_words import with_own_names

        ds = with_own_names(super().cube(chunks, check=check))
        ds.encoding["source"] = self.name
        return ds

    def tree(self, chunks: Any = None, *, check: bool | None = None) -> xr.DataTree:
        """Open the cube and all kept results of analyses as one tree; see `magpend.open_run`."""
        return _tree_of(self, chunks, check)

    @property
    def _next(self) -> tuple[str, ...]:
        from pipeline.runs.preview import needed

        name, options = needed(self)
        call = f"run.plot.{name}({', '.join(f'{key}={value!r}' for key, value in options.items())})"
        lines: tuple[str, ...] = (
            "next",
            "  run.cube()                           the cube, an xarray.Dataset",
            f"  {call:36s} a figure; run.plot lists the others",
        )
        if not self.spec.motion.obstacle:
            lines += ('  run.table("attractors")              what attracts, and what has been shown of it',)
        return lines

    @property
    def plot(self) -> Plots:
        """The figures of the run: ``run.plot.bifurcation()`` draws one and returns its axes."""
        from magpend._plots import Plots

        return Plots(self)

    def table(self, name: str, **options: Any) -> pd.DataFrame:
        """Return an analysis of the run as a pandas table, as ``magpend analyse NAME --csv`` writes it.

        Parameters
        ----------
        name
            Name of the analysis, such as ``attractors``.
        options
            Keywords of the method of its name.

        Returns
        -------
        DataFrame
            For `attractors`, a row for each attractor at each parameter point. Numbers are in SI units, unrounded.

        Raises
        ------
        SpecError
            If the analysis or an option is unknown or out of bounds, or if the run does not suit.
        """
        if name not in ANALYSES.listed:
            raise SpecError(unknown_name("analysis", name, ANALYSES.listed))
        return table(getattr(self, name)(**options))

    @names_arguments
    def explore(self, *, curves: str | Path | RunDirectory | None = None, height: int = 720) -> Explorer:
        """Show the run on the explorer's interactive page, in a cell of Jupyter, VS Code or marimo.

        Parameters
        ----------
        curves, height
            See `magpend.explorer`.

        Returns
        -------
        Explorer
            Widget; as the last value of a cell it is shown. Its ``selected`` is the selected point.

        Raises
        ------
        SpecError
            If anywidget is not installed, or the height is too small.

        Examples
        --------
        >>> widget = run.explore()                                           # doctest: +SKIP
        >>> widget.selected["state"]                                         # doctest: +SKIP
        """
        from pipeline.explorer.notebook import explorer

        return explorer(self, curves=curves, height=height)

    def lyapunov(self) -> xr.Dataset:
        """Return the Lyapunov exponents of the cells, which the run has computed.

        `chaos` tells regular from chaotic attractors with them, and has exponents of orbits for every run.

        Returns
        -------
        Dataset
            The variables of the cube that the product ``lyapunov`` makes, with their standard errors and flags.

        Raises
        ------
        SpecError
            If the run has none.
        """
        if "lyapunov" not in self.spec.products:
            raise SpecError(
                f"{self.name}: the run has no Lyapunov exponents. Add them with "
                'run.extend(products={"lyapunov": {}}), or [products] lyapunov = {} in its specification; '
                "run.chaos() has the exponents of periodic orbits."
            )
        variables = CELL_PRODUCTS["lyapunov"].variables(self.spec.products["lyapunov"], self.model)
        return self.cube()[["status", *(variable.name for variable in variables)]]

    def status(self) -> State:
        """Read how much of the run is computed now; printing the result shows the numbers of cells by status."""
        from pipeline.runs.status import state

        return state(self.info.files)

    @names_arguments
    def verify(self, *, repair: bool = False) -> Verification:
        """Compare every stored file with its checksum, and name what is damaged.

        Parameters
        ----------
        repair
            Whether to rebuild or discard damaged files. Open the run again afterwards.

        Returns
        -------
        Verification
            Its attribute ``sound`` says whether nothing is damaged.

        Raises
        ------
        LockedError
            With `repair`, if a run is writing to the directory.
        """
        from pipeline.runs.verify import verify_run

        return verify_run(self.name, repair=repair)

    @names_arguments
    def extend(
        self,
        spec: str | Path | None = None,
        out: str | Path | None = None,
        *,
        also: Sequence[str | Path] = (),
        axes: Mapping[str, Mapping[str, Any]] | None = None,
        starts: int | None = None,
        keep: int | None = None,
        products: Mapping[str, Mapping[str, Any]] | None = None,
        workers: int | None = None,
        scheduler: str | None = None,
        cluster: str | Path | None = None,
        dashboard: bool = False,
        echo: Callable[[str], None] = print,
    ) -> Self:
        """Compute a wider run, in a new directory or in place of this one, and open it; computed cells are copied.

        Parameters
        ----------
        spec, also, starts, keep, workers, scheduler, cluster, dashboard, echo
            See `magpend.extend`.
        out
            Directory of the wider run. By default it replaces this run, which is renamed to ``DIR.before``.
        axes
            New ranges by ``frequency_hz``, ``omega``, ``period``, parameter, or state of a grid:
            ``{"frequency_hz": {"start": 2.0, "stop": 3.0, "num": 201}}``.
        products
            Additional products, with their options: ``{"lyapunov": {}}``.

        Returns
        -------
        Run
            The wider run.

        Raises
        ------
        SpecError, RefusedError
            If no cell can be reused, or if cells would be lost; before anything is created.
        """
        from pipeline.runs.extend import extend

        extend(
            self.name, spec, out, also=also, axes=axes, starts=starts, keep=keep, products=products, workers=workers,
            scheduler=scheduler, cluster=cluster, dashboard=dashboard, echo=echo,
        )  # fmt: skip
        return self.open(self.name if out is None else out)

    @names_arguments
    def zoom(
        self,
        ranges: Mapping[str, tuple[float, float]] | None = None,
        *,
        at: Mapping[str, float] | None = None,
        num: int | None = None,
        nums: Mapping[str, int] | None = None,
        samples: int | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> Spec:
        """Return this run's specification with narrower ranges, for `magpend.run`.

        Parameters
        ----------
        ranges
            Lowest and highest value by ``frequency_hz``, ``omega``, ``period``, parameter or state (with ``_deg`` in
            degrees).
        at
            One value by key, as in `ranges`.
        num
            Number of points of every new range; by default as before.
        nums
            Number of points by key; takes precedence over `num`.
        samples
            Number of random initial states.
        echo
            Function that prints a note on each range that exceeds the old one.

        Returns
        -------
        Spec
            The new specification.

        Raises
        ------
        SpecError
            If nothing changes, a change does not fit, or the result is not a valid specification.

        Examples
        --------
        >>> magpend.run(run.zoom({"frequency_hz": (2.1, 2.2)}))              # doctest: +SKIP
        """
        from pipeline.layout.vocabulary import parameter_name
        from pipeline.runs.zoom import Changes, zoom

        def keyed(given: Mapping[str, Any] | None) -> dict[str, Any]:
            return {parameter_name(name): value for name, value in (given or {}).items()}

        spec, notes = zoom(self.spec, Changes(keyed(ranges), keyed(at), num, keyed(nums), samples))
        if echo is not None:
            for note in notes:
                echo(note)
        return spec


@names_arguments
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
    out = parsed.directory if out is None else out
    try:
        with bar_in_notebook():
            done = names_arguments(complete)(parsed, out, smoke=smoke, echo=echo, **options)
    except InterruptedRunError:
        raise interrupt(f"Stopped. The finished cells stay in {out}; the same call goes on from there.") from None
    return Run.open(done)


@overload
def open_run(
    path: str | Path | RunDirectory, *, tree: Literal[False] = False, chunks: Any = None, check: bool | None = None
) -> xr.Dataset: ...


@overload
def open_run(
    path: str | Path | RunDirectory, *, tree: Literal[True], chunks: Any = None, check: bool | None = None
) -> xr.DataTree: ...


def open_run(
    path: str | Path | RunDirectory, *, tree: bool = False, chunks: Any = None, check: bool | None = None
) -> xr.Dataset | xr.DataTree:
    """Open the result cube of a run directory, alone or in a tree with the kept results of all analyses.

    Only coordinates are read until variables are used. Cells that are not committed read as pending: ``status`` 0,
    ``section`` NaN. Open the run again to see cells that were committed later.

    Parameters
    ----------
    path
        Run directory, or an opened run.
    tree
        Whether to return a tree: the cube as ``cube``, and each kept result of an analysis under the name of the
        analysis. Further results with other options have the key of their folder in the name, such as
        ``attractors-1a2b3c4d``. Stale results (of an earlier cube or an earlier version of the code) are left
        out, and damaged ones as well; the root's attribute ``left_out`` names them.
    chunks
        As in `xarray.open_zarr`: None indexes lazily and loads what is selected; ``{}`` makes dask arrays in the
        chunks of the store, for cubes larger than the memory.
    check
        Whether every chunk of the cube is compared with the sha256 in its commit record when it is read. The
        default is True, unless the environment has ``MAGPEND_VERIFY=0``.

    Returns
    -------
    Dataset or DataTree
        The attributes of the cube hold the model's name, the specification's TOML text, the settings of the
        integration and the provenance. The root of a tree has the run's ``title``, its ``cells``, the number of
        cells ``computed``, those ``pending``, and ``left_out``. A result has its options in ``derived_options``.

    Raises
    ------
    RefusedError
        If there is no run in `path`.
    DamagedError
        If ``run.json``, metadata or coordinates have changed since they were written. When a cell is used later:
        if its chunk is missing or has changed.

    Examples
    --------
    >>> ds = open_run("runs/quickstart")                                    # doctest: +SKIP
    >>> open_run("runs/quickstart", tree=True)["attractors"].n_cells        # doctest: +SKIP
    """
    opened = Run.open(path)
    return opened.tree(chunks, check=check) if tree else opened.cube(chunks, check=check)


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

    return pd.DataFrame(shown(found).rows)


def shown(found: xr.Dataset) -> Table:
    """Return the table of an analysis' result; raise ValueError if the Dataset is none of an analysis with a table."""
    name = str(found.attrs.get("derived_product", ""))
    if name not in ANALYSES or not ANALYSES[name].table:
        known = ", ".join(key for key, analysis in ANALYSES.items() if analysis.table)
        raise ValueError(f"the Dataset is not the result of an analysis that has a table ({known}).")
    return shown_table(name, found)


def _tree_of(run: Run, chunks: Any, check: bool | None) -> xr.DataTree:
    """Return the cube and the kept results of a run as a tree."""
    import xarray as xr

    nodes = {"cube": run.cube(chunks, check=check)}
    for name in ANALYSES.listed:
        for k, result in enumerate(stored_each(run, name, lazy=True)):
            folder = str(result.encoding["source"]).rpartition("/")[2]
            nodes[folder.removesuffix(".zarr") if k else name] = result if chunks is None else result.chunk(chunks)
    attrs = {
        "title": run.info.title,
        "source": str(nodes["cube"].attrs["source"]),
        "digest": run.info.digest,
        "cells": run.plan.n_cells,
        "computed": run.n_committed,
        "pending": run.plan.n_cells - run.n_committed,
        "left_out": [name.rpartition("/")[2] for name in stale(run)],
    }
    return xr.DataTree.from_dict({"/": xr.Dataset(attrs=attrs), **nodes}, name=run.name.rpartition("/")[2])
