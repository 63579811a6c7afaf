"""``magpend model``, the page on systems of one's own, and presets in files."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import pytest
import xarray as xr

from magpend_core.models.preset_writing import write_preset
from magpend_core.models.text.grammar import FUNCTIONS
from magpend_core.models.text.reading import KEYS
from pipeline.runs.modelling import TEMPLATE
from pipeline.specification.spec import Spec


@pytest.mark.slow
def test_new__runs_as_it_is_and_overwrites_nothing(main, tmp_path):
    code, out, _ = main("model", "new", "mine.toml")
    assert (code, out) == (0, "specification: mine.toml\n")
    assert main("model", "new")[1] == (tmp_path / "mine.toml").read_text()
    for file in ("mine.toml", "mine.txt", "nowhere/mine.toml"):
        assert main("model", "new", file)[0] == 2
    code, _, said = main("run", "mine.toml", "--smoke", "--workers", 0)
    assert code == 0, said
    assert (tmp_path / "runs" / "mine-smoke" / "run.json").is_file()


def test_template__every_line_that_is_offered_can_be_taken(tmp_path):
    """Each block of lines behind # by itself, and all at once."""
    lines = TEMPLATE.read_text("utf-8").splitlines()
    offered = [i for i, line in enumerate(lines) if re.match(r"#(?! |$)", line)]
    assert len(offered) > 15
    whole = [line[1:] if i in offered else line for i, line in enumerate(lines)]
    path = tmp_path / "whole.toml"
    # a state more has an equation more: those two come together
    path.write_text("\n".join(whole))
    spec = Spec.read(path)
    assert spec.model.state_names == ("x", "v", "th")
    assert spec.model.drawing is not None
    assert spec.model.classifier is not None
    assert len(spec.model.definition.impacts) == 1


def test_show__text_of_a_specification(main, tmp_path, own):
    (tmp_path / "spec.toml").write_text(own.spec(own.text))
    code, out, said = main("model", "show", "spec.toml")
    assert code == 0, said
    for line in ("  drive = A*cos(2*pi*f*t)", "  dx/dt = v", "  dv/dt = drive - d*v - x**3", "  A  N  amplitude"):
        assert line in out.splitlines()
    assert "checks: passed" in out
    found = json.loads(main("model", "show", "spec.toml", "--json")[1])
    assert found["equations"] == {"x": "v", "v": "drive - d*v - x**3"}
    assert (found["kind"], found["has_drive"]) == ("flow", True)
    code, out, _ = main("model", "show", "spec.toml", "--latex")
    assert out.startswith("\\begin{align}\n")
    assert r"\frac{\mathrm{d}\dot{x}}{\mathrm{d}t} &= \mathrm{drive} - d \, \dot{x} - x^{3}" in out


def test_show__file_of_a_model_and_one_that_ships(main, tmp_path, own):
    (tmp_path / "shared.toml").write_text(own.text.replace("[model]", "").replace('name = "duffing5"', ""))
    code, out, _ = main("model", "show", "shared.toml")
    assert code == 0
    assert out.startswith("shared: ")
    code, out, _ = main("model", "show", "duffing")
    assert code == 0
    assert "checks: passed" in out
    code, _, said = main("model", "show", "duffing", "--latex")
    assert code == 2
    assert "is not a text model" in said


def test_run__start_without_a_value_is_refused_before_anything_is_made(main, tmp_path, own):
    (tmp_path / "spec.toml").write_text(own.spec(own.text.replace("x**3", "log(x + 0.5)")))
    code, _, said = main("run", "spec.toml", "--workers", 0)
    assert code == 2
    assert "model.equations.v: log(x + 0.5): logarithm of -0.5 at the start x = -1" in said
    assert not (tmp_path / "runs").exists()
    assert main("run", "spec.toml", "--dry-run")[0] == 2


IMPACT = '\n[[model.impacts]]\nof = "x - d"\ndirection = "up"\nset = { v = "-0.5*v" }\n'
FORCES = {
    "-0.3*tanh(v/0.01)": r"layer: tanh where v passes 0; half-width 0\.0157, jump 0\.6",
    "-0.3*atan(100*(v - 0.2))*2/pi": r"layer: atan where v - 0\.2 passes 0; half-width 0\.01, jump 0\.6",
    "-0.3*sign(v - 0.2)": r"switch: a jump where v - 0\.2 passes 0; a step ends there, and motion may slide",
    "-abs(x)": r"switch: a corner where x passes 0; a step ends there$",
}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        # half-widths are the poles of the functions: pi/2 of tanh, 1 of the arctangent, over the slope
        *(("- x**3", f"- x**3 + ({force})", words) for force, words in FORCES.items()),
        ("A*cos(2*pi*f*t)", "A*square(t*f, 0.25)", r"edges: 2 per period of the drive, at 0, 0\.25 of it"),
        ("drive - d*v", "-d*v", "no drive"),
        ("", IMPACT, r"impact: where x - d rises through 0, v becomes -0\.5\*v"),
        # what is wrong has its place
        ("- d*v", "- dd*v", r"(?s)equations\.v.*did you mean d\?"),
        ("x**3", "x**3/(x - x)", r"(?s)equations\.v.*division by 0"),
        ('v = "drive', 'w = "drive', r"(?s)equations\.w.*there is no such state"),
    ],
)
def test_show__steep_places_with_their_numbers_and_what_is_wrong(main, tmp_path, own, old, new, words):
    text = own.text.replace(old, new) if old else own.text + new
    (tmp_path / "shared.toml").write_text(text)
    code, out, said = main("model", "show", "shared.toml")
    assert code == (2 if "equations" in words else 0), said
    assert re.search(words, said if code else out, re.MULTILINE), out + said


