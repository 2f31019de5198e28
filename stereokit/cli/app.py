"""The command line: ``stereokit match``, ``list``, ``info`` and the commands of other packages.

Other packages add commands through the entry-point group ``stereokit.commands``: each entry is a plain
function with typer annotations. It is imported only for its command or for the list of all commands. One that cannot
be imported reports its error without harm to the rest. Everything heavy is imported inside the functions.

Bad input ends with one line, ``error: ...``, on standard error and exit status 2; an interrupt with 130. A warning is
one line, ``warning: ...``. A request to end (SIGTERM, SIGHUP) is an interrupt, so that no half-written file stays
behind, and the process then ends by that signal.
"""

from __future__ import annotations

import inspect
import io
import logging
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import metadata
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from stereokit.cli.info import info, list_
from stereokit.cli.match import match
from stereokit.cli.output import version_of
from stereokit.cli.pair import check
from stereokit.cli.rig import rig
from stereokit.cli.warmup import warmup
from stereokit.errors import StereokitError, StereokitWarning, one_line
from stereokit.notices import collecting

__all__ = ["app", "main"]

_GROUP = "stereokit.commands"


class _Commands(TyperGroup):
    """The built-in commands and those of entry points."""

    def list_commands(self, ctx: Any) -> list[str]:
        names = super().list_commands(ctx)
        return [*names, *sorted({entry.name for entry in metadata.entry_points(group=_GROUP)} - set(names))]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        command = super().get_command(ctx, cmd_name)
        if command is None:
            for entry in metadata.entry_points(group=_GROUP, name=cmd_name):
                return _plugin(entry)
        return command

    def invoke(self, ctx: Any) -> Any:
        try:
            with collecting(_print_warning):
                return super().invoke(ctx)
        except StereokitError as error:
            _fail(str(error), error)
        except ModuleNotFoundError as error:
            if (error.name or "stereokit").startswith("stereokit"):
                raise
            _fail(f"this needs the package {error.name!r}, which is not installed", error)
        except MemoryError as error:
            _fail(f"not enough memory: {error}" if str(error) else "not enough memory", error)
        except KeyboardInterrupt as error:  # typer 0.12 would end with 1
            raise typer.Exit(130) from error


app = typer.Typer(
    name="stereokit",
    cls=_Commands,
    help="Classical stereo matching: disparity maps from rectified pairs.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def main() -> None:
    """Run the command line; the console entry point."""
    from stereokit.io.quiet import keep_stderr

    keep_stderr()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a path may have bytes that are no text
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # warnings of libraries are for programmers
        warnings.filterwarnings("default", module="stereokit")
        warnings.filterwarnings("default", category=StereokitWarning)
    warnings.showwarning = lambda message, *_, **__: _print_warning(str(message))
    logger = logging.getLogger("stereokit")
    logger.addHandler(_Lines())
    logger.setLevel(logging.INFO)
    with _ending_by_signal():
        try:
            app(prog_name="stereokit")
        except KeyboardInterrupt:
            sys.exit(130)


@contextmanager
def _ending_by_signal() -> Iterator[None]:
    """Turn a request to end into an interrupt, so that running work is cleaned up, and then end by its signal."""
    signals: list[int] = []

    def end(number: int, frame: object) -> None:
        signals.append(number)
        if len(signals) == 1:  # it may come again meanwhile, as from `timeout`
            raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        for name in ("SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) is signal.SIG_DFL:  # nohup ignores SIGHUP
                signal.signal(number, end)
    try:
        yield
    finally:
        if signals:
            signal.signal(signals[0], signal.SIG_DFL)
            os.kill(os.getpid(), signals[0])


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"stereokit {version_of('stereokit')}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


app.command()(match)
app.command()(check)
app.command("list")(list_)
app.command()(info)
app.command()(warmup)
app.command()(rig)


def _plugin(entry: metadata.EntryPoint) -> Any:
    app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    try:
        function: Callable[..., Any] = entry.load()
        summary = (inspect.getdoc(function) or "").split("\n\nParameters\n")[0]  # the rest is for programmers
        app.command(entry.name, help=summary)(function)
        command = typer.main.get_command(app)
    except Exception as error:
        reason = f"command {entry.name!r} cannot be loaded: {type(error).__name__}: {error}"

        def unavailable(ctx: typer.Context) -> None:
            raise StereokitError(reason)

        app = typer.Typer(add_completion=False, rich_markup_mode=None)
        any_arguments = {"allow_extra_args": True, "ignore_unknown_options": True}
        app.command(entry.name, help=f"Not available: {reason}", context_settings=any_arguments, add_help_option=False)(
            unavailable
        )
        command = typer.main.get_command(app)
    command.name = entry.name
    return command


def _fail(message: str, error: BaseException) -> None:
    typer.echo(f"error: {one_line(message)}", err=True)
    raise typer.Exit(2) from error


class _Lines(logging.Handler):
    """Prints what the package tells of its work, a line each on standard error."""

    def emit(self, record: logging.LogRecord) -> None:
        typer.echo(one_line(record.getMessage()), err=True)


def _print_warning(line: str) -> None:
    typer.echo(f"warning: {one_line(line)}", err=True)
