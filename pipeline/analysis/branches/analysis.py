"""Define the analyses ``branches`` and ``curves`` of a run, and tabulate them."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from magpend_core.sizes import LEVEL
from magpend_core.troubleshooting import see
from pipeline.analysis.branches.completeness import counted_lines, searched_lines
from pipeline.analysis.branches.declaration import COEFFICIENTS, BranchOptions, CurveOptions
from pipeline.analysis.branches.intervals import (
    in_words,
    interval_along,
    interval_of,
    refuse_frequency_of_flow,
    settle_along,
    swept_axis,
)
from pipeline.analysis.branches.kinds import (
    BRANCH_POINTS,
    BRANCHING,
    CURVE_WHY,
    FOLD,
    HOMOCLINIC,
    KINDS,
    LABELS,
    LIMITS,
    PITCHFORK,
)
from pipeline.layout.own_words import RATE, dims_in_own_words, place_in_words, rate_of
from pipeline.layout.vocabulary import FREQUENCY_DIM, axis_name, model_of, parameter_name, parameters_of
from pipeline.products.product import Table
from pipeline.results.run import OpenRun
from pipeline.results.tabular import Row, Words, aligned, counted, header_of, plain, value_with_error, values, words_of
from pipeline.specification.problems import SpecError
from pipeline.specification.tables import FREQUENCY

if TYPE_CHECKING:
    from pipeline.analysis.branches.homoclinic import Loop

BEYOND = 20
"""Points of a branch beyond its stable part that are followed with ``--stable``: they show what crosses there."""


def settle_branches(run: OpenRun, options: BranchOptions) -> BranchOptions:
    """Fill in the parameter interval of the branches from the run's swept axis; raise SpecError if it is empty."""
    from pipeline.analysis.branches.asked import check_asked

    refuse_frequency_of_flow(run, options.parameter)
    low, high = interval_of(run, options.parameter, options.low, options.high)
    check_asked(run, options, (low, high))
    return options.model_copy(update={"low": low, "high": high})


def branches(run: OpenRun, options: BranchOptions) -> xr.Dataset:
    """Follow branches of periodic orbits along a parameter, from the attractors of a run."""
    from pipeline.analysis.branches.arclength import Settings
    from pipeline.analysis.branches.asked import count_equilibria, counted_variables, given_starts
    from pipeline.analysis.branches.dataset import dataset_of
    from pipeline.analysis.branches.exploring import Scope, explore
    from pipeline.analysis.branches.searching import places_of, searched_variables
    from pipeline.analysis.branches.starting_orbits import attracting, recurrent

    least_period = 4  # least limit for the periods of followed branches, however short the orbits of the run are
    cube, parameter = run.cube(), axis_name(options.parameter)
    interval = low, high = interval_of(run, parameter, options.low, options.high)
    base = parameters_of(cube)
    given, missed = given_starts(run, options, interval)
    counted = count_equilibria(run, options, interval)
    starts, left_out = attracting(run.derive("attractors"), base, parameter, interval, options.max_period)
    starts = [*given, *starts, *(start for one in counted for start in one.starts)]
    longest = options.max_period or max([least_period, *(s.family.period for s in starts)])
    if options.recurrences:
        found = recurrent(cube, base, parameter, high - low, min(options.recurrences, longest))
        starts += [s for s in found if low <= s.value <= high]
    searched = places_of(cube, base, parameter, interval, options.isolas)
    own = max([1, *(s.family.period for s in starts)])
    periods = np.arange(1, 1 + (options.max_period or min(own, least_period)))
    for place in searched:
        place.search(periods)
        starts += place.starts()
    run.echo(f"branches: {len(starts)} starting orbits, periods up to {longest}")
    settings = Settings(beyond=BEYOND if options.stable else 0)
    scope = Scope(low, high, longest, options.generations, settings)
    followed = explore(starts, scope)
    if starts and not followed:
        left_out = [*left_out, f"{len(starts)} starting orbits: could not be followed"]
    return dataset_of(followed, parameter, base, [*missed, *left_out], run.spec.rate).assign(
        searched_variables(searched, followed, periods, base.model) | counted_variables(counted, base.model)
    )


