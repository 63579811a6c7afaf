"""Start the command line. Signal handlers are installed first, since the imports that follow take seconds."""

from __future__ import annotations

from pipeline.runs import stopping


def main() -> None:
    """Install the signal handlers, and run the command line."""
    stopping.listen()
    from pipeline.cli.main import main as command_line

    command_line()
