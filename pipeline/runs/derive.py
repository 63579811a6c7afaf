"""Results of analyses, computed once and kept in a run's ``derived/``.

A result is named by what decides its numbers: the digest of the committed cells, the analysis' name, its
options, and the version of its code (`code_version`). `derive` returns what is stored under that name and
computes it otherwise. A result that is damaged, or was left half written, is computed again; one of an
earlier cube or an earlier version of the code stays until `prune` is called, and is never read.

Each is a zarr group such as ``derived/attractors-1a2b3c4d.zarr``, readable by
``xarray.open_zarr(path, consolidated=False)``: options as JSON in the attribute ``derived_options``, words
(``state``, ``direction``) as codes with the attribute ``words``. Two processes may derive at once: both
compute, one of the two equal results stays.

What was shown of a set by a longer extension holds for every analysis from then on: options that ask for less
are raised to the largest budget with which attractors are kept (`most_evidence`), so that no two results
contradict each other.

To add an analysis see `pipeline.products.product`.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.products.attractors import IdentifyOptions
from pipeline.products.product import Analysis, Options, function_of
from pipeline.products.registry import ANALYSES
from pipeline.runs.naming import named
from pipeline.runs.versions import code_version
from pipeline.spec.problems import SpecError, unknown_name, validated
from pipeline.store.errors import DamagedError
from pipeline.store.files import DERIVED, Files
from pipeline.store.local import unwritable
from pipeline.store.products import (
    leftover_products,
    open_product,
    products_in,
    read_product_attrs,
    remove_product,
    write_product,
)
from pipeline.store.run import Run

if TYPE_CHECKING:
    import xarray as xr

Echo = Callable[[str], None]
Source = str | Path | Run

_LEFTOVER_SECONDS = 3600.0


def _silent(_: str) -> None:
    pass


@dataclass(frozen=True, repr=False)
class AnalysedRun(Run):
    """A run as analyses see it: with the other analyses of the same cells.

    Attributes
    ----------
    echo : callable
        Prints a line.
    """

    echo: Echo = _silent

    @classmethod
    def of(cls, source: Source, echo: Echo | None = None) -> AnalysedRun:
        """Return what stands in a run directory now, or the cells that an opened run speaks of."""
        run = Run.open(source)
        if isinstance(run, AnalysedRun) and echo is None:
            return run
        return cls(**{f.name: getattr(run, f.name) for f in fields(Run)}, echo=echo or _silent)

    def derive(self, name: str, **options: Any) -> xr.Dataset:
        """Another analysis of the same cells; see `derive`."""
        return derive(self, name, options)


def derive(
    source: Source,
    name: str,
    options: Mapping[str, Any] | Options | None = None,
    *,
    echo: Echo | None = None,
) -> xr.Dataset:
    """Return what an analysis finds in a run, stored or computed.

    Parameters
    ----------
    source
        Run directory, or an opened run.
    name
        One of `pipeline.products.registry.ANALYSES`.
    options
        Those that are not as by default.
    echo
        Prints a line; says what is computed, and why.

    Returns
    -------
    Dataset
        In memory; ``encoding["source"]`` is its folder, absent if it could not be written.

    Raises
    ------
    SpecError
        If the analysis or an option is unknown or out of bounds, or the run has not what it takes.
    RefusedError
        If there is no run.
    DamagedError
        If a chunk of the cube is damaged.
    """
    if name not in ANALYSES:
        raise SpecError([unknown_name("analysis", name, ANALYSES)])
    analysis = ANALYSES[name]
    wanted = options if isinstance(options, Options) else validated(analysis.options, options or {})
    run = AnalysedRun.of(source, echo)
    _refuse_recorded(run, name)
    wanted = prepared(run, analysis, wanted)
    key = _key(run, analysis, wanted)
    place = run.info.files.below(DERIVED).below(f"{name}-{key['derived_key'][:8]}.zarr")
    try:
        ds = open_product(place)
        if all(ds.attrs.get(part) == value for part, value in key.items()):
            run.echo(f"{name}: taken from {place.name}")
            return _placed(ds, place)
    except FileNotFoundError:
        pass
    except DamagedError as error:
        run.echo(f"{name}: damaged ({error}); computing it again")
    if place.local is not None and (problem := unwritable(place.local.parent)):
        run.echo(f"{problem}: what {name} finds is shown, and not kept")
    return _kept(run, place, _compute(run, analysis, wanted).assign_attrs(key))


def stored(source: Source, name: str) -> xr.Dataset | None:
    """Return what is kept of an analysis of a run's cells as they are now; nothing is computed.

    Parameters
    ----------
    source
        Run directory, or an opened run.
    name
        One of `pipeline.products.registry.ANALYSES`.

    Returns
    -------
    Dataset or None
        In memory: of the sound results of these cells and this version of the code that with the fewest
        options other than by default, the first by its name among equals; None if there is none.
    """
    run = Run.open(source)
    folder = run.info.files.below(DERIVED)
    places = [p for p in products_in(folder) if p.name.rpartition("/")[2].startswith(f"{name}-")]
    if not places:  # then the version, which takes a moment, does not matter
        return None
    current = {"cube_digest": run.digest, "analysis_version": code_version(name), "derived_product": name}
    found = []
    for place in places:
        with contextlib.suppress(DamagedError, FileNotFoundError):
            attrs = read_product_attrs(place)
            if all(attrs.get(key) == value for key, value in current.items()) and not is_outdone(run, attrs):
                found.append((_changed_options(run, name, attrs), place.name, place))
    for _, _, place in sorted(found, key=lambda entry: entry[:2]):
        with contextlib.suppress(DamagedError, FileNotFoundError):
            return _placed(open_product(place), place)
    return None


def _changed_options(run: Run, name: str, attrs: Mapping[str, Any]) -> int:
    """Number of options of a result that are other than by default."""
    try:
        options = prepared(AnalysedRun.of(run), ANALYSES[name], validated(ANALYSES[name].options, {})).plain()
    except SpecError:  # the run has not what they take
        options = {}
    return sum(options.get(key) != value for key, value in _options_of(attrs).items())


def _options_of(attrs: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that a kept result was computed with.

    Raises
    ------
    DamagedError
        If they cannot be read.
    """
    try:
        given = json.loads(str(attrs.get("derived_options", "{}")))
    except ValueError:
        given = None
    if not isinstance(given, dict):
        raise DamagedError("its attribute derived_options is not a table in JSON")
    return given


