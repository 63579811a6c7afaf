"""Make the report page about one or several runs: diagrams, attractors, bifurcations, exponents, parameters.

A report shows the cube and the results in ``derived/``. Attractors, basins, and the hysteresis of a
continuation are computed if they are missing, as ``magpend analyse`` does. For other missing results the
report names the command.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import metadata
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.analysis.atlas.sentences import sentences
from pipeline.analysis.events.kinds import RANGE_END
from pipeline.analysis.spectrum.declaration import SpectrumOptions
from pipeline.layout.conventions import shown_unit
from pipeline.layout.own_words import dims_in_own_words, in_own_words
from pipeline.layout.vocabulary import BRANCH, axis_name, is_grid_dim, letter, parameter_name, split_dims
from pipeline.products.product import as_flags
from pipeline.products.registry import ANALYSES, FIGURES
from pipeline.report.page import Block, Facts, Grid, Note, Page, Part, Source, Text, grid_of, picture_of
from pipeline.results.outcomes import sentence
from pipeline.results.tabular import axis_ranges, counted, distinct, leading, number
from pipeline.runs.derive import AnalysedRun, changed_options, is_current, shown_table
from pipeline.runs.drawing import figure
from pipeline.runs.naming import options_in_own_words
from pipeline.runs.status import state
from pipeline.runs.suitability import unsuited
from pipeline.specification.problems import SpecError, unknown_name
from pipeline.specification.tables import RATES
from pipeline.store.errors import DamagedError
from pipeline.store.files import DERIVED
from pipeline.store.products import products_in, read_product_attrs
from pipeline.store.run import RunDirectory

if TYPE_CHECKING:
    import xarray as xr


def stored_options(run: RunDirectory, name: str) -> list[dict[str, Any]]:
    """Return the options, as far as they differ from the defaults, of each valid stored result; the fewest first.

    Branches are those on which other results rest, one set for each parameter.
    """
    found = []
    for place in products_in(run.info.files.below(DERIVED)):
        try:
            attrs = read_product_attrs(place)
        except (DamagedError, FileNotFoundError):
            continue
        if is_current(run, name, attrs) and (name != "branches" or not changed_options(run, name, attrs)):
            found.append(settled_options(name, attrs))
    return sorted(found, key=lambda options: (len(options), json.dumps(options, sort_keys=True)))


def settled_options(name: str, attrs: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a stored result that differ from their defaults.

    Options that were left open are filled in, such as a range that defaults to the axis'.
    """
    return ANALYSES[name].options.model_validate_json(attrs["derived_options"]).changed()


CHEAP = ("attractors", "hysteresis", "basins")
"""Analyses that a report computes by default."""

SHOWN = {
    "attractors": ("Attractors", ""),
    "hysteresis": ("Hysteresis", "Jumps of the branches: the parameter values, and the attractors before and after"),
    "basins": ("Basins", "Attractors on which the initial states of the grid end"),
    "events": ("Events", "Where attractors begin, change and end"),
    "branches": ("Bifurcations", "Located bifurcations"),
    "curves": ("Curves of bifurcations", "Points of codimension two on the curves of bifurcations"),
    "atlas": ("Atlas", ""),
    "orbits": ("Periodic orbits", "All periodic orbits found at a parameter point, stable or not"),
    "manifolds": ("Stable and unstable manifolds", "Manifolds of the saddle orbits"),
    "tangency": ("Homoclinic tangencies", "Parameter values at which manifolds of a saddle orbit first touch"),
    "chaos": ("Regular and chaotic", "Kind of motion of each attractor"),
    "dimension": ("Dimensions", "Correlation dimensions of the attractors that do not close"),
    "spectrum": ("Spectra", "Spectra"),
    "settling": ("Transient or attractor", "Sets that do not close, and the results of extending their cells"),
    "escapes": ("Escapes", "Rates at which cells with noise leave a set, and where they go"),
    "density": ("Densities", "Moments and peaks of the density of section points"),
}
"""Analyses in the order of a report: their headings, and the captions of their tables."""


class Shown:
    """A run that a report shows, with its result cube; analyses not in `computed` are shown only if they are stored."""

    def __init__(self, run: AnalysedRun, computed: tuple[str, ...]) -> None:
        self.run, self.computed = run, computed
        self.cube = in_own_words(run.cube())
        self.axes, self.starts = split_dims(self.cube["status"])

    @property
    def directory(self) -> str:
        """Run directory, quoted for a shell command."""
        return shlex.quote(self.run.name)

    def options_of(self, name: str) -> list[dict[str, Any]]:
        """Return the options with which an analysis is shown: those of each stored result, or else the defaults."""
        known = stored_options(self.run, name)
        return known or ([{}] if name in self.computed else [])


