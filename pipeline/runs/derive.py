"""Compute the analyses of a run, each once, and store their results in the run's folder ``derived/``.

A result's key holds everything that decides its numbers: the digest of the committed cells, the analysis'
name, its options, and its version (`pipeline.runs.versions.version_of`). `derive` returns the stored result with that
key, or computes it. A damaged or incomplete result is computed again. A result of an earlier cube or an
earlier version is never read; it stays until `prune` is called.

Each result is a zarr group such as ``derived/attractors-1a2b3c4d.zarr``. ``xarray.open_zarr(path)`` reads it.
The attribute ``derived_options`` holds the options as JSON. Labels (``state``, ``direction``) are codes with
the attribute ``words``. If two processes derive the same result at once, both compute it, and one of the equal
results stays.

A run has one set of attractors, and one set of branches along each parameter. Its other analyses and its figures
rest on them. `pipeline.runs.choices` keeps the options with which they were last found; results that rest on others
are stale.

docs/adding.md tells how to add an analysis.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magpend_core.precision import Precision
from pipeline.layout.columns import described
from pipeline.layout.conventions import conventional
from pipeline.layout.own_words import in_own_words, rate_attribute, rate_of, with_own_names, with_plain_names
from pipeline.layout.vocabulary import axis_name, model_attribute, overrides_attribute, parameter_name
from pipeline.products.product import Analysis, Figure, Options, Table, function_of
from pipeline.products.registry import ANALYSES
from pipeline.products.reporting import silent
from pipeline.runs.beside import refine, runs_at
from pipeline.runs.choices import Choices, branches_in_words, changed_branches, chosen_options, is_choice
from pipeline.runs.naming import named
from pipeline.runs.progress import bar_in_notebook
from pipeline.runs.suitability import unsuited
from pipeline.runs.versions import current, key_of
from pipeline.specification.problems import SpecError, unknown_name, validated
from pipeline.store.errors import DamagedError
from pipeline.store.files import DERIVED, Files
from pipeline.store.local import unwritable
from pipeline.store.products import (
    blocks_beside,
    blocks_in,
    leftover_products,
    open_product,
    products_in,
    read_product_attrs,
    remove_product,
    write_product,
)
from pipeline.store.run import RunDirectory

if TYPE_CHECKING:
    import xarray as xr

    from pipeline.analysis.branches.declaration import BranchOptions
    from pipeline.compute.clients import Where

Echo = Callable[[str], None]
Source = str | Path | RunDirectory

_LEFTOVER_SECONDS = 3600.0


@dataclass(frozen=True, repr=False)
class AnalysedRun(RunDirectory):
    """An opened run for analyses; an analysis gets from it the results of other analyses."""

    echo: Echo = silent  # function that prints a line
    # number of threads or processes for blocks, see `pipeline.compute.execute.run_tasks`; of threads of the engine for
    # an analysis without blocks
    workers: int | None = None
    where: Where | None = None  # place of the computation of blocks

    @classmethod
    def of(cls, source: Source, echo: Echo | None = None, **places: Any) -> AnalysedRun:
        """Open a run directory for analyses, or convert a run that is open already."""
        run = RunDirectory.open(source)
        if isinstance(run, AnalysedRun) and echo is None and not places:
            return run
        return cls(run.info, run.commits, run.known, echo or silent, **places)

    def derive(self, name: str, **options: Any) -> xr.Dataset:
        """Return the result of an analysis of this run with plain names, computed now or read if it is stored.

        Options of attractors or branches that differ from those of the run do not hold for the run.
        """
        return with_plain_names(_derived(self, name, _validated(name, options)))

    def branch_options(self, parameter: str) -> BranchOptions:
        """Return the options of the run's branches along a parameter: those last given, or the defaults."""
        return Choices.of(self).along(parameter_name(parameter))

    def with_values(self, values: Sequence[float]) -> AnalysedRun:
        """Return the run beside this one that has further values of the swept parameter, see `beside.refine`; its
        attractors and branches are found with the same options.
        """
        beside = refine(self, values, workers=self.workers, where=self.where, echo=self.echo)
        return self if beside is self else self._beside(beside)

    def at_points(self, points: Sequence[Mapping[str, float]], n_starts: int | Sequence[int]) -> list[AnalysedRun]:
        """Return the runs beside this one at single points of the swept parameters, see `beside.runs_at`; their
        attractors and branches are found with the same options.
        """
        found = runs_at(self, points, n_starts, workers=self.workers, where=self.where, echo=self.echo)
        return [self._beside(run) for run in found]

    def _beside(self, run: RunDirectory) -> AnalysedRun:
        """Open a run beside this one for analyses, with the same places and choices."""
        found = AnalysedRun.of(run, self.echo, workers=self.workers, where=self.where)
        if (chosen := Choices.of(self)) != Choices.of(found):
            chosen.keep(found)
        return found


