"""How many wrong loops a recorded run withstands: its inputs again, with more and more of them, by each strategy.

What the recorded run kept counts as true, what is put in as wrong, what it refused as neither. The map is broken when its
keyframes are further from where the recorded run has them (root mean square, from the same start) than is tolerated.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from ..core.config import Config, RelativeSource, config_from, config_to
from ..core.errors import BadConfig, BadFile
from ..core.measurement import parse_stamp
from ..core.sensors.relative import RelativePose
from ..core.trajectory import Trajectory
from ..io.finished import FinishedRun
from ..io.inputs import open_inputs
from ..io.replay import Run
from .tally import IN, Label, Tally
from .wrong import Injected, Wrongs, wanted

PART = 0.1  # of what odometry alone is off, that a map may be off and count as whole
LEAST = 0.1  # m, that it may be off in any case
NONE = "none"  # the name of the strategy that judges nothing


@dataclass(frozen=True, slots=True)
class Trial:
    """share: of wrong loops among all. size: of groups that agree. off: m. true, wrong: kept at the end, of so many offered.

    ever: wrong ones that were kept at some moment.
    """

    strategy: str
    share: float
    size: int
    off: float
    broken: bool
    true: int
    true_offered: int
    wrong: int
    wrong_offered: int
    ever: int
    seconds: float

    def plain(self) -> dict[str, Any]:
        return asdict(self)


class Stress:
    """BadConfig or BadFile where there is nothing to put wrong loops in, or nothing that says what one looks like."""

    def __init__(self, run: FinishedRun, seed: int = 0, tolerance: float | None = None) -> None:
        self._run, self._seed = run, seed
        self._paths = [Path(path) for path in run.summary["input"]]
        self._source = _source(run)
        verdicts = {
            frozenset((parse_stamp(line["a"]), parse_stamp(line["b"]))): line["verdict"]
            for line in run.decisions
            if "a" in line
        }
        self._true = {ends for ends, verdict in verdicts.items() if verdict in IN}
        self.tolerance = tolerance or max(PART * self._off(run.odometry), LEAST)

    @property
    def recorded(self) -> str:
        """The strategy with which it was recorded."""
        return "+".join(self._run.config.robust) or NONE

    @cached_property
    def count(self) -> int:
        """Of records in the input, for progress."""
        with open_inputs(self._paths) as inputs:
            return inputs.count

    def trial(
        self, strategy: str, share: float, size: int = 1, watch: Callable[[int], None] = lambda _: None
    ) -> Trial:
        """watch: called with how many more records have been read."""
        config = configured(self._run.config, strategy)
        loops = self._wrongs.loops(wanted(share, len(self._like)), size) if share else []
        injected = {frozenset(loop.ends) for loop in loops}

        def label(ends: tuple[int, int]) -> Label:
            known = frozenset(ends)
            return "wrong" if known in injected else "true" if known in self._true else "neither"

        tally = Tally(label)
        run = Run(Injected(open_inputs(self._paths), loops), config, [], "batch")
        shown = 0
        for update in run:
            tally.take(update.decisions, len(run.backend.timeline))
            watch(run.inputs.read - shown)
            shown = run.inputs.read
        off = self._off(run.result.trajectory)
        return Trial(
            strategy, share, size, off, not off <= self.tolerance, tally.true_kept, len(self._true),
            tally.wrong_kept, len(loops), tally.wrong_ever, run.seconds.solving,
        )  # fmt: skip

    @cached_property
    def _like(self) -> list[RelativePose]:
        """The recorded loops that were kept."""
        with open_inputs(self._paths) as inputs:
            found = [
                item
                for item in inputs.stream(self._run.config)
                if isinstance(item, RelativePose) and frozenset(item.ends) in self._true
            ]
        if not found:
            raise BadFile(
                f"{self._run.path}: kept no loop: nothing says what a loop of this drive looks like"
            )
        return found

    @property
    def _wrongs(self) -> Wrongs:
        """New each time, so that a trial does not depend on those before it."""
        like = [each for each in self._like if each.source == self._source] or self._like
        return Wrongs(self._run.trajectory, like, self._run.space, self._seed)

    def _off(self, trajectory: Trajectory) -> float:
        """m, of the keyframes that both have."""
        reference = self._run.trajectory
        apart = trajectory.at(reference.stamps)[:, :3] - reference.sevens[:, :3]
        known = apart[np.isfinite(apart).all(axis=1)]
        return float(np.sqrt(np.mean(np.sum(known**2, axis=1)))) if len(known) else np.inf


def configured(config: Config, strategy: str) -> Config:
    """With the stages that the strategy names, joined by `+`; BadConfig for one that does not exist."""
    stages = [] if strategy == NONE else strategy.split("+")
    return config_from({**config_to(config), "robust": stages}, f"strategy '{strategy}'")


def sentences(trials: Sequence[Trial]) -> Mapping[str, str]:
    """By strategy (and size of groups, where there are several): what it withstands."""
    several = len({trial.size for trial in trials if trial.share}) > 1
    found: dict[str, str] = {}
    for (strategy, size), group in groupby(trials, key=lambda trial: (trial.strategy, trial.size)):
        name = f"{strategy}, {'single ones' if size == 1 else f'groups of {size}'}" if several else strategy
        found[name] = _sentence(sorted(group, key=lambda trial: trial.share))
    return found


def _sentence(trials: Sequence[Trial]) -> str:
    whole = 0
    while whole < len(trials) and not trials[whole].broken:
        whole += 1
    if whole == len(trials):
        return f"holds to {trials[-1].share:.0%}, the most that was tried"
    first = trials[whole]
    what = f"{first.off:.3g} m off, {first.wrong} wrong loops and {first.true} of {first.true_offered} true ones kept"
    if not whole:
        return f"broken at {first.share:.0%}: {what}"
    return f"holds to {trials[whole - 1].share:.0%}, breaks at {first.share:.0%}: {what}"


def _source(run: FinishedRun) -> str:
    """Which source the wrong loops are said to come from: of loops alone, if there is one."""
    names = [name for name, source in run.config.sources.items() if isinstance(source, RelativeSource)]
    if not names:
        raise BadConfig(f"{run.path}: its configuration has no source of kind relative, so no loops")
    return next((name for name in names if name != run.config.driver), names[0])
