"""Open a run directory: its specification, plan, commit records and result cube."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from pipeline.layout.plan import Plan
from pipeline.specification.spec import Spec
from pipeline.store.commits import cube_digest, read_commits
from pipeline.store.errors import DamagedError
from pipeline.store.files import RUN_FILE, Files
from pipeline.store.records import Records
from pipeline.store.runfile import RunInfo, read_run, remade
from pipeline.store.skeleton import check_skeleton, lacking

if TYPE_CHECKING:
    import xarray as xr

    from magpend_core.models.model import Model, Parameters


MOST_SHOWN = 70
"""Most characters of a list of names in one line."""


def _short(text: str) -> str:
    return text if len(text) <= MOST_SHOWN else f"{text[: MOST_SHOWN - 4]} ..."


@dataclass(frozen=True)
class RunDirectory:
    """An opened run directory with the commit records found when it was opened: all results use the same cells."""

    info: RunInfo  # files of the directory, and content of ``run.json``
    commits: Records  # valid commit records by task
    # contents of small files of the set-up by key, which were compared with their digests in ``run.json``
    known: Mapping[str, bytes] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def open(cls, source: str | Path | Files | RunDirectory) -> Self:
        """Open a run directory with its present commit records; return an opened run unchanged.

        Metadata and coordinates are compared with the digests in ``run.json``; no cell is read.

        Raises
        ------
        RefusedError
            If there is no run in `source`.
        DamagedError
            If ``run.json``, metadata or coordinates have changed since they were written.
        UnreadableError
            If a file exists and cannot be read.
        """
        if isinstance(source, cls):
            return source
        if isinstance(source, RunDirectory):
            return cls(source.info, source.commits, source.known)
        info = read_run(source)
        known = check_skeleton(info)
        if absent := lacking(info):
            place = info.files.below(RUN_FILE).name
            raise DamagedError(f"{place}: damaged (skeleton has no {', '.join(absent[:3])}); {remade(info.name)}")
        return cls(info, read_commits(info), known)

    @property
    def _next(self) -> tuple[str, ...]:
        """Lines that say how to go on from the run in Python."""
        return ()

    def __repr__(self) -> str:
        facts = (f"  {name:9s} {text}" for name, text in self._facts.items())
        return "\n".join([self._title, *facts, *self._next])

    def _repr_html_(self) -> str:
        left = "style='text-align:left'"
        rows = "".join(
            f"<tr><th {left}>{escape(name)}</th><td {left}>{escape(text)}</td></tr>"
            for name, text in self._facts.items()
        )
        return f"<b>{escape(self._title)}</b><table>{rows}</table><pre>{escape(chr(10).join(self._next))}</pre>"

    @property
    def _title(self) -> str:
        return f"magpend run {self.name}" + (f": {self.spec.title}" if self.spec.title else "")

    @property
    def _facts(self) -> dict[str, str]:
        """Model, cells and progress of the run in words, by name, for its `repr`."""
        states, plan = ", ".join(self.model.state_names), self.plan
        shape = " x ".join(f"{dim} ({n})" for dim, n in zip(plan.dims, plan.shape, strict=True))
        missing = "" if self.complete else "; run the specification again to complete it"
        return {
            "model": f"{self.model.name}; states {_short(states)}",
            "cells": f"{plan.n_cells}: {shape}",
            "computed": f"{self.n_committed} of {plan.n_cells}{missing}",
        }

    @property
    def plan(self) -> Plan:
        """Plan of the run: its cells, tasks and chunks."""
        return self.info.plan

    @property
    def spec(self) -> Spec:
        """Specification of the run."""
        return self.plan.spec

    @property
    def directory(self) -> Path:
        """Path of the run directory; raises `RefusedError` for a run that is not in a folder of this machine."""
        return self.info.directory

    @property
    def name(self) -> str:
        """Path or URL of the run directory."""
        return self.info.name

    @property
    def model(self) -> Model:
        """Model that was integrated."""
        return self.spec.model

    @property
    def parameters(self) -> Parameters:
        """Values of the model parameters that are not swept."""
        return self.spec.values

    @property
    def complete(self) -> bool:
        """Whether every task of the run has been computed and committed."""
        return len(self.commits) == self.plan.n_tasks

    @property
    def n_committed(self) -> int:
        """Number of cells that are computed and committed."""
        return sum(self.plan.cells_in(i) for i in self.commits)

    @cached_property
    def digest(self) -> str:
        """Digest of the run's identity and of all its commit records."""
        return cube_digest(self.info, self.commits)

    def cube(self, chunks: Any = None, *, check: bool | None = None) -> xr.Dataset:
        """Open the run's result cube as an xarray dataset; see `pipeline.open_run`."""
        from pipeline.store.reading import cube_of

        return cube_of(self.info, self.commits, self.known, chunks=chunks, check=check)


def open_run(path: str | Path | RunDirectory, *, chunks: Any = None, check: bool | None = None) -> xr.Dataset:
    """Open the result cube of a run directory as a dataset; only coordinates are read until variables are used.

    Cells that are not committed read as pending: ``status`` 0, ``section`` NaN. Open the run again to see
    cells that were committed later.

    Parameters
    ----------
    path
        Run directory.
    chunks
        As in `xarray.open_zarr`: None indexes lazily and loads what is selected; ``{}`` makes dask
        arrays in the chunks of the store, for cubes larger than the memory.
    check
        Whether every chunk is compared with the sha256 in its commit record when it is read. The default is
        True, unless the environment has ``MAGPEND_VERIFY=0``.

    Returns
    -------
    xarray.Dataset
        The cube. Its attributes hold the model's name, the specification's TOML text, the settings of the
        integration by name, those of products as ``<product>_<name>`` (such as ``lyapunov_n_periods``), and
        the provenance (``source``, ``created``, ``host``, ``git_commit``). It can be written as NetCDF.

    Raises
    ------
    RefusedError
        If there is no run in `path`.
    DamagedError
        If ``run.json``, metadata or coordinates have changed since they were written. When a cell is used
        later: if its chunk is missing or has changed.

    Examples
    --------
    >>> ds = open_run("runs/quickstart")                                    # doctest: +SKIP
    >>> ds.section.isel(state=0).sel(frequency=2.2, method="nearest")       # doctest: +SKIP
    """
    return RunDirectory.open(path).cube(chunks, check=check)