def part_of(source: str | AnalysedRun, echo: Callable[[str], None], computed: tuple[str, ...] = CHEAP) -> Part:
    """Make the section of a report about one run; analyses in `computed` are computed if they are not stored."""
    shown = Shown(AnalysedRun.of(source, echo), computed)
    title = shown.run.info.title or shown.run.name.rpartition("/")[2]
    parts = [
        Part("Diagram", list(_diagram(shown))),
        Part("Attractors", list(_attractors(shown))),
        *_analyses(shown),
        Part("Exponents", list(_exponents(shown))),
        Part("Parameters", list(_parameters(shown))),
        Part("Provenance", list(provenance_of(shown.run))),
    ]
    return Part(title, list(_state(shown)), [part for part in parts if part.blocks])


def _state(shown: Shown) -> Iterator[Block]:
    run, found = shown.run, state(shown.run)
    swept = ", ".join(f"{name} {_span(shown.cube, name)}" for name in shown.axes) or "nothing"
    model = run.model
    yield Facts(
        {
            "model": f"{model.name}: {model.title}",
            "kind": f"{run.spec.kind}; swept: {swept}",
            "cells": f"{found.n_committed} of {found.plan.n_cells} computed"
            + "".join(f", {n} {name.replace('_', ' ')}" for name, n in found.cells.items() if n),
            "sections": f"{run.spec.integration.n_keep} kept after {run.spec.integration.n_transient}, "
            f"at {model.section}",
        }
    )
    if not run.complete:
        yield Note(
            "This run is not complete: the page omits cells that are not computed.",
            f"magpend run SPEC --out {shown.directory}",
        )


def _span(cube: xr.Dataset, name: str) -> str:
    values, unit = cube[name].values, shown_unit(cube[name].attrs)
    if values.size == 1:
        return f"{values[0]:g}{'' if unit == '1' else ' ' + unit}"
    return f"{values[0]:g} to {values[-1]:g}{'' if unit == '1' else ' ' + unit} ({values.size} values)"


def _parameters(shown: Shown) -> Iterator[Block]:
    run = shown.run
    chosen = run.model.preset(run.spec.parameters.chosen)
    over, swept = run.spec.parameters.overrides, {parameter_name(name): name for name in shown.axes}
    rows = []
    rate, hertz = RATES[run.spec.rate], run.spec.frequency_hz
    if hertz and rate.column not in swept and run.model.clock.hertz is None:
        rows.append((rate.meaning, f"{rate.given(hertz):g}", rate.unit, "of the forcing", "the specification"))
    for p in run.model.parameters:
        source = chosen.provenance.get(p.name, f"preset {chosen.name}")
        value = f"{run.parameters[p.name]:g}"
        if p.name in swept:
            value, source = _span(shown.cube, swept[p.name]), "swept"
        elif p.name in over:
            source = "the specification"
        rows.append((p.name, value, "" if p.unit == "1" else p.unit, p.meaning, source))
    yield Grid(
        ("parameter", "value", "unit", "meaning", "from"), rows, f"Preset {chosen.name}: {chosen.title}".rstrip(": ")
    )


def _diagram(shown: Shown) -> Iterator[Block]:
    if len(shown.axes) > 1:
        at = _first_of_others(shown)
        yield from _drawn(shown, "bifurcation", "Bifurcation diagram at the first values of the other axes", at=at)
    elif shown.axes and shown.cube.sizes[shown.axes[0]] > 1:
        yield from _drawn(shown, "bifurcation", "Bifurcation diagram")
    else:
        yield from _drawn(shown, "section", "Section points")


def _first_of_others(shown: Shown) -> dict[str, float]:
    continuation = shown.run.spec.continuation
    path = shown.axes[0]
    if continuation is not None:
        (path,) = dims_in_own_words([axis_name(continuation.path)], shown.run.spec.rate)
    return {d: float(shown.cube[d].values[0]) for d in shown.axes if d != path}


