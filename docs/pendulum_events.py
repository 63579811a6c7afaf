"""Tabulate the events of the pendulum's attractors: ``python docs/pendulum_events.py [--runs FOLDER] [NAME...]``.

A name is that of a workflow. Its run is computed (a complete one is taken as it is), its events are named as by
``magpend analyse events RUN --stable --period N``, and the tables of the tutorial are written anew, between the
marks ``<!-- events: NAME -->`` and ``<!-- end -->``; without names all that have marks. Beside the tutorial lie the
figure and a CSV file with all columns.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import pandas as pd

import magpend
from pipeline.analysis.tabular import plain
from pipeline.layout.vocabulary import letter

PAGE = Path(__file__).resolve().parent / "tutorials" / "bifurcations.md"

LONGEST = {"events_2_3hz": 24, "events_0p1_2hz": 12}
"""Longest period of the branches that are followed in each run."""

SIDES = {"on one side": ("left", "right"), "that swing to both sides": ("straddling",), "that rotate": ("rotating",)}
"""Groups of the tables: classes of motion."""


def options_of(name: str) -> dict[str, object]:
    """Return the options of the analysis of a run."""
    return {"stable": True, "max_period": LONGEST[name]}


def rows_of(run: magpend.Run, options: dict[str, object]) -> pd.DataFrame:
    """Return the events of a run by rising frequency, each with the side of its attractor."""
    rows = run.table("events", **options)
    sides = run.table("attractors").groupby("attractor_id")["side"].agg(lambda own: ", ".join(sorted(set(own))))
    rows = rows[~rows["what"].isin(["range_end", "lives_on"])].assign(side=rows["attractor"].map(sides))
    middle = rows["value"].fillna(0.5 * (rows["seen"] + rows["beyond"]))
    return rows.iloc[middle.argsort(kind="stable")]


def tables_of(rows: pd.DataFrame, longest: int) -> list[str]:
    """Return the number of events by name, a table of the decided ones for each group, and one of all others."""
    is_open = rows["what"] == "not_decided"
    counts = rows.loc[~is_open, "what"].value_counts()
    told = ", ".join(f"{n} {plain(what)}{'s' * (n > 1)}" for what, n in counts.items())
    lines = [f"{len(rows)} events: {told}, {is_open.sum()} not decided."]
    kept = rows["side"].map(
        lambda side: next((name for name, own in SIDES.items() if set(side.split(", ")) <= {*own}), "")
    )
    for name in [*SIDES, ""]:
        own = rows[~is_open & (kept == name)]
        if len(own):
            lines += ["", f"**Motions {name or 'that change between these classes'}**", ""]
            lines += ["| Hz | attractor | ends as the frequency | by | its cells go on |", "|---|---|---|---|---|"]
        for row in own.to_dict("records"):
            value, what, cells = _parts(row["sentence"])
            lines.append(f"| {value} | {_who(row)} | {'rises' if row['rises'] else 'falls'} | {what} | {cells} |")
    lines += ["", "**Not decided**", "", "| motions | end, between these values in Hz | tried |", "|---|---|---|"]
    groups: dict[tuple[str, str], list[str]] = {}
    for row in rows[is_open].to_dict("records"):
        own = f"orbits of period over {longest}" if row["period"] > longest else f"{_own(row)}s"
        low, high = sorted((row["seen"], row["beyond"]))
        ends = groups.setdefault((f"{own}, {row['side']}", _tried(row, longest)), [])
        ends.append(f"{letter(row['attractor'])} {low:.5g}-{high:.5g}")
    return lines + [f"| {who} | {', '.join(ends)} | {tried} |" for (who, tried), ends in sorted(groups.items())]


def _group(sides: str) -> str:
    return next((name for name, own in SIDES.items() if set(sides.split(", ")) <= {*own}), "")


def _parts(sentence: str) -> tuple[str, str, str]:
    """Return the value with its error, the event and what becomes of the cells, without the numbers of branches."""
    value, _, rest = sentence.partition(" = ")[2].partition(" Hz as it ")
    what, _, cells = rest.partition(": ")[2].partition("; its cells ")
    if not cells:
        what, _, cells = what.partition("; of its cells ")
    what = re.sub(r" \(branch \d+\)", "", what.replace("meets the unstable", "meets an unstable"))
    cells = cells.replace("go on ", "").replace("reach no attractor", "to none")
    return value, re.sub(r" of branch \d+", "", what), cells


def _tried(row: dict[str, object], longest: int) -> str:
    """Say in brief why an end is not decided."""
    why, _, crisis = str(row["evidence"]).partition("; no crisis: ")
    if int(str(row["period"])) > longest:
        return "no branch was followed"
    if "such ids rest on distance" in why:
        why = "the set beyond is chaotic too and may be the same"
    why = {"no orbit to follow": "neither closed, nor shown to be chaotic or a torus"}.get(why, why)
    return why + ("; no unstable orbit that was tried is met" if crisis else "")


def _own(row: dict[str, object]) -> str:
    return f"orbit of period {row['period']}" if row["period"] else plain(str(row["set"]))


def _who(row: dict[str, object]) -> str:
    own = f"period {row['period']}" if row["period"] else plain(str(row["set"]))
    after = f" to {row['period_after']}" if int(str(row["period_after"])) >= 0 else ""
    return f"{letter(int(str(row['attractor'])))}, {row['side']}, {own}{after}"


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
        run, options = magpend.run(name, given.runs / name), options_of(name)
        rows = rows_of(run, options)
        rows.to_csv(PAGE.parent / f"{name}.csv", index=False)
        run.plot.genealogy(**options).figure.savefig(PAGE.parent / f"{name}.png", dpi=120)
        PAGE.write_text(written(PAGE.read_text("utf-8"), name, tables_of(rows, LONGEST[name])), "utf-8")


if __name__ == "__main__":
    main()