def derive(
    source: Source,
    name: str,
    options: Mapping[str, Any] | Options | None = None,
    *,
    echo: Echo | None = None,
    workers: int | None = None,
    scheduler: Where | str | None = None,
) -> xr.Dataset:
    """Return the result of an analysis of a run. It is read if it is stored, or else computed and stored.

    Parameters
    ----------
    source
        Run directory, or an opened run.
    name
        One of `pipeline.products.registry.ANALYSES`.
    options
        Options that differ from the defaults.
    echo
        Function that prints a line about each computation and its reason.
    workers
        Number of threads or processes, see `pipeline.compute.execute.run_tasks`; of threads for an analysis that is
        not computed in blocks.
    scheduler
        Where blocks are computed.

    Returns
    -------
    Dataset
        Result in memory. ``encoding["source"]`` is its folder; it is absent if the result could not be
        written.

    Raises
    ------
    SpecError
        If the analysis or an option is unknown or out of bounds, or if the run does not suit the analysis.
    RefusedError
        If there is no run.
    DamagedError
        If a chunk of the cube is damaged.
    """
    wanted = options if isinstance(options, Options) else _validated(name, options or {})
    places: dict[str, Any] = {"workers": workers} if workers is not None else {}
    if scheduler is not None:
        from pipeline.compute.clients import Where

        places["where"] = Where.of(scheduler)
        places["where"].resolved()
    run = AnalysedRun.of(source, echo, **places)
    result = _derived(run, name, wanted)
    if is_choice(wanted):
        Choices.of(run).having(named(run, wanted)).keep(run)
    return result


def _validated(name: str, options: Mapping[str, Any]) -> Options:
    if name not in ANALYSES:
        raise SpecError(unknown_name("analysis", name, ANALYSES))
    return validated(ANALYSES[name].options, options)


def _derived(run: AnalysedRun, name: str, wanted: Options) -> xr.Dataset:
    analysis = ANALYSES[name]
    is_given, wanted = is_choice(wanted), prepared(run, analysis, wanted)
    if name == "branches" and not is_given:
        for line in branches_in_words(changed_branches(run, wanted.plain()["parameter"]), run.spec.rate):
            run.echo(line)
    key = key_of(current(run, name, wanted.plain()), analysis, wanted)
    told = {**overrides_attribute(run.spec.parameters.overrides), **rate_attribute(run.spec.rate)}
    place = run.info.files.below(DERIVED).below(f"{name}-{key['derived_key'][:8]}.zarr")
    try:
        ds = open_product(place)
        if all(ds.attrs.get(part) == value for part, value in key.items()):
            run.echo(f"{name}: taken from {place.name}")
            return _placed(ds.assign_attrs(told), place)
    except FileNotFoundError:
        pass
    except DamagedError as error:
        run.echo(f"{name}: damaged ({error}); computing it again")
    why = unwritable(place.local.parent) if place.local is not None else ""
    if why:
        run.echo(f"{why}: the result of {name} is shown but not kept")
    with bar_in_notebook():
        computed = _compute(run, analysis, wanted, can_keep=not why)
        others = {k: value for k, value in computed.attrs.items() if k not in key}
        others.setdefault("model", model_attribute(run.model))
        complete = computed.drop_attrs(deep=False).assign_attrs({**others, **key, **told})
        return _kept(run, place, with_own_names(complete, analysis.columns))


