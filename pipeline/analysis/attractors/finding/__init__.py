"""Find the closed orbits, limit cycles and equilibria on which the trajectories of a parameter point end."""
