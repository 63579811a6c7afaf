"""The bench: recordings, the magnet torque, identification, measured beside computed diagrams."""
