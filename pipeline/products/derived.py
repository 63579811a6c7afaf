"""Analysis products of a run directory, computed once and kept in ``derived/``.

A product is named by what decides its numbers: the digest of the committed cells, the product's name,
its options and the version of the analysis code. `derive` returns what is stored under that name and
computes it otherwise. A product that is damaged, or was left half written, is computed again; one of
an earlier cube or an earlier version of the code stays until `prune` is called, and is never read.

Each is a zarr group such as ``derived/attractors-1a2b3c4d.zarr``, readable by
``xarray.open_zarr(path, consolidated=False)``: options as JSON in the attribute ``derived_options``, words
(``state``, ``link``, ``direction``) as codes with the attribute ``words``. Two processes may derive at
once: both compute, one of the two equal results stays.

To add a product: write a function from the cube to a Dataset in `pipeline.analysis` and call `derive`,
as `attractors` does.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.spec.problems import SpecError, unknown_key
from pipeline.store.errors import DamagedError
from pipeline.store.files import DERIVED
from pipeline.store.products import (
    leftover_products,
    open_product,
    product_paths,
    read_product_attrs,
    remove_product,
    write_product,
)
from pipeline.store.run import Run

if TYPE_CHECKING:
    import xarray as xr

Echo = Callable[[str], None]

_LEFTOVER_SECONDS = 3600.0
_ANALYSIS = Path(__file__).parents[1] / "analysis"


Source = str | Path | Run


@lru_cache
def analysis_version() -> str:
    """Digest of the code that products depend on: the sources of `pipeline.analysis`, and the kernel."""
    from magpend_core import kernel_version

    digest = hashlib.sha256(kernel_version().encode())
    for path in sorted(_ANALYSIS.rglob("*.py")):
        digest.update(path.relative_to(_ANALYSIS).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def derive(
    source: Source,
    product: str,
    options: Mapping[str, Any],
    compute: Callable[[Run], xr.Dataset],
    echo: Echo | None = None,
) -> xr.Dataset:
    """Return a product of a run, stored or computed.

    Parameters
    ----------
    source
        Run directory, or one that has been opened.
    product
        Name of the product; begins the name of its folder.
    options
        All that `compute` depends on besides the cells and the code: JSON values, defaults filled in.
    compute
        Called with the snapshot if the product is not stored; ``snapshot.cube()`` gives the cube, and
        another product derived from the snapshot speaks of the same cells.
    echo
        Prints a line; says what is computed, and why.

    Returns
    -------
    Dataset
        In memory; ``encoding["source"]`` is its folder, absent if it could not be written.

    Raises
    ------
    RefusedError
        If there is no run.
    DamagedError
        If a chunk of the cube is damaged.
    """
    say = echo or _silent
    snapshot = Run.open(source)
    key = _key(snapshot, product, options)
    path = snapshot.info.directory / DERIVED / f"{product}-{key['derived_key'][:8]}.zarr"
    try:
        ds = open_product(path)
        if all(ds.attrs.get(name) == value for name, value in key.items()):
            say(f"{product}: taken from {path}")
            return _placed(ds, path)
    except FileNotFoundError:
        pass
    except DamagedError as error:
        say(f"{product}: damaged ({error}); computing it again")
    started = time.perf_counter()
    result = _compute(snapshot, compute).assign_attrs(key)
    say(f"{product}: computed in {time.perf_counter() - started:.1f} s")
    try:
        write_product(path, result)
    except PermissionError as error:
        say(f"{product}: not kept ({error})")
        return result
    return _placed(open_product(path), path)


def _silent(_: str) -> None:
    pass


def _placed(ds: xr.Dataset, path: Path) -> xr.Dataset:
    ds.encoding["source"] = str(path)
    return ds


def _key(snapshot: Run, product: str, options: Mapping[str, Any]) -> dict[str, str]:
    """Attributes that name a product."""
    parts = {
        "derived_product": product,
        "derived_options": json.dumps(options, sort_keys=True),
        "cube_digest": snapshot.digest,
        "analysis_version": analysis_version(),
    }
    return {**parts, "derived_key": hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()}


def _compute(snapshot: Run, compute: Callable[[Run], xr.Dataset]) -> xr.Dataset:
    try:
        return compute(snapshot)
    except ValueError as error:
        if "checksum" not in str(error).lower():
            raise
        directory = snapshot.info.directory
        raise DamagedError(
            f"{directory}: a chunk is damaged; look with: magpend verify {directory}"
        ) from None


# ---- products ----------------------------------------------------------------------------------


def attractors(directory: Source, *, echo: Echo | None = None, **options: Any) -> xr.Dataset:
    """Attractors of a run, found, named and followed along its axes.

    Parameters
    ----------
    directory
        Run directory, or an opened `Run`.
    echo
        Prints a line.
    options
        Those of `pipeline.analysis.attractors.attractors.identify` and `match` that have numbers; those of
        `bounded.Rule` with the prefix ``rule_``. `attractor_defaults` lists them.

    Returns
    -------
    Dataset
        See `pipeline.analysis.attractors`, ``matched`` 1. What `identify` finds is kept as a product
        of its own, so that other options of `match` integrate nothing.

    Raises
    ------
    SpecError
        If an option is unknown.
    """
    from pipeline.analysis.attractors.attractors import match

    wanted = _with_defaults("attractors", options, attractor_defaults())
    matching = {name: wanted.pop(name) for name in _defaults_of(match)}

    def compute(snapshot: Run) -> xr.Dataset:
        return match(derive(snapshot, "identified", wanted, lambda s: _identify(s, wanted), echo), **matching)

    return derive(directory, "attractors", {**wanted, **matching}, compute, echo)


def attractor_defaults() -> dict[str, Any]:
    """Options of `attractors` with their defaults."""
    from pipeline.analysis.attractors.attractors import Rule, identify, match

    rule = {f"rule_{name}": value for name, value in asdict(Rule()).items()}
    # a product's options are plain values: 0 asks for the tolerance that follows from the run
    return {**_defaults_of(identify), "tolerance": 0.0, **rule, **_defaults_of(match)}


def basins(directory: Source, *, echo: Echo | None = None, **options: Any) -> xr.Dataset:
    """Basins of a sweep: cells, fractions, boundaries.

    Parameters
    ----------
    directory, echo
        As in `attractors`.
    options
        Those of `attractors` and of `pipeline.analysis.basins.basins.basins`. `basin_defaults` lists them.

    Returns
    -------
    Dataset
        See `pipeline.analysis.basins.basins.basins`.

    Raises
    ------
    SpecError
        If an option is unknown or out of bounds, or the run is no sweep of initial conditions.
    """
    from pipeline.analysis.basins.basins import basins as compute
    from pipeline.analysis.basins.basins import check_basin_options, check_starts

    snapshot = Run.open(directory)
    wanted = _with_defaults("basins", options, basin_defaults())
    own = {name: wanted[name] for name in _defaults_of(compute)}
    shared = {name: value for name, value in wanted.items() if name not in own}
    with _refused(snapshot):
        check_basin_options(**own)
        check_starts(snapshot.cube())
    return derive(
        snapshot,
        "basins",
        wanted,
        lambda s: compute(s.cube(), attractors(s, echo=echo, **shared), **own),
        echo,
    )


def basin_defaults() -> dict[str, Any]:
    """Options of `basins` with their defaults."""
    from pipeline.analysis.basins.basins import basins as compute

    return {**attractor_defaults(), **_defaults_of(compute)}


def hysteresis(directory: Source, *, echo: Echo | None = None, **options: Any) -> xr.Dataset:
    """Hysteresis of a continuation in both directions: loops, and jumps between attractors.

    Parameters
    ----------
    directory, echo, options
        As in `attractors`.

    Returns
    -------
    Dataset
        See `pipeline.analysis.attractors.hysteresis.hysteresis`.

    Raises
    ------
    SpecError
        If an option is unknown, or the run is no continuation in both directions.
    """
    from pipeline.analysis.attractors.hysteresis import check_directions
    from pipeline.analysis.attractors.hysteresis import hysteresis as compute

    snapshot = Run.open(directory)
    wanted = _with_defaults("hysteresis", options, attractor_defaults())
    with _refused(snapshot):
        check_directions(snapshot.cube())
    return derive(
        snapshot, "hysteresis", wanted, lambda s: compute(s.cube(), attractors(s, echo=echo, **wanted)), echo
    )


def settling(directory: Source, *, echo: Echo | None = None, **options: Any) -> xr.Dataset:
    """Transient or attractor: a sample of every bounded set is run on.

    Parameters
    ----------
    directory, echo
        As in `attractors`.
    options
        Those of `attractors` and of `pipeline.analysis.attractors.lifetimes.lifetimes`.

    Returns
    -------
    Dataset
        See `pipeline.analysis.attractors.lifetimes`.

    Raises
    ------
    SpecError
        If an option is unknown or out of bounds.
    """
    from pipeline.analysis.attractors.lifetimes import lifetimes

    wanted = _with_defaults("settling", options, settling_defaults())
    shared = {name: wanted[name] for name in attractor_defaults()}
    own = {name: wanted[name] for name in _defaults_of(lifetimes)}
    return derive(
        directory, "settling", wanted,
        lambda s: lifetimes(s.cube(), attractors(s, echo=echo, **shared), **own), echo,
    )  # fmt: skip


def settling_defaults() -> dict[str, Any]:
    """Options of `settling` with their defaults."""
    from pipeline.analysis.attractors.lifetimes import lifetimes

    return {**attractor_defaults(), **_defaults_of(lifetimes)}


def chaos(directory: Source, *, echo: Echo | None = None, **options: Any) -> xr.Dataset:
    """Chaos of a run's cells: exponents, dimension, 0-1 test, and their means by kind of motion.

    Parameters
    ----------
    directory, echo
        As in `attractors`.
    options
        Those of `pipeline.analysis.chaos.chaos.chaos`.

    Returns
    -------
    Dataset
        See `pipeline.analysis.chaos.chaos.chaos`.

    Raises
    ------
    SpecError
        If an option is unknown or out of bounds, or the cube has neither exponents nor sections enough.
    """
    from pipeline.analysis.chaos.chaos import chaos as compute
    from pipeline.analysis.chaos.chaos import check_chaos

    snapshot = Run.open(directory)
    wanted = _with_defaults("chaos", options, chaos_defaults())
    with _refused(snapshot):
        check_chaos(snapshot.cube(), **wanted)
    return derive(snapshot, "chaos", wanted, lambda s: compute(s.cube(), **wanted), echo)


def chaos_defaults() -> dict[str, Any]:
    """Options of `chaos` with their defaults."""
    from pipeline.analysis.chaos.chaos import chaos as compute

    return _defaults_of(compute)


def dimension(
    directory: Source, *, at: Mapping[str, float] | None = None, echo: Echo | None = None, **options: Any
) -> xr.Dataset:
    """Correlation dimension of the chaotic sections of each parameter point.

    Parameters
    ----------
    directory, echo
        As in `attractors`.
    at
        Values of swept parameters; all points of the others are taken.
    options
        Those of `pipeline.analysis.chaos.chaos.section_dimension`.

    Returns
    -------
    Dataset
        See `pipeline.analysis.chaos.chaos.section_dimension`.

    Raises
    ------
    SpecError
        If an axis, a value or an option is unknown or out of bounds.
    """
    from pipeline.analysis.chaos.chaos import check_dimension, section_dimension
    from pipeline.analysis.selection import select_points

    snapshot = Run.open(directory)
    wanted = _with_defaults("dimension", options, dimension_defaults())
    with _refused(snapshot):
        check_dimension(snapshot.cube(), at=at, **wanted)
        part = select_points(snapshot.cube(), at)
    # the values that the axes have: another spelling of a point is the same product
    chosen = {name: float(part[name].values[0]) for name in at or {}}
    return derive(
        snapshot, "dimension", {"at": chosen, **wanted},
        lambda s: section_dimension(s.cube(), at=chosen, **wanted), echo,
    )  # fmt: skip


def dimension_defaults() -> dict[str, Any]:
    """Options of `dimension` with their defaults."""
    from pipeline.analysis.chaos.chaos import section_dimension

    return _defaults_of(section_dimension)


@contextlib.contextmanager
def _refused(snapshot: Run) -> Iterator[None]:
    """Turn what an analysis refuses into a sentence with the directory's name."""
    try:
        yield
    except ValueError as error:
        raise SpecError([f"{snapshot.info.directory}: {error}"]) from None


