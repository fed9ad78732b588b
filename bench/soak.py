"""Eight hours of a robot, as fast as they can be computed: what memory and updates come to."""

import gc
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from resource import getpagesize
from statistics import median
from time import process_time
from typing import Any

from bench.laps import START, config, laps
from bench.table import Row
from slam_backend.core.config import Config, Keyframes
from slam_backend.core.graph import Decision
from slam_backend.core.measurement import SECOND, Measurement
from slam_backend.io.cdr import Decoder
from slam_backend.io.inputs import OWN
from slam_backend.io.replay import Run
from slam_backend.io.typestore import typestore_of

TITLE = "Soak"
EXPLANATION = (
    "Eight hours of a planar robot with odometry at 50 Hz, a keyframe every two metres and a loop every ten seconds; the middle four hours it is parked. Memory: growth of the resident set "
    "over what there was after the first half hour, for each keyframe since; and over the parked hours in all. Updates: the median CPU time of our own part (all but the solver's), "
    "in the last hour over that in the first."
)
HOURS, RATE = 8.0, 50.0
HOUR = 3600.0


class Soaked:
    """A stream of records as the worker has it, and what is looked at on the way."""

    def __init__(self, hours: float) -> None:
        self.paths, self.damage, self.count, self.read = [Path("soak")], list[str](), 0, 0
        self.hours = hours
        self.at: dict[
            float, tuple[int, int, int]
        ] = {}  # share of the time -> bytes, keyframes, samples of odometry
        self.run: Any = None

    def stream(self, chosen: Config) -> Iterator[Measurement | Decision]:
        table = dict(OWN) | {source.topic: (name, source.kind) for name, source in chosen.sources.items()}
        decoder, seconds = Decoder(typestore_of(()), table), self.hours * HOUR
        marks = iter([seconds * n / 16 for n in range(1, 16)])
        mark = next(marks)
        for record in laps(seconds, RATE, parked=(seconds / 4, 3 * seconds / 4)):
            self.read += 1
            if record.log_time - START >= mark * SECOND:
                self.look(mark / seconds)
                mark = next(marks, 2 * seconds)
            yield from decoder.decode(record)
        self.look(1.0)

    def look(self, share: float) -> None:
        gc.collect()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        backend = self.run.backend
        self.at[share] = pages * getpagesize(), len(backend.timeline), len(backend.track)
        memory, keyframes, _ = self.at[share]
        print(f"{share * self.hours:.2f} h: {keyframes} keyframes, {memory / 1e6:.0f} MB", file=sys.stderr)

    def vertex(self, stamp: int) -> int | None:  # noqa: ARG002  # no graph file
        return None

    def close(self) -> None:
        """Nothing is open."""

    def __enter__(self) -> "Soaked":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def rows(hours: float = HOURS) -> list[Row]:
    chosen = config().model_copy(update={"keyframes": Keyframes(distance=2.0)})
    soaked = Soaked(hours)
    run = Run(soaked, chosen, [])
    soaked.run = run
    own = _own_parts(run)
    begin, end = soaked.at[1 / 16], soaked.at[1.0]
    quarter, three = soaked.at[5 / 16], soaked.at[12 / 16]
    each = (end[0] - begin[0]) / (end[1] - begin[1])
    n = len(own) // 4
    first, last = median(own[:n]), median(own[-n:])
    return [
        Row("memory, each keyframe", f"{each / 1e3:.1f} kB", f"{end[1]} keyframes, {end[0] / 1e6:.0f} MB", each / 1e3, "<= 12"),
        Row("memory, parked", f"{(three[0] - quarter[0]) / 1e6:.2f} MB", f"{hours * 7 / 16:.1f} h", (three[0] - quarter[0]) / 1e6, "<= 1"),
        Row("odometry kept while parked", f"{three[2] - quarter[2]}", f"of {hours * 7 / 16 * HOUR * RATE:,.0f}", three[2] - quarter[2], "<= 64"),
        Row("own part of an update, p50", f"{last * 1e3:.2f} ms", f"{first * 1e3:.2f} ms", last / first, "<= 1.5"),
    ]  # fmt: skip


def _own_parts(run: Run) -> list[float]:
    """CPU seconds of each update without the solver's."""
    backend, solving, found = run.backend, [0.0], list[float]()
    backend.solver.update = _timed(backend.solver.update, solving.append)  # type: ignore[method-assign]
    add = _timed(backend.add, found.append)

    def watched(item: Measurement) -> Any:
        solving.clear()
        updates = add(item)
        found[-1:] = [found[-1] - sum(solving)] if updates else []
        return updates

    backend.add = watched  # type: ignore[method-assign]
    for _ in run:
        pass
    return found


def _timed(function: Callable[..., Any], took: Callable[[float], object]) -> Callable[..., Any]:
    """took: told the CPU seconds of each call."""

    def timed(*arguments: Any, **named: Any) -> Any:
        begin = process_time()
        try:
            return function(*arguments, **named)
        finally:
            took(process_time() - begin)

    return timed
