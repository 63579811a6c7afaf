"""The way in: signals first, then everything else, which takes a moment to load."""

from __future__ import annotations

from pipeline.runs import stopping


def main() -> None:
    """Run the command line."""
    stopping.listen()
    from pipeline.cli.main import main as command_line

    command_line()
