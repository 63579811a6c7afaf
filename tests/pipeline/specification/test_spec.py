"""What a specification may say, and what is said about a bad one."""

from __future__ import annotations

import math
import tomllib

import numpy as np
import pytest

import magpend
from magpend_core.models import load_model
from pipeline.compute.task import compute
from pipeline.layout.plan import make_plan
from pipeline.products.lyapunov import LYAPUNOV, LyapunovOptions
from pipeline.runs.zoom import Changes, read_source, write_zoom
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.specification.tables import Range


def problems_of(text: str) -> list[str]:
    with pytest.raises(SpecError) as caught:
        Spec.parse(tomllib.loads(text))
    return caught.value.problems


def test_parse_spec__reads_back_what_as_dict_says(sweep_text, walk_text):
    for text in (sweep_text, walk_text):
        spec = Spec.parse(tomllib.loads(text))
        assert Spec.parse(spec.as_dict()) == spec


def test_parse_spec__all_errors_at_once():
    problems = problems_of(
        """
        kind = "continuatio"
        titel = "x"
        [parameters]
        overrides = { qq = 1.5, m1 = -1.0 }
        frequncy_hz = 2.0
        [axes]
        q = { start = 2, stop = 3, num = 0, stp = 3 }
        duty_cycle = { start = 0.5, stop = 1.5, num = 3 }
        J9 = { values = [1.0] }
        eps = { values = [3.0, "a"] }
        [initial_conditions]
        kind = "grid"
        psi1_deg = { start = 1 }
        psi2 = nan
        psi1_dott = 0
        [continuation]
        direction = "upp"
        path = "frequency_hz"
        [integration]
        rtol = 0.0
        n_keep = 1.5
        stop_when_closed = 1
        [execution]
        trajectories_per_task = 0
        """
    )
    expected = [
        ("kind = 'continuatio'", "Did you mean 'continuation'"),
        ("titel", "did you mean title"),
        ("parameters.overrides: 'qq'", "did you mean q"),
        ("parameters.overrides: m1 = -1.0", "greater than 0"),
        ("parameters.frequncy_hz", "did you mean frequency_hz"),
        ("axes.q.num = 0", "at least 2"),
        ("axes.q.stp", "did you mean st"),
        ("axes.duty_cycle: duty_cycle = 1.5", "between 0 and 1"),
        ("axes.J9", "did you mean J"),
        ("axes.eps.values[1] = 'a'", "must be a number"),
        ("initial_conditions.psi1_deg", "give start, stop and num"),
        ("initial_conditions.psi2 = nan", "finite"),
        ("initial_conditions.psi1_dott", "did you mean psi1_dot"),
        ("continuation.direction = 'upp'", "Did you mean 'up'"),
        ("integration.rtol = 0.0", "at least 1e-13"),
        ("integration.n_keep = 1.5", "whole number"),
        ("integration.stop_when_closed = 1", "true or false"),
        ("execution.trajectories_per_task = 0", "at least 1"),
    ]
    for path, remedy in expected:
        assert any(p.startswith(path) and remedy in p for p in problems), (path, problems)
    assert len(problems) == len(expected)


@pytest.mark.parametrize(
    ("change", "path", "remedy"),
    [
        (("[axes]", "[parameters]\nfrequency_hz = 2.0\n[axes]"), "axes.frequency_hz", "keep one"),
        (("[axes]", "[parameters]\noverrides = { q = 1.0 }\n[axes]"), "axes.q", "keep one"),
        (("[axes]", "[continuation]\n[axes]"), "continuation", "a sweep has no such table"),
        (("[1.5, 1.6]", "[1.6, 1.5]"), "axes.q", "rise strictly"),
        (("[1.5, 1.6]", "[]"), "axes.q.values = []: ", "must have at least 1 value; add what is missing."),
        (('kind = "grid"\n', ""), "initial_conditions.kind", "missing"),
        (("psi1_dot = 0.1", "psi1_dot = 0.1\npsi1_dot_deg = 2"), "initial_conditions", "keep one"),
        (("rtol = 1e-6", "rtol = '1e-6'"), "integration.rtol", "a number"),
        (("[integration]", "[[integration]]"), "integration", "must be a table"),
    ],
)
def test_parse_spec__single_problem(sweep_text, change, path, remedy):
    assert change[0] in sweep_text
    problems = problems_of(sweep_text.replace(*change))
    assert len(problems) == 1
    assert problems[0].startswith(path)
    assert remedy in problems[0]


