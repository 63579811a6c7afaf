"""Read from a run what the explorer's page shows: diagrams, planes of initial states, orbits, tables."""
