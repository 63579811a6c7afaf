"""Name the kinds of bifurcations, with the labels of other programs. Imports nothing, for figures and tables."""

FOLD, DOUBLING, TORUS, BRANCHING = "fold", "period_doubling", "neimark_sacker", "branch_point"
HOPF, PITCHFORK, TRANSCRITICAL = "hopf", "pitchfork", "transcritical"
KINDS = (FOLD, DOUBLING, TORUS, BRANCHING, HOPF, PITCHFORK, TRANSCRITICAL)
BRANCH_POINTS = (BRANCHING, PITCHFORK, TRANSCRITICAL)

HOMOCLINIC, SNIC = LIMITS = ("homoclinic", "snic")
"""Kinds of ends at which the period of a flow's cycles grows without bound (see `limits`)."""

CURVE_KINDS = (*KINDS, *LIMITS)
"""Kinds of curves in two parameters, in the order of their codes."""

LABELS = {
    **dict(zip(KINDS, ("LP", "PD", "NS", "BP", "H", "BP", "BP"), strict=True)),
    **dict(zip(LIMITS, ("HOM", "SNIC"), strict=True)),
    "cusp": "CP",
    "generalised_doubling": "GPD",
    "chenciner": "CH",
    "r1": "R1",
    "r2": "R2",
    "r3": "R3",
    "r4": "R4",
    "fold_flip": "LPPD",
    "fold_neimark_sacker": "LPNS",
    "doubling_neimark_sacker": "PDNS",
    "double_neimark_sacker": "NSNS",
    "bogdanov_takens": "BT",
    "generalised_hopf": "GH",
    "zero_hopf": "ZH",
    "double_hopf": "HH",
    "degenerate_pitchfork": "DP",
    "neutral_saddle": "NSS",
    "saddle_node_homoclinic": "NCH",
}
"""Labels of bifurcations, and of points of codimension two, as MatCont and MatContM print them.

AUTO writes HB for H and TR (torus) for NS; MatCont writes LPC for the fold of a limit cycle. A pitchfork or
transcritical point is a branch point to both.
"""

MARKERS = dict(zip(CURVE_KINDS, "^soDpvX*P", strict=True))
"""Markers of bifurcations in figures."""

NAMES = {
    **{FOLD: "fold", DOUBLING: "period doubling", TORUS: "Neimark-Sacker", BRANCHING: "branch point", HOPF: "Hopf"},
    **{PITCHFORK: "pitchfork", TRANSCRITICAL: "transcritical"},
    **{HOMOCLINIC: "homoclinic", SNIC: "saddle node on a circle"},
}
"""Names of bifurcations in texts."""

CURVE_WHY = {
    "closed": "closed",
    "resonance": "the multipliers become real",
    "max_points": "as many points as a curve may have: a run at other values of the second parameter shows more",
    "budget": "as many evaluations as a curve may take: a run at other values of the second parameter shows more",
    "stuck": "Newton's method finds no next point",
    "period_halving": "an orbit of half the period",
    "equilibrium": "the cycles shrink to an equilibrium",
    "tangent": "the cycles only touch the section",
    "heteroclinic": "the orbit meets another saddle",
}
"""Reasons why a curve in two parameters ends within its bounds, in words; others are points of codimension two."""