def shown_table(name: str, ds: xr.Dataset) -> Table:
    """Return the table of an analysis' result, in the words of the run's specification."""
    from pipeline.results.tabular import shown

    analysis, plain = ANALYSES[name], in_own_words(ds)
    order = [column.name for column in analysis.columns if column.name in plain.data_vars]
    table = shown(plain[[*order, *(n for n in plain.data_vars if n not in order)]], function_of(analysis.table))
    basis = [f"on {line}" for line in branches_in_words(ds.attrs.get("branch_options", "{}"), rate_of(ds))]
    return replace(table, lines=[*table.lines, *(["", *basis] if basis else [])])


def analyses_in(text: str) -> list[str]:
    """Return the analyses that a list names, such as ``attractors,basins``.

    Raises
    ------
    SpecError
        If one is unknown, or cannot be computed with its defaults.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        if name not in ANALYSES.listed:
            raise SpecError(f"--analyse: {unknown_name('analysis', name, ANALYSES.listed)}")
        validated(ANALYSES[name].options, {})
    return names


def stored(source: Source, name: str) -> xr.Dataset | None:
    """Return the stored result of an analysis for the present cells of a run; None if there is none.

    Parameters
    ----------
    source
        Run directory, or an opened run.
    name
        One of `pipeline.products.registry.ANALYSES`.

    Returns
    -------
    Dataset or None
        Result in memory; None if there is none. Among several sound results of these cells and this version
        of the code it is the one with the fewest options other than the defaults, or than those of the run's
        attractors and branches; then the first by name. Branches along an axis of the run come first.
    """
    return next(stored_each(source, name), None)


def stored_each(source: Source, name: str, *, lazy: bool = False) -> Iterator[xr.Dataset]:
    """Yield all stored results of an analysis for the present cells of a run, in the order in which `stored` prefers
    them.

    Parameters
    ----------
    source
        Run directory, or an opened run.
    name
        One of `pipeline.products.registry.ANALYSES`.
    lazy
        Whether numbers are read when they are used.
    """
    run = RunDirectory.open(source)
    folder = run.info.files.below(DERIVED)
    places = [p for p in products_in(folder) if p.name.rpartition("/")[2].startswith(f"{name}-")]
    if not places:
        return
    found = []
    for place in places:
        with contextlib.suppress(DamagedError, FileNotFoundError):
            attrs = read_product_attrs(place)
            if is_current(run, name, attrs):
                along = axis_name(options_of(attrs).get("parameter", ""))
                is_beside = along not in ("", *map(axis_name, run.spec.axes))
                order = changed_options(run, name, attrs), is_beside, place.name
                found.append((*order, place))
    for *_, place in sorted(found, key=lambda entry: entry[:3]):
        try:
            result = _placed(open_product(place, lazy=lazy), place)
        except (DamagedError, FileNotFoundError):
            continue
        yield result


def is_current(run: RunDirectory, name: str, attrs: Mapping[str, Any]) -> bool:
    """Return whether the attributes are those of a result of an analysis that holds for a run as it is."""
    return all(attrs.get(key) == value for key, value in current(run, name, options_of(attrs)).items())


def changed_options(run: RunDirectory, name: str, attrs: Mapping[str, Any]) -> int:
    """Return the number of options of a stored result that differ from the defaults, or from those of the run's
    attractors, or branches along the same parameter.
    """
    given = options_of(attrs)
    along = {"parameter": given["parameter"]} if name == "branches" else {}
    try:
        options = prepared(AnalysedRun.of(run), ANALYSES[name], validated(ANALYSES[name].options, along)).plain()
    except SpecError:  # the run does not suit the defaults
        options = {}
    return sum(options.get(key) != value for key, value in given.items())


def options_of(attrs: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options with which a stored result was computed; raise DamagedError if they cannot be read."""
    try:
        given = json.loads(str(attrs.get("derived_options", "{}")))
    except ValueError:
        given = None
    if not isinstance(given, dict):
        raise DamagedError("its attribute derived_options is not a table in JSON")
    return given