def settle_curves(run: OpenRun, options: CurveOptions) -> CurveOptions:
    """Return the options; raise SpecError unless the second parameter differs from that of the run's branches."""
    settled, second = settle_along(run, options), options.second
    if axis_name(second) == axis_name(settled.parameter):
        raise SpecError(f"{in_words(run, second)} is the branches' own parameter; give another one.")
    if swept_axis(run, second) is not None:
        raise SpecError(
            f"the run sweeps {in_words(run, second)}, so that its branches lie at several values; use a run that does "
            "not."
        )
    interval_of(run, second, options.second_low, options.second_high)
    return settled


def curves(run: OpenRun, options: CurveOptions) -> xr.Dataset:
    """Continue the bifurcations on the branches in the plane of the branches' parameter and a second one."""
    from pipeline.analysis.branches.curves import curves_dataset, curves_from, not_followed

    located = run.derive("branches", parameter=options.parameter)
    bounds = (interval_along(run, options.parameter), (options.second_low, options.second_high))
    second = axis_name(options.second)
    base = parameters_of(run.cube())
    left_out: dict[int, str] = {}
    lost: list[Loop] = []
    found = curves_from(located, base, second, bounds, options.curve_period, left_out=left_out, lost=lost)
    lines = [f"{_place_of(located, k)}: {why}" for k, why in sorted(left_out.items()) if k >= 0]
    lines += [_lost(loop, run.spec.rate) for loop in lost]
    ds = curves_dataset(found, axis_name(options.parameter), second, base.model)
    return ds.assign_attrs(left_out="\n".join([*lines, *not_followed(ds, run.spec.rate)]))


def _lost(loop: Loop, word: str) -> str:
    """Say that the search of a homoclinic orbit ended without one."""
    from pipeline.analysis.branches.homoclinic import HomoclinicSettings

    place = ", ".join(place_in_words(n, word, x) for n, x in zip(loop.family.free, loop.values, strict=True))
    most = HomoclinicSettings.to_start
    return (
        f"homoclinic orbits, near {place}: none found within {most} evaluations of their equations, which is the limit"
    )


def _place_of(ds: xr.Dataset, k: int) -> str:
    """Name a located bifurcation with its place."""
    kind, period = KINDS[int(ds["kind"][k])], int(ds["orbit_period"][int(ds["of_branch"][k])])
    place = place_in_words(str(ds.attrs["parameter"]), rate_of(ds), float(ds["value"][k]))
    return f"{kind}, {period_words(period)}, at {place}"


def branches_table(ds: xr.Dataset) -> Table:
    """Return the table of bifurcations, with text lines on the stable segments of branches and on attractors without a
    branch.

    Equilibria have the period 0, and eigenvalues [1/s] in place of multipliers. A Hopf point has the period of
    its small cycles. ``normal_form`` is the coefficient of the normal form (see
    `pipeline.analysis.branches.normal_forms`). ``unstable_below`` and ``unstable_above`` say how many
    multipliers are unstable on the two sides of the parameter; at a fold both orbits lie on one side, and the
    other says ``none``. Two bifurcations that are mirror images of each other are one row; ``mirror_branch`` and
    ``mirror_to_branch`` are the branches of the other one, -1 none.
    """
    rows = table_of(ds, once=True)
    if not ds.sizes["branch"]:
        lines = ["no branch: no closed orbit to begin with", *counted_lines(ds), *searched_lines(ds)]
        return Table(rows, [*lines, *listed(ds, "left_out")], _why_none(ds))
    head = f"{len(rows)} bifurcations on {ds.sizes['branch']} branches"
    head += ", mirror images counted once" if any(row.get("mirror_branch", -1) >= 0 for row in rows) else ""
    located = ["", *aligned([_words(ds, row) for row in rows], "")] if rows else []
    lines = [head, *located, "", *_windows(ds)]
    lines += [*_unbounded(ds), *_detached(ds), *_no_equilibria(ds), *counted_lines(ds), *searched_lines(ds)]
    header = (parameter_name(str(ds.attrs["parameter"])), *_COLUMNS)
    return Table(rows, [*lines, *listed(ds, "left_out")], header=header)


