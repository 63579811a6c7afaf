"""Carry out the commands on runs: run, status, verify, derive, draw, extend, zoom."""
