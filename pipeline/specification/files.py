"""Find, read and write the TOML files of specifications and models."""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from importlib import resources
from pathlib import Path
from typing import Any

from magpend_core.models.imported import KEY
from pipeline.specification.problems import SpecError, unknown_name

MOST_TOML_BYTES = 1_000_000
MOST_TEXT_BYTES = 20_000_000
"""Most bytes of a CSV file that a table names."""
MOST_ELEMENTS = 100_000
"""Most elements of an array."""
MOST_DEPTH = 32
MOST_KEY = 200
"""Most characters of a key."""
STUDY = "study.toml"
"""File name of a study that ships; its folder has the study's name."""
WHOLE_NUMBERS = range(-(2**63), 2**63)

IDENTIFICATION = "identification"
"""Kind of the specifications that `pipeline.rig.identify` reads."""
GALLERY = "gallery"
"""Folder of the shipped specifications that are named with their folder, ``gallery/NAME``: one per published figure."""


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return the tables of a TOML file.

    Raises
    ------
    SpecError
        If the file cannot be read, or holds data that no specification can have (see `odd_data`).
    """
    try:
        with open(path, "rb") as file:
            content = file.read(MOST_TOML_BYTES + 1)
    except OSError as error:
        raise SpecError(f"{path}: {_unreadable(error)}") from None
    return toml_tables(content, str(path))


def read_text(path: str | Path, remedy: str = "") -> tuple[str, str]:
    """Return the text of a CSV file and its sha256.

    Parameters
    ----------
    path
        The file.
    remedy
        End of the message if it cannot be read.

    Raises
    ------
    SpecError
        If it cannot be read, is not text, or is too large.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise SpecError(f"{path}: cannot be read ({error.strerror or error}){remedy}.") from None
    if len(content) > MOST_TEXT_BYTES:
        raise SpecError(f"{path}: has {len(content)} bytes; give at most {MOST_TEXT_BYTES}: choose a part, or thin it.")
    try:
        return content.decode("utf-8"), hashlib.sha256(content).hexdigest()
    except UnicodeDecodeError:
        raise SpecError(f"{path}: is not text in UTF-8; give a CSV file.") from None


def with_text(table: Any, folder: str | Path, at: str, problems: list[str], remedy: str = "") -> Any:
    """Return a table with the text and the sha256 of the file that it names, unless it has them."""
    if not isinstance(table, dict) or not isinstance(table.get("file"), str) or "text" in table:
        return table
    path = Path(folder) / table["file"]
    try:
        text, digest = read_text(path, remedy)
    except SpecError as error:
        problems += [f"{at}.file = {table['file']!r}: {p.removeprefix(f'{path}: ')}" for p in error.problems]
        return table
    return {"sha256": digest, **table, "text": text}


def has_digest(text: str, sha256: str | None, file: str | None, at: str, problems: list[str]) -> bool:
    """Return whether the text of a file has the digest of its table; if not, add a problem."""
    if hashlib.sha256(text.encode()).hexdigest() == sha256:
        return True
    problems.append(
        f"{at}.sha256 = {sha256!r}: is not the digest of {file}; drop the key, or restore the file with this digest."
    )
    return False


def shipped_files(pattern: str) -> list[Path]:
    """Return the files of the package ``workflows`` that match a pattern, sorted; empty if it is not installed."""
    try:
        return sorted(Path(str(resources.files("workflows"))).glob(pattern))
    except ModuleNotFoundError:
        return []


def find_file(what: str, name: str | Path, shipped: Mapping[str, Path]) -> Path:
    """Return the path of a file, given as a path or as the name of a shipped one.

    Parameters
    ----------
    what
        Kind of the file, for the message.
    name
        Path or name.
    shipped
        Shipped files by name.

    Raises
    ------
    SpecError
        If neither a file nor a shipped one has the name.
    """
    path = Path(name)
    if path.exists():
        return path
    if str(name) in shipped:
        return shipped[str(name)]
    beside = {file.stem: str(file) for file in sorted(path.parent.glob("*.toml"))}
    near = [beside[stem] for stem in get_close_matches(path.stem, beside, n=2, cutoff=0.6)]
    if near and not get_close_matches(str(name), shipped, n=1, cutoff=0.6):
        raise SpecError(f"{name}: no such file; did you mean {' or '.join(near)}?")
    if path.suffix:
        return path
    folders = {known.partition("/")[0] for known in shipped if "/" in known}
    if len(path.parts) > 1 and path.parts[0] not in folders:
        return path
    raise SpecError(f"{name}: no such file; {unknown_name(what, str(name), shipped)}")


