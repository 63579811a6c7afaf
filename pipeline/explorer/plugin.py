"""List the commands that the interactive page adds."""

from __future__ import annotations

from pipeline.products.plugins import Plugin

PLUGIN = Plugin(commands={"explore": "pipeline.explorer.command:explore", "export": "pipeline.explorer.command:export"})