def _attractors(shown: Shown) -> Iterator[Block]:
    """Make the table of a run's attractors, and figures of them."""
    if shown.run.spec.motion.obstacle:
        return
    known = shown.options_of("attractors")
    if not known:
        yield _missing(shown, "attractors")
        return
    options = known[0]
    try:
        found = shown.run.derive("attractors", **options)
    except SpecError as error:
        yield Note(str(error))
        return
    command = command_of("analyse attractors", options, shown.directory)
    found = in_own_words(found)
    table, told = shown_table("attractors", found), sentence(found)
    rows: list[dict[str, Any]] = [dict(row) for row in table.rows]
    most, n_others = leading(rows, "attractor_id", "n_cells")
    yield Grid(*_attractor_grid(found, most, shown.axes), _counted(rows, told), command, n_others)
    last = next(i for i, line in enumerate(table.lines) if line.startswith(told))  # it may point to a page
    for remark in table.lines[last + 1 :]:
        yield Note(f"{remark[:1].upper()}{remark[1:]}.")
    if len(shown.axes) == 1 and shown.cube.sizes[shown.axes[0]] > 1:
        yield from _drawn(shown, "attractors", "All coexisting attractors", **options)
        if "fraction" in (rows or [{}])[0]:
            yield from _drawn(
                shown, "fractions", "Fractions of the initial states that end on each attractor", **options
            )
    elif len(shown.axes) == 2:
        yield from _drawn(shown, "regimes", "Periods that coexist", **options)
        yield from _drawn(shown, "regimes", "Number of coexisting attractors", **options, show="number")
    if rows:
        where = _richest(rows, shown.axes)
        place = ", ".join(f"{name} = {value:g}" for name, value in where.items())
        if any(row["stability"] == "attracts" for row in rows):
            words = f"Attractors at {place}, where most coexist" if place else "Attractors"
        else:
            words = f"Sets on which cells end at {place}" if place else "Sets on which cells end"
        yield from _drawn(shown, "gallery", words, **options, at=where)


def _counted(rows: list[dict[str, Any]], told: str) -> str:
    attract = {r["attractor_id"] for r in rows if r["stability"] == "attracts"}
    others = {r["attractor_id"] for r in rows} - attract
    more = f", {counted(len(others), 'other set')}" if others else ""
    return f"{counted(len(attract), 'attractor')}{more}; {told}"


def _richest(rows: list[dict[str, Any]], axes: tuple[str, ...]) -> dict[str, float]:
    counts: dict[tuple[float, ...], int] = {}
    for row in rows:
        place: tuple[float, ...] = tuple(row[name] for name in axes)
        counts[place] = counts.get(place, 0) + (row["stability"] == "attracts")
    best = max(counts, key=counts.__getitem__)
    return dict(zip(axes, best, strict=True))


def _attractor_grid(
    ds: xr.Dataset, rows: list[dict[str, Any]], axes: tuple[str, ...]
) -> tuple[list[str], list[list[str]]]:
    """Return the heads and the rows of a table with one row per attractor."""
    motion, sampled = any("side" in r for r in rows), any("fraction" in r for r in rows)
    names = ["", "kind", "stability", "shown by", "period", *(["motion"] if motion else []), *axes, "cells"]
    names += ["basin fraction (95 % interval)"] if sampled else []
    lines: list[list[str]] = []
    by_id: dict[int, list[dict[str, Any]]] = {}
    for row in rows:
        by_id.setdefault(row["attractor_id"], []).append(row)
    for i, own in sorted(by_id.items()):
        line = [letter(i)]
        line += [distinct(r[key].replace("_", " ") for r in own) for key in ("kind", "stability")]
        line.append(distinct(r["evidence"] for r in own if r["evidence"] != "none") or "-")
        line.append(distinct(r["orbit_period"] for r in own if r["orbit_period"]) or "-")
        line += [distinct(r["side"] for r in own)] if motion else []
        line += [axis_ranges(ds, d, own, alone=len(axes) == 1) for d in axes]
        line.append(str(sum(r["n_cells"] for r in own)))
        line += [_share(own, axes)] if sampled else []
        lines.append(line)
    return names, lines


def _share(rows: list[dict[str, Any]], axes: tuple[str, ...]) -> str:
    best = max(rows, key=lambda row: float(np.nan_to_num(row["fraction"], nan=-1.0)))
    if not np.isfinite(best["fraction"]):  # it attracts nowhere
        return "-"
    where = ", ".join(f"{name} {best[name]:g}" for name in axes)
    share = f"{number(best['fraction'], '.3f')} ({number(best['low'], '.3f')} to {number(best['high'], '.3f')})"
    return f"{share} at {where}" if where and len(rows) > 1 else share


def _analyses(shown: Shown) -> Iterator[Part]:
    for name, (heading, _) in SHOWN.items():
        if name == "attractors" or not _suits(shown, name):
            continue
        if name == "spectrum":
            yield Part(heading, list(_spectra(shown)))
            continue
        known = shown.options_of(name)
        blocks: list[Block] = [] if known else [_missing(shown, name)]
        for options in known:
            blocks += _atlas(shown, options) if name == "atlas" else _analysis(shown, name, options)
        yield Part(heading, blocks)