def prepared(run: AnalysedRun, product: Analysis | Figure, options: Options) -> Options:
    """Complete the options of an analysis or figure from the run: full names, missing values, and the run's choice of
    attractors and branches.

    Raises
    ------
    SpecError
        If the run does not suit the product; the message names the directory.
    """
    with refused(run.name):
        if reason := unsuited(run.spec.motion, product):
            raise ValueError(reason)
        options = chosen_options(run, named(run, options))
        if product.needs:
            function_of(product.needs)(run, options)
        settle = getattr(product, "settle", "")
        options = function_of(settle)(run, options) if settle else options
    return options


@contextlib.contextmanager
def refused(directory: str | Path) -> Iterator[None]:
    """Add the name of the run directory to errors of an analysis or figure inside this context."""
    try:
        yield
    except SpecError:
        raise
    except ValueError as error:
        if "checksum" in str(error).lower():
            raise DamagedError(f"{directory}: a chunk is damaged; check with: magpend verify {directory}") from None
        if hasattr(error, "problems"):  # parameters out of bounds say enough themselves
            raise
        raise SpecError(f"{directory}: {error}") from None


def _compute(run: AnalysedRun, analysis: Analysis, options: Options, *, can_keep: bool) -> xr.Dataset:
    """Compute a result, in blocks if it has any and they can be kept, otherwise on threads of the engine."""
    from threadpoolctl import threadpool_limits

    from magpend_core.engine.threads import using_threads
    from pipeline.runs.blocks import computed_at_once, in_blocks

    started = time.perf_counter()
    threads = contextlib.nullcontext() if run.workers is None else using_threads(max(run.workers, 1))
    # matrices are so small that threads of linear algebra would wait for each other
    with refused(run.name), threads, threadpool_limits(1), Precision.of(run.cube().attrs).used():
        is_divided = bool(analysis.parts) or (analysis.by_point and not getattr(options, "at", None))
        result = (in_blocks if is_divided and can_keep else computed_at_once)(run, analysis, options)
        if analysis.finish:
            result = function_of(analysis.finish)(run, result, options)
        result = described(result, analysis.columns, run.model)
    run.echo(f"{analysis.name}: computed in {time.perf_counter() - started:.1f} s")
    return result


def _kept(run: AnalysedRun, place: Files, result: xr.Dataset) -> xr.Dataset:
    try:
        write_product(place, result)
    except OSError as error:
        kept = place.name.rpartition("/")[2]
        run.echo(f"{kept}: not kept ({error}); the result is shown all the same")
        return conventional(result)
    remove_product(blocks_beside(place))
    return _placed(open_product(place), place)


def _placed(stored: xr.Dataset, place: Files) -> xr.Dataset:
    ds = conventional(stored)
    ds.encoding["source"] = place.name
    return ds


def stale(source: Source) -> list[str]:
    """Return the paths of stored results that are outdated, damaged or incomplete.

    Outdated results belong to an earlier cube or an earlier version. A leftover was begun by a
    process that was killed. Leftovers younger than an hour may belong to a running process and are not
    listed. Blocks of results that are not complete are listed.
    """
    return [place.name for place in _stale(RunDirectory.open(source))]


def _stale(run: RunDirectory) -> list[Files]:
    folder = run.info.files.below(DERIVED)

    def is_stale(place: Files) -> bool:
        try:
            attrs = read_product_attrs(place)
            name = str(attrs.get("derived_product"))
            return name not in ANALYSES or not is_current(run, name, attrs)
        except DamagedError:
            return True

    products = [place for place in products_in(folder) if is_stale(place)]
    return products + blocks_in(folder) + leftover_products(folder, older_than=_LEFTOVER_SECONDS)


def prune(source: Source) -> list[str]:
    """Remove the stored results that `stale` lists, and return their paths."""
    found = _stale(RunDirectory.open(source))
    for place in found:
        remove_product(place)
    return [place.name for place in found]
