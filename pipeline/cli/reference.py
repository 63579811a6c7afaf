"""Write the tables of README and docs, and the methods of the Python package, from the code.

The command is ``python -m pipeline.cli.reference``.

A table stands between the marks ``<!-- reference: NAME -->`` and ``<!-- /reference -->``. The text between
the marks is replaced. With ``--check`` nothing is written, and the exit code is 1 if a page is out of date.
"""

from __future__ import annotations

import inspect
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.specification.table_methods import bounds_in_words, default_in_words

Row = tuple[str, str]
ROOT = Path(__file__).parents[2]
_BLOCK = re.compile(r"(<!-- reference: ([\w ]+) -->\n).*?(<!-- /reference -->)", re.DOTALL)


def pages() -> list[Path]:
    """Return the Markdown files whose tables are generated: README and docs."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def rendered(text: str) -> str:
    """Return the text of a documentation page with all its tables generated anew.

    Raises
    ------
    KeyError
        If a mark names a table that does not exist.
    """
    from pipeline.products.plugins import added

    tables = TABLES | added("tables")
    return _BLOCK.sub(lambda block: f"{block[1]}{tables[block[2]]()}\n{block[3]}", text)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a Markdown table from its head and its rows."""
    lines = [list(head), ["---"] * len(head), *(list(row) for row in rows)]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in lines)


# ---- commands ----------------------------------------------------------------------------------


def commands() -> str:
    """Return the Markdown text on all commands: the options that several share, then a section for each group with its
    commands and their own options.
    """
    found = dict(_commands())
    listed = {name: _options(command) for name, command in found.items()}
    among = Counter(row for rows in listed.values() for row in rows)
    own = {name: [row for row in rows if among[row] < _EVERYWHERE] for name, rows in listed.items()}
    bases = {name: _bases(name, own) for name in own}
    for name, others in bases.items():
        covered = {row for other in others for row in listed[other]}
        own[name] = [row for row in own[name] if row not in covered]
    again = Counter(row for rows in own.values() for row in rows)
    takers = {row: _takers([n for n in found if row in listed[n]], found) for row in among}
    shared = [(row[0], takers[row], row[1]) for row in sorted(among) if among[row] >= _EVERYWHERE or again[row] > 1]
    parts = [f"### Options of several commands\n\n{table(('option', 'commands', 'meaning'), shared)}"]
    for group, names in _groups(found).items():
        does, rows = [], []
        for name in names:
            takes = " and ".join(f"`{other}`" for other in bases[name])
            does.append((f"`magpend {name}{_arguments(found[name])}`", _does(found[name], takes)))
            rows += [(f"`{name}`", *row) for row in own[name] if again[row] == 1]
        parts.append(f"### {group}\n\n{table(('command', 'does'), does)}")
        parts += [table(("command", "option", "meaning"), rows)] if rows else []
    return "\n\n".join(parts)


_EVERYWHERE = 10
"""Number of commands from which on an option says nothing about a command."""

_COMMON = ("help", "quiet", "verbose", "log", "force", "import_object")
"""Options of every command, which the page describes above its tables."""


def _bases(name: str, own: Mapping[str, Sequence[Row]]) -> list[str]:
    """Return the commands all whose options a command has, too: the largest, of the equal ones the first."""
    order = list(own)
    smaller = [
        other
        for other, rows in own.items()
        if len(rows) > 1
        and (set(rows) < set(own[name]) or (set(rows) == set(own[name]) and order.index(other) < order.index(name)))
    ]
    found: list[str] = []
    for other in sorted(smaller, key=lambda other: -len(own[other])):
        if not set(own[other]) <= {row for one in found for row in own[one]}:
            found.append(other)
    return found


def _groups(found: Mapping[str, Any]) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for name in found:
        first, _, inner = name.partition(" ")
        groups.setdefault(f"`magpend {first}`" if inner else "Runs, models and reports", []).append(name)
    return groups


def _takers(names: Sequence[str], found: Mapping[str, Any]) -> str:
    """Return the names of commands as text; a group's name stands for all its commands."""
    parts = []
    for members in _groups(found).values():
        having, first = [name for name in members if name in names], members[0].partition(" ")[0]
        lacking = [name for name in members if name not in names]
        if len(having) > 9 and " " in members[0]:
            but = f" but {', '.join(f'`{name}`' for name in lacking)}" if lacking else ""
            parts.append(f"all of `{first}`{but}")
        else:
            parts += [f"`{name}`" for name in having]
    return ", ".join(parts)


def _does(command: Any, takes: str) -> str:
    text = _text(" ".join((command.help or "").split()))
    return f"{text} Takes the options of {takes}." if takes else text