def _suits(shown: Shown, name: str) -> bool:
    if unsuited(shown.run.spec.motion, ANALYSES[name]):
        return False
    if name == "hysteresis":
        return shown.run.spec.continuation is not None and shown.run.spec.continuation.direction == "both"
    if name == "basins":
        return sum(map(is_grid_dim, shown.starts)) >= 2
    known = name in shown.computed or bool(stored_options(shown.run, name))
    if name == "events" and len(_long_axes(shown)) == 1:
        return True
    if name == "atlas" and len(_long_axes(shown)) == 2 and BRANCH not in shown.starts:
        return True
    return known or name in ("branches", "chaos") or (name == "spectrum" and bool(shown.computed))


def _spectra(shown: Shown) -> Iterator[Block]:
    """Draw spectra at the gallery's point, and those that the run keeps; if they are asked for, along an axis."""
    try:
        if shown.computed:
            found = in_own_words(shown.run.derive("attractors"))
            if rows := [dict(row) for row in shown_table("attractors", found).rows]:
                shown.run.derive("spectrum", at=_richest(rows, shown.axes))
        if "spectrum" in shown.computed and len(_long_axes(shown)) == 1:
            shown.run.derive("spectrum", scaling="spectrum")
    except SpecError as error:
        yield Note(str(error))
    for options in stored_options(shown.run, "spectrum"):
        at: dict[str, float] = options_in_own_words(SpectrumOptions(**options), shown.run.spec.rate).at
        along = [d for d in _long_axes(shown) if d not in at]
        if not along or "cell" in options:
            place = ", ".join(f"{name} = {value:g}" for name, value in at.items())
            yield from _drawn(shown, "spectrum", f"Spectra at {place}" if place else "Spectra", **options)
        elif len(along) == 1:
            yield from _drawn(shown, "waterfall", f"Spectra along {along[0]}", **options)


def _long_axes(shown: Shown) -> list[str]:
    return [d for d in shown.axes if shown.cube.sizes[d] > 1]


def _analysis(shown: Shown, name: str, options: Mapping[str, Any]) -> Iterator[Block]:
    try:
        found = shown.run.derive(name, **options)
    except SpecError as error:
        yield Note(str(error))
        return
    found = in_own_words(found)
    path = str(found.attrs.get("path", ""))
    unit = shown_unit(found[path].attrs) if path in found.coords else "1"
    axis = f"{path} [{unit}]" if unit != "1" else path
    rows = [_with_letters(row, axis) for row in shown_table(name, found).rows]
    if name == "events":
        rows = [{"event": row["sentence"], "evidence": row["evidence"]} for row in rows if row["what"] != RANGE_END]
    # the settled options, so that a page made from the stored result is the same
    options = settled_options(name, found.attrs)
    command = command_of(f"analyse {name}", options, shown.directory)
    if rows:
        yield replace(grid_of(rows, SHOWN[name][1], command), stacked=name == "events")
    else:
        yield Note("Nothing of this kind was found.", command)
    drawn = ANALYSES[name].figure
    if drawn and drawn not in ("attractors", "lyapunov"):
        at = {d: float(shown.cube[d].values[0]) for d in shown.axes} if drawn == "basins" else {}
        where = " at the first values of the axes" if any(shown.cube.sizes[d] > 1 for d in at) else ""
        own = {key: value for key, value in options.items() if key in FIGURES[drawn].options.model_fields}
        yield from _drawn(shown, drawn, f"{SHOWN[name][1]}{where}", **own, **({"at": at} if at else {}))


def _atlas(shown: Shown, options: Mapping[str, Any]) -> Iterator[Block]:
    """Make the figure of an atlas, and say in sentences what the plane contains."""
    try:
        found = in_own_words(shown.run.derive("atlas", **options))
    except SpecError as error:
        yield Note(str(error))
        return
    options = settled_options("atlas", found.attrs)
    yield from _drawn(shown, "atlas", "Regions of the plane by their attractors", **options)
    yield from map(Text, sentences(found))
    yield Note("Each change of attractors, and each curve:", command_of("analyse atlas", options, shown.directory))


_OF_ATTRACTORS = {
    "attractor_id": "attractor",
    "from_id": "from attractor",
    "to_id": "to attractor",
    "mirror_partner": "mirror partner",
}


def _with_letters(row: Mapping[str, Any], path: str) -> dict[str, Any]:
    """Replace the attractor ids of a table row by letters, and name the parameter in its heads."""
    found: dict[str, Any] = {}
    for name, value in row.items():
        if name in _OF_ATTRACTORS:
            found[_OF_ATTRACTORS[name]] = "-" if value < 0 else letter(int(value))
        else:
            found[f"{name} {path}" if path and name in ("from", "to") else name] = value
    return found