def find_spec(name: str | Path) -> Path:
    """Return the path of a specification, given as a path or by the name of a shipped workflow.

    Raises
    ------
    SpecError
        If neither a file nor a workflow has the name.
    """
    return find_file("workflow", name, _shipped())


def shipped_workflows() -> dict[str, Path]:
    """Return the paths of the run specifications that ship with magpend, by name."""
    return {name: path for name, path in _shipped().items() if not _identifies(path)}


def shipped_identifications() -> dict[str, Path]:
    """Return the paths of the specifications of identifications that ship with magpend, by name."""
    return {name: path for name, path in _shipped().items() if _identifies(path)}


def _identifies(path: Path) -> bool:
    return tomllib.loads(path.read_text("utf-8")).get("kind") == IDENTIFICATION


def _shipped() -> dict[str, Path]:
    figures = {f"{GALLERY}/{path.stem}": path for path in shipped_files(f"{GALLERY}/*.toml") if path.name != STUDY}
    return {path.stem: path for path in shipped_files("*.toml")} | figures


def default_directory(spec_path: Path, smoke: bool) -> Path:
    """Return the default run directory of a specification file: ``runs/NAME``."""
    # a dot in a name such as fail_0.05.toml begins no suffix
    return Path("runs") / (spec_path.name.removesuffix(".toml") + ("-smoke" if smoke else ""))


def check_new_file(path: str | Path, suffixes: Sequence[str]) -> Path:
    """Return the path of a file to write; raise `SpecError` if its suffix is not one of `suffixes`, or its folder does
    not exist.
    """
    target = Path(path)
    if target.suffix.lower() not in suffixes:
        raise SpecError(f"{path}: the suffix must be {'one of ' if len(suffixes) > 1 else ''}{', '.join(suffixes)}.")
    if not target.parent.is_dir():
        raise SpecError(f"{target.parent}: no such folder; make it first.")
    return target


def write_new(path: Path, text: str, option: str) -> None:
    """Write a text to a file; raise `SpecError` if the file exists, naming the option that gives another one."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise SpecError(f"{path}: exists already and is not overwritten; give another {option}.") from None


def toml_tables(content: bytes, name: str) -> dict[str, Any]:
    """Parse TOML text and return its tables; error messages call the text `name`.

    Raises
    ------
    SpecError
        If the text is not TOML, or holds data that no specification can have.
    """
    try:
        if len(content) > MOST_TOML_BYTES:
            raise SpecError(
                f"{name}: has more than {MOST_TOML_BYTES // 1_000_000} MB, the limit of a specification; "
                "give ranges, or random starts with a seed, instead of lists."
            )
        data = tomllib.loads(content.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        if isinstance(error, SpecError):
            raise
        raise SpecError(f"{name}: {_unreadable(error)}") from None
    problems = odd_data(data)
    if problems:
        raise SpecError([f"{name}: {problem}" for problem in problems])
    return data


def _unreadable(error: Exception) -> str:
    if isinstance(error, OSError):
        return f"cannot be read ({error.strerror or error})."
    if isinstance(error, UnicodeDecodeError):
        return "is not text in UTF-8; a specification is a TOML file."
    if isinstance(error, tomllib.TOMLDecodeError):
        return f"is not valid TOML: {error}."
    if isinstance(error, RecursionError):
        return f"is nested too deeply; a specification has at most {MOST_DEPTH} levels of tables and lists."
    # Python's own bound on the digits of a whole number; or a path with a null character
    return f"is not valid TOML: {str(error).partition(';')[0].partition(':')[0]}."


def odd_data(data: Any) -> list[str]:
    """Return problems of data that no valid specification can have: deep nesting, long lists or keys, huge integers.

    Later code may then recurse into the data, convert whole numbers to floats and repeat keys in messages.
    """
    todo: list[tuple[str, Any, int]] = [("", data, 0)]
    while todo:
        place, value, depth = todo.pop()
        if depth > MOST_DEPTH:
            return [f"{place[:MOST_KEY]}: is nested too deeply; the limit is {MOST_DEPTH} levels of tables and lists."]
        if isinstance(value, Mapping):
            for key, inner in value.items():
                if not isinstance(key, str):
                    return [f"{place or 'specification'}: the key {key!r} is not a text."]
                if len(key) > MOST_KEY:
                    return [f"{key[:40]}...: this key has {len(key)} characters; the limit is {MOST_KEY}."]
                todo.append((f"{place}.{key}" if place else key, inner, depth + 1))
        elif isinstance(value, (list, tuple)):
            if len(value) > MOST_ELEMENTS:
                return [
                    f"{place[:MOST_KEY]}: has {len(value)} elements; the limit is {MOST_ELEMENTS} in an "
                    "array. Give ranges, or random starts with a seed."
                ]
            todo += [(place, v, depth + 1) for v in value if not isinstance(v, (float, str, bool))]
        elif isinstance(value, int) and value not in WHOLE_NUMBERS:
            bits = value.bit_length()
            return [f"{place}: has {bits} bits; a whole number in TOML has at most 64. Write it as 1e300."]
    return []


def nested(table: Mapping[str, Any]) -> dict[str, Any]:
    """Expand dotted keys to nested dicts: ``{"a.b": 1}`` becomes ``{"a": {"b": 1}}``."""
    result: dict[str, Any] = {}
    for key, value in table.items():
        *parents, last = key.split(".")
        inner = nested(value) if isinstance(value, dict) else value
        for parent in reversed(parents):
            inner, last = {last: inner}, parent
        result = merged(result, {last: inner})
    return result


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` updated by `changes`: nested tables are merged key by key, other values are replaced."""
    result = dict(base)
    for key, value in changes.items():
        old = result.get(key)
        result[key] = merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return result