def _options(command: Any) -> list[Row]:
    return [
        (f"`{', '.join((*p.opts, *p.secondary_opts))}{_metavar(p)}`", _help(p))
        for p in command.params
        if p.param_type_name == "option" and p.name not in _COMMON
    ]


def exit_codes() -> str:
    """Return the Markdown table of the exit codes of all commands."""
    from pipeline.cli.console import Exit

    return table(("code", "meaning"), ((str(int(code)), code.sentence) for code in Exit))


def _commands() -> list[tuple[str, Any]]:
    from typer.main import get_command

    from pipeline.cli.main import app

    def walk(group: Any, prefix: str) -> list[tuple[str, Any]]:
        found = []
        for name in group.list_commands(None):
            command = group.get_command(None, name)
            inner = hasattr(command, "list_commands")
            found += walk(command, f"{prefix}{name} ") if inner else [(f"{prefix}{name}", command)]
        return found

    return walk(get_command(app), "")


def _arguments(command: Any) -> str:
    named = (p for p in command.params if p.param_type_name == "argument")
    return "".join(f" {(p.metavar or p.name.upper())}" for p in named)


def _metavar(parameter: Any) -> str:
    return "" if parameter.is_flag else f" {parameter.metavar or 'VALUE'}"


def _help(parameter: Any) -> str:
    default = parameter.default
    has_default = isinstance(default, (int, float, str, Path)) and default is not False and default != ""
    return _text(parameter.help or "") + (f" Default: {default}." if has_default else "")


def _text(text: str) -> str:
    return text.replace("<", "&lt;")


def workflows() -> str:
    """Return the Markdown table of the specifications that ship with magpend."""
    from pipeline.specification.files import shipped_identifications, shipped_workflows

    def title(path: Path) -> str:
        return str(tomllib.loads(path.read_text("utf-8")).get("title", ""))

    shipped = {**shipped_workflows(), **shipped_identifications()}
    return table(("workflow", "what it computes"), ((f"`{n}`", title(p)) for n, p in shipped.items()))


# ---- specification -----------------------------------------------------------------------------


def specification() -> str:
    """Return Markdown tables of the keys of a run's specification."""
    from pipeline.specification import drift, noise, recorded_drive, section, starts, tables

    parts = [
        ("[parameters]", tables.ParametersTable, ""),
        ("[axes] NAME = {...}", tables.Range, "NAME is `frequency_hz` or a parameter of the model."),
        ('[initial_conditions] kind = "grid"', starts.GridStarts, _STATES.format("a number or a range {...}")),
        ('[initial_conditions] kind = "list"', starts.ListStarts, ""),
        ('[initial_conditions] kind = "random"', starts.RandomStarts, _STATES.format("a number or [low, high]")),
        (
            "[section]",
            section.SectionTable,
            "For models without a drive: see [Flows](../flows.md). Then no frequency is given.",
        ),
        ("[continuation]", tables.Continuation, 'For `kind = "continuation"` alone.'),
        (
            "[drive]",
            recorded_drive.DriveTable,
            'For `kind = "sweep"` alone: see [Recorded drives](../recorded-drives.md).',
        ),
        (
            "[drift.NAME]",
            drift.DriftTable,
            "NAME is a parameter of the model; see [Parameters that move](../drift.md). Each number is a parameter of "
            "the run, `NAME_KEY`, and can be an axis.",
        ),
        (
            "[noise]",
            noise.NoiseTable,
            'For `kind = "sweep"` alone: see [Noise](../noise.md). Each strength is a parameter `noise_STATE`, and '
            "`realization` is one, so that both can be axes.",
        ),
        ("[integration]", tables.Integration, ""),
        ("[execution]", tables.Execution, "Decides the layout of the store, never the numbers."),
    ]
    return "\n\n".join(keys(*part) for part in parts)


_STATES = (
    "Give each state of the model under its own name: {}. For an angle or its rate, `NAME_deg` takes degrees. "
    "States may also stand in a table `states = {{ NAME = ... }}`, and one with the name of a key of this table must."
)


def products() -> str:
    """Return Markdown tables of the products of a run's specification, with their keys."""
    from pipeline.products.registry import CELL_PRODUCTS

    return "\n\n".join(
        keys(f"[products] {name} = {{...}}", product.options, product.help) for name, product in CELL_PRODUCTS.items()
    )


