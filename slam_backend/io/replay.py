"""The same core, driven by recorded logs: records in, updates out, a result at the end."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from math import inf
from pathlib import Path
from time import perf_counter
from typing import Any, Literal, NamedTuple

import numpy as np

from ..core.backend import Backend, Update
from ..core.check import checked, pace_of, rechecked
from ..core.command import LOAD, Command
from ..core.config import Config, config_from, config_to
from ..core.decisions import DecisionLog
from ..core.errors import BadFile, SlamError
from ..core.graph import Decision
from ..core.measurement import SECOND, Constant, Measurement, format_stamp
from ..core.sessions import SavedMap
from ..core.settle import FAR, settled
from ..core.solvers import SOLVERS, Solver
from ..core.solvers.batch import Solution, polish
from ..core.space import SPACES, Space
from ..core.trajectory import Trajectory
from .configfile import configured, load_config
from .discover import discover
from .edits import NONE, Edits, kept
from .gravity import leaning
from .inputs import GraphInput, Inputs, open_inputs
from .mapfile import read_map
from .result import Result, cost

Final = Literal["none", "batch"]
Ended = Literal["input", "interrupted", "saved"]
Estimator = Callable[[Config, Space], Solver]
RECENT = 500  # updates


class Cut(NamedTuple):
    """records: of the inputs, that are read before they are taken to end. flush: what waits for its turn by then is applied, and the
    run ends; without it, it stands there as it stood while they came.
    """

    records: float = inf
    flush: bool = True


WHOLE = Cut()


def replay(
    inputs: Path | str | Sequence[Path | str],
    config: Config | None = None,
    settings: Sequence[str] = (),
    final: Final = "none",
    estimator: Estimator = SOLVERS["isam2"],
    edits: Edits = NONE,
    continued: Path | None = None,
    cut: Cut = WHOLE,
) -> "Run":
    """Replay bags, journals or a pose graph. Iterate the Run for its updates, or ask for its `result`.

    config: without one, or without sources in it, these are found by the types of the topics. settings: `key=value`, applied
    to what was found. final: `batch` ends at the optimum of the kept factors. estimator: makes the solver that takes the
    factors. edits: what was done to the run before. continued: a run directory, whose map the inputs go on in; its
    configuration serves if none is given. cut: where the inputs are taken to end. SlamError says what is wrong with the input.
    """
    paths = [inputs] if isinstance(inputs, Path | str) else list(inputs)
    saved = None if continued is None else read_map(continued)
    if continued is not None and (config is None or not config.sources):
        config = load_config(continued / "config.yaml")
    opened = open_inputs(paths)
    notes: list[str] = []
    try:
        if config is None or not config.sources:
            found, notes = discover(opened)
            opened.close()
            opened = open_inputs(paths)  # what the first look found damaged is not to be said twice
            given = {} if config is None else config.model_dump(exclude_unset=True, exclude={"sources"})
            config = config_from({**config_to(found), **given}, "configuration")
        config = configured(config, settings)
        notes += leaning(opened, config)
        run = Run(opened, config, notes, final, estimator, cut, edits)
        if continued is not None and saved is not None:
            run.load(continued, saved)
    except BaseException:
        opened.close()
        raise
    return run


def settled_stream(
    items: Iterable[Measurement | Decision],
    config: Config,
    last_resort: bool = True,
    passed: Callable[[int], object] = lambda _: None,
) -> Iterator[Measurement | Decision]:
    """The way from decoded measurements to what the back-end takes: the same live and offline. See `settled`."""
    driver = config.driver
    assert driver is not None
    lag, ahead = (round(seconds * SECOND) for seconds in (config.settle.lag, config.settle.ahead))
    pace = pace_of(driver, config)
    return rechecked(settled(checked(items, config), driver, lag, last_resort, ahead, passed, pace), config)


class Run:
    """One replay. An iterator of updates; progress, early stop and fleets wrap it from outside."""

    def __init__(
        self,
        inputs: Inputs,
        config: Config,
        notes: list[str],
        final: Final = "none",
        estimator: Estimator = SOLVERS["isam2"],
        cut: Cut = WHOLE,
        edits: Edits = NONE,
    ) -> None:
        """cut: where the inputs are taken to end. edits: what is left out, and done at the end."""
        self.config, self.inputs, self._notes = config, inputs, notes
        self._final, self.edits = final, Edits(edits.dropped)
        self._to_do = edits.commands
        self.batch: Solution | None = None
        self.backend = Backend(config, estimator(config, SPACES[config.space]))
        self.decisions = DecisionLog()
        self.seconds = Seconds()
        self.measurements = 0
        self.continued: Path | None = None  # the run whose map this one goes on in
        self._begins = 0  # what drives must be later
        self.last: Update | None = None
        self.reached = 0  # the newest stamp that has been applied
        self._watermark = -FAR
        self._cut = cut
        self._is_cut = self._is_over = False
        self._items = self._stream()
        self._ahead: Measurement | Decision | None = None  # the head of the stream, not applied yet
        self._online: list[tuple[int, tuple[float, ...]]] = []
        self._online_cost = 0.0
        self._updates = self._run()

    def __iter__(self) -> Iterator[Update]:
        return self._updates

    def stop(self) -> None:
        """Read no further: the run ends with what has been read, as a recording does that was cut there."""
        self._cut = self._cut._replace(records=self.inputs.read)

    @property
    def ended(self) -> Ended:
        """input: at the end of its inputs. interrupted: before that. saved: not at all, what is asked of it is its state while they come."""
        if not self._is_over:
            return "saved"
        return "interrupted" if self._is_cut else "input"

    @property
    def records(self) -> int:
        """How many of the inputs are in it."""
        return int(min(self.inputs.read, self._cut.records))

    @property
    def notes(self) -> list[str]:
        """What people should know of it, a line each."""
        if self.ended != "interrupted":
            return self._notes
        return [*self._notes, f"interrupted: it ends after {self.records} of {self.inputs.count} records"]

    def load(self, run: Path, saved: SavedMap) -> None:
        """Go on in the map of a finished run. SlamError if that cannot be."""
        if isinstance(self.inputs, GraphInput):
            raise BadFile(
                f"{self.inputs.paths[0]}: a pose graph has no stamps of its own, and cannot continue a map"
            )
        try:
            self.backend.load(saved)
        except SlamError as error:
            raise BadFile(f"{run}: {error}") from None
        self.continued, self._begins = run, saved.end
        self._online += zip(
            saved.online.stamps.tolist(), map(tuple, saved.online.sevens.tolist()), strict=True
        )

    @cached_property
    def result(self) -> "Result":
        """What came of it; runs what is left of the input first."""
        for _ in self._updates:
            pass
        return Result(self)

    def edit(self, asked: Command) -> Iterator[Update]:
        """At the end of the run: carry a command out, and come to rest as at the end of the input."""
        before = perf_counter()
        self.edits = Edits(self.edits.dropped, (*self.edits.commands, asked))
        yield from self._take(self.backend.add(asked))
        self._settle()
        self.__dict__.pop("result", None)
        self.seconds.solve(perf_counter() - before, 0)

    @property
    def online(self) -> Trajectory:
        """What was believed of each keyframe when it was newest."""
        stamps = np.array([stamp for stamp, _ in self._online], dtype=np.int64)
        return Trajectory(stamps, np.array([seven for _, seven in self._online]).reshape(-1, 7))

    @property
    def online_cost(self) -> float:
        """chi2/2 of the kept factors at the last online estimate, gauges left out."""
        return self._online_cost

    def reach(self, stamp: int, told: Callable[[Update], object] = lambda _: None) -> bool:
        """Go on until the watermark has passed a stamp: all up to it is applied, and nothing beyond. False: the input ends before.

        What is asked of the back-end then is what was believed when the run was there, whatever came later. told: each update.
        """
        for update in self._advance(stamp):
            told(update)
        there = self._ahead is not None or max(self._watermark - 1, self.reached) >= stamp
        for update in self._take(self.backend.complete(stamp + 1) if there else ()):
            told(update)
        return there

    def _run(self) -> Iterator[Update]:
        start = perf_counter()
        yield from self._advance(FAR)
        if self._cut.flush:
            yield from self._finish()
        for asked in self._to_do:
            yield from self.edit(asked)
        self.seconds.wall = perf_counter() - start

    def _stream(self) -> Iterator[Measurement | Decision]:
        with self.inputs:
            items = kept(self._read(), self.edits.dropped)
            yield from settled_stream(items, self.config, self._cut.flush, self._passed)

    def _read(self) -> Iterator[Measurement | Decision]:
        for item in self.inputs.stream(self.config):
            if self.inputs.read > self._cut.records:
                self._is_cut = True
                return
            yield item

    def _passed(self, watermark: int) -> None:
        self._watermark = watermark

    def _advance(self, until: int) -> Iterator[Update]:
        """Apply what comes; what lies beyond a stamp stays at the head of the stream."""
        while True:
            if self._ahead is None:
                self._ahead = next(self._items, None)
            item = self._ahead
            if item is None or self._watermark > until:
                return
            if isinstance(item, Decision):
                self.decisions.add(item)
            elif isinstance(item, Command) and item.action == LOAD:
                self._load(item)
            elif item.stamp > until and not isinstance(item, Constant):
                return
            elif item.stamp <= self._begins and item.source == self.config.driver:
                self.decisions.add(_overlapping(item, self._begins))
            else:
                yield from self._apply(item)
            self._ahead = None

    def _load(self, asked: Command) -> None:
        """A session that begins in a saved map: its journal says in which. BadFile if that is not there, or another one is."""
        folder = Path(self.inputs.paths[0]).parent
        run = (folder / str(asked.arguments.get("run"))).resolve()
        if self.continued is None or self.continued.resolve() != run:
            saved = read_map(run)
            if saved.run_hash != asked.arguments.get("run_hash"):
                raise BadFile(
                    f"{run}: is not the run in whose map {self.inputs.paths[0]} goes on; put that one back"
                )
            self.load(run, saved)
        self.decisions.add(loaded(asked, self._begins))

    def _apply(self, item: Measurement) -> Iterator[Update]:
        self.measurements += 1
        before = perf_counter()
        updates = self.backend.add(item)
        self.seconds.solve(perf_counter() - before, len(updates))
        if not isinstance(item, Constant):
            self.reached = max(self.reached, item.stamp)
        yield from self._take(updates)

    def _finish(self) -> Iterator[Update]:
        before = perf_counter()
        yield from self._take(self.backend.finish())
        if self.last is None:
            raise BadFile(_nothing(self))
        self._online_cost = cost(self.backend.solver.factors.values(), self.backend.estimate.values())
        self._settle()
        self._is_over = True
        self.seconds.solve(perf_counter() - before, 0)

    def _settle(self) -> None:
        self.backend.polish()
        if self._final == "batch":
            self.batch = polish(self.backend.solver.factors.values(), self.backend.estimate.values())
            self.backend.adopt(self.batch.values)

    def _take(self, updates: Sequence[Update]) -> Iterator[Update]:
        for update in updates:
            self.decisions.extend(update.decisions)
            if not self._online or update.keyframe.stamp > self._online[-1][0]:
                self._online.append((update.keyframe.stamp, update.pose))
            self.last = update
            yield update


class Seconds:
    """Where the time of a run went; for people, never for a verdict."""

    def __init__(self) -> None:
        self.wall = 0.0
        self.solving = 0.0
        self._updates: list[float] = []

    def solve(self, seconds: float, updates: int) -> None:
        self.solving += seconds
        if updates:
            self._updates.append(seconds)

    @property
    def last_ms(self) -> float:
        """Of the newest update."""
        return self._updates[-1] * 1e3 if self._updates else 0.0

    def recent(self) -> tuple[float, float]:
        """Median and 99th percentile, in ms, of the last updates."""
        ms = np.array(self._updates[-RECENT:] or [0.0]) * 1e3
        return float(np.percentile(ms, 50)), float(np.percentile(ms, 99))

    def summary(self) -> dict[str, Any]:
        ms = np.array(self._updates or [0.0]) * 1e3
        percentiles = {f"p{p}": round(float(np.percentile(ms, p)), 3) for p in (50, 95, 99)}
        return {
            "wall_s": round(self.wall, 3),
            "read_s": round(max(self.wall - self.solving, 0.0), 3),
            "solve_s": round(self.solving, 3),
            "update_ms": {**percentiles, "max": round(float(ms.max()), 3)},
        }


def loaded(asked: Command, end: int) -> Decision:
    basis = {"ends": format_stamp(end)}
    return Decision(end, f"command/{asked.id}", asked.source, "accepted", "command", LOAD, basis=basis)


def _overlapping(item: Measurement, end: int) -> Decision:
    return Decision(
        item.stamp, f"{item.source}/{format_stamp(item.stamp)}", item.source, "refused", "session", "overlap",
        f"a new session must be later than the map that it continues, which ends at {format_stamp(end)}", ends=item.ends,
    )  # fmt: skip


def _nothing(run: Run) -> str:
    """Why there is no trajectory, in one line."""
    driver = run.config.driver
    refused = {rule: n for rule, n in run.decisions.by_rule().items() if n}
    overlap = next((f"; {d.detail}" for d in run.decisions if d.reason == "overlap"), "")
    why = ", ".join(f"{rule} {n}" for rule, n in refused.items()) or "it holds none"
    damage = "; ".join(run.inputs.damage)
    where = ", ".join(str(path) for path in run.inputs.paths)
    return f"{where}: not one usable message of source '{driver}' ({why}){overlap}" + (
        f"; {damage}" if damage else ""
    )
