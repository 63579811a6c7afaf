"""Two routes to one fact: settings from run.json and from attributes; ends on the live page and of analyses."""

import numpy as np
import pytest

from pipeline.analysis.attractors.destinations import destinations_at
from pipeline.analysis.attractors.finding.points import SECTION_BYTES, Dynamics, slabs
from pipeline.analysis.attractors.finding.requests import Settings
from pipeline.explorer.live.live import LiveRun
from pipeline.explorer.live.settling import settle_cells
from pipeline.layout.plan import make_plan
from pipeline.layout.vocabulary import model_of, overrides_of, parameters_of
from pipeline.runs.derive import derive
from pipeline.specification.spec import Spec
from pipeline.store.run import RunDirectory
from pipeline.store.setup import create
from tests.core.flows import BAUTIN
from tests.pipeline.analysis.cubes import line, sweep
from tests.pipeline.runs.test_golden_bits import DRIVE, RUNS


@pytest.mark.parametrize("name", RUNS)
def test_settings__of_run_json_are_those_of_the_cubes_attributes(name, tmp_path):
    """Of runs of every kind of motion, which are set up and not computed."""
    (tmp_path / "drive.csv").write_text(DRIVE, "utf-8")
    (tmp_path / "spec.toml").write_text(RUNS[name], "utf-8")
    spec = Spec.read(tmp_path / "spec.toml")
    plan = make_plan(spec, RUNS[name])
    create(tmp_path / "run", plan)
    run = RunDirectory.open(tmp_path / "run")
    spec, cube = run.spec, run.cube()
    assert model_of(cube) is run.model is spec.model
    assert parameters_of(cube) == spec.values
    assert overrides_of(cube) == spec.parameters.overrides
    own, dynamics = spec.integration, Dynamics.of(cube)
    assert dynamics.parameters == spec.values
    found = Settings.of(cube, dynamics.system, dynamics.geometry, closure=1e-5, longest=4, residual=1e-10)
    assert (found.rtol, found.atol, found.max_steps) == (own.rtol, own.atol, own.max_steps_per_period)
    assert (found.method, found.seen) == (own.method, own.n_transient + own.n_keep)
    assert cube.attrs["closure_tolerance"] == own.closure_tolerance
    assert cube.attrs["max_orbit_period"] == own.max_orbit_period


FIVE = sweep(
    "duffing5",
    {"kind": "grid", "x": line(-0.9375, 0.9375, 16), "v": line(-0.5, 1.0, 7)},
    axes={"A": {"values": [0.2]}},
    frequency_hz=0.15915494309189535,
    tolerance=1e-7,
    lengths=(120, 12),
)
CYCLE = sweep(
    BAUTIN,
    {"kind": "grid", "x": line(-1.2, 1.2, 8), "y": line(-1.1, 1.1, 8)},
    axes={"mu": {"values": [-0.1]}},
    section={"of": "y", "value": 0.1, "longest": 20.0},
    lengths=(60, 12),
)


@pytest.mark.slow
@pytest.mark.parametrize(("spec", "n_ends"), [(FIVE, 5), (CYCLE, 2)], ids=["five orbits", "a cycle and a rest"])
def test_destinations__of_the_live_page_are_those_of_the_analyses(spec, n_ends, computed):
    """Starts beside those of the run: both find the attractor of the run on which each ends."""
    run = RunDirectory.open(computed(spec))
    cube, attractors = run.cube(), derive(run.directory, "attractors")
    (points,) = slabs(cube, Dynamics.of(cube), SECTION_BYTES)
    ((_, there),) = destinations_at(cube, attractors, points)
    states = np.random.default_rng(2).uniform([-0.9, -0.5], [0.9, 1.0], (60, 2))
    analysed = there.follow(states).label
    live = LiveRun(run)
    place = live.place({name: axis["values"][0] for name, axis in spec["axes"].items()}, None)
    catalog = live.catalog(place)
    numbers = settle_cells(place, live.integration, catalog, states, lambda: None)
    entries = {entry.number: entry.attractor for entry in catalog.entries}
    assert [entries[number] for number in numbers.tolist()] == analysed.tolist()
    assert len(set(analysed.tolist())) == n_ends
    live.close()
