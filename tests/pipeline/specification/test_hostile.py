"""Specifications that nobody means well: one clear message each, quickly, and nothing created."""

import os
import time
import tomllib

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from pipeline.layout.plan import make_plan
from pipeline.specification.files import toml_key, toml_value
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.specification.tables import Range
from tests.pipeline.factories import duffing

LONG = os.environ.get("MAGPEND_LONG") == "1"

BASE = duffing(
    "amplitude = { start = 0.2, stop = 0.3, num = 3 }",
    'kind = "grid"\nx = { start = -1.0, stop = 1.0, num = 4 }\nv = 0.0',
    execution="trajectories_per_task = 16",
    more="[parameters]\nfrequency_hz = 0.2\noverrides = { damping = 0.1 }\n[products.lyapunov]\nn_exponents = 1\n"
    "[smoke]\nintegration.n_keep = 2\n",
)

HUGE = "9" * 5000
DEEP = 5000
ODD = {
    "list as kind": ('kind = []\nmodel = "duffing"\n', "kind = []"),
    "list as model": (BASE.replace('"duffing"', "[]"), "model"),
    "number as product": (BASE.replace("n_exponents = 1", "n_exponents = []"), "products.lyapunov.n_exponents"),
    "5000 digits": (BASE.replace("n_keep = 3", f"n_keep = {HUGE}"), "digits"),
    "digits of an overridden value": (BASE.replace("damping = 0.1", "damping = 0x" + "F" * 300), "overrides"),
    "deep lists": ("kind = " + "[" * DEEP + "]" * DEEP, "nested too deeply"),
    "deep key": ("a." * DEEP + "b = 1", "nested too deeply"),
    "deep quoted key": (BASE + '"' + "a." * DEEP + 'b" = 1', "characters; the limit is 200"),
    "endless key": ("a" * 100_000 + " = 1", "characters; the limit is 200"),
    "dates": ("kind = 2020-01-01\ntitle = 12:00:00", "title"),
    "no text": ("kind = \x00", "not valid TOML"),
    "empty": ("", "kind: missing"),
    "escape in a title": (BASE.replace('"small"', r'"\u001b[31mred\u001b[0m"'), r"\x1b[31mred"),
    "escape in a key": (BASE + '"\\u001b[2J" = 1', r"\x1b[2J: unknown key"),
    "beyond floats": (BASE.replace("v = 0.0", "v = 1e999"), "initial_conditions.v = inf"),
    "many keys": ("\n".join(f"{'x' * 150}{i} = 1" for i in range(500)), "unknown key"),
    "a long word": (f"kind = '{'é' * 50_000}'", "kind"),
    "many problems": (
        'kind = "sweep"\n[model]\nname = "a"\n[model.equations]\n'
        + "\n".join(f"x{i} = '{'(' * 50}'" for i in range(60)),
        "model.equations",
    ),
}


@pytest.fixture
def refused(main, tmp_path):
    """Give a specification to the command, which must refuse it; returns what it says."""
    spec = tmp_path / "spec.toml"

    def call(text, *options, ways=(["--out", "run"], ["--dry-run"])):
        spec.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass"))
        for words in ways:
            code, _, said = main("run", "spec.toml", *words, *options)
            assert code == 2, said
            assert said.count("magpend: ") == 1
            assert "Traceback" not in said
            assert 20 < len(said.encode()) <= 2100
            assert all(c.isprintable() or c == "\n" for c in said)
        assert sorted(p.name for p in tmp_path.iterdir()) == ["spec.toml"]
        return said

    return call


@pytest.mark.slow
@pytest.mark.parametrize("what", ODD)
def test_run__odd_specifications_are_refused_in_few_words(refused, what):
    text, words = ODD[what]
    assert words in refused(text)


@pytest.mark.slow
def test_load_spec__endless_files_and_arrays(tmp_path):
    path = tmp_path / "spec.toml"
    with open(path, "wb") as file:
        file.truncate(40_000_000)
    for endless in (path, "/dev/zero"):
        with pytest.raises(SpecError, match="has more than 1 MB, the limit of a specification"):
            Spec.read(endless)
    path.write_text(f"[axes]\namplitude = [{'0,' * 100_001}]")
    with pytest.raises(SpecError, match=r"axes\.amplitude: has 100001 elements; the limit is 100000"):
        Spec.read(path)


# ---- mutations --------------------------------------------------------------------------------------

VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.sampled_from([2**63, -(2**70), 10**400, 0, -1]),
    st.floats(),
    st.sampled_from([1e308, 1e-308, 5e-324, -0.0, 1e180]),
    st.text(max_size=8),
    st.sampled_from(["sweep", "grid", "list", "random", "up", "both", "nan", "duffing", "x"]),
    st.lists(st.one_of(st.integers(), st.floats(), st.text(max_size=3), st.lists(st.floats(), max_size=2)), max_size=3),
    st.dictionaries(
        st.sampled_from(["start", "stop", "num", "step", "values", "kind", "a.b", "", "\x1b"]),
        st.one_of(st.integers(), st.floats(), st.lists(st.floats(), max_size=3)),
        max_size=4,
    ),
)
WORDS = "kind title model axes smoke drive section products continuation step refine n seed points x x_deg frequency_hz"
MORE_WORDS = "preset stop_when_closed lyapunov extremes path file of values"
KEYS = st.one_of(st.sampled_from(f"{WORDS} {MORE_WORDS}".split()), st.text(max_size=6))


