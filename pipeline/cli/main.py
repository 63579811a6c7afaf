"""Define the command line ``magpend`` with all its commands. Each command imports its heavy modules itself."""

from __future__ import annotations

import os
import sys
from typing import Any

from pipeline.cli.console import LOG
from pipeline.runs import stopping

if __name__ == "__main__":
    stopping.listen()

import typer

from magpend_core.troubleshooting import see
from pipeline.cli.analyse import analyse_app
from pipeline.cli.animate import animate
from pipeline.cli.common import CommandError
from pipeline.cli.console import EnoughError, Exit, visible
from pipeline.cli.extend import extend
from pipeline.cli.groups import SETTINGS, TopGroup, add_command
from pipeline.cli.model import model_app
from pipeline.cli.models import models, presets
from pipeline.cli.options import VERSION, VERSIONS, drawing
from pipeline.cli.plot import plot_app
from pipeline.cli.report import report
from pipeline.cli.reproduce import reproduce
from pipeline.cli.running import atlas, run, status, submit, verify
from pipeline.cli.simulate import EXTRA, simulate
from pipeline.cli.zoom import zoom
from pipeline.products.plugins import added

MOST_SAID, MOST_LINE = 2000, 600
"""Most bytes of a message, and most characters of one of its lines."""

app = typer.Typer(
    name="magpend",
    cls=TopGroup,
    help="Sweeps, continuations, attractors, basins and bifurcations of periodically forced systems.",
    epilog="Exit codes: docs/reference/commands.md#exit-codes",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings=SETTINGS,
)


@app.callback()
def _main(version: VERSION = False, versions: VERSIONS = False) -> None:
    pass


_ANY_OPTION = ("zoom", "simulate", "animate")
"""Commands whose options include a model's states by name."""

for _command in (
    run,
    submit,
    status,
    verify,
    extend,
    zoom,
    atlas,
    drawing(simulate),
    animate,
    report,
    reproduce,
    models,
    presets,
):
    add_command(app, _command, settings=EXTRA if _command.__name__ in _ANY_OPTION else {})
app.add_typer(analyse_app, name="analyse")
app.add_typer(plot_app, name="plot")
app.add_typer(model_app, name="model")
for _name, _added in added("commands").items():
    if isinstance(_added, typer.Typer):
        app.add_typer(_added, name=_name)
    else:
        add_command(app, _added, _name)


def _codes() -> list[tuple[tuple[type[BaseException], ...], Exit]]:
    """Return the exceptions that mean a user's error or a failed run, with the exit code of each."""
    from magpend_core.engine.checks import SystemCheckError
    from magpend_core.models.parameters import ParameterError
    from pipeline.compute.addresses import SchedulerError
    from pipeline.compute.execute import TaskFailedError
    from pipeline.runs.submit import SubmitError
    from pipeline.specification.problems import SpecError
    from pipeline.store.errors import DamagedError, IncompleteError, LockedError, StoreError, UnreadableError

    return [
        ((LockedError,), Exit.LOCKED),
        ((DamagedError,), Exit.DAMAGED),
        ((IncompleteError, UnreadableError), Exit.FAILED),
        ((SpecError, ParameterError, SystemCheckError, StoreError), Exit.REFUSED),
        ((TaskFailedError, SchedulerError, SubmitError, ArithmeticError, OSError), Exit.FAILED),
    ]


def _complain(error: BaseException) -> None:
    lines: list[Any] = getattr(error, "problems", None) or [_shortage(error) or str(error)]
    lines = [" ".join([str(lines[0]), *getattr(error, "__notes__", ())]), *lines[1:]]
    head = "magpend: " if len(lines) == 1 else f"magpend: {len(lines)} problems\n  "
    text = _short(head + "\n  ".join(map(str, lines)))
    if LOG.handlers:
        LOG.error(text)
        LOG.debug("where it came from", exc_info=error)
    else:
        print(visible(text), file=sys.stderr)


def _short(text: str) -> str:
    """Shorten an error message to `MOST_SAID` bytes: cut the middle of long lines, and drop the last lines."""
    said: list[str] = []
    size = 0
    lines = visible(text).split("\n")
    for n, line in enumerate(lines):
        cut = line if len(line) <= MOST_LINE else f"{line[: MOST_LINE - 120]} ... {line[-115:]}"
        size += len(cut.encode()) + 1
        if size > MOST_SAID - 40:
            return "\n".join([*said, f"  ... and {len(lines) - n} lines more."])
        said.append(cut)
    return "\n".join(said)


def main() -> None:
    """Run the command line, and turn errors into messages and exit codes."""
    code: Any = Exit.DONE
    try:
        with stopping.in_order():
            code = app(standalone_mode=False) or Exit.DONE
            sys.stdout.flush()
        if code == Exit.INTERRUPTED:  # typer returns this code for every signal
            raise KeyboardInterrupt
    except (EnoughError, BrokenPipeError):
        _leave_quietly()
    except CommandError as error:
        _usage(error)
        code = Exit.REFUSED
    except (typer.Abort, KeyboardInterrupt):
        print("magpend: stopped.", file=sys.stderr)
        code = 128 + (stopping.first_signal() or int(Exit.INTERRUPTED) - 128)
    except Exception as error:
        code = _exit_code(error)
        if code is Exit.BUG:
            raise
        _complain(error)
    stopping.end_if_stopped(int(code))
    if code != Exit.DONE:
        sys.exit(int(code))


def _usage(error: Any) -> None:
    context = getattr(error, "ctx", None)
    message = error.format_message()
    near = getattr(error, "possibilities", None)
    if near and hasattr(error, "option_name"):
        message = f"no option {error.option_name}; did you mean {' or '.join(near)}?"
    if context is not None and not message.strip():  # a group without a command shows its help
        message = context.get_help()
    hint = f"\nhelp: {context.command_path} --help" if context is not None else ""
    print(visible(f"magpend: {message}{hint}"), file=sys.stderr)


def _leave_quietly() -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _exit_code(error: Exception) -> Exit:
    if isinstance(error, stopping.InterruptedRunError):
        return Exit(128 + error.signal_number)
    if _shortage(error):
        return Exit.FAILED
    return next((code for kinds, code in _codes() if isinstance(error, kinds)), Exit.BUG)


def _shortage(error: BaseException) -> str:
    """Return a sentence about an error that says that the system has no more memory or threads; else an empty text."""
    text = " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return (
            f"memory ran out{f' ({text})' if text else ''}. Free some, or raise its limit (ulimit -v) {see('memory')}."
        )
    if isinstance(error, RuntimeError) and "can't start new thread" in text:
        return f"{text}: raise the limits on processes and memory (ulimit -u, -v) {see('memory')}."
    return ""


if __name__ == "__main__":
    main()
