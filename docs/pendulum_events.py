"""Tabulate the events of the pendulum's attractors: ``python docs/pendulum_events.py [--runs FOLDER] [NAME...]``.

For each workflow of `RUNS`, or those named, the run is computed (a complete one is taken as it is), its events are
named by ``magpend analyse events RUN --stable``, and the tables between the marks ``<!-- events: NAME -->`` and
``<!-- end -->`` of the tutorial are written anew. A CSV file beside the tutorial has all columns.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import pandas as pd

import magpend
from pipeline.layout.vocabulary import letter

PAGE = Path(__file__).resolve().parent / "tutorials" / "bifurcations.md"
RUNS = ("events_2_3hz", "events_0p1_2hz")


def computed(name: str, folder: Path) -> magpend.Run:
    """Return the run of a workflow, complete."""
    return magpend.run(name, folder / name)


def rows_of(run: magpend.Run) -> pd.DataFrame:
    """Return the events of a run by rising frequency, each with the sides of its attractor."""
    rows = run.table("events", stable=True)
    sides = run.table("attractors").groupby("attractor")["side"].agg(lambda own: ", ".join(sorted(set(own))))
    rows = rows[~rows["what"].isin(["range_end", "lives_on"])].assign(side=rows["attractor"].map(sides))
    middle = rows["value"].fillna(0.5 * (rows["seen"] + rows["beyond"]))
    return rows.iloc[middle.argsort(kind="stable")]


def table_of(rows: pd.DataFrame) -> list[str]:
    """Return the decided events as a Markdown table, and below it the intervals in which nothing is decided."""
    decided, is_open = rows[rows["what"] != "not_decided"], rows["what"] == "not_decided"
    lines = ["| Hz | attractor | event |", "|---|---|---|"]
    for row in decided.to_dict("records"):
        value, _, what = row["sentence"].partition(" = ")[2].partition(": ")
        at, _, way = value.partition(" Hz as it ")
        lines.append(f"| {at} | {_who(row)}, as the frequency {way} | {what} |")
    lines += [
        "",
        f"Not decided are {is_open.sum()} of {len(rows)} ends:",
        "",
        "| Hz | attractor | tried |",
        "|---|---|---|",
    ]
    for row in rows[is_open].to_dict("records"):
        low, high = sorted((row["seen"], row["beyond"]))
        lines.append(f"| {low:.5g} to {high:.5g} | {_who(row)}, as the frequency {_way(row)} | {row['evidence']} |")
    return lines


def _who(row: dict[str, object]) -> str:
    own = f"period {row['period']}" if row["period"] else str(row["set"]).replace("_", " ")
    return f"{letter(int(str(row['attractor'])))}, {row['side']}, {own}"


def _way(row: dict[str, object]) -> str:
    return "rises" if row["rises"] else "falls"


def written(page: str, name: str, lines: list[str]) -> str:
    """Return a page with the tables of a run between its marks."""
    marks = re.compile(rf"(<!-- events: {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    page, n = marks.subn(lambda at: at[1] + "\n".join(lines) + "\n" + at[2], page)
    if n != 1:
        raise ValueError(f"{PAGE.name} has {n} marks of {name}; it must have one")
    return page


def main() -> None:
    """Compute what the command line names, and write the page and its files."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("names", nargs="*", default=RUNS, metavar="NAME", help=f"workflows: {', '.join(RUNS)}")
    words.add_argument("--runs", type=Path, default=Path("runs"), help="folder of the runs")
    given = words.parse_args()
    for name in given.names:
        rows = rows_of(computed(name, given.runs))
        rows.to_csv(PAGE.parent / f"{name}.csv", index=False)
        PAGE.write_text(written(PAGE.read_text("utf-8"), name, table_of(rows)), "utf-8")


if __name__ == "__main__":
    main()
