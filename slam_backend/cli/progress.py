"""How far a verb is: a bar with rate and time left on a terminal, nothing elsewhere. Never on stdout."""

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

Advance = Callable[[int], None]
Progress = Callable[[str, int | None], AbstractContextManager[Advance]]


@contextmanager
def progress(what: str, total: int | None) -> Iterator[Advance]:
    """Yield `advance(n)`, to be called whenever n more of `total` are done; total None: not known beforehand."""
    if not sys.stderr.isatty():
        yield _nothing
        return
    with _bar(what, total) as advance:
        yield advance


@contextmanager
def silent(_what: str, _total: int | None) -> Iterator[Advance]:
    """For work that another bar counts."""
    yield _nothing


def _nothing(_: int) -> None:
    """Show nothing."""


@contextmanager
def _bar(what: str, total: int | None) -> Iterator[Advance]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            speed = task.finished_speed or task.speed
            return Text(f"{speed:,.0f}/s" if speed else "")

    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), Rate(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bars:
        task = bars.add_task(what, total=total)
        yield lambda n: bars.advance(task, n)
