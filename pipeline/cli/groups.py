"""Groups of commands that are made from a registry, each when it is asked for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import typer
from typer.core import TyperGroup
from typer.main import get_command

from pipeline.cli.common import EXIT_HELP, UsageError
from pipeline.cli.options import Command, speaking

SETTINGS = {"help_option_names": ["-h", "--help"]}


def made(name: str, function: Command, help: str) -> Any:
    """Make a command of a function."""
    app = typer.Typer(add_completion=False, rich_markup_mode=None)
    app.command(name, help=help, epilog=EXIT_HELP, context_settings=SETTINGS)(speaking(function))
    return get_command(app)


class RegistryGroup(TyperGroup):
    """``magpend VERB NAME DIR``: commands by name from a registry, beside those of its own."""

    verb = ""

    def names(self) -> list[str]:
        """Names of the commands that are made."""
        raise NotImplementedError

    def make(self, name: str) -> Any:
        """Make one of them."""
        raise NotImplementedError

    def list_commands(self, ctx: Any) -> list[str]:
        """All names."""
        return [*self.names(), *super().list_commands(ctx)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Make a command when it is asked for."""
        return self.make(cmd_name) if cmd_name in self.names() else super().get_command(ctx, cmd_name)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find a command; say what the order is if the directory came first."""
        if args and args[0] not in self.list_commands(ctx):
            later = [a for a in args[1:] if a in self.list_commands(ctx)]
            if later:
                rest = [a for a in args if a != later[0]]
                raise UsageError(f"the directory comes last: magpend {self.verb} {later[0]} {' '.join(rest)}")
            from pipeline.spec.problems import unknown_name

            raise UsageError(unknown_name(f"magpend {self.verb}", args[0], self.list_commands(ctx)))
        return super().resolve_command(ctx, args)


_MOVED = {"branches": "magpend analyse branches DIR", "analyze": "magpend analyse X DIR"}


class TopGroup(TyperGroup):
    """``magpend``: its commands, and where those went that it had."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find a command, or name the nearest."""
        if args and args[0] not in self.list_commands(ctx) and not args[0].startswith("-"):
            from pipeline.spec.problems import unknown_name

            if args[0] in _MOVED:
                raise UsageError(f"no command {args[0]!r}; it is: {_MOVED[args[0]]}")
            raise UsageError(unknown_name("command", args[0], self.list_commands(ctx)))
        return super().resolve_command(ctx, args)


def registry_group(verb: str, names: Callable[[], list[str]], make: Callable[[str], Any]) -> type[TyperGroup]:
    """Return a class of groups whose commands are made by `make`."""

    class Group(RegistryGroup):
        def names(self) -> list[str]:
            return names()

        def make(self, name: str) -> Any:
            return make(name)

    Group.verb = verb
    return Group
