"""Hold the models that ship as text: one TOML file each, named after the model."""