def test_show__flow_seen_at_crossings_is_shown_as_it_is_written(main, tmp_path, own):
    text = own.spec(own.text.replace("drive - d*v", "-d*v"), '[section]\nof = "v"').replace("frequency_hz =", "# ")
    (tmp_path / "spec.toml").write_text(text)
    code, out, said = main("model", "show", "spec.toml")
    assert code == 0, said
    assert "  dv/dt = -d*v - x**3" in out
    assert "section_value" not in out
    assert "checks: passed (finite at the starts; Jacobian equal to differences)" in out


def test_run__what_is_said_of_states_is_checked_where_equations_are_wrong(main, tmp_path, own):
    text = own.spec(own.text, "[axes]\nB = { values = [1.0, 2.0] }").replace("- d*v", "- dd*v")
    (tmp_path / "spec.toml").write_text(text.replace("\nx = { start", "\ny = { start"))
    said = main("run", "spec.toml")[2]
    for words in ("did you mean d?", "axes.B: 'B' is not a parameter", "initial_conditions.y: unknown key"):
        assert words in said
    assert "section" not in said


# ---- docs: "your own system in ten minutes" --------------------------------------------------------------

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "own-system.md").read_text("utf-8")


def block(mark: str, language: str) -> str:
    (text,) = re.findall(rf"<!-- {mark} -->\n```{language}\n(.*?)```", PAGE, re.DOTALL)
    return text


def test_own_system__text_of_the_page_is_twenty_lines_and_errors_are_as_it_says(main, tmp_path):
    text = block("file: mine.toml", "toml")
    lines = [line for line in text.splitlines() if line.strip()]
    assert len(lines) <= 25
    wrong = text.replace("drive - d*v", "driv - d*v").replace("rtol = 1e-7", "rtol = -1")
    wrong = wrong.replace("\natol", "\n#")
    (tmp_path / "mine.toml").write_text(wrong, "utf-8")
    said = main("run", "mine.toml")[2]
    for line in said.splitlines():
        assert line in PAGE
    (tmp_path / "mine.toml").write_text(text.replace("- x**3", "- log(x + 0.5)"), "utf-8")
    said = main("run", "mine.toml", "--smoke")[2]
    assert said[:100] in PAGE


def test_own_system__page_names_every_key_and_function():
    for key in KEYS:
        assert f"`{key}`" in PAGE, key
    (functions,) = re.findall(r"^    (sin (?:.+\n)+)", PAGE, re.MULTILINE)
    assert set(functions.split()) == set(FUNCTIONS)


def test_own_system__section_without_a_drive_fits():
    sections = re.findall(r"```toml\n(\[section\].*?)```", PAGE, re.DOTALL)
    assert len(sections) == 2  # a state, and an expression
    for section in sections:
        data = tomllib.loads(block("file: mine.toml", "toml") + "\n" + section)
        data["model"]["equations"]["v"] = "(1 - x**2)*v - x"
        del data["parameters"], data["model"]["define"], data["smoke"]
        assert Spec.parse(data).section is not None


# ---- presets in files ------------------------------------------------------------------------------------


@pytest.fixture
def rig(tmp_path):
    values = {"damping": 0.2, "linear": -1.0, "cubic": 1.0, "amplitude": 0.3}
    return write_preset(
        tmp_path / "rig.toml", "duffing", values, dict.fromkeys(values, "fit of 3 swings"), "a bent beam"
    )


def test_presets__shows_a_file_with_its_own_model(main, rig):
    code, out, _ = main("presets", str(rig))
    assert code == 0
    assert out.startswith("preset rig: a bent beam")
    assert "damping    0.2" in out
    assert "fit of 3 swings" in out


def test_simulate__takes_a_file_and_says_where_the_values_come_from(main, rig, tmp_path):
    series = tmp_path / "x.nc"
    words = ("--model", "duffing", "--preset", str(rig), "--set", "amplitude=0.25", "--periods", "1")
    code, _, err = main("simulate", *words, "--out", str(series), "--no-figure")
    assert code == 0, err
    with xr.open_dataset(series, engine="scipy") as ds:
        assert "damping = 0.2" in ds.attrs["parameters"]
        assert ds.attrs["preset"] == "rig"
        assert "damping: fit of 3 swings" in ds.attrs["sources"]
        assert "amplitude: given" in ds.attrs["sources"]


def test_simulate__refuses_the_file_of_another_model(main, rig):
    code, _, err = main("simulate", "--preset", str(rig))
    assert code == 2
    assert "is of model 'duffing'" in err
