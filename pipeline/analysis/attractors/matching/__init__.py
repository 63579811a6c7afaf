"""Match attractors along the swept parameters: ids, connected branches, hysteresis."""