def _identify(snapshot: Run, options: Mapping[str, Any]) -> xr.Dataset:
    from pipeline.analysis.attractors.attractors import Rule, identify

    own = {name: value for name, value in options.items() if not name.startswith("rule_")}
    rule = {name.removeprefix("rule_"): value for name, value in options.items() if name not in own}
    if not own["tolerance"]:
        del own["tolerance"]
    return identify(snapshot.cube(), rule=Rule(**rule), **own)


_NO_OPTIONS = frozenset({"block_bytes"})
"""Parameters that change nothing in a result."""


def _defaults_of(function: Callable[..., Any]) -> dict[str, Any]:
    """Options of a function that are numbers or words."""
    return {
        name: parameter.default
        for name, parameter in inspect.signature(function).parameters.items()
        if isinstance(parameter.default, (bool, int, float, str)) and name not in _NO_OPTIONS
    }


_NOT_NEGATIVE = ("tolerance", "rtol", "atol")
_POSITIVE = ("residual", "mirror_threshold", "threshold", "rule_box", "rule_same_share")
_AT_LEAST_ONE = (
    "n_sample",
    "n_periods",
    "max_orbit_period",
    "n_points",
    "look_back",
    "rule_n_anchors",
    "rule_n_rounds",
)


def _with_defaults(product: str, options: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """All options of a product, checked, numbers in the type of their default."""
    problems = [unknown_key(f"{product}.{name}", name, defaults) for name in options if name not in defaults]
    found = dict(defaults)
    for name in options.keys() & defaults.keys():
        kind = type(defaults[name])
        try:
            found[name] = kind(options[name])
        except (TypeError, ValueError):
            found[name] = None
        if found[name] != options[name]:  # NaN is not itself
            words = {bool: "true or false", int: "a whole number", float: "a number", str: "a word"}
            problems.append(f"{name} = {options[name]!r}: must be {words[kind]}.")
        elif name in _POSITIVE and not found[name] > 0:
            problems.append(f"{name} = {options[name]!r} is out of bounds: it must be greater than 0.")
        elif name in _NOT_NEGATIVE and found[name] < 0:
            problems.append(
                f"{name} = {options[name]!r} is out of bounds: it must be 0 (default) or greater."
            )
        elif name == "confidence" and not 0 < found[name] < 1:
            problems.append(f"{name} = {options[name]!r} is out of bounds: it must lie between 0 and 1.")
        elif name in _AT_LEAST_ONE and found[name] < 1:
            problems.append(f"{name} = {options[name]!r} is out of bounds: it must be 1 or more.")
        elif name == "rule_same_share" and found[name] > 1:
            problems.append(f"{name} = {options[name]!r} is out of bounds: it must be at most 1.")
    if problems:
        raise SpecError(sorted(problems))
    return found


# ---- what is no longer wanted ------------------------------------------------------------------


def stale(source: Source) -> list[Path]:
    """Products of an earlier cube or an earlier version of the code, damaged ones, and leftovers.

    A leftover is what a process that was killed had begun to write; one younger than an hour may
    belong to a process at work and is not listed.
    """
    snapshot = Run.open(source)
    folder = snapshot.info.directory / DERIVED
    now = {"cube_digest": snapshot.digest, "analysis_version": analysis_version()}

    def is_stale(path: Path) -> bool:
        try:
            attrs = read_product_attrs(path)
        except DamagedError:
            return True
        return any(attrs.get(name) != value for name, value in now.items())

    products = [path for path in product_paths(folder) if is_stale(path)]
    return products + leftover_products(folder, older_than=_LEFTOVER_SECONDS)


def prune(source: Source) -> list[Path]:
    """Remove what `stale` lists; returns it."""
    found = stale(source)
    for path in found:
        remove_product(path)
    return found
