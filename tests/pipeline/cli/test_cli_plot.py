"""``magpend plot``: figures of attractors from a run directory, and what is refused."""

from __future__ import annotations

import xarray as xr

from pipeline.cli.exits import Exit

SWEEP = """
kind = "sweep"
axes = { frequency_hz = { values = [2.6, 2.8] }, q = { values = [1.5, 1.6] } }
initial_conditions.kind = "grid"
initial_conditions.psi1_deg = { start = -10, stop = 10, num = 3 }
initial_conditions.psi2_deg = { start = -10, stop = 10, num = 2 }
integration.rtol = 1e-6
integration.atol = 1e-6
integration.n_transient = 200
integration.n_keep = 16
integration.stop_when_closed = true
integration.closure_tolerance = 1e-2
"""


def test_plot__every_figure_of_a_sweep(main, copied, tmp_path):
    """One analysis serves them all, and each puts its data beside it."""
    copied(SWEEP)
    one, both = ["--at", "q=1.5"], ["--at", "q=1.5", "--at", "frequency=2.6"]
    figures = {
        "basins": [*both, "--degrees", "--shade"],
        "fractions": one,
        "gallery": both,
        "attractors": [*one, "--state", "psi2"],
        "regimes": ["--show", "number"],
    }
    names = {
        "basins": "basins_q_1.5_frequency_2.6_degrees_shade",
        "fractions": "fractions_q_1.5",
        "gallery": "gallery_q_1.5_frequency_2.6",
        "attractors": "attractors_psi2_q_1.5",
        "regimes": "regimes_number",
    }
    for verb, options in figures.items():
        code, out, err = main("plot", verb, "run", *options)
        assert code == 0, err
        assert ("attractors: computed" in err) == (verb == "basins")
        name = names[verb]
        assert out.splitlines()[-2:] == [f"figure: run/figures/{name}.png", f"data: run/figures/{name}.nc"]
        assert (tmp_path / "run" / "figures" / f"{name}.png").stat().st_size > 5000
        with xr.open_dataset(tmp_path / "run" / "figures" / f"{name}.nc", engine="scipy") as stored:
            assert stored.data_vars
    code, out, _ = main("plot", "regimes", "run", "--out", "map.pdf")
    assert (code, out.splitlines()[-2:]) == (0, ["figure: map.pdf", "data: map.nc"])

    for arguments, message in (
        (["basins"], "frequency (2 values), q (2 values): choose a value of each, such as frequency=2.8"),
        (["basins", "--at", "q"], "--at q: must be NAME=VALUE with a number, such as frequency=2.2"),
        (["basins", "--at", "p=1"], "unknown axis 'p'; known: frequency, q"),
        (["fractions", "--at", "q=7"], "q = 7 lies off its axis, which runs from 1.5 to 1.6"),
        (["attractors"], "one swept parameter, and 2 are left of frequency, q"),
        (["regimes", "--at", "q=1.5"], "two swept parameters, and 1 are left of frequency, q"),
        (["gallery", "--at", "q=1.5"], "frequency (2 values)"),
        (["basins", "--out", "a.gif"], "the suffix must be one of .png, .pdf, .svg"),
        (["basins", "--threshold", "0"], "threshold = 0.0: must be greater than 0"),
    ):
        before = sorted(tmp_path.rglob("*"))
        code, _, err = main("plot", arguments[0], "run", *arguments[1:])
        assert code == Exit.REFUSED
        assert message in err, err
        assert "Traceback" not in err
        assert sorted(tmp_path.rglob("*")) == before
