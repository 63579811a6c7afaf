"""Studies that ship with magpend: one TOML file each, run by name with ``magpend run NAME``."""
