"""Find coexisting attractors, describe them, and follow them along the swept parameters."""
