"""The way of a change: into the solver, whole; without what cannot be solved; with the parts that it connects."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from .errors import SolverFailure
from .graph import UNTIL_JOINED, Decision, Delta, Estimate, Factor, Pose, is_pose
from .parts import Parts
from .sessions import SavedMap
from .solvers import Solver
from .space import Space
from .variables import moved, pose_beside, value_in

FOUNDATION = frozenset({"gauge", "motion"})  # kinds without which a keyframe cannot be


class Applier:
    """Gives changes to the solver and keeps the books: decisions, parts, and who waits for which variable.

    A measurement that connects something is a change of its own: the first absolute pose of a part moves the part
    there and replaces its gauge; a relative pose between two parts, or what fixes tell of the earth that one of them knows, moves
    the later one to where it says. All are sets of first guesses for variables that exist, so that the solver starts near the answer.
    """

    def __init__(
        self,
        solver: Solver,
        space: Space,
        parts: Parts,
        wake: Callable[[int], None],
    ) -> None:
        """wake: called with the key of each new landmark, and with UNTIL_JOINED when two parts become one."""
        self._solver, self._space, self._parts, self._wake = solver, space, parts, wake
        self.booked = _nobody  # called with every change that the solver has taken
        self._verdicts: Mapping[str, Decision] = {}
        self.estimate: Estimate | None = None
        self.sighted: dict[
            int, tuple[int, Any]
        ] = {}  # variable other than a keyframe's pose -> the first pose that it was tied to, and the value from there
        self.decisions: list[Decision] = []

    def take_decisions(self) -> list[Decision]:
        taken, self.decisions = self.decisions, []
        return taken

    def apply(self, delta: Delta, verdicts: Mapping[str, Decision] | None = None) -> None:
        """SolverFailure when not even the motion can be solved; nothing of the change is in the graph then.

        verdicts: by id, why a factor may enter; told of those that the solver takes.
        """
        self._verdicts = verdicts or {}
        while (event := self._event(delta.add)) is not None:
            before, delta = _split(delta, event)
            self._solve(before)
            self._connect(event)
        self._solve(delta)

    def _event(self, factors: Sequence[Factor]) -> Factor | None:
        """The first that connects something. Where all is one part, only an absolute pose can; a camera adds hundreds of others."""
        if len(self._parts) < 2:
            factors = [factor for factor in factors if factor.kind == "pose"]
        return next((factor for factor in factors if self._connects(factor)), None)

    def _connects(self, factor: Factor) -> bool:
        if factor.kind == "pose":
            part = self._parts.of(factor.keys[0])
            return part is not None and self._parts.is_loose(part)
        if len(self._parts) < 2:
            return False
        posed = factor.kind == "earth" or all(map(is_pose, factor.keys))
        return posed and len(self._parts_of(factor)) == 2

    def _parts_of(self, factor: Factor) -> set[int]:
        return {part for key in factor.keys if (part := self._parts.of(key)) is not None}

    def _connect(self, event: Factor) -> None:
        parts = sorted(self._parts_of(event))
        part = self._loose(parts)
        values = {} if part is None else self._moved(part, self._shift(part, event))
        if not self._solve(Delta((event,), self._gauge(part), values)):
            return
        if event.kind != "pose":
            self._merge(parts[0], parts[1])
            return
        assert part is not None
        home = self._parts.home
        if home is None:
            self._parts.release(part)
        else:  # it stands in that map now
            self._merge(home, part)

    def join(self, first: int, second: int, shift: Pose, factors: tuple[Factor, ...]) -> bool:
        """Move a part as a whole, and hold it there by factors between it and another one instead of its gauge.

        shift: of the first to where it lies beside the second. False: the solver did not take it.
        """
        part = self._loose((first, second))
        shift = shift if part == first else shift.inverse()
        values = {} if part is None else self._moved(part, shift)
        if not self._solve(Delta(factors, self._gauge(part), values)):
            return False
        self._merge(first, second)
        return True

    def load(self, saved: SavedMap) -> None:
        """Begin with the factors and the estimate of a map."""
        keys = saved.values.keys()
        values = {key: value_in(self._space, saved.values, key) for key in keys}
        delta = Delta(saved.factors, values=values)
        self.estimate = self._solver.update(delta)
        gauges = {saved.parts[f.keys[0]]: f.id for f in saved.factors if f.kind == "gauge"}
        self._parts.restore(saved.parts, gauges)
        self.sighted |= saved.sighted
        self.booked(delta)

    def _loose(self, parts: Sequence[int]) -> int | None:
        """Of these the part to move: the latest that only its gauge holds."""
        return max((part for part in parts if self._parts.is_loose(part)), default=None)

    def _gauge(self, part: int | None) -> tuple[str, ...]:
        gauge = None if part is None else self._parts.gauge(part)
        return () if gauge is None else (gauge,)

    def _merge(self, first: int, second: int) -> None:
        """What was moved is gone; else what began later."""
        part = self._loose((first, second))
        gone = max(first, second) if part is None else part
        self._parts.merge(first if gone == second else second, gone)
        self._wake(UNTIL_JOINED)

    def _shift(self, part: int, event: Factor) -> Pose:
        """The motion of a part as a whole that makes the event's error zero."""
        assert self.estimate is not None
        keys = event.factor.keys()
        poses = [self.estimate.pose(key) for key in keys]
        return shift_of(event, poses, last=self._parts.of(keys[-1]) == part)

    def _moved(self, part: int, shift: Pose) -> dict[int, Any]:
        """The variables of a part, moved as a whole."""
        assert self.estimate is not None
        values, space = self.estimate.values(), self._space
        members = self._parts.members(part)
        return {key: moved(shift, key, value_in(space, values, key)) for key in members}

    def renew(self, delta: Delta) -> bool:
        """Put factors in the place of those with the same ids: the same measurements, with other constants. False: it cannot be solved."""
        try:
            self.estimate = self._solver.update(delta)
        except SolverFailure as failure:
            self.decisions += [_kept(self._solver.factors[id_], failure) for id_ in delta.remove[:1]]
            return False
        finally:
            self.decisions += self._solver.incidents()
        return True

    def replace(
        self, estimate: Estimate, parts: Parts, added: Sequence[Factor], removed: Sequence[str]
    ) -> None:
        """The graph has been put together anew, and solved."""
        joined = len(parts) < len(self._parts)
        keys = {key for factor in added for key in factor.keys if self._parts.of(key) is None}
        self.estimate = estimate
        self._parts.become(parts)
        self.booked(Delta(remove=tuple(removed)))
        self.booked(Delta(tuple(factor for factor in added if factor.kind == "loop")))
        for key in (*sorted(keys), *[UNTIL_JOINED][:joined]):
            self._wake(key)

    def _solve(self, delta: Delta) -> bool:
        """Whether the change was applied whole; factors that cannot be solved are left out with a decision."""
        whole = True
        held = {
            key for id_ in delta.remove if (factor := self._solver.factors.get(id_)) for key in factor.keys
        }
        while delta:
            try:
                self.estimate = self._solver.update(delta)
            except SolverFailure as failure:
                bad = [f for f in delta.add if f.id in failure.guilty] or list(delta.add)
                self.decisions += [_unsolvable(factor, failure) for factor in bad]
                if any(factor.kind in FOUNDATION for factor in bad):
                    raise
                delta, whole = without(delta, {factor.id for factor in bad}), False
                if not delta.add:
                    kept = self._solver.factors
                    self.decisions += [_kept(kept[id_], failure) for id_ in delta.remove if id_ in kept]
                    return False
                continue
            finally:
                self._note(self._solver.incidents())
            self._book(delta)
            for key in sorted(key for key in held if not self.estimate.knows(key)):
                if self._parts.of(key) is not None:  # its last factor is gone
                    self._parts.drop(key)
                self.sighted.pop(key, None)
            return whole
        return whole

    def _note(self, incidents: Sequence[Decision]) -> None:
        """What went wrong; and what the solver had to let go of is in nobody's books any more."""
        self.decisions += incidents
        gone = tuple(decision.id for decision in incidents if decision.verdict == "removed")
        if not gone:
            return
        self.booked(Delta(remove=gone))
        held = {key for factor in self._solver.factors.values() for key in factor.keys}
        for key in [key for key in self._parts.all() if not is_pose(key) and key not in held]:
            self._parts.drop(key)
            self.sighted.pop(key, None)

    def _book(self, delta: Delta) -> None:
        back: dict[int, Pose] = {}  # a camera makes hundreds of points at one pose
        known = self._parts.all()
        for factor in delta.add:
            for key in factor.keys:
                if key not in known:
                    pose = pose_beside(factor.keys[0])
                    if pose not in back:
                        back[pose] = self._started(delta, pose).inverse()
                    self._parts.put(key, pose)
                    self.sighted[key] = (pose, moved(back[pose], key, delta.values[key]))
                    self._wake(key)
            if factor.kind == "datum" and (part := self._parts.of(factor.keys[0])) is not None:
                self._parts.release(part)
            if factor.kind in ("loop", "pose") or factor.id in self._verdicts:
                self.decisions.append(self._verdicts.get(factor.id) or _accepted(factor))
        self.booked(delta)

    def _started(self, delta: Delta, key: int) -> Pose:
        """The first guess of a pose; of one that has been there before, what is believed."""
        guess = delta.values.get(key)
        if guess is not None:
            return guess
        assert self.estimate is not None
        return self.estimate.pose(key)


