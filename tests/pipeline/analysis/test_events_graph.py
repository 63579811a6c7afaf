"""The graph of events, against the cells of the cube counted by hand, and further points against closed forms."""

from __future__ import annotations

import json

import numpy as np
import pytest

import magpend
from pipeline.cli.main import app

CUBIC = magpend.model("x' = mu*x - x**3", name="cubic", kind="map", mu=0.5)


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
    for k, row in table.iterrows():
        edges = [edge for edge in graph["edges"] if edge["event"] == k]
        assert {edge["sentence"] for edge in edges} == ({row["sentence"]} if row["what"] != "range_end" else set())
        if not edges:
            continue
        assert sum(edge["cells"] for edge in edges) == row["n_cells"]
        nodes = graph["nodes"]
        source = nodes[edges[0]["source"]]
        assert (source["attractor"], source["period"]) == (row["attractor"], row["period"])
        end = "high" if row["rises"] else "low"
        assert source[f"{end}_event"] == row["what"]
        assert source[end] == row["value"]
        if row["period_after"] >= 0:
            after = nodes[edges[0]["target"]]
            assert (after["attractor"], after["period"]) == (row["attractor"], row["period_after"])
            assert after["low"] == row["value"]
    ends = [(nodes[e["source"]]["name"], nodes[e["target"]]["name"], e["label"]) for e in graph["edges"]]
    assert set(ends) >= {("A", "B", "BP"), ("A", "C", "BP"), ("B", "A", "BP"), ("B", "B", "PD"), ("C", "C", "PD")}