def _refuse_recorded(run: Run, name: str) -> None:
    """Refuse a run under a recorded drive: an analysis runs cells on, under a drive that goes on."""
    if run.spec.recorded is not None:
        raise SpecError([
            f"{run.name}: its drive is the recording {run.spec.recorded.file}, and {name} goes on where "
            "it ends. For attractors and what rests on them make a run at its mean frequency (frequency_hz = "
            f"{run.spec.frequency_hz:.6g} instead of [drive]); this one's sections can be drawn: magpend "
            "plot bifurcation, or section."
        ])  # fmt: skip


def prepared(run: AnalysedRun, product: Any, options: Options) -> Options:
    """Return options with the run's own names, completed from it, once it has what a product takes.

    Raises
    ------
    SpecError
        If it has not, with the directory's name.
    """
    with refused(run.name):
        options = named(run, options)
        if product.needs:
            function_of(product.needs)(run, options)
        settle = getattr(product, "settle", "")
        options = function_of(settle)(run, options) if settle else options
    return most_evidence(run, options)


def most_evidence(run: Run, options: Options) -> Options:
    """Return options with the largest effort of extension among the kept attractors that they would find.

    Options without one are returned as they are.
    """
    if not isinstance(options, IdentifyOptions):
        return options
    own = IdentifyOptions(**options.part(IdentifyOptions))
    kept = [effort for told, effort in _kept_efforts(run) if told == _aside(own)]
    return options.with_effort(max([own.effort, *kept]))