def _nobody(delta: Delta) -> None:
    """Who keeps no books."""


def shift_of(event: Factor, poses: Sequence[Pose], last: bool) -> Pose:
    """By which a part is moved as a whole, so that the error of a factor between poses, or about one, is zero.

    poses: those of the factor. last: the part is that of the last of them.
    """
    if event.kind == "pose":
        return event.factor.prior().compose(poses[0].inverse())
    shift = poses[0].compose(event.factor.measured()).compose(poses[1].inverse())
    return shift if last else shift.inverse()


def without(delta: Delta, ids: Collection[str]) -> Delta:
    """The change without some factors, and without the new variables that only they touched."""
    if not ids:
        return delta
    add = tuple(factor for factor in delta.add if factor.id not in ids)
    dropped = {key for factor in delta.add if factor.id in ids for key in factor.keys}
    kept = {key for factor in add for key in factor.keys}
    values = {key: value for key, value in delta.values.items() if key in kept or key not in dropped}
    return Delta(add, delta.remove, values, delta.waits, delta.decisions)


def touched(delta: Delta) -> Delta:
    """The change without first guesses that none of its factors needs."""
    keys = {key for factor in delta.add for key in factor.keys}
    return replace(delta, values={key: value for key, value in delta.values.items() if key in keys})