def study() -> str:
    """Return Markdown tables of the keys of the TOML file that describes a study (figures and claims of a paper)."""
    from pipeline.report import pictures
    from pipeline.report import study as tables

    kinds = "; ".join(f"`{name}`, {kind.meaning}" for name, kind in pictures.kinds().items())
    parts = [
        keys("STUDY.toml", tables.StudyTable, "", ("runs", *tables.INPUTS, "figures")),
        keys("[runs.NAME]", tables.RunTable, "", ()),
        *(keys(f"[{key}.NAME]", kind.table, "", ()) for key, kind in tables.INPUTS.items()),
        keys("[[figures]]", tables.FigureTable, "", ("pictures", "claims")),
        keys("[[figures.pictures]]", pictures.PictureTable, f"Kinds: {kinds}.", ()),
        keys("[[figures.claims]]", tables.ClaimTable, "", ()),
    ]
    return "\n\n".join(parts)


def measures() -> str:
    """Return the Markdown table of the measures that the claims of a study can use, with their options."""
    from pipeline.report.measures import MEASURES

    rows = []
    for name, measure in MEASURES.items():
        text = inspect.getdoc(measure) or ""
        first, _, more = text.partition("\n\n")
        first = _flat(first).removeprefix("Return the ")
        rows.append((f"`{name}`", f"{first[:1].upper()}{first[1:]}", _flat(more)))
    return table(("measure", "what it is", "options and interval"), rows)


def _flat(text: str) -> str:
    return " ".join(text.replace("``", "`").split())


def keys(head: str, model: Any, more: str, left_out: Sequence[str] = ("kind",)) -> str:
    """Return a Markdown section on the keys of a table of a TOML file, with a text above."""
    rows = []
    for name, info in model.model_fields.items():
        if name in left_out:
            continue
        extra: Any = info.json_schema_extra or {}
        unit = f" [{extra['unit']}]" if extra.get("unit") else ""
        meaning = f"{(info.description or '').rstrip('.')}{unit}"
        rows.append((f"`{info.alias or name}`", default_in_words(info), bounds_in_words(info), meaning))
    text = f"{more}\n\n" if more else ""
    return f"### `{head}`\n\n{text}{table(('key', 'default', 'bounds', 'meaning'), rows)}"


# ---- cube --------------------------------------------------------------------------------------


def variables() -> str:
    """Return the Markdown table of the variables of a run's result cube; those of products come last."""
    from magpend_core.models import load_model
    from pipeline.layout.schema import REST_STATE, RETURN_TIME, STRONG_ERROR, base_variables
    from pipeline.products.registry import CELL_PRODUCTS

    model = load_model()
    examples: dict[str, dict[str, Any]] = {
        "extremes": {"quantities": ("energy",)},
        "rotation": {"of": model.state_names[:1]},
    }
    found = [("", variable) for variable in base_variables(model)]
    found += [("`[section]`", variable) for variable in (RETURN_TIME, REST_STATE)]
    found.append(("`[noise]`", STRONG_ERROR))
    for name, product in CELL_PRODUCTS.items():
        options = product.settle(product.options(**examples.get(name, {})), model)
        found += [(name, variable) for variable in product.variables(options, model)]
    rows = (
        (f"`{v.name}`", ", ".join(f"`{d}`" for d in v.own_dims), v.dtype, v.units, v.long_name, product)
        for product, v in found
    )
    return table(("variable", "own dims", "type", "unit", "meaning", "product"), rows)


def results() -> str:
    """Return the Markdown text on the variables of the result of each analysis."""
    from pipeline.products.column import POINTS, STARTS
    from pipeline.products.registry import ANALYSES

    dims = {POINTS: "swept parameters", STARTS: "starts"}
    parts = []
    for name in ANALYSES.listed:
        rows = [
            (f"`{c.own or c.name}`", ", ".join(dims.get(d, f"`{d}`") for d in c.dims.split()), c.unit, c.text)
            for c in ANALYSES[name].columns
        ]
        parts.append(f"## {name}\n\n{table(('variable', 'dims', 'unit', 'meaning'), rows)}")
    return "\n\n".join(parts)


def divisions() -> str:
    """Return the Markdown table of how analyses are divided for threads, processes and clusters."""
    from pipeline.products.registry import ANALYSES

    by_point = ", ".join(f"`{name}`" for name in ANALYSES.listed if ANALYSES[name].by_point)
    rows = [(f"the search for attractors, {by_point}", "in blocks of parameter points")]
    for name in ANALYSES.listed:
        one = ANALYSES[name]
        if one.parts:
            rows.append((f"`{name}`", f"in blocks of rows, along `{one.rows}`"))
        elif one.whole:
            rows.append((f"`{name}`", f"in one process: {one.whole}"))
    return table(("analysis", "is computed"), rows)


def event_kinds() -> str:
    """Return the Markdown table of the kinds of events."""
    from pipeline.analysis.events.kinds import EVENTS

    rows = ((f"`{kind.name}`", f"`{kind.label}`" if kind.label else "", kind.text) for kind in EVENTS.values())
    return table(("name", "label", "event"), rows)