_COLUMNS = (
    *("bracket", "label", "type", "criticality", "period", "multiplier_real", "multiplier_imag", "normal_form"),
    *("normal_form_error", "unstable_below", "unstable_above", "branch", "to_branch"),
)
"""Columns that the table of bifurcations has in any case."""


def _no_equilibria(ds: xr.Dataset) -> list[str]:
    """Return a text line on how to start from equilibria, if a flow's branches have cycles alone and no bifurcation."""
    is_alone = not ds.sizes["bifurcation"] and bool((ds["orbit_period"].values > 0).all())
    if not is_alone or "model" not in ds.attrs or model_of(ds).crossing is None:
        return []
    return ["", "no branch of equilibria: no cell rests; --all-equilibria finds all in a box, --start follows one"]


def _why_none(ds: xr.Dataset) -> str:
    name = parameter_name(str(ds.attrs["parameter"]))
    lines = str(ds.attrs.get("left_out", "")).splitlines()
    reasons = Counter(line.partition(": ")[2] for line in lines)
    told = [f"\n  {n} of {len(lines)}: {reason}" for reason, n in reasons.most_common()]
    head = f"no branch along {name}: there is no closed orbit to begin with"
    return f"{head}. Attractors left out:{''.join(told)}" if told else f"{head}; no cell has an attractor."


def table_of(ds: xr.Dataset, once: bool = False) -> list[Row]:
    """Return one table row per located bifurcation, and per end of a branch at which the period grows without bound,
    sorted by parameter value.

    At such an end ``bracket`` is the error of the value, and ``saddle_quantity`` the sum of the saddle's leading
    eigenvalues [1/s]. The parameter's column has its name and, for the drive's frequency, its unit: ``frequency_hz``.
    Parameters that have other values than the run's own follow, and ``side`` where the model has words for motions.
    With `once` there is one row for two mirror images.
    """
    parameter = parameter_name(str(ds.attrs["parameter"]))
    rows = []
    for k in np.argsort(ds["value"].values, kind="stable"):
        one = ds.isel(bifurcation=int(k))
        if once and "image" in ds and 0 <= int(one["image"]) < k:
            continue
        branch, told = int(one["of_branch"]), values(one, "kind", "criticality", "bifurcation_side")
        below, above = _unstable(one, _turns(ds, int(k)))
        rows.append(
            {
                parameter: float(one["value"]),
                "bracket": float(one["bracket"]),
                "label": LABELS[told["kind"]],
                "type": told["kind"],
                "criticality": "" if told["criticality"] == "unknown" else told["criticality"],
                "period": int(ds["orbit_period"].values[branch]),
                **({"side": told["bifurcation_side"]} if "bifurcation_side" in told else {}),
                "multiplier_real": float(one["critical_real"]),
                "multiplier_imag": float(one["critical_imag"]),
                "normal_form": float(one["normal_form"]),
                "normal_form_error": float(one["normal_form_error"]),
                "unstable_below": below,
                "unstable_above": above,
                **({"period_s": float(one["bifurcation_period_s"])} if model_of(ds).clock.is_continuous else {}),
                **fixed_of(ds, branch),
                "branch": branch,
                "to_branch": int(one["to_branch"]),
                **_branches_of_image(ds, one),
            }
        )
    if not (ends := limits_of(ds)):
        return rows
    rows = [{**row, "saddle_quantity": np.nan} for row in rows]
    return sorted([*rows, *(_limit_row(ds, *end) for end in ends)], key=lambda row: float(row[parameter]))


def _branches_of_image(ds: xr.Dataset, one: xr.Dataset) -> dict[str, int]:
    """Return the branches of a bifurcation's mirror image, -1 none; nothing if the model has no mirror."""
    if "image" not in ds:
        return {}
    image = int(one["image"])
    names = {"mirror_branch": "of_branch", "mirror_to_branch": "to_branch"}
    return {name: int(ds[of].values[image]) if image >= 0 else -1 for name, of in names.items()}


