"""List the commands, inputs, pictures, measures and tables that the analysis of a test rig adds."""

from __future__ import annotations

from pipeline.products.plugins import Plugin

PLUGIN = Plugin(
    commands={
        "fit-magnet": "pipeline.rig.commands.magnet:fit_magnet",
        "measured": "pipeline.rig.commands.measured:measured_app",
        "recordings": "pipeline.rig.commands.recordings:recordings_app",
        "identify": "pipeline.rig.commands.identify:identify_app",
    },
    functions={"run_posterior": "pipeline.rig.identify.posterior_runs:run_and_spread"},
    inputs={"recordings": "pipeline.rig.recordings.study:RECORDINGS", "torques": "pipeline.rig.magnet.study:TORQUES"},
    pictures={
        "recording": "pipeline.rig.recordings.study:RECORDING",
        "series": "pipeline.rig.recordings.study:SERIES",
        "torques": "pipeline.rig.magnet.study:FIT",
    },
    measures={
        "recorded_duty_cycle": "pipeline.rig.recordings.study:recorded_duty_cycle",
        "curves_described": "pipeline.rig.magnet.study:curves_described",
        "torque_gain": "pipeline.rig.magnet.study:gain_over_dipoles",
        "width_spread": "pipeline.rig.magnet.study:width_spread",
        "signs_apart": "pipeline.rig.magnet.study:signs_apart",
    },
    tables={
        "identification": "pipeline.rig.reference:identification",
        "mapping": "pipeline.rig.reference:mapping",
        "findings": "pipeline.rig.reference:findings",
        "virtual rig": "pipeline.rig.reference:virtual_rig",
        "measured branch": "pipeline.rig.reference:measured_branch",
    },
)
