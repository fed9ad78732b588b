"""A change on its way into the graph: what nothing judges, then what the robust stages let in; what follows from it, and what is told."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gtsam import symbolIndex

from .apply import without
from .books import Books
from .budget import Budget
from .coast import floor_from
from .command import Command
from .config import Config, GnssSource, LandmarkSource
from .drive import Drive
from .editor import Editor, Shift
from .errors import SlamError, SolverFailure
from .floor import priors
from .graph import Decision, Delta, Keyframe, Offer, Pose
from .jury import Jury
from .merging import Merger
from .quarantine import Quarantine
from .reunion import reunion
from .robust import ROBUST, Doubt, Robust
from .robust.paths import Paths
from .sensing import Sensing
from .sensors.odometry import HERE
from .splitting import Splitter
from .variables import value_in


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """What one keyframe changed; plain data, small enough to send each time.

    pose: `map_T_base` of the keyframe; correction: `map_T_odom`; both x y z qx qy qz qw. origin: where the driving odometry's frame
    has been since its last restart, in that odom.
    revision: grows whenever a solver update corrects the newest pose noticeably.
    state: where an IMU reaches it, velocity (m/s, in the map) and bias, accelerometer first; 9 numbers.
    """

    keyframe: Keyframe
    pose: tuple[float, ...]
    correction: tuple[float, ...]
    revision: int
    decisions: tuple[Decision, ...]
    origin: tuple[float, ...] = HERE
    state: tuple[float, ...] = ()


class Change:
    """What has been made at a keyframe, into the solver."""

    def __init__(
        self,
        books: Books,
        drive: Drive,
        sensing: Sensing,
        robust: Sequence[Robust] | None,
    ) -> None:
        """robust: instead of the stages that the configuration names."""
        config, solver = books.config, books.solver
        self._books, self._drive, self._sensing = books, drive, sensing
        self._space, self._floor = books.space, floor_from(config)
        self.paths = Paths(books.space, config.gate.odometry_scale, solver.factors)
        self._splitter = Splitter(books, sensing.associators, lambda: self.editor.edited_variables)
        self._quarantine = Quarantine(books, self._splitter, self.paths)
        self._budget = Budget(config, books.space, solver.factors, lambda: self.editor.wishes.ids)
        self._merger = Merger(
            books,
            sensing.associators,
            self.paths,
            lambda: self.editor.edited_variables | books.suspended.keys(),
        )
        usual = _stages(config, self.paths, self._quarantine, self._merger, self._budget)
        stages = usual if robust is None else robust
        self._is_judged = bool(stages)
        books.applier.booked = self._book
        keyframes = books.timeline.keyframes
        self.editor = Editor(
            solver, books.space, books.applier, lambda key: keyframes[symbolIndex(key)].stamp
        )
        self.jury = Jury(stages, books.applier, self.editor)

    def apply(
        self, b: Keyframe, delta: Delta, new: Sequence[Keyframe], window: Sequence[Offer]
    ) -> list[Update]:
        """Solve: motion and all that nothing judges first, then what the robust stages let in."""
        books, waiting = self._books, self._books.waiting
        if held := tuple(priors(self._floor, new)):
            delta += Delta(held)
        books.decisions += delta.decisions
        books.decisions += [told for each in delta.waits for told in waiting.wait(each)]
        window = [*window, *waiting.landed(delta.values, {factor.id for factor in delta.add})]
        judged = tuple([factor for factor in delta.add if self.jury.judges(factor.kind)])
        sure = without(delta, {factor.id for factor in judged})
        try:
            books.applier.apply(sure)
            if self.jury:
                late = {key: guess for key, guess in delta.values.items() if key not in sure.values}
                self.hear(Delta(judged, values=late))
            self._reunite()
            if books.calibration.is_due(len(books.timeline)):
                self.calibrate(b.stamp)
        except SolverFailure:
            self._give_up(delta, new, window)
        return [self.told(b, delta.values.get(b.pose))] if books.timeline.at(b.stamp) is b else []

    def _book(self, delta: Delta) -> None:
        """What the solver has taken, for those who keep books on it."""
        if self._is_judged:
            self.paths.book(delta)
            self._quarantine.book(delta)
            self._budget.book(delta)
            self._merger.book(delta)
            self._books.decisions += self._merger.take_decisions()
            self._books.decisions += self._splitter.book(delta)
        if delta.remove:
            for key in self._quarantine.left(self._books.estimate.knows):
                self._books.parts.drop(key)

    def calibrate(self, stamp: int) -> None:
        """Estimate the constants of the sensors with the graph, and put better ones in force: in what is there and what will come.

        Variables are moved only where iSAM2 would not follow by itself.
        """
        books, believed = self._books, self._books.estimate.values()
        calibration, remade = books.calibration, self._sensing.remade
        vector, values, decisions = calibration.estimate(books.solver.factors, believed, remade, stamp)
        books.decisions += decisions
        if not calibration.matters(vector):
            return
        made, found = remade(vector, vector), {}
        if (
            np.abs(believed.localCoordinates(values).vector()).max()
            > books.config.isam2.relinearize_threshold
        ):
            found = {key: value_in(self._space, values, key) for key in values.keys()}  # noqa: SIM118  # gtsam's Values
        if books.applier.renew(Delta(tuple(made.values()), tuple(made), found)):
            calibration.take(vector)
            books.waiting.late = calibration.late

    def _reunite(self) -> None:
        """Join parts that have come to know enough of the same landmarks."""
        books = self._books
        while waits := books.waiting.for_a_joint():
            found = reunion(self._space, waits, books.estimate, books.parts.of)
            if found is None:
                return
            books.waiting.used(found.waits)
            if not books.applier.join(found.part, found.to, found.shift, self._sensing.common(found)):
                return

    def end(self) -> None:
        """The input has ended: the stages judge what they still think over."""
        self.paths.ended = True
        self.hear(Delta())

    def hear(self, proposed: Delta) -> None:
        """The robust stages judge. What was decided before goes first: a person's wishes rest on all of it."""
        books = self._books
        self.editor.note(books.decisions)
        try:
            self.jury.hear(proposed)
        finally:
            books.decisions += self.jury.take_decisions()

    def _give_up(self, delta: Delta, new: Sequence[Keyframe], window: Sequence[Offer]) -> None:
        """Not even the motion could be solved: the keyframes are taken back. The next one spans the gap, and takes what
        else was to land here.
        """
        books = self._books
        estimate = books.applier.estimate
        self._drive.rewind()
        for gone in reversed(new):
            if estimate is None or not estimate.knows(gone.pose):
                books.timeline.drop(gone)
                books.parts.drop(gone.pose)
        last = books.timeline.newest
        books.newest = (last, books.track.pose(last.stamp)) if last else None
        refused = {d.id for d in (*books.decisions, *books.applier.decisions) if d.verdict == "refused"}
        lost = {factor.id for factor in delta.add} - refused - books.solver.factors.keys()
        books.waiting.again([offer for offer in window if offer.id in lost])

    def told(self, b: Keyframe, guess: Pose | None = None) -> Update:
        """The update for the newest keyframe, with the decisions since the last one."""
        books = self._books
        pose = books.estimate.pose(b.pose)
        if guess is not None:
            books.revision += Shift(*self._space.size(guess.between(pose))).noticeable
        correction = pose.compose(books.track.pose(b.stamp).inverse())
        decisions = books.take_decisions()
        self.editor.note(decisions)
        sevens = self._space.seven(pose), self._space.seven(correction)
        state = books.state(b) if books.imu else None
        told = () if state is None else (*state.velocity.tolist(), *state.bias.vector().tolist())
        return Update(b, *sevens, books.revision, decisions, self._drive.origin, told)

    # -- what a person asks ----------------------------------------------------------------------

    def carry_out(self, command: Command) -> list[Update]:
        """What a person asks; what came of it is a decision, told with the newest keyframe."""
        books = self._books
        self.editor.note(books.decisions)
        newest = books.newest[0] if books.newest else None
        decision = Decision(
            newest.stamp if newest else 0, f"command/{command.id}", command.source,
            "accepted", "command", command.action,
        )  # fmt: skip
        try:
            plan, decisions = self.editor.carry_out(command)
            books.revision += plan.revised
            books.decisions += decisions
            decision = replace(decision, basis={**plan.told, "revision": books.revision})
        except SlamError as error:
            decision = replace(decision, verdict="refused", detail=str(error))
        books.decisions.append(decision)
        return [self.told(newest)] if newest else []

    def dry_run(self, action: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """What a command would come to; nothing is touched. SlamError where it would be refused."""
        self.editor.note(self._books.decisions)
        return {**self.editor.plan(action, arguments).told, "revision": self._books.revision}


def _stages(
    config: Config, paths: Paths, quarantine: Quarantine, merger: Merger, budget: Budget
) -> list[Robust]:
    """What judges factors: loops as the configuration says, fixes on the earth and landmarks always."""
    landmarks = any(isinstance(source, LandmarkSource) for source in config.sources.values())
    fixes = any(isinstance(source, GnssSource) for source in config.sources.values())
    return [
        *(ROBUST[name](config, paths) for name in config.robust),
        *([Doubt(config, paths)] if fixes else []),
        *([quarantine] if landmarks else []),
        *(
            [merger]
            if any(isinstance(s, LandmarkSource) and s.merge for s in config.sources.values())
            else []
        ),
        *([budget] if landmarks and config.budget.sightings else []),
    ]