def limits_of(ds: xr.Dataset) -> list[tuple[int, int]]:
    """Return the branch and the end, 0 or 1, of each end at which the period of cycles grows without bound."""
    return (
        [(int(i), int(e)) for i, e in np.argwhere(np.isfinite(ds["limit_value"].values))] if "limit_value" in ds else []
    )


def _limit_row(ds: xr.Dataset, branch: int, end: int) -> Row:
    one, kind = ds.isel(branch=branch, end=end), _ends_of(ds, branch)[end]
    point = int(one["n_points"]) - 1 if end else 0
    value, last = float(one["limit_value"]), one.isel(point=point)
    number, is_below = str(int(last["n_unstable"])), float(last["parameter"]) < value
    return {
        parameter_name(str(ds.attrs["parameter"])): value,
        "bracket": float(one["limit_error"]),
        "label": LABELS[kind],
        "type": kind,
        "criticality": "",
        "period": int(one["orbit_period"]),
        **({"side": values(last[["side"]], "side")["side"]} if "side" in ds else {}),
        **dict.fromkeys(("multiplier_real", "multiplier_imag", "normal_form", "normal_form_error"), np.nan),
        "unstable_below": number if is_below else "none",
        "unstable_above": "none" if is_below else number,
        "period_s": np.inf,
        **fixed_of(ds, branch),
        "branch": branch,
        "to_branch": -1,
        **({"mirror_branch": -1, "mirror_to_branch": -1} if "image" in ds else {}),
        "saddle_quantity": _saddle_quantity(ds, branch, end),
    }


def _saddle_quantity(ds: xr.Dataset, branch: int, end: int) -> float:
    """Return the sum of the leading unstable and stable eigenvalue of the saddle at an end [1/s]; NaN for a saddle
    node.
    """
    if _ends_of(ds, branch)[end] != "homoclinic":
        return np.nan
    real = ds["limit_eigenvalue_real"].values[branch, end]
    return float(real[real > 0.0].min() + real[real < 0.0].max())


def _unbounded(ds: xr.Dataset) -> list[str]:
    """Return text lines on the ends of branches at which the period grows without bound; none if there are none."""
    lines = []
    for branch, end in limits_of(ds):
        one, name = ds.isel(branch=branch, end=end), parameter_name(str(ds.attrs["parameter"]))
        rests = [rest for rest in one["limit_state"].values.round(12) + 0.0 if np.isfinite(rest).all()]
        named = [zip(ds["state"].values.tolist(), rest, strict=True) for rest in rests]
        place = " and at ".join(", ".join(f"{state} {value:.6g}" for state, value in rest) for rest in named)
        own = (one["limit_eigenvalue_real"].values + 1j * one["limit_eigenvalue_imag"].values).round(12) + 0.0
        eigenvalues = ", ".join(f"{v.real:.5g}{v.imag:+.5g}i" if v.imag else f"{v.real:.5g}" for v in own)
        fitted, error, expected = (float(one[f"limit_slope{part}"]) for part in ("", "_error", "_expected"))
        at = f"{name}_h = {value_with_error(float(one['limit_value']), float(one['limit_error']))}"
        quantity = _saddle_quantity(ds, branch, end)
        if np.isfinite(quantity):
            n_unstable = int((own.real > 0.0).sum())
            cycle = "a stable cycle" if quantity < 0.0 and n_unstable == 1 else "an unstable cycle"
            what, law = f"homoclinic to the saddle at {place}", f"-ln|{name} - {name}_h|"
            told = f"saddle quantity {quantity:.5g} 1/s: {cycle} ends there"
        else:
            nodes = "saddle node" if len(rests) == 1 else f"{len(rests)} saddle nodes"
            what, law = f"{nodes} on an invariant circle, at {place}", f"1/sqrt|{name} - {name}_h|"
            told = "the cycle goes on as " + ("a saddle and a node" if len(rests) == 1 else "saddles and nodes")
        lines += [
            f"  branch {branch}{_at(ds, branch)}: {what}; {at}",
            f"    eigenvalues {eigenvalues} [1/s]; {told}",
            f"    slope of the period over {law}: {fitted:.5g} ± {error:.0e} fitted, {expected:.5g} computed",
        ]
    return ["", f"the period grows without bound {see('unbounded')}", *lines] if lines else []