def conventions() -> str:
    """Return the Markdown table of the attributes that describe the variables of an opened cube or result."""
    from pipeline.layout.conventions import ADDED

    return table(("attribute", "contents"), ((f"`{name}`", contents) for name, contents in ADDED.items()))


def statuses() -> str:
    """Return the Markdown table of the status codes of a trajectory."""
    from magpend_core.status import Status

    return table(("code", "status", "meaning"), ((str(int(s)), f"`{s.name.lower()}`", s.sentence) for s in Status))


def models() -> str:
    """Return the Markdown table of the models that ship with magpend."""
    from magpend_core.models import load_model, model_names

    rows = []
    for name in model_names():
        model = load_model(name)
        states = ", ".join(f"`{s.name}` [{s.unit}]" for s in model.states)
        presets = ", ".join(f"`{p}`" for p in model.preset_names)
        rows.append((f"`{name}`", model.title, states, presets))
    return table(("model", "what it is", "states", "presets"), rows)


def public() -> str:
    """Return the public names of the Python package, as Markdown text."""
    import magpend

    return ", ".join(f"`{name}`" for name in dir(magpend) if not name.startswith("_"))


TABLES: dict[str, Callable[[], str]] = {
    "commands": commands,
    "exit codes": exit_codes,
    "workflows": workflows,
    "specification": specification,
    "products": products,
    "study": study,
    "measures": measures,
    "variables": variables,
    "results": results,
    "divisions": divisions,
    "events": event_kinds,
    "conventions": conventions,
    "statuses": statuses,
    "models": models,
    "public": public,
}


# ---- methods of Python --------------------------------------------------------------------------

FACE = ROOT / "pipeline/face/magpend"


def methods() -> str:
    """Return the module with the analyses of a run and its figures as methods, for type checkers and for ``help``."""
    from pipeline.products.registry import ANALYSES, FIGURES, OWN

    imports: dict[str, str] = {}

    def declared(name: str, kind: str, options: type) -> str:
        room, _, module = options.__module__.rpartition(".")
        alias = f"of_{room.rpartition('.')[2] if module == 'declaration' else module}"
        imports[alias] = f"from {room} import {module} as {alias}"
        return f"    {name} = {kind}({alias}.{options.__name__})"

    def panels(name: str) -> str:
        figure = FIGURES[name]
        if name == "bifurcation":
            return "Bifurcation"
        return {"one": "OnePanel", "several": "SeveralPanels"}.get("" if figure.unless else figure.panels, "AnyPanels")

    analyses = [declared(name, "AnalysisMethod", ANALYSES[name].options) for name in OWN if name in ANALYSES]
    figures = [declared(name, panels(name), FIGURES[name].options) for name in OWN if name in FIGURES]
    kinds = sorted({line.partition(" = ")[2].partition("(")[0] for line in analyses + figures})
    return "\n".join(
        [
            '"""The analyses of a run and its figures as methods, made by ``python -m pipeline.cli.reference``."""',
            "",
            "from __future__ import annotations",
            "",
            f"from magpend._methods import {', '.join(kinds)}",
            *sorted(imports.values()),
            "",
            "",
            "class Analyses:",
            '    """The analyses of a run."""',
            "",
            *analyses,
            "",
            "",
            "class Figures:",
            '    """The figures of a run."""',
            "",
            *figures,
            "",
        ]
    )


def names() -> str:
    """Return the stub of the Python package, whose last lines list the functions of analyses."""
    from pipeline.products.registry import ANALYSES, OWN

    stub = (FACE / "__init__.pyi").read_text("utf-8")
    listed = [f"{name} = Run.{name}" for name in OWN if name in ANALYSES]
    return "\n".join([stub.partition(_OF_ANALYSES)[0] + _OF_ANALYSES, *listed, ""])


_OF_ANALYSES = "# analyses, made by python -m pipeline.cli.reference"


def stale() -> dict[Path, str]:
    """Return the new texts of the pages and modules that are out of date, by path."""
    texts = {page: rendered(page.read_text("utf-8")) for page in pages()}
    texts |= {FACE / "_names.py": methods(), FACE / "__init__.pyi": names()}
    return {path: text for path, text in texts.items() if path.read_text("utf-8") != text}


def main() -> None:
    """Rewrite the pages that are out of date or, with ``--check``, list them."""
    check = "--check" in sys.argv[1:]
    found = stale()
    for path, text in found.items():
        print(f"{'out of date' if check else 'written'}: {path.relative_to(ROOT)}")
        if not check:
            path.write_text(text, "utf-8")
    if check and found:
        sys.exit(1)


if __name__ == "__main__":
    main()
