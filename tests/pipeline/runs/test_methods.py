"""Decide the method of a run: the rule on counts by a law, and real systems that are stiff or are not."""

from __future__ import annotations

import numpy as np
import pytest

from magpend_core.status import Status
from pipeline.layout.identity import digest_of
from pipeline.layout.plan import make_plan
from pipeline.runs import methods
from pipeline.runs.extend import plan_extension
from pipeline.runs.methods import Decision, decide, decided
from pipeline.runs.run import prepare, run
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.store.objects import open_files
from pipeline.store.runfile import read_run
from pipeline.store.setup import create
from tests.pipeline.factories import silent

RTOL = 1e-8


def spec_of(text, points, method="auto", integration=None, **tables):
    """A sweep of a model as text."""
    own = {"n_transient": 2, "n_keep": 4, "rtol": RTOL, "atol": RTOL, **({"method": method} if method else {})}
    starts = {"kind": "list", "points": points}
    return Spec.parse(
        {
            "kind": "sweep",
            "model": text,
            "initial_conditions": starts,
            "integration": own | (integration or {}),
            **tables,
        }
    )


def relaxed(rate, **more):
    """A state that follows a cosine at a rate, the problem of Prothero and Robinson."""
    text = f"x' = -k*(x - cos(2*pi*phase)) - 2*pi*f*sin(2*pi*phase)\nk = {rate}"
    return spec_of(text, [[1.0], [0.0]], parameters={"frequency_hz": 1.0}, **more)


@pytest.fixture
def law(monkeypatch):
    """Set what the counts are: steps by accuracy at `RTOL`, steps at any tolerance, and of the stiff method."""

    def set_law(by_accuracy, always, stiff=100, status=(1, 1), stiff_status=(1, 1), radius=3.0):
        def count(spec, inputs, scale=1.0, limit=20000):
            own, n = spec.integration, len(inputs.initial_states)
            is_stiff = own.method == methods.STIFF
            steps = int(stiff if is_stiff else by_accuracy * (RTOL / (own.rtol * scale)) ** 0.2 + always)
            found = np.array((stiff_status if is_stiff else status)[:n])
            found[(steps > limit) & (found == Status.PERIODIC)] = Status.STEP_LIMIT
            four = np.full(n, 4)
            return methods._Count(np.full(n, min(steps, limit)), four, 1.0 * four, found, np.zeros((n, 1)))

        monkeypatch.setattr(methods, "_count", count)
        monkeypatch.setattr(methods, "_at_stability_limit", lambda *_: radius > methods.LEAST_RADIUS)
        monkeypatch.setattr(methods, "compile_kernel", lambda *_: None)

    return set_law


def method_of(spec):
    return decide(make_plan(spec), silent).method


@pytest.mark.parametrize(
    ("counts", "method"),
    [
        ((2000, 0), "dopri5"),
        ((2000, 400), "dopri5"),
        ((2000, 4000, 1900), "dopri5"),  # the count hardly changes, but the stiff steps cost more
        ((2000, 4000, 100), "rodas5p"),
        ((100, 4000), "rodas5p"),
        ((100, 4000, 3900), "dopri5"),  # the stiff method does not take fewer
        ((0, 12), "dopri5"),  # at rest: steps cannot be fewer
        ((0, 100_000), "rodas5p"),  # both met the limit
        ((0, 100_000, 100_000), "dopri5"),  # so does the stiff method
    ],
)
def test_decide__by_counts(law, counts, method):
    law(*counts)
    assert method_of(relaxed(10.0)) == method


def test_decide__is_the_same_at_coarse_tolerances_which_a_finer_one_is_compared_with(law):
    law(2000, 0)
    assert method_of(relaxed(10.0, integration={"rtol": 1e-3, "atol": 1e-3})) == "dopri5"
    law(100, 4000)
    assert method_of(relaxed(10.0, integration={"rtol": 1e-3, "atol": 1e-3})) == "rodas5p"


