"""Work with a test rig: recordings, magnet torque, identification, measured diagrams."""
