"""Define the commands of a rig: recordings, identification, measured diagrams, and the magnets' torque."""