def test_parse_spec__what_must_be_there(sweep_text, walk_text):
    problems = problems_of(sweep_text.replace("frequency_hz = { start = 2.0, stop = 3.0, num = 5 }", ""))
    missing = "parameters.frequency_hz: missing; set it there (or omega, or period), or sweep it as axes.frequency_hz."
    assert problems == [missing]
    problems = problems_of(walk_text.replace("[continuation]", '[continuation]\npath = "q"'))
    assert problems[0].startswith("continuation.path = 'q'")
    assert "frequency_hz" in problems[0]
    head = 'kind = "sweep"\n[parameters]\nfrequency_hz = 2\n[initial_conditions]\nkind = "list"'
    for rows in ("[[0.1]]", "[[0.1, 0.2, 0.3]]", "[]", "[0.1, 0.2]", "[[0.1, nan]]"):
        assert problems_of(f"{head}\npoints = {rows}")[0].startswith("initial_conditions"), rows


def test_load_spec__unreadable(tmp_path, write_spec):
    for path, words in [(tmp_path / "absent.toml", "cannot be read"), (write_spec("kind = \n"), "not valid TOML")]:
        with pytest.raises(SpecError) as caught:
            Spec.read(path)
        assert len(caught.value.problems) == 1
        assert words in str(caught.value)
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe")
    with pytest.raises(SpecError, match="UTF-8"):
        Spec.read(binary)


@pytest.mark.parametrize("form", ["axes.frequency_hz.num = 2", '"axes.frequency_hz.num" = 2'])
def test_load_spec__smoke_replaces_leaves(write_spec, sweep_text, form):
    path = write_spec(f"{sweep_text}\n[smoke]\n{form}\nintegration.n_transient = 0\n")
    full, small = Spec.read(path), Spec.read(path, smoke=True)
    assert len(full.axes["frequency_hz"].array()) == 5
    assert small.axes["frequency_hz"].array().tolist() == [2.0, 3.0]
    assert (small.integration.n_transient, small.integration.n_keep) == (0, 3)


def test_load_spec__bad_smoke(write_spec, sweep_text):
    path = write_spec(f"{sweep_text}\n[smoke]\nintegration.n_kep = 0\n")
    with pytest.raises(SpecError, match=r"with \[smoke\]: integration.n_kep.*n_keep"):
        Spec.read(path)


def test_range__values_are_the_decimals_a_person_would_write():
    values = Range(start=2.0, stop=3.0, num=101).array()
    assert values.tolist() == [float(f"{2 + i / 100:.2f}") for i in range(101)]
    assert Range(start=0.1, stop=0.7, step=0.1).array().tolist() == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]
    assert Range(start=0.0, stop=1.0, step=0.3).array().tolist() == [0.0, 0.3, 0.6, 0.9]


def test_spec__degrees_convert_once():
    from pipeline.layout.cells import initial_states

    text = """
    kind = "sweep"
    [parameters]
    frequency_hz = 2
    [initial_conditions]
    kind = "list"
    points_deg = [[90, -45], [180, 0, 360, -180]]
    """
    states = initial_states(Spec.parse(tomllib.loads(text)).initial_conditions).at(np.arange(2))
    expected = [[math.pi / 2, -math.pi / 4, 0, 0], [math.pi, 0, 2 * math.pi, -math.pi]]
    assert np.allclose(states, expected, rtol=1e-15)


def test_model__as_lines_of_equations():
    text = "x'' = -d*x' - x + A*cos(2*pi*f*t)\nd = 0.2\nA = 0.1"
    tables = tomllib.loads(
        f'kind = "sweep"\nmodel = """\n{text}\n"""\nparameters.frequency_hz = 0.2\n'
        'initial_conditions = { kind = "list", points = [[0.1, 0.0]] }\nintegration.n_keep = 2\n'
    )
    assert Spec.parse(tables).model is load_model(magpend.model(text).reference)


@pytest.mark.parametrize(("given", "used"), [(150, 160), (160, 160), (3, 16)])
def test_lyapunov__rounds_up_to_whole_blocks(given, used):
    assert LYAPUNOV.settle(LyapunovOptions(n_periods=given), load_model("duffing")).n_periods == used


