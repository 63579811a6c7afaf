"""Columns of the sets that are found at each parameter point; results of other analyses have some of them."""

from __future__ import annotations

from pipeline.products.column import STATES, Columns, in_parts, over

IDENTIFIED_COLUMNS: Columns = (
    *over("*", n_sets="number of sets", ran_out="whether the extension's budget ended"),
    *over("*", growth_length="sections over which the distance of growing cells from where they began grew"),
    *over("*", growth_factor="factor by which it grew"),
    *over("*", "1/s", growth_rate="relative growth of these cells, at the end of their extension"),
    *over("* +", attractor_id="attractor of the cell, -1 none", decision="how the cell was decided"),
    *over("* +", status="what became of the cell"),
    *over(
        "set",
        attractor="attractor",
        kind="kind of set",
        stability="what has been shown of the set",
        evidence="what the stability rests on",
        orbit_period="period in {periods}, 0 if bounded or absent",
        is_polished="whether Newton's method converged",
        residual="scaled distance of the orbit's first point from its image",
        multiplier_error="error of the largest modulus of the multipliers",
        closes_above="period of cells that seem to close above the longest looked for",
        dimension="dimension of a torus, 0 of any other set",
        share="share of all cells of the parameter point",
        n_cells="cells on the attractor",
        n_points="stored section points",
        n_sampled="cells of the set, and neighbours, that were extended",
        n_left="extended cells that left the set",
        n_leaving="extended cells that were near their end from the start",
        time_at_risk="time on the set in all, {periods}",
        mean_lifetime="mean lifetime, {periods}",
        mirror_partner="attractor that is the mirror image, -1 none",
        mirror_distance="distance from the mirror image",
        side="class of the motion, by the model's classifier",
    ),
    *in_parts(over("set", lifetime="mean lifetime, {periods}"), "low", "high"),
    *over("set", "s", period_s="period of a polished orbit"),
    *over("set", "1/{time}", lyapunov_max="largest Lyapunov exponent"),
    *in_parts(over("set", "1/{time}", lyapunov="largest Lyapunov exponent"), "low", "high"),
    *in_parts(over("set multiplier", multiplier="Floquet multipliers"), "real", "imag"),
    *in_parts(over("set multiplier", "1/{time}", eigenvalue="eigenvalues at rest"), "real", "imag"),
    *over("set state", STATES, state_min="least value of the state", state_max="largest value of the state"),
    *over("set angle", rotation="mean rotation, turns per {period}"),
    *over("sample state", STATES, attractor_points="section points"),
    *over("transition", from_set="row of the set that was left", to="set of the end", n_to="cells that left"),
)
