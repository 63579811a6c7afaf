"""Find the attractors of a parameter point: orbits, limit cycles and equilibria that its cells are on."""