# ---- small runs ------------------------------------------------------------------------------------------


def test_smoke__fewest_points_and_starts(write_spec, sweep_text, walk_text):
    small = Spec.read(write_spec(sweep_text), smoke=True)
    assert [axis.array().tolist() for axis in small.axes.values()] == [[2.0, 3.0], [1.5, 1.6]]
    assert make_plan(small).shape == (2, 2, 2, 2)
    assert small.integration == Spec.read(write_spec(sweep_text)).integration
    walk = Spec.read(write_spec(walk_text), smoke=True)
    assert make_plan(walk).n_cells == 2 * 2 * 2  # frequencies, starts, directions
    rows = sweep_text.replace('kind = "grid"', 'kind = "list"\npoints = [[0, 0, 0, 0], [1, 0, 0, 0], [2, 0, 0, 0]]')
    rows = "\n".join(line for line in rows.splitlines() if not line.startswith("psi"))
    assert make_plan(Spec.read(write_spec(rows), smoke=True)).shape == (2, 2, 2)


def test_smoke__a_refined_grid_and_a_fixed_axis(write_spec, sweep_text):
    text = sweep_text.replace('kind = "grid"', 'kind = "grid"\nrefine = 2').replace("[1.5, 1.6]", "[1.5]")
    small = Spec.read(write_spec(text), smoke=True)
    assert small.refine is None
    assert make_plan(small).shape == (2, 1, 2, 2)


def test_zoom__keeps_the_smoke_table(write_spec, sweep_text, tmp_path):
    smoke = "[smoke]\naxes.frequency_hz.num = 3\ninitial_conditions.psi1_deg.num = 2\n"
    source = read_source(write_spec(sweep_text + smoke))
    assert write_zoom(source, Changes({"frequency_hz": (2.2, 2.4)}), tmp_path / "a.toml") == []
    assert make_plan(Spec.read(tmp_path / "a.toml", smoke=True)).shape == (3, 2, 2, 4)
    assert make_plan(Spec.read(tmp_path / "a.toml")).shape == (5, 2, 3, 4)
    notes = write_zoom(source, Changes({"q": (1.5, 1.55)}, {"frequency_hz": 2.2}), tmp_path / "b.toml")
    assert any("[smoke]" in note for note in notes)
    Spec.read(tmp_path / "b.toml", smoke=True)


# ---- methods of integration ------------------------------------------------------------------------------


def spec_of(method, **more):
    return Spec.parse(
        {
            "kind": "sweep",
            "model": "duffing",
            "parameters": {"preset": "hardening", "frequency_hz": 0.2},
            "initial_conditions": {"kind": "list", "points": [[0.3, 0.1], [-0.2, 0.5]]},
            "integration": {"method": method, "n_transient": 20, "n_keep": 4, "rtol": 1e-10, "atol": 1e-10},
            **more,
        }
    )


def cells_of(spec):
    plan = make_plan(spec)
    return compute(plan, tuple(slice(0, n) for n in plan.shape))


@pytest.mark.slow
def test_method__of_order_8_gives_the_same_motion_in_fewer_steps():
    fifth, eighth = (cells_of(spec_of(m, products={"lyapunov": {}})) for m in ("dopri5", "dop853"))
    np.testing.assert_allclose(eighth["section"], fifth["section"], atol=1e-6)
    np.testing.assert_allclose(eighth["lyapunov"], fifth["lyapunov"], atol=1e-3)
    assert (3 * eighth["n_steps"] < fifth["n_steps"]).all()


def test_method__is_known_and_order_8_goes_with_nothing_that_looks_into_steps():
    with pytest.raises(SpecError, match=r"integration.method = 'rk4'"):
        spec_of("rk4")
    extremes = {"extremes": {"quantities": ["energy"]}}
    for method in ("auto", "dopri5", "rodas5p"):
        assert spec_of(method, products=extremes).products
    with pytest.raises(SpecError) as caught:
        spec_of("dop853", products=extremes)
    (problem,) = caught.value.problems
    assert problem == (
        'integration.method = "dop853": products.extremes looks within steps; drop one of the two, or set '
        'method = "dopri5".'
    )
