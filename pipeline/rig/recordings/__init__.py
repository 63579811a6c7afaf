"""Recordings of a rig: files, their mapping to states, what is wrong with them, their rates."""