def _kept_efforts(run: Run) -> list[tuple[dict[str, Any], tuple[float, int]]]:
    """Other options and effort of each kept search for attractors of these cells by this code."""
    try:
        kept_here = products_in(run.info.files.below(DERIVED))
    except NotADirectoryError:
        return []
    places = [p for p in kept_here if p.name.rpartition("/")[2].startswith("identified-")]
    if not places:
        return []
    current = {"cube_digest": run.digest, "analysis_version": code_version("identified")}
    found = []
    for place in places:
        with contextlib.suppress(DamagedError, FileNotFoundError, ValueError):
            attrs = read_product_attrs(place)
            if all(attrs.get(key) == value for key, value in current.items()):
                kept = IdentifyOptions.model_validate(_options_of(attrs))
                found.append((_aside(kept), kept.effort))
    return found


def _aside(options: IdentifyOptions) -> dict[str, Any]:
    """Options aside from the effort."""
    effort = ("extend", "budget", "n_sample")
    return {name: value for name, value in options.plain().items() if name not in effort}


def is_outdone(run: Run, attrs: Mapping[str, Any]) -> bool:
    """Whether a kept result rests on less evidence than is kept by now."""
    name, given = str(attrs.get("derived_product")), _options_of(attrs)
    if name not in ANALYSES or not issubclass(ANALYSES[name].options, IdentifyOptions):
        return False
    own = IdentifyOptions.model_validate({k: given[k] for k in IdentifyOptions.model_fields if k in given})
    return bool(most_evidence(run, own) != own)


@contextlib.contextmanager
def refused(directory: str | Path) -> Iterator[None]:
    """Turn what an analysis or a figure refuses into a sentence with the directory's name."""
    try:
        yield
    except SpecError:
        raise
    except ValueError as error:
        if "checksum" in str(error).lower():
            raise DamagedError(
                f"{directory}: a chunk is damaged; look with: magpend verify {directory}"
            ) from None
        if hasattr(error, "problems"):  # parameters out of bounds say enough themselves
            raise
        raise SpecError([f"{directory}: {error}"]) from None


def _key(run: Run, analysis: Analysis, options: Options) -> dict[str, str]:
    """Attributes that name a result."""
    plain = {name: value for name, value in options.plain().items() if name not in analysis.ignores}
    parts = {
        "derived_product": analysis.name,
        "derived_options": json.dumps(plain, sort_keys=True),
        "cube_digest": run.digest,
        "analysis_version": code_version(analysis.name),
    }
    return {**parts, "derived_key": hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()}


def _compute(run: AnalysedRun, analysis: Analysis, options: Options) -> xr.Dataset:
    started = time.perf_counter()
    with refused(run.name):
        result: xr.Dataset = function_of(analysis.compute)(run, options)
    run.echo(f"{analysis.name}: computed in {time.perf_counter() - started:.1f} s")
    return result


def _kept(run: AnalysedRun, place: Files, result: xr.Dataset) -> xr.Dataset:
    try:
        write_product(place, result)
    except OSError as error:
        kept = place.name.rpartition("/")[2]
        run.echo(f"{kept}: not kept ({error}); what was found is shown all the same")
        return result
    return _placed(open_product(place), place)


def _placed(ds: xr.Dataset, place: Files) -> xr.Dataset:
    ds.encoding["source"] = place.name
    return ds


def stale(source: Source) -> list[str]:
    """Places of results of an earlier cube or an earlier version of the code, damaged ones, and leftovers.

    A leftover is what a process that was killed had begun to write; one younger than an hour may
    belong to a process at work and is not listed.
    """
    return [place.name for place in _stale(Run.open(source))]


def _stale(run: Run) -> list[Files]:
    folder = run.info.files.below(DERIVED)

    def is_stale(place: Files) -> bool:
        try:
            attrs = read_product_attrs(place)
            name = str(attrs.get("derived_product"))
            if name not in ANALYSES or attrs.get("cube_digest") != run.digest:
                return True
            return bool(attrs.get("analysis_version") != code_version(name)) or is_outdone(run, attrs)
        except DamagedError:
            return True

    products = [place for place in products_in(folder) if is_stale(place)]
    return products + leftover_products(folder, older_than=_LEFTOVER_SECONDS)


def prune(source: Source) -> list[str]:
    """Remove what `stale` lists; returns it."""
    found = _stale(Run.open(source))
    for place in found:
        remove_product(place)
    return [place.name for place in found]
