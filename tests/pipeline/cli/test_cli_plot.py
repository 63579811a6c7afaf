"""``magpend plot``: figures of attractors from a run directory, and what is refused."""

from __future__ import annotations

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


def test_plot__names_of_files_and_refusals(main, copied, tmp_path):
    """What each figure shows, and its data: see tests/test_duffing_day.py."""
    copied(SWEEP)
    code, out, err = main("plot", "basins", "run", "--at", "q=1.5", "--at", "frequency=2.6", "--degrees", "--shade")
    assert code == 0, err
    name = "run/figures/basins_q_1.5_frequency_2.6_degrees_shade"
    assert out.splitlines()[-2:] == [f"figure: {name}.png", f"data: {name}.nc"]
    code, out, err = main("plot", "regimes", "run", "--out", "map.pdf")
    assert (code, out.splitlines()[-2:]) == (0, ["figure: map.pdf", "data: map.nc"])
    assert "attractors: computed" not in err

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
