"""Name the events of attractors along a parameter: where they begin, change and end, and by which bifurcation.

An attractor that is a closed orbit or an equilibrium lives where its branch is stable. From the last parameter value
at which cells end on it, its branch is followed until it loses stability (`lines`). So the event is the first
located bifurcation on the branch of that very orbit, wherever it lies on the grid of parameter values; where the
branch gives no reason, the event is not decided. `analysis` joins attractors and branches, `cascades` and `passages`
decide ends of chaotic sets and tori, `grazing` those of orbits that touch a surface, `sentences` has the table.

Ids that lie on one stable piece of a branch are one attractor and have the least of their ids, since ids of
equilibria rest on distance alone. Nothing is looked for between neighbouring values at which cells end on the same
orbit.

Schema
------
Dims ``event``, ``outcome``, ``doubling`` and ``stretch``: neighbouring parameter values at which an attractor has one
kind and period.

============================== ================= ==========================================================
variable                       dims              meaning
============================== ================= ==========================================================
``attractor``, ``set``,        event             id of the attractor, its kind, and its period (0: none)
``period``
``period_after``               event             period of the same attractor beyond a change; -1: it ends
``rises``                      event             1 if the attractor ends as the parameter rises
``what``                       event             name of the event, see `analysis.NAMES`
``criticality``                event             unknown, supercritical, subcritical, contradictory
``value``, ``value_error``     event             parameter value of the event, its error; NaN if unknown
``seen``, ``beyond``           event             last value at which cells end there, next value of the run
``bifurcation``, ``branch``,   event             its number, the attractor's branch and the other branch,
``other_branch``                                 as in the analysis ``branches``; -1 none
``is_own``                     event             1 if the bifurcation lies on its branch, 0 if the branch
                                                 springs from it or turns there
``n_cells``                    event             cells of the attractor at ``seen``
``to_attractor``, ``to_cells`` event, outcome    ids on which they end at ``beyond`` (-1: none, -2: they
                                                 diverge), with their numbers, the largest first
``doublings``, ``ratio``       event, doubling   of a cascade: doublings, and the ratio of the last intervals
``exponent``,                  event             minus the power of the distance from the event with which the
``exponent_error``                               lengths of laminar phases grow, and its error
``rotation``                   event             p/q of the orbit to which a torus locks, in turns of the section
``evidence``                   event             what decided the event, or what was tried
``stretch_attractor``, ...     stretch           ``_set``, ``_period``, ``_low``, ``_high``: the range, up to
                                                 its events where they are decided
============================== ================= ==========================================================
"""
