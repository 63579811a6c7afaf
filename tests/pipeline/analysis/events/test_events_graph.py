"""The graph of events, against the cells of the cube counted by hand, and further points against closed forms."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import magpend
from magpend._runs import shown
from pipeline.analysis.events import analysis
from pipeline.cli.main import app
from pipeline.report.report import part_of
from pipeline.runs import beside as refining
from pipeline.store.errors import RefusedError

CUBIC = magpend.model("x' = mu*x - x**3", name="cubic", kind="map", mirror={"signs": {"x": -1}}, mu=0.5)


@pytest.fixture(scope="module")
def cubic(tmp_path_factory):
    """Cubic map: 0 up to its pitchfork at 1, then both arms, which double at 2; starts beyond sqrt(mu + 1) diverge."""
    spec = magpend.Spec("sweep", CUBIC).with_axis("mu", values=[-0.75, -0.45, 0.65, 1.15, 1.65, 2.15])
    spec = spec.with_start_random(n=40, seed=3, x=(-2.0, 2.0)).with_integration(n_transient=1000, n_keep=20)
    return magpend.run(spec, tmp_path_factory.mktemp("cubic") / "run", workers=0)


def wilson(k, n):
    """Wilson's interval at 95 % as the roots of (k/n - p)**2 = z**2 p (1 - p)/n."""
    z2 = 1.959963984540054**2
    return np.sort(np.roots([1.0 + z2 / n, -2.0 * k / n - z2 / n, (k / n) ** 2]))


@pytest.mark.slow
def test_graph__fractions_are_those_of_the_cells(cubic):
    ds, last = cubic.events(), cubic.cube()["section"].isel(period_index=-1, state=0)
    graph = ds.magpend.graph()
    nodes = [node for node in graph["nodes"] if node["id"] != "diverged"]
    assert sorted((node["name"], node["period"]) for node in nodes) == [
        ("A", 1),
        *((i, n) for i in "BC" for n in (1, 2)),
    ]
    ends = {"A": (-0.75, 0.65), ("B", 1): (1.15, 1.65), ("B", 2): (2.15, 2.15)}
    # whether B is the arm of positive numbers follows from one cell
    first = last.sel(mu=1.15).values[cubic.attractors()["attractor_id"].sel(mu=1.15).values == 1][0]
    arm = {"B": np.sign(first), "C": -np.sign(first)}
    for node in nodes:
        lives = ends["A"] if node["name"] == "A" else ends["B", node["period"]]
        for word, mu in zip(("low", "high"), lives, strict=True):
            x = last.sel(mu=mu).values
            is_here = np.abs(x) < 1e-3 if node["name"] == "A" else np.sign(x) == arm[node["name"]]
            k, n = int((is_here & np.isfinite(x)).sum()), int(x.size)
            assert node[f"{word}_fraction"] == pytest.approx(k / n, abs=1e-12)
            assert [node[f"{word}_fraction_{end}"] for end in ("low", "high")] == pytest.approx(wilson(k, n), abs=1e-12)


@pytest.mark.slow
def test_graph__edges_are_the_rows_of_the_table(cubic, tmp_path):
    table, ds = cubic.table("events"), cubic.events()
    out = tmp_path / "graph.json"
    app(["analyse", "events", cubic.name, "--json", str(out)], standalone_mode=False)
    graph = json.loads(out.read_text())
    assert graph == ds.magpend.graph()
    names = {node["id"] for node in graph["nodes"]}
    assert all({edge["source"], edge["target"]} <= names for edge in graph["edges"])
    nodes = graph["nodes"]
    for _, row in table.iterrows():
        edges = [edge for edge in graph["edges"] if edge["event"] == row["event"]]
        assert {edge["sentence"] for edge in edges} == ({row["sentence"]} if row["what"] != "range_end" else set())
        if not edges:
            continue
        assert np.ptp([edge["value"] for edge in edges]) <= 2.0 * row["mu_error"]
        edges = [edge for edge in edges if edge["attractor"] == row["attractor"]]
        assert sum(edge["cells"] for edge in edges) == row["n_cells"]
        source = nodes[edges[0]["source"]]
        assert (source["attractor"], source["period"]) == (row["attractor"], row["period"])
        end = "high" if row["rises"] else "low"
        assert source[f"{end}_event"] == row["what"]
        assert source[end] == row["mu"]
        if row["period_after"] >= 0:
            after = nodes[edges[0]["target"]]
            assert (after["attractor"], after["period"]) == (row["attractor"], row["period_after"])
            assert after["low"] == row["mu"]
    name = {node["id"]: node["name"] for node in graph["nodes"]}
    ends = [(name[e["source"]], name[e["target"]], e["label"]) for e in graph["edges"]]
    assert set(ends) >= {("A", "B", "BP"), ("A", "C", "BP"), ("B", "A", "BP"), ("B", "B", "PD"), ("C", "C", "PD")}
    # the pitchfork is one event of three attractors, and the doublings of both arms are another one
    told = table[table["what"].isin(["pitchfork", "period_doubling"]) & (table["mu"] > 0.0)]
    assert told["mu"].tolist() == pytest.approx([1.0, 2.0], abs=1e-6)
    assert [len({e["source"] for e in graph["edges"] if e["event"] == k}) for k in told["event"]] == [3, 2]


