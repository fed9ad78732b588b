"""`slam-backend edit RUN`: what the live node's ~/edit, ~/undo and ~/redo do, on a finished run."""

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core.errors import BadConfig, SlamError
from .progress import progress

if TYPE_CHECKING:
    from ..core.command import Command
    from ..io.finished import FinishedRun
    from ..io.history import History
    from ..io.replay import Run
    from ..io.resultbag import With

SHOWN = 5  # ids in the line for people


def command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run directory, as `replay` writes it.")],
    disable: Annotated[list[str] | None, typer.Option(metavar="NAME", help="Keep out.")] = None,
    enable: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Bring in, and keep in whatever a stage says.")
    ] = None,
    remove: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Keep out; only undo takes it back.")
    ] = None,
    reweight: Annotated[
        list[str] | None, typer.Option(metavar="NAME=FACTOR", help="Multiply the information.")
    ] = None,
    source: Annotated[str | None, typer.Option(metavar="S", help="Only factors of this source.")] = None,
    begin: Annotated[
        str | None, typer.Option("--from", metavar="T", help="Only from this stamp on: <sec>.<nsec>.")
    ] = None,
    end: Annotated[str | None, typer.Option("--to", metavar="T", help="Only up to this stamp.")] = None,
    undo: Annotated[bool, typer.Option("--undo", help="Take the last edit back.")] = False,
    redo: Annotated[bool, typer.Option("--redo", help="Do again what was undone last.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what it would come to, and touch nothing.")
    ] = False,
    anew: Annotated[
        bool,
        typer.Option("--replay", help="Decide everything anew, as if what is kept out had never been said."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print what came of it as JSON.")] = False,
) -> None:
    """Edit a finished run: its files are written anew, from its inputs and its edits (edits.jsonl).

    NAME: a factor's id (loops/1700000000.000000000/3, see decisions.jsonl), a source, or all (all but the motion).
    --source, --from and --to narrow sources and all; alone they say what to disable. All or nothing.
    """
    from ..io.finished import FinishedRun

    lists = {"disable": disable or [], "enable": enable or [], "remove": remove or []}
    action, arguments = _asked(lists, reweight or [], (source, begin, end), (undo, redo))
    if anew and (dry_run or undo or redo):
        raise BadConfig("--replay decides anew: leave out --dry-run, --undo and --redo")
    finished = FinishedRun(run)
    again, history = _replayed(finished, finished.again())
    finished.compare(again)
    told = again.backend.dry_run(action, arguments)
    if dry_run:
        typer.echo(json.dumps(told) if as_json else f"{run} would change: {_line(told)}")
        return
    _carry_out(again, history, _numbered(again, action, arguments))
    if anew:
        before = again.result.summary["counts"]
        again, history = _replayed(finished, _without(finished, again))
        told = {"before": before, "after": again.result.summary["counts"]}
    _replace(again, history, run)
    told = {**told, "run_hash": again.result.summary["run_hash"]}
    if as_json:
        typer.echo(json.dumps(told))
    else:
        typer.echo(f"{run}: {_line(told)}; run hash {told['run_hash'][:16]}")


def _asked(
    lists: Mapping[str, Sequence[str]],
    reweight: Sequence[str],
    narrow: tuple[str | None, str | None, str | None],
    back: tuple[bool, bool],
) -> tuple[str, dict[str, Any]]:
    """The action of a command and its arguments. BadConfig where options do not go together."""
    from ..core.edits import EVERY, edit_of, weights_of

    undo, redo = back
    any_name = any(lists.values()) or bool(reweight)
    if undo or redo:
        if any_name or any(narrow) or (undo and redo):
            raise BadConfig("--undo and --redo stand alone")
        return ("undo" if undo else "redo"), {}
    if any(narrow) and not any_name:
        lists = {**lists, "disable": [EVERY]}
    arguments: dict[str, Any] = {
        what: [_narrowed(name, *narrow) for name in names] for what, names in lists.items()
    }
    arguments["reweight"] = {_narrowed(name, *narrow): k for name, k in weights_of(reweight).items()}
    edit_of(arguments)
    return "edit", arguments


def _narrowed(name: str, source: str | None, begin: str | None, end: str | None) -> str:
    from ..core.edits import EVERY

    if "/" in name or "@" in name:
        return name
    if source and name not in (EVERY, source):
        raise BadConfig(f"'{name}' is not of --source {source}: name one of both")
    return f"{source or name}@{begin or ''},{end or ''}" if begin or end else source or name


def _replayed(finished: "FinishedRun", run: "Run") -> "tuple[Run, History]":
    from ..io.history import History
    from .replay import watch

    history = History(run)
    watch(run, [history.see], progress)
    refused = [each for each in run.decisions if each.stage == "command" and each.verdict == "refused"]
    known = [each.id.removeprefix("command/") for each in refused]
    if lost := [each for each in run.edits.commands if each.id in known]:
        why = refused[known.index(lost[0].id)].detail
        raise SlamError(f"{finished.path}: an edit made before cannot be made any more: {why}")
    return run, history


def _numbered(run: "Run", action: str, arguments: Mapping[str, Any]) -> "Command":
    from ..core.command import command as asked

    return asked(f"after the end {len(run.edits.commands) + 1}", action, arguments)


def _carry_out(run: "Run", history: "History", asked: "Command") -> None:
    for update in run.edit(asked):
        history.see(update)


def _without(finished: "FinishedRun", edited: "Run") -> "Run":
    """The run anew, without the measurements that are kept out; what is forced or reweighted is so again at the end."""
    from ..core.command import command as asked
    from ..io.edits import Edits, without

    wishes, earlier = edited.backend.wishes, edited.edits.dropped
    found = finished.numbers(wishes.out, earlier)
    if lost := sorted(wishes.out.keys() - found.keys()):
        continued = finished.summary.get("continued")
        where = f", unless it is of the map that is continued: then edit {continued}" if continued else ""
        raise SlamError(
            f"'{lost[0]}' is no single message of a source: there can be no replay without it{where}"
        )
    arguments = {
        "enable": sorted(without(id_, found) for id_ in wishes.forced),
        "reweight": {without(id_, found): k for id_, k in sorted(wishes.weights.items()) if id_ not in found},
    }
    commands = (asked("after the end 1", "edit", arguments),) if any(arguments.values()) else ()
    return finished.again(Edits({**earlier, **{n: id_ for id_, n in found.items()}}, commands))


def _replace(run: "Run", history: "History", out: Path) -> None:
    """The files of the run, the summary last; whatever breaks off before leaves the run as it was."""
    from ..io.rundir import INPUTS, RESULT_BAG, replace_run
    from ..lab.report import REPORT
    from .replay import write

    bag: With | None = (
        ("link" if (out / INPUTS).is_dir() else "copy") if (out / RESULT_BAG).exists() else None
    )
    aside = out.with_name(f".{out.name}.edited")
    shutil.rmtree(aside, ignore_errors=True)
    try:
        write(run.result, history, aside, (out / REPORT).exists(), bag)
        replace_run(out, aside)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _line(told: Mapping[str, Any]) -> str:
    if "after" in told:
        before, after = told["before"], told["after"]
        return ", ".join(
            f"{name} {before[name]} -> {after[name]}" for name in ("factors", "loops_accepted", "parts")
        )
    cost, shift, ids = told["cost"], told["largest_shift"], told["factors"]
    names = ", ".join(ids[:SHOWN]) + (f" and {len(ids) - SHOWN} more" if len(ids) > SHOWN else "")
    return (
        f"{names or 'nothing'}; cost {cost['before']:.6g} -> {cost['after']:.6g}, "
        f"largest shift {shift['m']:.3f} m, {shift['rad']:.4f} rad, {told['parts']} parts"
    )