def fixed_of(ds: xr.Dataset, branch: int) -> dict[str, float]:
    """Return the fixed parameters of a branch by name: the drive frequency, and those that differ from the run's
    values.
    """
    parameter = str(ds.attrs["parameter"])
    # a dataset in the word of the specification has the drive's rate under this word
    words = dict.fromkeys([FREQUENCY_DIM, *dims_in_own_words([FREQUENCY_DIM], str(ds.attrs.get(RATE, FREQUENCY)))])
    found = {word: ds[word] for word in words if word != parameter and word in ds}
    for variable in ds.coords.values():
        told = str(variable.attrs.get("long_name", ""))
        if variable.dims == ("branch",) and told.startswith("value of "):
            found[told.removeprefix("value of ")] = variable
    return {parameter_name(name): float(variable.values[branch]) for name, variable in found.items()}


def _turns(ds: xr.Dataset, k: int) -> bool:
    """Return whether the branch turns back at a bifurcation, so that both its sides lie on one side of the value."""
    one = ds.isel(bifurcation=k)
    kind, branch, after = values(one, "kind")["kind"], int(one["of_branch"]), max(int(one["after"]), 0)
    before, beyond = ds["parameter"].values[branch, after : after + 2] - float(one["value"])
    return kind == FOLD or (kind in (BRANCHING, PITCHFORK) and before * beyond > 0.0)


def _unstable(one: xr.Dataset, turns: bool) -> tuple[str, str]:
    """Return the numbers of unstable multipliers below and above a bifurcation, as texts."""
    before, after = int(one["n_unstable_before"]), int(one["n_unstable_after"])
    rises = bool(one["rises_before"])
    if turns:
        both = f"{min(before, after)}|{max(before, after)}"
        return (both, "none") if rises else ("none", both)
    return (str(before), str(after)) if rises else (str(after), str(before))


def _words(ds: xr.Dataset, row: Row) -> Words:
    name, unit = str(ds.attrs["parameter"]), str(ds.attrs["parameter_units"])
    branches = [row["branch"], row["to_branch"]], [row.get(f"mirror_{of}branch", -1) for of in ("", "to_")]
    one, image = (" -> ".join(str(branch) for branch in pair if branch >= 0) for pair in branches)
    return {
        name if unit == "1" else f"{name} {unit}".rstrip(): f"{row[parameter_name(name)]:.7f}",
        "label": row["label"],
        "type": row["type"],
        "criticality": row["criticality"],
        "normal_form": "" if row["type"] in LIMITS else _with_error(row["normal_form"], row["normal_form_error"]),
        "period": str(row["period"] or "equilibrium"),
        # the period in drive periods says the same
        "seconds": f"{row['period_s']:.6g}" if model_of(ds).crossing is not None else None,
        "side": row.get("side"),
        "multiplier": _number(complex(row["multiplier_real"], row["multiplier_imag"]), row["period"]),
        "unstable below, above": f"{row['unstable_below']}, {row['unstable_above']}",
        "branch": f"{one}{_at(ds, row['branch'])}{f', and its mirror {image}' if image else ''}",
    }


def _at(ds: xr.Dataset, branch: int) -> str:
    found = [
        f"{value:g} Hz" if name == parameter_name(FREQUENCY_DIM) else f"{name} {value:g}"
        for name, value in fixed_of(ds, branch).items()
        if int(ds["orbit_period"][branch]) or name != LEVEL  # equilibria are on no section
    ]
    return f" at {', '.join(found)}" if found else ""