def test_decide__leaves_out_cells_that_fail_and_short_steps_far_from_the_limit_of_stability(law):
    law(0, 4000, status=(Status.DIVERGED, Status.STEP_UNDERFLOW))
    assert decide(make_plan(relaxed(10.0)), silent) == Decision("dopri5", "no cell tells how long its steps can be")
    law(0, 4000, status=(Status.PERIODIC, Status.DIVERGED))
    assert method_of(relaxed(10.0)) == "rodas5p"
    law(0, 4000, stiff_status=(Status.DIVERGED, Status.PERIODIC))
    assert method_of(relaxed(10.0)) == "dopri5"
    law(0, 4000, radius=0.1)
    assert method_of(relaxed(10.0)) == "dopri5"


def test_decided__only_where_it_is_left_open_and_there_are_steps():
    for chosen in ("dopri5", "dop853"):
        plan = make_plan(relaxed(10.0, method=chosen))
        assert decided(plan, None) is plan
    henon = {"kind": "sweep", "model": "henon", "initial_conditions": {"kind": "list", "points": [[0.1, 0.1]]}}
    noisy = relaxed(10.0, noise={"strengths": {"x": 0.1}}, integration={"n_keep": 1})
    for spec in (Spec.parse(henon), noisy):
        assert decided(plan := make_plan(spec), None) is plan
        assert plan.spec.integration.method == "dopri5"


def test_auto__is_the_default_and_until_decided_the_run_of_dopri5():
    spec, chosen = relaxed(10.0, method=None), relaxed(10.0, method="dopri5")
    assert spec.integration.method == "auto"
    assert "method" not in spec.toml()
    assert make_plan(spec).undecided
    assert not make_plan(chosen).undecided
    assert make_plan(spec).identity == make_plan(chosen).identity


def test_prepare__takes_the_method_that_was_decided_for_the_run_in_the_directory(tmp_path):
    spec = relaxed(10.0)
    stored = create(tmp_path / "run", make_plan(spec.by_method("rodas5p"), spec.text))
    plan = prepare(spec, open_files(tmp_path / "run"))
    assert (plan.undecided, plan.spec.integration.method) == (False, "rodas5p")
    assert digest_of(plan.identity) == stored.digest
    assert prepare(relaxed(10.0, method="dopri5"), open_files(tmp_path / "run")).spec.integration.method == "dopri5"
    create(tmp_path / "other", make_plan(relaxed(10.0, method="dop853")))
    assert prepare(spec, open_files(tmp_path / "other")).undecided  # another run, which is refused then


def test_prepare__refuses_the_stiff_method_where_it_does_not_suit(tmp_path):
    many = "\n".join(f"x{i}' = -x{i}" for i in range(65))
    spec = spec_of(many, [[0.1] * 65], method="rodas5p", parameters={"period": 1.0})
    with pytest.raises(SpecError, match=r'integration.method = "rodas5p": .* has 65 states; .* at most 64'):
        prepare(spec, open_files(tmp_path / "run"))
    with pytest.raises(SpecError, match=r'integration.method = "rodas5p": noise .* drop the key'):
        relaxed(10.0, method="rodas5p", noise={"strengths": {"x": 0.1}})


def test_advice__names_the_method_that_met_the_limit_of_steps_and_the_stiff_one_beside_an_explicit_one():
    explicit, stiff = (Status.STEP_LIMIT.advice_for(method) for method in ("dopri5", "rodas5p"))
    assert "more steps of dopri5 than max_steps_per_period; if the equations are stiff, set method" in explicit
    assert "more steps of rodas5p than max_steps_per_period; raise it" in stiff
    assert Status.DIVERGED.advice_for("dopri5") == Status.DIVERGED.advice


CHEMISTRY = {  # Hairer and Wanner, Solving Ordinary Differential Equations II, section IV.10
    "rober": "a' = -0.04*a + 1e4*b*c\nb' = 0.04*a - 1e4*b*c - 3e7*b**2\nc' = 3e7*b**2",
    "orego": "a' = 77.27*(b + a*(1 - 8.375e-6*a - b))\nb' = (c - (1 + a)*b)/77.27\nc' = 0.161*(a - c)",
    "hires": """a' = -1.71*a + 0.43*b + 8.32*c + 0.0007
b' = 1.71*a - 8.75*b
c' = -10.03*c + 0.43*d + 0.035*e
d' = 8.32*b + 1.71*c - 1.12*d
e' = -1.745*e + 0.43*g + 0.43*h
g' = -280*g*m + 0.69*d + 1.71*e - 0.43*g + 0.69*h
h' = 280*g*m - 1.81*h
m' = -280*g*m + 1.81*h""",
}
STARTS = {"rober": [1.0, 0.0, 0.0], "orego": [1.0, 2.0, 3.0], "hires": [1.0, *[0.0] * 6, 0.0057]}
VAN_DER_POL = "x' = v\nv' = mu*(1 - x**2)*v - x\nmu = 1.0"


