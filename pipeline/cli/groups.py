"""Define groups of commands whose commands are created from a registry when they are first used."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from pipeline.cli.common import PRINTED, UsageError
from pipeline.cli.options import Command, speaking

Groups = Mapping[str, Mapping[str, str]]
SETTINGS = {"help_option_names": ["-h", "--help"]}


class FileCommand(TyperCommand):
    """A command whose option ``--json`` may be followed by a file: by a word that ends in ``.json``."""

    def parse_args(self, ctx: Any, args: list[str]) -> Any:
        """Give ``--json`` its value: the file, or the standard output."""
        own = args[: args.index("--")] if "--" in args else args
        if "--json" in own and any("--json" in parameter.opts for parameter in self.params):
            at = own.index("--json")
            has_file = own[at + 1 : at + 2] and own[at + 1].endswith(".json")
            args = [*args[:at], f"--json={own[at + 1] if has_file else PRINTED}", *args[at + (2 if has_file else 1) :]]
        return super().parse_args(ctx, args)


def made(name: str, function: Command, help: str) -> Any:
    """Turn a Python function into a command of the command line."""
    app = typer.Typer(add_completion=False, rich_markup_mode=None)
    app.command(name, cls=FileCommand, help=help, context_settings=SETTINGS)(speaking(function))
    return get_command(app)


def command_group(help: str, group: type[TyperGroup] = TyperGroup) -> typer.Typer:
    """Create a command group, such as ``magpend plot``."""
    return typer.Typer(cls=group, help=help, no_args_is_help=True, rich_markup_mode=None, context_settings=SETTINGS)


def add_command(
    app: typer.Typer, function: Command, name: str | None = None, settings: Mapping[str, Any] | None = None
) -> None:
    """Add a Python function to a command group, with the options that all commands share."""
    app.command(name, cls=FileCommand, context_settings={**SETTINGS, **(settings or {})})(speaking(function))


_MOVED = {"branches": "magpend analyse branches DIR", "analyze": "magpend analyse X DIR"}


class TopGroup(TyperGroup):
    """The top-level group of commands, ``magpend``; it suggests a name for an unknown or renamed command."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find a command by name. For an unknown name, raise an error that suggests a similar or a new name."""
        if args and args[0] not in self.list_commands(ctx) and not args[0].startswith("-"):
            from pipeline.specification.problems import unknown_name

            if args[0] in _MOVED:
                raise UsageError(f"no command {args[0]!r}; it is: {_MOVED[args[0]]}")
            raise UsageError(unknown_name("command", args[0], self.list_commands(ctx)))
        return super().resolve_command(ctx, args)


def registry_group(verb: str, groups: Callable[[], Groups], make: Callable[[str], Any]) -> type[TyperGroup]:
    """Make a class of command groups from a function that lists the commands, in groups with what each needs, and one
    that creates a command.
    """

    def names() -> list[str]:
        return [name for group in groups().values() for name in group]

    class Group(TyperGroup):
        def list_commands(self, ctx: Any) -> list[str]:
            return [*names(), *super().list_commands(ctx)]

        def get_command(self, ctx: Any, cmd_name: str) -> Any:
            return make(cmd_name) if cmd_name in names() else super().get_command(ctx, cmd_name)

        def format_commands(self, ctx: Any, formatter: Any) -> None:
            """Write the commands in groups, each with the run that it needs."""
            others = dict.fromkeys(super().list_commands(ctx), "")
            for title, needs in {**groups(), **({"Others": others} if others else {})}.items():
                with formatter.section(title):
                    formatter.write_dl([(name, self._about(ctx, name, words)) for name, words in needs.items()])

        def _about(self, ctx: Any, name: str, needs: str) -> str:
            summary = self.get_command(ctx, name).get_short_help_str(200)
            return f"{summary} Needs {needs}." if needs else summary

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            """Find a command by name; raise an error with the right word order if the directory was given first."""
            known = self.list_commands(ctx)
            if args and args[0] not in known:
                later = [a for a in args[1:] if a in known]
                if later:
                    rest = [a for a in args if a != later[0]]
                    raise UsageError(f"the directory comes last: magpend {verb} {later[0]} {' '.join(rest)}")
                from pipeline.specification.problems import unknown_name

                raise UsageError(unknown_name(f"magpend {verb}", args[0], known))
            return super().resolve_command(ctx, args)

    return Group
