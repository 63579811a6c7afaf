"""What the reader of XPPAUT's files carries over, renames, leaves out and refuses."""

from __future__ import annotations

import pytest

from magpend_core.models import load_model
from magpend_core.models.text.reading import MAX_DEFINED
from pipeline.importing.importing import import_file, import_model
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec


@pytest.fixture
def imported(tmp_path):
    """Import a text as a file of XPPAUT."""

    def imported(text, **others):
        for name, content in others.items():
            (tmp_path / name).write_text(content)
        (tmp_path / "own.ode").write_text(text)
        return import_file(tmp_path / "own.ode")

    return imported


def problems_of(imported, text):
    with pytest.raises(SpecError) as caught:
        imported(text)
    return list(caught.value.problems)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("x'=-x\ny'=delay(x,2)", "own.ode, line 2: delay: delays are not carried over."),
        ("u(t)=exp(-t)+int{exp(-t)#u}\nx'=-x", "line 1: integrals (Volterra equations, convolutions)"),
        ("volterra u=1+int{u}\nx'=-x", "line 1: volterra: integrals (Volterra equations)"),
        ("x'=-x*z\nmarkov z 2\n{0} {1}\n{1} {0}", "line 2: markov: Markov variables"),
        ("x'=-x+ran(1)", "line 1: ran: random numbers"),
        ("x'=-x\n0=x+y\nsolve y=1", "line 2: 0 = ...: algebraic equations"),
        ("x'=y\ny'=-x\nbdry x-1", "line 3: x-1: boundary value problems"),
        ("x'=y\ny=0\nexport {x} {y}", "line 3: export: functions in a compiled library"),
        ("x'=-x+z(0)\ntable w % 5 -2 2 1\nspecial z=conv(even,5,2,w,x)", "line 3: special: sums over networks"),
        ("x'=-x+erf(x)", "line 1: erf: the text of a model has no such function."),
        ("x'=-x+g", "line 1: g is not defined."),
        ("x'=-x+g(x)", "line 1: g: there is no such function."),
        ("f(u)=u\nx'=f", "line 2: f is a function."),
        ("f(u)=u\nx'=f(x,x)", "line 2: f has 2 arguments; it takes 1."),
        ("f(u)=f(u)+1\nx'=f(x)", "line 2: the function f needs itself."),
        ("x'=2x", "line 1: 'x' cannot stand at character 2; write a product with *."),
        ("x'=(x", "line 1: the expression ends where something must follow; ')' must stand there."),
        ("x'=x$", "line 1: '$' has no meaning in an expression."),
        ("par a=1/3\nx'=a*x", "line 1: a=1/3: must be a number; XPPAUT reads only 1 here. Write !a=1/3."),
        ("par a=1,A=2\nx'=a*x", "line 1: A is defined in line 1 already."),
        ("par T=1\nx'=-x/T", "line 1: T has a meaning in XPPAUT, for which T and t are one."),
        ("init z=1\nx'=-x", "line 1: init z: there is no such variable."),
        ("x'=-x\nglobal 0 x {x=1}", "line 2: global 0: only passages of zero"),
        ("x'=-x\nglobal 1 x {z=1}", "line 2: global: z is neither a variable nor a parameter."),
        ("x'=-x\nglobal 1 x {arret=1}", "line 2: global: arret steers XPPAUT's output"),
        ("x'=-x+shift(x,y)\ny'=1", "line 1: the bounds of sums and the second argument of shift must be numbers."),
        ("x'=-x+shift(x,7)", "line 1: shift(x, 7): there is no such variable."),
        ("x[1..3]'=-x[j**2]", "line 1: [j**2] is no index; XPPAUT writes [j], [j+1] or [j-1]."),
        ("x[1..99999]'=-x[j]", "line 1: arrays make more than 5000 lines."),
        ("par a=1", "line 1: there is no equation x' = ..., dx/dt = ... or x(t+1) = ...."),
        ("x'=-x+w\ny'=w\nwiener w", "line 2: the noise w is in two equations"),
        ("x'=sin(w)\nwiener w", "line 1: the noise w enters otherwise than as a summand."),
        ("a=b\nb=a\nx'=a", "line 1: define.a: goes round in a circle: a needs b needs a."),
        ("mksol s\nx'=-x", "line 1: mksol: XPPAUT's directive is not known here."),
        ("x'=-x\n#include other.ode", "line 2: #include: only one file is read"),
        ("x'=f(x)\ntable f nowhere.tab", "line 2: nowhere.tab: cannot be read (No such file or directory)."),
        ("x'=f(x)\ntable f ../../etc/passwd", "line 2: table f ../../etc/passwd: must name a file beside this one."),
    ],
)
def test_read__refuses_with_line_and_reason(imported, text, problem):
    found = problems_of(imported, text)
    assert any(problem.rstrip(".") in one for one in found), found