def _with_error(value: float, error: float) -> str:
    """Format a coefficient with as many digits as its error allows (1 to 4); ``?`` if the error is larger than the
    value.
    """
    if not abs(value) > error:
        return "?"
    digits = int(np.clip(np.floor(np.log10(abs(value) / max(error, 1e-300))), 1, 4))
    return f"{value:.{digits}g}"


def _number(z: complex, period: int) -> str:
    if np.isnan(z):
        return ""
    return (f"{z.real:.5f}" if abs(z.imag) < 1e-9 else f"{z.real:.5f}{z.imag:+.5f}i") + ("" if period else " 1/s")


def _windows(ds: xr.Dataset) -> list[str]:
    lines = Counter(
        f"  {period_words(w['period'])}{', ' if w['side'] else ''}{w['side']}, branch {w['branch']}"
        f"{_at(ds, w['branch'])}: {w['from']:.7f} ({w['begins']}) to {w['to']:.7f} ({w['ends']})"
        for w in windows_of(ds)
    )
    told = [line if n == 1 else f"{line}, and back by mirror images" for line, n in lines.items()]
    return ["stable segments", *told] if told else ["no stable segment"]


def period_words(period: int) -> str:
    """Return "period N", or "equilibrium" for the period 0."""
    return f"period {period}" if period else "equilibrium"


def listed(ds: xr.Dataset, name: str) -> list[str]:
    """Return the lines of an attribute under its name."""
    lines = str(ds.attrs.get(name, "")).splitlines()
    return ["", f"{name.replace('_', ' ')} {see('left-out')}", *(f"  {line}" for line in lines)] if lines else []


def isolas_of(ds: xr.Dataset) -> list[int]:
    """Return the branches that are isolas: closed curves that no bifurcation connects to a branch of their period."""
    return [i for i in _unconnected(ds) if _ends_of(ds, i)[0] == "closed"]


def cut_of(ds: xr.Dataset) -> list[int]:
    """Return the branches that are detached within the interval of the parameter, and leave it twice at one bound.

    Beyond the bound they may close or be connected to another branch.
    """
    cut = [i for i in _unconnected(ds) if _ends_of(ds, i) == ("bound", "bound")]
    line, last = ds["parameter"].values, ds["n_points"].values - 1
    return [i for i in cut if np.isclose(line[i, 0], line[i, last[i]], rtol=1e-9, atol=0.0)]


def _unconnected(ds: xr.Dataset) -> list[int]:
    """Return the branches that spring from no other one and are connected to none by a branch point."""
    crossing = np.isin(ds["kind"].values, [KINDS.index(kind) for kind in BRANCH_POINTS])
    connected = {*ds["of_branch"].values[crossing].tolist(), *ds["to_branch"].values[crossing].tolist()}
    return [i for i in range(ds.sizes["branch"]) if int(ds["origin"][i]) < 0 and i not in connected]


def _detached(ds: xr.Dataset) -> list[str]:
    lines = []
    for branches, head in (
        (isolas_of(ds), "isolas: closed curves that no bifurcation connects to another branch"),
        (cut_of(ds), "detached within the interval, which they leave twice at one bound: widen it"),
    ):
        lines += ["", head] if branches else []
        for i in branches:
            line = ds["parameter"].values[i, : int(ds["n_points"][i])]
            line = np.append(line, ds["value"].values[ds["of_branch"].values == i])
            what = f"{period_words(int(ds['orbit_period'][i]))}, branch {i}{_at(ds, i)}"
            lines.append(f"  {what}: {line.min():.7f} to {line.max():.7f}")
    return lines


