"""Tabulate the events of the pendulum's attractors: ``python docs/pendulum_events.py [--runs FOLDER] [NAME...]``.

A name is that of a workflow. Its run is computed (a complete one is taken as it is), its events are named as by
``magpend analyse events RUN --stable --period 12``, and the tables of the tutorial are written anew, between the
marks ``<!-- events: NAME -->`` and ``<!-- end -->``; without names all that have marks. Beside the tutorial lie the
figure and a CSV file with all columns.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import pandas as pd

import magpend
from pipeline.layout.vocabulary import letter

PAGE = Path(__file__).resolve().parent / "tutorials" / "bifurcations.md"
OPTIONS = {"stable": True, "max_period": 12}


def computed(name: str, folder: Path) -> magpend.Run:
    """Return the run of a workflow, complete."""
    return magpend.run(name, folder / name)


def rows_of(run: magpend.Run) -> pd.DataFrame:
    """Return the events of a run by rising frequency, each with the side of its attractor."""
    rows = run.table("events", **OPTIONS)
    sides = run.table("attractors").groupby("attractor_id")["side"].agg(lambda own: ", ".join(sorted(set(own))))
    rows = rows[~rows["what"].isin(["range_end", "lives_on"])].assign(side=rows["attractor"].map(sides))
    middle = rows["value"].fillna(0.5 * (rows["seen"] + rows["beyond"]))
    return rows.iloc[middle.argsort(kind="stable")]


def tables_of(rows: pd.DataFrame) -> list[str]:
    """Return the decided events as a Markdown table, and below it the intervals in which nothing is decided."""
    is_open = rows["what"] == "not_decided"
    lines = ["| Hz | attractor | lost as the frequency | by | its cells |", "|---|---|---|---|---|"]
    for row in rows[~is_open].to_dict("records"):
        value, what, cells = _parts(row["sentence"])
        lines.append(f"| {value} | {_who(row)} | {_way(row)} | {what} | {cells} |")
    lines += ["", f"{is_open.sum()} of {len(rows)} events are not decided:", ""]
    lines += ["| Hz | attractor | lost as the frequency | tried | its cells |", "|---|---|---|---|---|"]
    for row in rows[is_open].to_dict("records"):
        low, high = sorted((row["seen"], row["beyond"]))
        cells = row["sentence"].rpartition("); ")[2].removeprefix("of its cells ").removeprefix("its cells ")
        lines.append(f"| {low:.5g} to {high:.5g} | {_who(row)} | {_way(row)} | {row['evidence']} | {cells} |")
    return lines


def _parts(sentence: str) -> tuple[str, str, str]:
    """Return the value with its error, the event and what becomes of the cells, without the numbers of branches."""
    value, _, rest = sentence.partition(" = ")[2].partition(" Hz as it ")
    what, _, cells = rest.partition(": ")[2].partition("; ")
    what = re.sub(r" \(branch \d+\)", "", what.replace("meets the unstable", "meets an unstable"))
    return value, re.sub(r" of branch \d+", "", what), cells.removeprefix("of its cells ").removeprefix("its cells ")


def _who(row: dict[str, object]) -> str:
    own = f"period {row['period']}" if row["period"] else str(row["set"]).replace("_", " ")
    after = f" to {row['period_after']}" if int(str(row["period_after"])) >= 0 else ""
    return f"{letter(int(str(row['attractor'])))}, {row['side']}, {own}{after}"


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
    marked = re.findall(r"<!-- events: (\w+) -->", PAGE.read_text("utf-8"))
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("names", nargs="*", default=marked, metavar="NAME", help=f"workflows: {', '.join(marked)}")
    words.add_argument("--runs", type=Path, default=Path("runs"), help="folder of the runs")
    given = words.parse_args()
    for name in given.names:
        run = computed(name, given.runs)
        rows = rows_of(run)
        rows.to_csv(PAGE.parent / f"{name}.csv", index=False)
        run.plot.genealogy(**OPTIONS).figure.savefig(PAGE.parent / f"{name}.png", dpi=120)
        PAGE.write_text(written(PAGE.read_text("utf-8"), name, tables_of(rows)), "utf-8")


if __name__ == "__main__":
    main()