def test_read__tells_all_problems_at_once(imported):
    found = problems_of(imported, "x'=-x+ran(1)\ny'=delay(x,1)\nz'=z+g")
    assert [one.split(":")[0] for one in found] == ["own.ode, line 1", "own.ode, line 2", "own.ode, line 3"]


def test_read__renames_what_has_a_meaning_of_its_own(imported):
    found = imported("par lambda=2,kind=3,_a=1\nx'=-lambda*x+kind*_a\naux P.E.=x^2\naux x=2*x")
    assert set(found.notes) == {
        "lambda is called lambda_.",
        "kind is called kind_.",
        "_a is called a.",
        "P.E. is called P_E.",
        "x is called x_.",
    }
    model = load_model(found.spec.reference)
    assert model.parameter_names == ("lambda_", "kind_", "a")
    assert model.definition.table["equations"] == {"x": "-lambda_*x + kind_*a"}
    assert model.definition.table["quantities"] == {"P_E": "x**2", "x_": "2*x"}


def test_read__compares_before_it_adds_and_says_so(imported):
    found = imported("x'=-x+if(x-1>0)then(1)else(2)+(x>1)")
    assert found.notes[0].startswith("line 1: XPPAUT compares before it adds")
    # 1 > 0 is 1, so the condition is x - 1 != 0
    text = load_model(found.spec.reference).definition.table["equations"]["x"]
    assert text.startswith("-x + where((x - where(1 > 0, 1, 0) < 0) or (x - where(1 > 0, 1, 0) > 0), 1, 2)")
    assert not imported("x'=-x+(x>1)-if(x<=2)then(x)else(-1)").notes


def test_read__events_take_their_values_one_after_the_other(imported):
    found = imported("par b=.5\nx'=1\ny'=-y\nglobal 1 x-1 {x=0;y=y+b*x+b;b=b/2}\ninit y=1")
    (impact,) = load_model(found.spec.reference).definition.table["impacts"]
    assert impact == {"of": "x - 1", "direction": "up", "set": {"x": "0", "y": "y + b*0 + b", "b": "b/2"}}
    assert found.spec.tables["initial_conditions"]["points"] == [[0.0, 1.0, 0.5]]
    assert "the parameter b is a state, since an event changes it." in found.notes


def test_read__noise_becomes_a_strength(imported):
    found = imported("par s=.1\nwiener w,z\nx'=-x+s*(1+x)*w\ny'=-y-2*z\naux n=w")
    assert found.spec.tables["noise"] == {"strengths": {"x": "s*(1 + x)", "y": 2.0}, "interpretation": "ito"}
    assert load_model(found.spec.reference).definition.table["equations"] == {"x": "-x", "y": "-y"}
    assert found.notes == ("line 5: aux n is left out: it contains noise.",)


def test_read__options_choose_section_and_range(imported):
    text = "par a=1,b=2\nx'=y\ny'=-x+(a-x^2)*y\nz'=-b*z\n@ total=20,xlo=-3,bound=1000\n"
    found = imported(text + "@ poimap=section,poivar=y,poipln=.25,poisgn=-1,parmin=.5,parmax=3").spec.tables
    assert found["section"] == {"of": "y", "value": 0.25, "direction": "down", "longest": 100.0}
    assert found["axes"] == {"a": {"start": 0.5, "stop": 3.0, "num": 51}}
    found = imported(text + "aux r=x^2+y^2\n@ poimap=section,poivar=r,poipln=2").spec
    assert found.tables["section"] == {"of": "r", "value": 2.0, "direction": "up", "longest": 100.0}
    assert found.model.section == "r = 2 going up"
    found = imported(text + "@ rangeover=b,rangelow=1,rangehigh=2").spec.tables
    assert found["axes"] == {"b": {"start": 1.0, "stop": 2.0, "num": 51}}


def test_read__a_section_lies_across_the_motion(imported):
    # the cycle of radius 1 about (5, 7), from a start on it
    found = imported("x'=-(y-7)\ny'=x-5\ninit x=6,y=7\n@ total=10").spec.tables["section"]
    assert found["of"] in ("x", "y")
    assert found["value"] == pytest.approx(5.0 if found["of"] == "x" else 7.0, abs=0.1)
    assert "section" not in imported("x'=-x\ninit x=1").spec.tables  # comes to rest
    fires = imported("x'=1.5-x\nglobal 1 x-1 {x=0}").spec.tables["section"]  # would rest at 1.5 without its event
    assert 0.0 < fires["value"] < 1.0


def test_read__sets_become_presets(imported):
    found = imported("par a=1,b=2\nx'=-a*x+b\nset fast {a=5,x=2,total=9}")
    assert load_model(found.spec.reference).definition.table["presets"]["fast"] == {
        "source": "set fast of own.ode",
        "a": 5.0,
    }
    assert found.notes == ("line 3: the set fast keeps its parameters; left out: x=2, total=9.",)