def places(table, at=()):
    """Paths of all entries of a table."""
    for key, value in table.items():
        yield (*at, key)
        if isinstance(value, dict):
            yield from places(value, (*at, key))


@st.composite
def mutations(draw):
    """A specification with some entries replaced, dropped, renamed or added."""
    data = tomllib.loads(BASE)
    for _ in range(draw(st.integers(1, 3))):
        *above, key = draw(st.sampled_from(sorted(places(data))))
        table = data
        for part in above:
            table = table[part]
        kind = draw(st.sampled_from(["replace", "drop", "rename", "add"]))
        if kind == "drop":
            del table[key]
        elif kind == "rename":
            table[draw(KEYS)] = table.pop(key)
        else:
            table[key if kind == "replace" else draw(KEYS)] = draw(VALUES)
        if not data:
            break
    return data


def spelled(value):
    """Plain data as TOML within a line, valid or not."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{toml_key(k)} = {spelled(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(spelled, value)) + "]"
    return hex(value) if isinstance(value, int) and abs(value) > 10**300 else toml_value(value)


def outcome(path, smoke):
    """Whether a specification can be planned, in its own size or in its small one."""
    try:
        make_plan(Spec.read(path, smoke=smoke))
    except SpecError:
        return False
    return True


FUZZ = settings(
    max_examples=1000 if LONG else 25, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


def held(refused, path, content):
    """A specification is planned or refused, in its own size and in its small one."""
    path.write_bytes(content)
    for smoke, options in ((False, ()), (True, ("--smoke",))):
        if not outcome(path, smoke):
            refused(content, *options, ways=[["--dry-run"]])


@pytest.mark.slow
@FUZZ
@given(mutations())
@example({"kind": []})
@example({"kind": "sweep", "model": "duffing", "initial_conditions": {"kind": []}})
@example(tomllib.loads(BASE) | {"\t": {"num": 3}})
@example(tomllib.loads(BASE) | {"smoke": {"initial_conditions.none": 1}})
def test_run__mutated_tables_are_planned_or_refused(refused, tmp_path, data):
    text = "\n".join(f"{toml_key(key)} = {spelled(value)}" for key, value in data.items())
    held(refused, tmp_path / "spec.toml", text.encode("utf-8", "surrogatepass"))


@pytest.mark.slow
@FUZZ
@given(st.data())
def test_run__mutated_bytes_are_planned_or_refused(refused, tmp_path, data):
    content = bytearray(BASE.encode())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        kind = data.draw(st.sampled_from(["byte", "cut", "double", "swap"]))
        end = at + data.draw(st.integers(1, 40))
        if kind == "byte":
            content[at] = data.draw(st.integers(0, 255))
        elif kind == "cut":
            del content[at:end]
        elif kind == "double":
            content[at:at] = content[at:end]
        else:
            content[at:end] = content[at:end][::-1]
        if not content:
            break
    held(refused, tmp_path / "spec.toml", bytes(content))


# ---- sizes ------------------------------------------------------------------------------------------


def seconds_of(call):
    started = time.process_time()
    call()
    return time.process_time() - started


@pytest.mark.slow
def test_range__ten_million_points_take_seconds():
    for axis in (
        {"start": 2.0, "stop": 2.8, "num": 10_000_000},
        {"start": 0.1234567890123456, "stop": 1.9876543210987654, "num": 3_000_000},
    ):
        assert seconds_of(Range(**axis).array) < 60


@pytest.mark.slow
@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6), st.integers(2, 40), st.booleans(), st.integers(0, 12))
def test_range__values_are_the_nearest_floats(start, span, num, by_step, digits):
    from fractions import Fraction

    start, stop = round(start, digits), round(start, digits) + span
    if not stop > start:
        return
    axis = Range(start=start, stop=stop, num=num)
    low, high = Fraction(repr(start)), Fraction(repr(stop))
    exact = [low + i * (high - low) / (num - 1) for i in range(num)]
    if by_step:
        step = span / num
        axis = Range(start=start, stop=stop, step=step)
        exact = [low + i * Fraction(repr(step)) for i in range((high - low) // Fraction(repr(step)) + 1)]
    assert axis.array().tolist() == [float(x) for x in exact]


def test_parse_spec__many_axes_take_a_moment():
    names = ["T1", "T2", "c", "mu", "mu0", "c0", "q", "alpha1", "alpha2", "beta1", "beta2", "g"]
    data = {
        "kind": "sweep",
        "parameters": {"frequency_hz": 2.0},
        "axes": {name: {"values": [0.1, 0.2]} for name in names},
        "initial_conditions": {"kind": "list", "points": [[0.0, 0.0]]},
    }
    assert seconds_of(lambda: Spec.parse(data)) < 2


def test_parse_spec__corners_of_related_parameters_are_looked_at():
    """The dipoles' relation holds on the sides of the box, and not in one of its corners."""
    from magpend_core import load_model

    p = load_model("pendulum-dipole").load()
    room = p["h"] - p["l1"] - p["l2"]
    data = {
        "kind": "sweep",
        "model": "pendulum-dipole",
        "parameters": {"frequency_hz": 2.0},
        "axes": {name: {"values": [p[name], p[name] + 0.6 * room]} for name in ("l1", "l2")}
        | {"q": {"values": [1.0, 2.0]}},
        "initial_conditions": {"kind": "list", "points": [[0.0, 0.0]]},
    }
    with pytest.raises(SpecError, match="magnets can meet"):
        Spec.parse(data)
    del data["axes"]["l2"]
    Spec.parse(data)
