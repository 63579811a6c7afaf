"""Parameters that move while a model is integrated: ramps and recorded functions of time."""
