"""Name the events of attractors along a parameter: where they begin, change and end, and by which bifurcation.

An attractor that is a closed orbit or an equilibrium lives where its branch is stable. From the last parameter value
at which cells end on it, its branch is followed until it loses stability (`lines`). So the event is the first
located bifurcation on the branch of that very orbit, wherever it lies on the grid of parameter values; where the
branch gives no reason, the event is not decided. `analysis` joins attractors and branches; `cascades`, `passages` and
`crises` decide ends of chaotic sets and tori, `crises` by what `contact` and `transients` measure; `grazing` decides
those of orbits that touch a surface; `one_event` finds the ends that are one event; `dataset` has the Dataset,
`sentences` the table.

Ids that lie on one stable piece of a branch are one attractor and have the least of their ids, since ids of
equilibria rest on distance alone. Nothing is looked for between neighbouring values at which cells end on the same
orbit.

Schema
------
Dims ``event`` (an end of an attractor), ``outcome``, ``doubling``, ``stretch`` (neighbouring parameter values at which
an attractor has one kind and period) and ``end``: the first and the last value of a stretch. Stretches are the nodes of
a graph, whose edges are the events: ``stretch_of`` leads to each ``to_stretch``. Ends at one bifurcation are one event,
see ``same_as``.

============================== ================= ==========================================================
variable                       dims              meaning
============================== ================= ==========================================================
``attractor``, ``set``,        event             id of the attractor, its kind, and its period (0: none)
``period``
``period_after``               event             period of the same attractor beyond a change; -1: it ends
``rises``                      event             1 if the attractor ends as the parameter rises
``what``                       event             name of the event, see `names.NAMES`
``criticality``                event             unknown, supercritical, subcritical, contradictory
``value``, ``value_error``     event             parameter value of the event, its error; NaN if unknown
``seen``, ``beyond``           event             last value at which cells end there, next value of the run
``bifurcation``, ``branch``,   event             its number, the attractor's branch and the other branch,
``other_branch``                                 as in the analysis ``branches``; -1 none
``is_own``                     event             1 if the bifurcation lies on its branch, 0 if the branch
                                                 springs from it or turns there
``n_cells``                    event             cells of the attractor at ``seen``
``same_as``                    event             number of the event that this end belongs to, its own or another:
                                                 attractors that end or begin at one bifurcation or crisis, and mirror
                                                 images, have one event
``to_attractor``, ``to_cells`` event, outcome    ids on which they end at ``beyond`` (-1: none, -2: they
                                                 diverge), with their numbers, the largest first
``stretch_of``                 event             stretch that ends
``stretch_after``              event             stretch of the same attractor beyond a change; -1 none
``to_stretch``                 event, outcome    stretches on which the cells go on; -1 none, -2 they diverge
``doublings``, ``ratio``       event, doubling   of a cascade: doublings, and the ratio of the last intervals
``exponent``,                  event             minus the power of the distance from the event with which laminar
``exponent_error``                               phases or lifetimes grow, and its error
``rotation``                   event             p/q of the orbit to which a torus locks, in turns of the section
``met_period``                 event             of a crisis: period of the unstable orbit that is met
``twin``, ``lives_beyond``     event             of a crisis: id of the set with which it merges (-1 none); 1 if the
                                                 set on the other side meets the orbit
``evidence``                   event             what decided the event, or what was tried
``stretch_attractor``, ...     stretch           ``_set``, ``_period``, ``_low``, ``_high``: the range, up to
                                                 its events where they are decided
``stretch_side``               stretch, end      class of motion, if the model has a classifier
``stretch_fraction``,          stretch, end      basin fraction with its 95 % interval; NaN in continuations
``_low``, ``_high``
============================== ================= ==========================================================
"""