def _exponents(shown: Shown) -> Iterator[Block]:
    if shown.run.spec.motion.obstacle:
        return
    if "lyapunov" not in shown.run.spec.products:
        yield Note(
            "Lyapunov exponents were not computed in this run: add the table to the specification and run it "
            "into another directory.",
            "[products]\nlyapunov = {}",
        )
    elif len(shown.axes) == 2:
        yield from _drawn(shown, "lyapunov", "Largest Lyapunov exponent", as_map=True)
    elif shown.axes and shown.cube.sizes[shown.axes[0]] > 1:
        yield from _drawn(shown, "lyapunov", "Lyapunov exponents", spectrum=True)
    else:
        yield from _drawn(shown, "convergence", "Convergence of the largest Lyapunov exponent")


def provenance_of(run: AnalysedRun, spec: str = "SPEC") -> Iterator[Block]:
    """Make the blocks on where the results of a run come from: command, digests, versions and specification."""
    info = run.info
    made = dict(info.versions)
    facts = {
        "command": f"magpend run {spec} --out {shlex.quote(run.name)}",
        "digest of the specification": info.digest,
        "digest of the cube": run.digest,
        "made": info.provenance.get("created", ""),
        "commit": info.provenance.get("git_commit", ""),
        "versions": ", ".join(f"{name} {version}" for name, version in made.items()),
    }
    yield Facts({name: value for name, value in facts.items() if value})
    yield Source("Specification", info.spec_text)


def _drawn(shown: Shown, name: str, caption: str, **options: Any) -> Iterator[Block]:
    try:
        drawn = figure(shown.run, name, options)
    except SpecError as error:
        yield Note(f"{caption}: not drawn. {error}")
        return
    notes = "".join(f" {note}." for note in drawn.notes)
    words = f"{caption} of {shown.run.info.title or shown.run.name}"
    yield picture_of(drawn, words, f"{caption}.{notes}", command_of(f"plot {name}", options, shown.directory))


def _missing(shown: Shown, name: str) -> Note:
    does = ANALYSES[name].help.partition("\n")[0]
    return Note(f"Not computed. To {does[0].lower()}{does[1:]}", f"magpend analyse {name} {shown.directory}")


def command_of(words: str, options: Mapping[str, Any], place: str) -> str:
    """Return the shell command for an analysis or a figure with given options."""
    verb, _, name = words.partition(" ")
    model = (ANALYSES if verb == "analyse" else FIGURES)[name].options
    return " ".join(["magpend", words, place, *as_flags(model, options)])


Echo = Callable[[str], None]


def report(
    directories: Sequence[str],
    *,
    title: str = "",
    also: Sequence[str] = (),
    only_stored: bool = False,
    echo: Echo = print,
) -> Page:
    """Make the report page about one or several runs.

    Parameters
    ----------
    directories
        Run directories; each is opened before anything is computed.
    title
        Title of the page; by default the run's, or the number of runs.
    also
        Analyses that are computed in addition to `pipeline.report.report.CHEAP`, as ``magpend analyse`` does.
    only_stored
        Whether to compute nothing, and to show only the cubes and the results in ``derived/``.
    echo
        Function that prints a line.

    Raises
    ------
    SpecError
        If an analysis is unknown.
    RefusedError, DamagedError, UnreadableError
        See `pipeline.store.run.RunDirectory.open`.
    """
    unknown = [unknown_name("analysis", name, SHOWN) for name in also if name not in SHOWN]
    if unknown:
        raise SpecError(unknown)
    computed = () if only_stored else (*CHEAP, *also)
    runs = [AnalysedRun.of(directory, echo) for directory in directories]
    parts = [part_of(run, echo, computed) for run in runs]
    if len(parts) == 1:  # its title is the page's
        return Page(title or parts[0].title, parts[0].blocks, parts[0].parts, made_by())
    return Page(title or f"{len(parts)} runs", [_summary(runs)], parts, made_by())


def made_by() -> str:
    """Return the name and the version of this program."""
    return f"magpend {metadata.version('magpend')}"


def _summary(runs: Sequence[AnalysedRun]) -> Grid:
    rows = [
        (run.info.title or run.name, run.name, run.model.name, run.spec.kind, str(run.plan.n_cells), run.digest[:12])
        for run in runs
    ]
    return Grid(("run", "directory", "model", "kind", "cells", "digest of the cube"), rows)