@pytest.mark.slow
def test_events__chaos_that_moves_far_is_one_set(tmp_path):
    """x - s is the logistic map at every s, so that the set moves and is the same; its ids rest on distance."""
    model = magpend.model("x' = s + 1 - 1.9*(x - s)**2", name="moving", kind="map", s=0.0)
    spec = magpend.Spec("sweep", model).with_axis("s", values=[-0.15, 1.75])
    spec = spec.with_start_random(n=6, seed=0, x=(0.75, 0.85)).with_integration(n_transient=500, n_keep=100)
    run = magpend.run(spec, tmp_path / "run", workers=0)
    assert len(set(run.attractors()["attractor"].values.tolist())) > 1
    (node,) = run.events().magpend.graph()["nodes"]
    assert (node["set"], node["low"], node["high"]) == ("chaotic_set", -0.15, 1.75)
    assert set(run.table("events")["what"]) == {"range_end"}


# ---- further values -----------------------------------------------------------------------------

LOGISTIC = magpend.model("x' = r*x*(1 - x)", name="logistic", kind="map", r=3.9)
WIDTH = 0.004


@pytest.fixture
def undecided():
    """Leave the ends of chaotic sets open, so that their intervals alone tell where they are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(analysis, "_aperiodic", lambda scene, one, named: one)
        yield


def logistic(folder, kind="sweep", **how):
    """Chaos up to its crisis with the border of the basin at r = 4, beyond which all cells diverge."""
    spec = magpend.Spec(kind, LOGISTIC, **how).with_axis("r", values=[3.91, 3.95, 4.06])
    spec = spec.with_start_random(n=12, seed=1, x=(0.1, 0.9)).with_integration(n_transient=3000, n_keep=60)
    return magpend.run(spec, folder / "run", workers=0)


def assert_crisis(run, found):
    """The chaotic set ends within WIDTH of 4, and cells beyond diverge."""
    ends = [k for k in range(found.sizes["event"]) if found["rises"][k] and found["beyond"][k] > 4.0]
    (k,) = [k for k in ends if found["seen"][k] <= 4.0]
    seen, beyond = float(found["seen"][k]), float(found["beyond"][k])
    error = float(found["value_error"][k])
    assert beyond - seen <= WIDTH * (1.0 + 1e-9) or abs(found["r"][k] - 4.0) <= error <= WIDTH
    assert found["to_attractor"].values[k, 0] == -2
    beside = magpend.Run.open(f"{run.name}-refined")
    values = beside.cube()["r"].values
    assert set(run.cube()["r"].values) < set(values)
    assert found.attrs["n_further"] == len(values) - 3
    return beside


@pytest.mark.slow
def test_events__of_orbits_alone(tmp_path):
    """With `orbits` no end of a chaotic set is looked at; the doubling at 3 is named all the same."""
    spec = magpend.Spec("sweep", LOGISTIC).with_axis("r", values=[2.9, 3.1, 3.9, 3.95])
    spec = spec.with_start_random(n=4, seed=1, x=(0.1, 0.9)).with_integration(n_transient=1000, n_keep=60)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(analysis, "_aperiodic", None)
        patch.setattr(analysis.Crises, "split", None)
        table = magpend.run(spec, tmp_path / "run", workers=0).table("events", orbits=True)
    (doubling,) = table[table["what"] == "period_doubling"]["r"][:1]
    assert abs(doubling - 3.0) < 1e-8
    assert table[(table["set"] == "chaotic_set") & (table["what"] != "range_end")]["what"].tolist() == ["not_decided"]


@pytest.mark.slow
def test_refine__crisis_of_the_logistic_map(tmp_path, undecided):
    run = logistic(tmp_path)
    beside = assert_crisis(run, run.events(refine=WIDTH, workers=0))
    same = beside.cube()["section"].sel(r=run.cube()["r"])
    assert np.array_equal(same, run.cube()["section"], equal_nan=True)
    assert "further value" in "\n".join(shown(run.events(refine=WIDTH)).lines)
    # what is there is enough for a wider interval, and no cell is run
    n = beside.cube().sizes["r"]
    run.events(refine=2.0 * WIDTH)
    assert magpend.Run.open(beside.name).cube().sizes["r"] == n


@pytest.mark.slow
def test_refine__continuation_of_the_logistic_map(tmp_path, undecided):
    run = logistic(tmp_path, "continuation", continuation={"direction": "up", "path": "r"})
    assert_crisis(run, run.events(refine=WIDTH, workers=0))


class Killed(BaseException):
    """Stands for a kill at some place."""


@pytest.mark.slow
def test_refine__goes_on_after_a_kill(tmp_path, monkeypatch, undecided):
    whole = logistic(tmp_path / "whole")
    whole.events(refine=WIDTH, workers=0)
    run = logistic(tmp_path / "killed")
    original = {name: getattr(refining, name) for name in ("carry_out", "exchange")}
    rename, place = Path.rename, tmp_path / "killed" / "run-refined"

    def stop(*words, **options):
        raise Killed

    def stop_afterwards(*words, **options):
        original["carry_out"](*words, **options)
        raise Killed

    def half_exchange(self, target):
        if self.name.endswith(".extending"):
            raise Killed
        return rename(self, target)

    kills = [(refining, "carry_out", stop), (refining, "carry_out", stop_afterwards)]
    kills += [(refining, "carry_out", stop), (refining, "carry_out", stop_afterwards), (refining, "exchange", stop)]
    kills += [(Path, "rename", half_exchange)]
    for n, (owner, name, replacement) in enumerate(kills):
        monkeypatch.setattr(owner, name, replacement)
        with pytest.raises(Killed):
            run.events(refine=WIDTH, workers=0)
        monkeypatch.undo()
        assert place.exists() == (1 <= n < 5)
        if n == 1:  # one round by itself
            assert len(magpend.Run.open(place).cube()["r"]) == 6
    run.events(refine=WIDTH, workers=0)
    assert magpend.Run.open(place).digest == magpend.Run.open(f"{whole.name}-refined").digest
    assert not place.with_name("run-refined.extending").exists()
    assert run.table("events", refine=WIDTH).equals(whole.table("events", refine=WIDTH))


@pytest.mark.slow
def test_refine__refuses_what_it_cannot_refine(tmp_path, cubic):
    spec = cubic.spec.with_axis("mu", values=[0.5, 1.5])
    magpend.run(spec, f"{cubic.name}-refined", workers=0)
    with pytest.raises(RefusedError, match=r"is not .* with further values of mu"):
        cubic.events(refine=0.1)


# ---- hysteresis ---------------------------------------------------------------------------------

FOLDED = magpend.model("x' = x + 0.5*(mu + x - x**3)", name="folded", kind="map", mu=0.0)
BOTH = {"direction": "both", "path": "mu"}


@pytest.mark.slow
def test_hysteresis__names_the_folds(tmp_path):
    """Fixed points with mu = x**3 - x turn at x = +-1/sqrt(3)."""
    spec = magpend.Spec("continuation", FOLDED, continuation=BOTH).with_axis("mu", -0.6, 0.6, 13)
    spec = spec.with_start_list([[-1.0], [1.0]]).with_integration(n_transient=500, n_keep=4)
    run = magpend.run(spec, tmp_path / "run", workers=0)
    jumps = run.table("hysteresis", events=True)
    fold = 2.0 / (3.0 * np.sqrt(3.0))
    assert jumps["what"].tolist() == ["fold", "fold"]
    assert jumps["direction"].tolist() == ["up", "down"]
    known = np.array([fold, -fold])
    assert (np.abs(jumps["value"] - known) <= jumps["value_error"]).all()
    assert (jumps["value_error"] < 1e-8).all()
    assert np.allclose(jumps["from"], [0.3, -0.3])
    assert "fold at 0.384900179 ± 1e-09" in "\n".join(shown(run.hysteresis(events=True)).lines)
    assert "what" not in run.table("hysteresis")


@pytest.mark.slow
def test_hysteresis__without_attractors(tmp_path):
    """All starts of a map that has no bounded orbit diverge, so that there is neither a loop nor a jump."""
    away = magpend.model("x' = x + mu", name="away", kind="map", mu=1.0)
    spec = magpend.Spec("continuation", away, continuation=BOTH).with_axis("mu", values=[1e6, 2e6, 3e6])
    spec = spec.with_start_list([[0.0], [1.0]]).with_integration(n_transient=2000, n_keep=4)
    run = magpend.run(spec, tmp_path / "run", workers=0)
    assert run.attractors().sizes["set"] == 0
    found = run.hysteresis(events=True)
    assert (found.sizes["loop"], found.sizes["jump"]) == (0, 0)


# ---- report -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_report__has_a_sentence_for_each_event(cubic):
    sentences = [row["sentence"] for _, row in cubic.table("events").iterrows() if row["what"] != "range_end"]
    parts = part_of(cubic.name, lambda line: None, ("attractors",)).parts
    (part,) = (one for one in parts if one.title == "Events")
    grid, picture = part.blocks
    assert [line[0] for line in grid.rows] == sentences
    assert "plot genealogy" in picture.command
