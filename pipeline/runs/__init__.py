"""Do what the commands on runs do: run, status, verify, derive, draw, extend, zoom."""