def windows_of(ds: xr.Dataset) -> list[dict[str, Any]]:
    """Return the stable segments of all branches, with the parameter values and the names of their bounds."""
    no_length = 1e-9  # length of a stable segment, as a share of its branch, that is nothing but rounding
    found = []
    for i in range(ds.sizes["branch"]):
        n, closed = int(ds["n_points"][i]), _ends_of(ds, i)[0] == "closed"
        line = ds["parameter"].values[i, :n]
        runs = _stable_runs(ds["n_unstable"].values[i, :n] == 0, closed)
        for first, last in [piece for run in runs for piece in _straight(line, *run)]:
            ends = sorted([_bound(ds, i, first, 0), _bound(ds, i, last, 1)])
            if not ends[1][0] - ends[0][0] > no_length * np.ptp(line):
                continue
            middle = (first + (last - first) % n // 2) % n
            found.append(
                {
                    "from": ends[0][0],
                    "to": ends[1][0],
                    "begins": ends[0][1],
                    "ends": ends[1][1],
                    "period": int(ds["orbit_period"][i]),
                    "side": values(ds[["side"]].isel(branch=i, point=middle), "side")["side"] if "side" in ds else "",
                    **fixed_of(ds, i),
                    "branch": i,
                }
            )
    return sorted(found, key=lambda w: (w["period"], w["side"], w["from"]))


def _straight(line: np.ndarray, first: int, last: int) -> list[tuple[int, int]]:
    """Split a series of points where their parameter turns, as where a branch goes on to its mirror image."""
    n = len(line)
    path = [(first + k) % n for k in range((last - first) % n + 1)]
    if last < first < n - 1:
        path.remove(n - 1)  # the last step of a closed branch repeats the first one
    steps = np.sign(np.diff(line[path]))
    turns = [path[k + 1] for k in np.flatnonzero(steps[:-1] * steps[1:] < 0.0)]
    return list(pairwise([first, *turns, last])) if len(path) > 1 else [(first, last)]


def _stable_runs(stable: np.ndarray, closed: bool) -> list[tuple[int, int]]:
    """Return the first and last index of each series of stable points; on a closed branch, a series may pass the
    start.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[0], stable.astype(np.int8), [0]])))
    runs = [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]
    if closed and len(runs) > 1 and stable[0] and stable[-1]:
        runs = [(runs[-1][0], runs[0][1]), *runs[1:-1]]
    return runs


def _ends_of(ds: xr.Dataset, branch: int) -> tuple[str, str]:
    ends = values(ds[["first_end", "last_end"]].isel(branch=branch), "first_end", "last_end")
    return ends["first_end"], ends["last_end"]


def _bound(ds: xr.Dataset, branch: int, point: int, end: int) -> tuple[float, str]:
    """Return the parameter value and the name of the first (0) or last (1) bound of a stable segment: a bifurcation, or
    the end of the branch.
    """
    n, value = int(ds["n_points"][branch]), float(ds["parameter"][branch, point])
    after = point - 1 + end
    here = np.flatnonzero((ds["of_branch"].values == branch) & (ds["after"].values == after))
    if len(here):
        return _named(ds, int(here[0 if end else -1]))
    origins = np.flatnonzero(ds["to_branch"].values == branch)
    nearest = origins[np.argmin(np.abs(ds["value"].values[origins] - value))] if len(origins) else -1
    name = "not located" if point not in (0, n - 1) else _ends_of(ds, branch)[end]
    beside = ds["parameter"].values[branch, max(point - 1, 0) : min(point + 2, n)]
    is_near = nearest >= 0 and abs(float(ds["value"][nearest]) - value) <= np.ptp(beside)
    if (nearest >= 0 and name in ("start", "period_halving", "equilibrium")) or (name == "not located" and is_near):
        parent = int(ds["orbit_period"][int(ds["of_branch"][nearest])])
        at, kind = _named(ds, int(nearest))
        own = parent == int(ds["orbit_period"][branch])
        return at, kind if own else f"{kind} of {f'period {parent}' if parent else 'an equilibrium'}"
    if name in LIMITS:
        return float(ds["limit_value"][branch, end]), name
    return value, name


def _named(ds: xr.Dataset, k: int) -> tuple[float, str]:
    names = ["value", "criticality", "kind"]
    one = values(ds[names].isel(bifurcation=k), *names)
    return one["value"], f"{one['criticality']} {one['kind']}".removeprefix("unknown ")


# ---- curves ------------------------------------------------------------------------------------


def curves_table(ds: xr.Dataset) -> Table:
    """Return the table of the points of codimension two, with text lines that describe the bifurcation curves.

    ``error`` is the larger of the errors of both parameters, in units of the ranges that the curves cover. Points of
    equilibria have the coefficients of their normal forms (see `pipeline.analysis.branches.center_manifold`).
    """
    names = [parameter_name(str(ds.attrs[f"{role}_parameter"])) for role in ("first", "second")]
    known = [ds[role].values[np.isfinite(ds[role].values)] for role in ("first", "second")]
    ranges = [float(np.ptp(own)) if own.size else 0.0 for own in known]
    rows = [_special(ds.isel(special=k), names, ranges) for k in range(ds.sizes["special"])]
    rows.sort(key=lambda row: (row["type"], row[names[0]]))
    lines = [f"{counted(ds.sizes['curve'], 'curve')} in the plane of {' and '.join(names)}"]
    lines += [_curve_line(ds.isel(curve=i), i, names) for i in range(ds.sizes["curve"])]
    if any(_is_cut(ds, end) for end in ("first_end", "last_end")):
        lines.append(f"  a curve ends where it could not be followed {see('curves')}")
    missed = int(ds["n_missed"].sum())
    if missed:
        lines += ["", f"{counted(missed, 'sign change')} of test functions could not be located: points may be missing"]
    if rows:
        lines += ["", f"{counted(len(rows), 'point')} of codimension two", *aligned([_special_words(r) for r in rows])]
    header = header_of(ds, "special", lambda one: _special(one, names, ranges))
    return Table(rows, [*lines, *listed(ds, "left_out")], header=header)


def _is_cut(ds: xr.Dataset, end: str) -> bool:
    return not {"stuck", "max_points", "budget"}.isdisjoint(np.array(words_of(ds[end]))[ds[end].values])


def _special(one: xr.Dataset, names: list[str], ranges: list[float]) -> Row:
    errors = [float(one[f"special_{role}_error"]) for role in ("first", "second")]
    kind = values(one, "special_kind")["special_kind"]
    return {
        "label": LABELS[kind],
        "type": kind,
        names[0]: float(one["special_first"]),
        names[1]: float(one["special_second"]),
        "period": int(one["special_period"]),
        "error": max((e / r for e, r in zip(errors, ranges, strict=True) if r > 0.0), default=np.nan),
        "curve": int(one["special_curve"]),
        **{f"coefficient_{n}": float(one[f"special_{n}"]) for n in COEFFICIENTS if f"special_{n}" in one},
    }


def _special_words(row: Row) -> Words:
    own = {name: row[key] for name in COEFFICIENTS if (key := f"coefficient_{name}") in row}
    words = {name: f"{value:.7f}" if isinstance(value, float) else str(value) for name, value in row.items()}
    words = {name: word for name, word in words.items() if name.removeprefix("coefficient_") not in own}
    told = ", ".join(f"{name} = {value:.5g}" for name, value in own.items() if value == value)
    coefficients = {"normal form": told} if own else {}
    return words | {"period": str(row["period"] or "equilibrium"), "error": f"{row['error']:.1g}"} | coefficients


def _curve_line(one: xr.Dataset, number: int, names: list[str]) -> str:
    told, n = values(one, "kind", "orbit_period", "first_end", "last_end"), int(one["n_points"])
    lines = [one[role].values[:n] for role in ("first", "second")]
    spans = ", ".join(f"{name} {line.min():.7g} to {line.max():.7g}" for name, line in zip(names, lines, strict=True))
    ends = ", ".join(CURVE_WHY.get(end, plain(end)) for end in (told["first_end"], told["last_end"]) if end != "bound")
    what = f"{LABELS[told['kind']]} {told['kind']}, {period_words(int(told['orbit_period']))}"
    if told["kind"] == HOMOCLINIC:
        quantity = one["saddle_quantity"].values[:n]  # NaN where the saddle has become another point
        low, high = np.nanmin(quantity), np.nanmax(quantity)
        what = f"{LABELS[HOMOCLINIC]} homoclinic, saddle quantity {low:.4g} to {high:.4g} 1/s"
    return f"  {number}: {what}: {spans}" + (f"; ends: {ends}" if ends else "")
