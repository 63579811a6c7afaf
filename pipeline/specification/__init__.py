"""Read and validate the specifications (TOML) of runs, and report their problems in sentences."""
