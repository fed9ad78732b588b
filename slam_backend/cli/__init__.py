"""The command line: `slam-backend VERB`. One file per verb, imported when that verb is called and not before.

This is also the one edge where an error becomes a line and an exit code:
    0  done         1  a check that was asked for failed (the verb raises `typer.Exit(1)`)
    2  the user can mend it (SlamError, wrong options)          3  we have to mend it
    130  interrupted                                           141  nobody reads our output any more
"""

import os
import sys
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from typing import Annotated, Any

import typer

from ..core.errors import SlamError

VERBS: Mapping[
    str, str
] = {  # verb: its line in `--help`; slam_backend/cli/VERB.py holds its function `command`
    "replay": "Bags and pose graphs through the smoother, into a run directory.",
    "run": "The ROS 2 node.",
    "play": "A bag's messages to real topics.",
    "journal": "A node's journal: what it holds, whether it is whole, as a bag.",
    "solve": "The optimum of a pose graph.",
    "stress": "How many wrong loops a recorded run withstands.",
    "dataset": "A public data set that ships with gtsam, as a bag.",
    "simulate": "A world with ground truth, as a bag.",
    "convert": "A pose graph or trajectory from one format to another.",
    "edit": "Loops and other factors of a finished run disabled, forced, reweighted; undone.",
    "report": "A page that answers what people ask of a run.",
    "doctor": "A recording as the firewall sees it: what each topic holds, and what to mend.",
    "why": "Why a loop is in the graph or not, and what difference it makes.",
    "query": "Poses at any stamp, covariances, landmarks, decisions of a finished run.",
    "evaluate": "How far a run is from the truth: ATE, RPE.",
    "diff": "What moved in the map between two moments, and what came between them.",
    "compare": "What differs between runs, with an exit code for scripts.",
}

TRACEBACK = "SLAM_BACKEND_TRACEBACK"
LONGEST = 400  # characters; an overload error of gtsam prints its arguments whole, which may be megabytes


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"slam-backend {version('slam_backend')}")
        raise typer.Exit


def overview(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version.")
    ] = False,
) -> None:
    """SLAM back-end: keeps a robot's whole trajectory and map as one least-squares problem."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line (default: that of the process) and give its exit code; never a traceback."""
    arguments = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    try:
        code = _run(arguments)
        sys.stdout.flush()  # a reader that is gone shows here, and not in the interpreter's own farewell
    except (BrokenPipeError, SystemExit):  # SystemExit is what rich makes of a broken pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # there goes what is still buffered
        return 141
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - the one place that may
        text, code = _explain(error, arguments)
        with suppress(OSError):
            sys.stderr.write(f"slam-backend: {text}\n")
    return code


def _run(arguments: list[str]) -> int:
    """What typer does with a command line, without its own ways to end the process."""
    verb, *rest = arguments
    if verb in VERBS:
        name, command = f"slam-backend {verb}", _command_of(verb)
    else:  # --help, --version, or a word that gets a suggestion
        name, command, rest = "slam-backend", _all_verbs(), arguments
    try:
        with command.make_context(name, rest) as context:
            command.invoke(context)
    except typer.Exit as end:
        return end.exit_code
    return 0


def _command_of(verb: str) -> Any:
    """A verb's function as a command, from its file."""
    app = typer.Typer(add_completion=False)
    app.command()(import_module(f"slam_backend.cli.{verb}").command)
    return typer.main.get_command(app)


def _all_verbs() -> Any:
    """The overview, from the table alone: no verb's file is imported."""
    app = typer.Typer(add_completion=False, callback=overview)
    for verb, line in VERBS.items():
        app.command(verb, help=line)(lambda: None)
    return typer.main.get_command(app)


def _explain(error: BaseException, arguments: list[str]) -> tuple[str, int]:
    """The line and the exit code for what went wrong."""
    if isinstance(
        error.__context__, KeyboardInterrupt
    ):  # Ctrl-C in the middle of an import: what follows is its echo
        error = error.__context__
    match error:
        case SlamError():
            return _one_line(str(error)), 2
        case typer.TyperException():  # unknown verb or option, missing or malformed argument
            words = ("slam-backend", *(verb for verb in arguments[:1] if verb in VERBS), "--help")
            said = _one_line(error.format_message()).replace("Value error, ", "").rstrip(".")
            return f"{said} (see {' '.join(words)})", 2
        case typer.Abort() | KeyboardInterrupt():
            return "interrupted", 130
        case MemoryError():
            return f"not enough memory: {_one_line(str(error))}", 2
        case OSError():  # no permission, disk full, a directory where a file should be
            return ": ".join(str(part) for part in (error.filename, error.strerror or error) if part), 2
    hint = f"; run with {TRACEBACK}=1 for the traceback"
    if os.environ.get(TRACEBACK):
        hint = "\n" + "".join(traceback.format_tb(error.__traceback__)).rstrip()
    return f"internal error: {type(error).__name__}: {_one_line(str(error))}{hint}", 3


def _one_line(text: str) -> str:
    flat = " ".join(text[: 4 * LONGEST].split())
    return flat if len(flat) <= LONGEST else f"{flat[: LONGEST - 4]} ..."
