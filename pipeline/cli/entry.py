"""Start the command line; signal handlers are installed before the slow imports."""

from __future__ import annotations

from pipeline.runs import stopping


def main() -> None:
    """Run the command line."""
    stopping.listen()
    from pipeline.cli.main import main as command_line

    command_line()
