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

import hashlib
import inspect
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline import store
from pipeline.plan import Plan, make_plan
from pipeline.problems import SpecError, unknown_key
from pipeline.reading import open_committed
from pipeline.spec import parse_spec

if TYPE_CHECKING:
    import xarray as xr

Echo = Callable[[str], None]

_ANALYSIS = Path(__file__).parent / "analysis"


@dataclass(frozen=True)
class Snapshot:
    """A run directory with what was committed at one moment, so that all results speak of the same cells.

    Attributes
    ----------
    info : store.RunInfo
    plan : Plan
    commits : dict
        Valid markers by task.
    """

    info: store.RunInfo
    plan: Plan
    commits: Mapping[int, store.Commit]

    @classmethod
    def of(cls, directory: str | Path | Snapshot) -> Snapshot:
        """Return what stands in a run directory now; a snapshot is returned as it is.

        Raises
        ------
        store.RefusedError
            If there is no run in `directory`.
        """
        if isinstance(directory, Snapshot):
            return directory
        info = store.read_run(Path(directory))
        plan = make_plan(parse_spec(info.spec))
        return cls(info, plan, store.read_commits(info, plan))

    @cached_property
    def digest(self) -> str:
        """Digest of the committed cells."""
        return store.cube_digest(self.info, self.commits)

    def open(self, *, chunks: Any = None) -> xr.Dataset:
        """Open the cube, as `pipeline.open_run` does."""
        return open_committed(self.info, self.plan, self.commits, chunks=chunks)


Source = str | Path | Snapshot


@lru_cache
def analysis_version() -> str:
    """Digest of the code that products depend on: the sources of `pipeline.analysis`, and the kernel."""
    from magpend_core import kernel_version

    digest = hashlib.sha256(kernel_version().encode())
    for path in sorted(_ANALYSIS.glob("*.py")):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def derive(
    source: Source,
    product: str,
    options: Mapping[str, Any],
    compute: Callable[[Snapshot], xr.Dataset],
    echo: Echo | None = None,
) -> xr.Dataset:
    """Return a product of a run, stored or computed.

    Parameters
    ----------
    source
        Run directory, or a snapshot of one.
    product
        Name of the product; begins the name of its folder.
    options
        All that `compute` depends on besides the cells and the code: JSON values, defaults filled in.
    compute
        Called with the snapshot if the product is not stored; ``snapshot.open()`` gives the cube, and
        another product derived from the snapshot speaks of the same cells.
    echo
        Prints a line; says what is computed, and why.

    Returns
    -------
    Dataset
        In memory; ``encoding["source"]`` is its folder, absent if it could not be written.

    Raises
    ------
    store.RefusedError
        If there is no run.
    store.DamagedError
        If a chunk of the cube is damaged.
    """
    say = echo or _silent
    snapshot = Snapshot.of(source)
    key = _key(snapshot, product, options)
    path = snapshot.info.directory / store.DERIVED / f"{product}-{key['derived_key'][:8]}.zarr"
    try:
        ds = store.open_product(path)
        if all(ds.attrs.get(name) == value for name, value in key.items()):
            say(f"{product}: taken from {path}")
            return _placed(ds, path)
    except FileNotFoundError:
        pass
    except store.DamagedError as error:
        say(f"{product}: damaged ({error}); computing it again")
    started = time.perf_counter()
    result = _compute(snapshot, compute).assign_attrs(key)
    say(f"{product}: computed in {time.perf_counter() - started:.1f} s")
    try:
        store.write_product(path, result)
    except PermissionError as error:
        say(f"{product}: not kept ({error})")
        return result
    return _placed(store.open_product(path), path)


def _silent(_: str) -> None:
    pass


def _placed(ds: xr.Dataset, path: Path) -> xr.Dataset:
    ds.encoding["source"] = str(path)
    return ds


def _key(snapshot: Snapshot, product: str, options: Mapping[str, Any]) -> dict[str, str]:
    """Attributes that name a product."""
    parts = {
        "derived_product": product,
        "derived_options": json.dumps(options, sort_keys=True),
        "cube_digest": snapshot.digest,
        "analysis_version": analysis_version(),
    }
    return {**parts, "derived_key": hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()}


def _compute(snapshot: Snapshot, compute: Callable[[Snapshot], xr.Dataset]) -> xr.Dataset:
    try:
        return compute(snapshot)
    except ValueError as error:
        if "checksum" not in str(error).lower():
            raise
        directory = snapshot.info.directory
        raise store.DamagedError(
            f"{directory}: a chunk is damaged; look with: magpend verify {directory}"
        ) from None


# ---- products ----------------------------------------------------------------------------------


def attractors(directory: Source, *, echo: Echo | None = None, **options: Any) -> xr.Dataset:
    """Attractors of a run, found, named and followed along its axes.

    Parameters
    ----------
    directory
        Run directory, or a `Snapshot`.
    echo
        Prints a line.
    options
        Those of `pipeline.analysis.attractors.identify` and `match` that have numbers; those of
        `bounded.Rule` with the prefix ``rule_``. `attractor_defaults` lists them.

    Returns
    -------
    Dataset
        As `pipeline.analysis.attractors` says, ``matched`` 1. What `identify` finds is kept as a product
        of its own, so that other options of `match` integrate nothing.

    Raises
    ------
    SpecError
        If an option is unknown.
    """
    from pipeline.analysis.attractors import match

    wanted = _with_defaults("attractors", options, attractor_defaults())
    matching = {name: wanted.pop(name) for name in _defaults_of(match)}

    def compute(snapshot: Snapshot) -> xr.Dataset:
        return match(derive(snapshot, "identified", wanted, lambda s: _identify(s, wanted), echo), **matching)

    return derive(directory, "attractors", {**wanted, **matching}, compute, echo)


def attractor_defaults() -> dict[str, Any]:
    """Options of `attractors` with their defaults."""
    from pipeline.analysis.attractors import Rule, identify, match

    rule = {f"rule_{name}": value for name, value in asdict(Rule()).items()}
    return {**_defaults_of(identify), **rule, **_defaults_of(match)}


def _identify(snapshot: Snapshot, options: Mapping[str, Any]) -> xr.Dataset:
    from pipeline.analysis.attractors import Rule, identify

    own = {name: value for name, value in options.items() if not name.startswith("rule_")}
    rule = {name.removeprefix("rule_"): value for name, value in options.items() if name not in own}
    return identify(snapshot.open(), rule=Rule(**rule), **own)


_NO_OPTIONS = frozenset({"block_bytes"})
"""Parameters that change nothing in a result."""


def _defaults_of(function: Callable[..., Any]) -> dict[str, Any]:
    """Options of a function that are numbers or words."""
    return {
        name: parameter.default
        for name, parameter in inspect.signature(function).parameters.items()
        if isinstance(parameter.default, (bool, int, float, str)) and name not in _NO_OPTIONS
    }


def _with_defaults(product: str, options: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """All options of a product, numbers in the type of their default."""
    problems = [unknown_key(f"{product}.{name}", name, defaults) for name in options if name not in defaults]
    if problems:
        raise SpecError(problems)
    return {name: type(default)(options.get(name, default)) for name, default in defaults.items()}
