"""Read from a run the data that the page shows: diagrams, planes, orbits, overlays, tables."""