def toml_key(key: str) -> str:
    """Format a TOML key, quoted if necessary."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else toml_value(key)


def toml_value(value: Any) -> str:
    """Format a number, text, boolean, list or inline table as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON escapes every character that TOML requires, except DEL
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{toml_key(k)} = {toml_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        items = [toml_value(v) for v in value]
        if any(isinstance(v, list | tuple) for v in value):
            return "[\n" + "".join(f"    {item},\n" for item in items) + "]"
        return "[" + ", ".join(items) + "]"
    return repr(value.item() if hasattr(value, "item") else value)  # numbers of numpy, too


def _toml_of(key: str, value: Any) -> str:
    """Return the TOML of a value; the source of a function has its lines."""
    if key != "function" or not isinstance(value, str):
        return toml_value(value)
    return '"""\n' + "\n".join(toml_value(line)[1:-1] for line in value.split("\n")) + '"""'


def table_lines(head: str, table: Mapping[str, Any]) -> list[str]:
    """Return the TOML lines of a table and of the tables in it, each below its own header."""
    plain = {key: value for key, value in table.items() if not isinstance(value, Mapping)}
    lines = [f"[{head}]", *(f"{toml_key(key)} = {_toml_of(key, value)}" for key, value in plain.items())]
    for key, inner in table.items():
        if key not in plain:
            entries = (f"{toml_key(k)} = {toml_value(v)}" for k, v in inner.items())
            lines += ["", f"[{head}.{toml_key(key)}]", *entries]
    return lines


ORDER = (
    "parameters",
    "axes",
    "initial_conditions",
    "section",
    "drive",
    "drift",
    "noise",
    "continuation",
    "integration",
    "products",
    "execution",
    "smoke",
)
"""Tables of a specification in the order of a file. A model as text comes last, with its own tables."""


def specification_toml(tables: Mapping[str, Any]) -> str:
    """Return the tables of a specification as TOML text. Empty tables are left out.

    Parameters
    ----------
    tables
        Plain data with the keys of a specification. Values that no specification has are written as they
        are, for the reader to report.
    """
    model = tables.get("model")
    text = model_toml(model) if isinstance(model, str | Mapping) else None
    plain = {key: value for key, value in tables.items() if key != "model" and not isinstance(value, Mapping)}
    lines = [f"{toml_key(key)} = {toml_value(value)}" for key, value in plain.items()]
    if model is not None and (text is None or not text.startswith("[")):
        lines.append(text.rstrip("\n") if text is not None else f"model = {toml_value(model)}")
    names = [key for key in tables if key not in plain and key != "model"]
    for name in sorted(names, key=lambda n: ORDER.index(n) if n in ORDER else len(ORDER)):
        entries = [f"{toml_key(k)} = {toml_value(v)}" for k, v in tables[name].items()]
        lines += ["", f"[{toml_key(name)}]", *entries] if entries else []
    if text is not None and text.startswith("["):
        lines += ["", text.rstrip("\n")]
    return "\n".join(lines).lstrip("\n") + "\n"


def model_toml(reference: str | Mapping[str, Any]) -> str:
    """Format the reference to a model as TOML: one line for a name, or the tables of a model given as text.

    For a Python object this is its import path, which is imported when the file is read. Tables must come
    last in a file.
    """
    if isinstance(reference, str):
        return f"model = {toml_value(reference)}\n"
    if KEY in reference:
        return f"model = {toml_value(reference[KEY])}\n"
    return "\n".join(table_lines("model", reference)) + "\n"