def test_read__time_that_is_not_periodic_becomes_a_clock(imported):
    found = imported("x'=-x+exp(-t)\n@ t0=2")
    assert load_model(found.spec.reference).definition.table["equations"] == {"x": "-x + exp(-clock)", "clock": "1"}
    assert found.spec.tables["initial_conditions"]["points"] == [[0.0, 2.0]]
    assert "t is the state clock" in found.notes[0]
    found = imported("x'=-x+sin(t)+sin(1.4142135*t)")  # two frequencies
    assert "clock" in load_model(found.spec.reference).definition.table["equations"]
    found = imported("x(t+1)=x+mod(t,2)")
    assert load_model(found.spec.reference).definition.table["equations"]["clock"] == "clock + 1"


def test_read__a_drive_decides_the_parameter_of_its_frequency(imported):
    found = imported("par per=4,a=1\nx'=-x+a*sin(2*pi*t/per)*per")
    table = load_model(found.spec.reference).definition.table
    assert table["define"] == {"per": "6.283185307179586/omega"}
    assert table["equations"] == {"x": "-x + a*sin(omega*t)*per"}
    assert found.spec.tables["parameters"] == {"omega": pytest.approx(1.5707963267948966)}
    found = imported("par w=0,a=1\nx'=-x+a*sin(w*t)")  # no frequency
    assert "w = 0" in found.notes[0]


def test_read__tables_of_files_are_polygons(imported):
    found = imported("x'=-x+f(2*x)\ntable f f.tab", **{"f.tab": "4\n0\n3\n1\n2\n0\n0\n"})
    text = load_model(found.spec.reference).definition.table["equations"]["x"]
    assert text == "-x + (1 + 1*(2*x) - 3*max(2*x - 1, 0) + 2*max(2*x - 2, 0))"
    assert "corners at its points" in found.notes[0]
    found = imported("par s=2\nx'=-x+g(x)\ntable g % 11 -5 5 exp(-t^2/s)")
    assert load_model(found.spec.reference).definition.table["define"] == {"g": "exp(-x**2/s)"}
    assert "as smooth as that" in found.notes[0]


def test_read__keeps_comments_where_they_stand(imported):
    lines = imported("# a model of mine\n\n# the rate\npar a=1\n# falls\nx'=-a*x\n\" the end").text.split("\n")
    assert lines[1:3] == ["# a model of mine", "# the rate"]
    assert lines[lines.index('x = "-a*x"') - 1] == "# falls"
    assert "# the end" in lines


def test_text__is_the_specification(imported, tmp_path):
    found = imported("par a=1\nx'=y\ny'=-x+(a-x^2)*y\ninit x=.1\nset b {a=2}\nglobal 1 x-1 {y=-y}\naux e=x^2")
    (tmp_path / "own.toml").write_text(found.text)
    assert Spec.read(tmp_path / "own.toml") == found.spec


def test_import_model__warns_of_what_has_changed(tmp_path):
    (tmp_path / "own.ode").write_text("par lambda=2\nx'=-lambda*x")
    with pytest.warns(UserWarning, match="lambda is called lambda_"):
        spec = import_model(tmp_path / "own.ode")
    assert spec.model.parameter_names == ("lambda_",)
    with pytest.raises(SpecError, match="files that end in"):
        import_model(tmp_path / "own.txt")


def test_command__writes_a_file_that_runs(main, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.ode").write_text("par mu=1,lambda=0\nx'=y\ny'=mu*(1-x^2)*y-x+lambda\ninit x=.1\n")
    code, out, err = main("model", "import", "own.ode")
    assert (code, out) == (0, "specification: own.toml\n")
    assert "lambda is called lambda_." in err
    code, out, _ = main("model", "show", "own.toml")
    assert code == 0
    assert "dx/dt = y" in out
    code, out, _ = main("run", "own.toml", "--dry-run")
    assert code == 0
    code, _, err = main("model", "import", "own.ode")
    assert code == 2
    assert "exists already" in err
    (tmp_path / "bad.ode").write_text("x'=ran(1)")
    code, _, err = main("model", "import", "bad.ode", "--out", "other.toml")
    assert code == 2
    assert "bad.ode, line 1: ran: random numbers" in err
    assert not (tmp_path / "other.toml").exists()


def test_read__writes_out_the_shortest_parts_beyond_those_that_a_model_may_have(imported):
    n = MAX_DEFINED + 1
    parts = [f"a{k}={k}*x^2+{k}*x+{k}" if k > 2 else f"a{k}={k}*x" for k in range(1, n + 1)]
    terms = "+".join(f"a{k}" for k in range(1, n + 1))
    model = load_model(imported("\n".join([*parts, f"x'=-x+{terms}", "global 1 x-a1-4 {x=a2}"])).spec.reference)
    found = model.definition.table
    assert set(found["define"]) == {f"a{k}" for k in range(3, n + 1)}
    assert found["equations"]["x"].startswith("-x + 1*x + 2*x + a3 + a4")
    assert (found["impacts"][0]["of"], found["impacts"][0]["set"]) == ("x - 1*x - 4", {"x": "2*x"})
