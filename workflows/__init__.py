"""Specifications and studies that ship with magpend, one TOML file each."""