def van_der_pol(mu, **more):
    section = {"of": "x", "longest": 5.0 * mu + 20.0}
    return spec_of(VAN_DER_POL, [[2.0, 0.0]], section=section, axes={"mu": {"values": [mu]}}, **more)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CHEMISTRY))
def test_decide__kinetics_are_stiff(name):
    for tolerance in (1e-5, 1e-8):  # rober is lost by explicit steps at 1e-5
        own = {"rtol": tolerance, "atol": tolerance}
        assert (
            method_of(spec_of(CHEMISTRY[name], [STARTS[name]], parameters={"period": 80.0}, integration=own))
            == "rodas5p"
        )


@pytest.mark.slow
def test_decide__a_fast_relaxation_to_a_slow_motion_is_stiff():
    assert {rate: method_of(relaxed(rate)) for rate in (10.0, 1e4, 1e6)} == {
        10.0: "dopri5",
        1e4: "rodas5p",
        1e6: "rodas5p",
    }


@pytest.mark.slow
def test_decide__relaxation_oscillations_are_stiff_from_some_stiffness_on():
    found = {mu: method_of(van_der_pol(mu)) for mu in (1.0, 10.0, 100.0, 1000.0)}
    assert found == {1.0: "dopri5", 10.0: "dopri5", 100.0: "rodas5p", 1000.0: "rodas5p"}
    assert method_of(van_der_pol(100.0, integration={"rtol": 1e-3, "atol": 1e-3})) == "rodas5p"


@pytest.mark.slow
def test_run__keeps_the_decision_and_what_was_written(tmp_path):
    told = []
    run(van_der_pol(1000.0), tmp_path / "run", workers=0, echo=told.append)
    (line,) = [line for line in told if line.startswith("method: ")]
    assert line.startswith("method: rodas5p (auto: ")
    info = read_run(tmp_path / "run")
    assert info.spec["integration"]["method"] == "rodas5p"
    assert 'method = "auto"' in info.spec_text
    again = []
    run(van_der_pol(1000.0), tmp_path / "run", workers=0, echo=again.append)
    assert again[-1] == f"{tmp_path / 'run'} is complete; nothing to do."
    assert not any(line.startswith("method: ") for line in again)
    wider = van_der_pol(1000.0).with_axis("mu", values=[1000.0, 1100.0])
    (tmp_path / "wider.toml").write_text(wider.toml())
    assert plan_extension([tmp_path / "run"], tmp_path / "wider.toml").plan.spec.integration.method == "rodas5p"
    by_hand = run(van_der_pol(1000.0, method="rodas5p"), tmp_path / "by-hand", workers=0, echo=silent)
    assert by_hand.info.digest == info.digest


@pytest.mark.slow
def test_run__of_an_ordinary_system_has_the_digest_and_the_bits_of_dopri5(tmp_path):
    found = {}
    for method in ("auto", "dopri5"):
        one = run(van_der_pol(1.0, method=method), tmp_path / method, workers=0, echo=silent)
        found[method] = one.info.digest, one.cube().section.values.tobytes()
    assert found["auto"] == found["dopri5"]


@pytest.mark.slow
def test_decide__impacts_leave_steps_short_that_are_not_stiff(monkeypatch):
    spec = Spec.read("tests/zoo/systems/ball-on-shaken-table.toml")
    inputs = (plan := make_plan(spec)).cells.spread(8)
    exact, coarse = (methods._count(plan.spec, inputs, scale) for scale in (1.0, 1e3))
    assert exact.attempts.sum() < 1.1 * coarse.attempts.sum()
    monkeypatch.setattr(methods, "compile_kernel", None)  # nothing else is compiled
    assert method_of(spec) == "dopri5"
