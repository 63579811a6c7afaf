"""The models that ship as text: a TOML file each, named after the model."""
