"""Tabulate the events of the pendulum's attractors: ``python docs/pendulum_events.py [--runs FOLDER] [NAME...]``.

A name is that of a workflow. Its run is computed (a complete one is taken as it is), its events are named as by
``magpend analyse branches RUN --stable --period N`` and ``magpend analyse events RUN``, and the tables of the tutorial
are written anew, between the marks ``<!-- events: NAME -->`` and ``<!-- end -->``; without names all that have marks.
Beside the tutorial lie the figure and a CSV file with all columns.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

import magpend
from pipeline.analysis.branches.kinds import NAMES
from pipeline.layout.vocabulary import letter
from pipeline.results.tabular import plain

PAGE = Path(__file__).resolve().parent / "tutorials" / "bifurcations.md"

SMALL = 1e-8
"""Error of a value [Hz] that the tables leave out."""

Row = dict[str, Any]

LONGEST = {"events_2_3hz": 24, "events_0p1_2hz": 28}
"""Longest period of the branches by run."""

OPTIONS: dict[str, dict[str, Any]] = {"events_2_3hz": {}, "events_0p1_2hz": {"orbits": True}}
"""Options of the events by run."""

SIDES = {
    "on one side": ("left", "right"),
    "that swing to both sides": ("straddling",),
    "that rotate": ("rotating",),
    "of no class": ("undecided",),
}
"""Groups of the tables: classes of motion."""


def rows_of(run: magpend.Run, options: dict[str, Any]) -> pd.DataFrame:
    """Return the events of a run by rising frequency, each with the side of its attractor."""
    rows = run.table("events", **options)
    sides = run.table("attractors").groupby("attractor_id")["side"].agg(lambda own: ", ".join(sorted(set(own))))
    rows = rows[~rows["what"].isin(["range_end", "lives_on"])].assign(side=rows["attractor"].map(sides))
    middle = rows["frequency_hz"].fillna(0.5 * (rows["seen"] + rows["beyond"]))
    return rows.iloc[middle.argsort(kind="stable")]


def twins_of(run: magpend.Run) -> set[frozenset[int]]:
    """Return the pairs of attractors that are near mirror images of each other at some frequency, from both sides."""
    found = run.table("attractors")[["attractor_id", "mirror_partner"]].itertuples(index=False)
    seen = {(int(a), int(b)) for a, b in found if a != b and b >= 0}
    return {frozenset(pair) for pair in seen if pair[::-1] in seen}


def paired(rows: Sequence[Row], twins: set[frozenset[int]]) -> list[list[Row]]:
    """Put events of one kind together if their attractors are twins."""
    kind = ("what", "criticality", "rises", "period", "period_after", "is_own")
    found: list[list[Row]] = []
    for row in rows:
        for other in found:
            same = all(other[0][name] == row[name] for name in kind)
            if len(other) == 1 and same and frozenset((row["attractor"], other[0]["attractor"])) in twins:
                other.append(row)
                break
        else:
            found.append([row])
    return found


def tables_of(rows: pd.DataFrame, longest: int, twins: set[frozenset[int]]) -> list[str]:
    """Return the number of events by name, a table of the decided ones for each group, and one of all others."""
    is_open = rows["what"] == "not_decided"
    counts = rows.loc[~is_open, "what"].value_counts()
    told = ", ".join(f"{n} {_named(what)}{'s' * (n > 1)}" for what, n in counts.items())
    lines = [f"{len(rows)} events: {told}, {is_open.sum()} not decided."]
    kept = rows["side"].map(
        lambda side: next((name for name, own in SIDES.items() if set(side.split(", ")) <= {*own}), "")
    )
    for name in [*SIDES, ""]:
        own = rows[~is_open & (kept == name)]
        if len(own):
            lines += ["", f"**Motions {name or 'that change between these classes'}**", ""]
            lines += ["| Hz | attractor | ends as the frequency | by | its cells go on |", "|---|---|---|---|---|"]
        lines += [_line(one) for one in paired(own.to_dict("records"), twins)]
    lines += ["", "**Not decided**", "", "| motions | end, between these values in Hz | tried |", "|---|---|---|"]
    groups: dict[tuple[str, str], list[str]] = {}
    for row in rows[is_open].to_dict("records"):
        own = f"orbits of period over {longest}" if row["period"] > longest else _own(row)
        low, high = sorted((row["seen"], row["beyond"]))
        ends = groups.setdefault((f"{own}, {row['side']}", _tried(row, longest)), [])
        ends.append(f"{letter(row['attractor'])} {low:.5g}-{high:.5g}")
    return lines + [f"| {who} | {', '.join(ends)} | {tried} |" for (who, tried), ends in sorted(groups.items())]


def _line(told: Sequence[Row]) -> str:
    """Return the table's line of one event, or of the two events of mirror twins."""
    values, whats, cells = zip(*(_parts(row) for row in told), strict=True)
    names = [letter(row["attractor"]) for row in told]
    own = [f"{name}: {to}" for name, to in zip(names, cells, strict=True) if to] if len(told) > 1 else cells
    sides = [f" ({row['side']})" if row["side"] in SIDES["on one side"] else "" for row in told]
    who = ", ".join(name + side for name, side in zip(names, sides, strict=True))
    first = told[0]
    period = f"period {first['period']}" if first["period"] else plain(first["set"])
    after = f" to {first['period_after']}" if first["period_after"] >= 0 else ""
    what = whats[0] if len(set(whats)) == 1 else "; ".join(f"{n}: {w}" for n, w in zip(names, whats, strict=True))
    way = "rises" if first["rises"] else "falls"
    return f"| {', '.join(values)} | {who}: {period}{after} | {way} | {what} | {'; '.join(own)} |"


