"""The runs that ~/save keeps and ~/load takes up: folders under the node's data directory, and nowhere else."""

import shutil
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

from ..core.errors import BadFile
from ..io.restore import RUNS

ASIDE = "."  # begins the name of a run that is not whole yet
SAVING = 120.0  # s that the worker may take to come to a request to save, and to do it


class Shelf:
    """Runs that a former node left half written are thrown away."""

    def __init__(self, data_dir: Path) -> None:
        self._data_dir = data_dir
        for broken in (data_dir / RUNS).glob(f"{ASIDE}*"):
            shutil.rmtree(broken, ignore_errors=True)

    def save(self, ask: Callable[..., Any]) -> Mapping[str, Any]:
        """A new run, written aside, so that one with its name is whole; where it is, and what it holds. Waits.

        ask: the worker, as Feeder.request. BadFile where it cannot be written; SlamError of the worker.
        """
        stamp = datetime.now(UTC).strftime("%Y-%m-%dT%H-%M-%SZ")
        runs = self._data_dir / RUNS
        try:
            runs.mkdir(parents=True, exist_ok=True)
            run = next(run for run in _names(runs / stamp) if not run.exists() and _made(_aside(run)))
            try:
                summary = ask("save", str(_aside(run)), SAVING)
                _aside(run).rename(run)
            except BaseException:
                shutil.rmtree(_aside(run), ignore_errors=True)
                raise
        except OSError as error:
            raise BadFile(f"{runs}: the run cannot be saved: {error}") from None
        counts = {name: summary["counts"][name] for name in ("keyframes", "landmarks", "factors")}
        return {"run": str(run), "run_hash": summary["run_hash"], **counts}

    def find(self, url: str) -> Path:
        """The run that a request names. BadFile for what lies outside the data directory, by whatever way."""
        root = self._data_dir.resolve()
        path = (root / url.removeprefix("file://")).resolve()
        if not url or root not in path.parents:
            raise BadFile(f"only a run inside {root} can be loaded")
        return path


def _names(path: Path) -> Iterator[Path]:
    """path, path-2, path-3, ..."""
    yield path
    yield from (path.with_name(f"{path.name}-{n}") for n in count(2))


def _aside(run: Path) -> Path:
    """Where it is written: a run under its own name is whole."""
    return run.with_name(f"{ASIDE}{run.name}")


def _made(folder: Path) -> bool:
    """Whether the folder is new: of two that save at once each gets its own."""
    try:
        folder.mkdir()
    except FileExistsError:
        return False
    return True