def _split(delta: Delta, event: Factor) -> tuple[Delta, Delta]:
    """What must be in the graph before the event, and what can follow it; the event itself is in neither."""
    at = delta.add.index(event)
    before = tuple(f for n, f in enumerate(delta.add) if n < at or (f.kind in FOUNDATION and n != at))
    after = tuple(f for f in delta.add[at + 1 :] if f.kind not in FOUNDATION)
    touched = {key for factor in (*before, event) for key in factor.keys}
    early = {key: value for key, value in delta.values.items() if key in touched}
    late = {key: value for key, value in delta.values.items() if key not in touched}
    return Delta(before, delta.remove, early), Delta(after, (), late)


def _accepted(factor: Factor) -> Decision:
    return Decision(
        factor.stamp, factor.id, factor.source, "accepted", "admit", "unjudged", "no robust stage judges it",
        ends=factor.stamps,
    )  # fmt: skip


def _unsolvable(factor: Factor, failure: SolverFailure) -> Decision:
    return Decision(
        factor.stamp,
        factor.id,
        factor.source,
        "refused",
        "solver",
        "unsolvable",
        str(failure),
        ends=factor.stamps,
    )


def _kept(factor: Factor, failure: SolverFailure) -> Decision:
    return Decision(
        factor.stamp, factor.id, factor.source, "restored", "solver", "unsolvable",
        f"not removed: {failure}", ends=factor.stamps,
    )  # fmt: skip