def _named(what: str) -> str:
    return NAMES.get(what, plain(what)) + (" point" if what in ("neimark_sacker", "hopf") else "")


def _group(sides: str) -> str:
    return next((name for name, own in SIDES.items() if set(sides.split(", ")) <= {*own}), "")


def _parts(row: Row) -> tuple[str, str, str]:
    """Return the value of an event, what happens, and what becomes of the cells, without the numbers of branches."""
    value, _, rest = row["sentence"].partition(" = ")[2].partition(" Hz as it ")
    what, _, cells = rest.partition(": ")[2].partition("; its cells ")
    if not cells:
        what, _, cells = what.partition("; of its cells ")
    what = re.sub(r" \(branch \d+\)", "", what.replace("meets the unstable", "meets an unstable"))
    cells = cells.replace("go on ", "").replace("reach no attractor", "to none")
    value = f"{row['frequency_hz']:.7f}" if row["frequency_hz_error"] <= SMALL else value
    return value, re.sub(r" of branch \d+", "", what), cells


def _tried(row: Row, longest: int) -> str:
    """Say in brief why an end is not decided."""
    why, _, crisis = row["evidence"].partition("; no crisis: ")
    if row["period"] > longest:
        return "no branch was followed"
    if "such ids rest on distance" in why:
        why = "the set beyond is chaotic too and may be the same"
    if "no bifurcation is located" in why:
        return "its branch turns or loses stability where no bifurcation is located"
    if why == "no orbit to follow":
        is_known = row["set"] in ("chaotic_set", "torus")
        why = "not looked for (`--orbits`)" if is_known else "neither closed, nor shown to be chaotic or a torus"
    return why + ("; no unstable orbit that was tried is met" if crisis else "")


def _own(row: Row) -> str:
    return f"orbits of period {row['period']}" if row["period"] else plain(row["set"]) + "s"


def written(page: str, name: str, lines: list[str]) -> str:
    """Return a page with the tables of a run between its marks."""
    marks = re.compile(rf"(<!-- events: {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    page, n = marks.subn(lambda at: at[1] + "\n".join(lines) + "\n" + at[2], page)
    if n != 1:
        raise ValueError(f"{PAGE.name} has {n} marks of {name}; it must have one")
    return page


def main() -> None:
    """Compute what the command line names, and write the page and its files."""
    marked = re.findall(r"<!-- events: (\w+) -->", PAGE.read_text("utf-8"))
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("names", nargs="*", default=marked, metavar="NAME", help=f"workflows: {', '.join(marked)}")
    words.add_argument("--runs", type=Path, default=Path("runs"), help="folder of the runs")
    given = words.parse_args()
    for name in given.names:
        run, options = magpend.run(name, given.runs / name), OPTIONS[name]
        run.branches(stable=True, max_period=LONGEST[name])
        rows = rows_of(run, options)
        rows.to_csv(PAGE.parent / f"{name}.csv", index=False)
        run.plot.genealogy(**options).figure.savefig(PAGE.parent / f"{name}.png", dpi=120)
        PAGE.write_text(written(PAGE.read_text("utf-8"), name, tables_of(rows, LONGEST[name], twins_of(run))), "utf-8")


if __name__ == "__main__":
    main()
