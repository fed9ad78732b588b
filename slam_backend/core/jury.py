"""The robust stages at work: what they judge enters the graph only through them, and each may think again at every keyframe."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from .apply import Applier, touched
from .editor import Editor
from .graph import Decision, Delta, Estimate
from .robust import Robust


class Jury:
    """decisions: told since they were taken last, in the order in which they were made."""

    def __init__(self, stages: Sequence[Robust], applier: Applier, editor: Editor) -> None:
        self.stages, self._applier, self._editor = stages, applier, editor
        self._kinds = frozenset[str]().union(*(stage.kinds for stage in stages))
        self._undecided: dict[str, Decision] = {}  # what a stage thinks over: what those before it found
        self.decisions: list[Decision] = []

    def __bool__(self) -> bool:
        return bool(self.stages)

    def judges(self, kind: str) -> bool:
        """Whether factors of that kind are judged."""
        return kind in self._kinds

    def take_decisions(self) -> list[Decision]:
        taken, self.decisions = self.decisions, []
        return taken

    def hear(self, proposed: Delta) -> None:
        """Judge what is proposed, then let each stage review what it said before. SolverFailure as of the applier."""
        if proposed:
            self._editor.offered(proposed.add)
            self._admit(proposed, self.stages)
        for stage in self.stages:
            amendment, decisions = stage.review(self._believed)
            if not amendment and not decisions:
                continue
            added = {factor.id for factor in amendment.add}
            decisions = tuple(self._with_basis(each) for each in decisions)
            self.decisions += [each for each in decisions if each.id not in added]
            others = [other for other in self.stages if other is not stage]
            self._admit(amendment, others, {each.id: each for each in decisions if each.id in added})

    @property
    def _believed(self) -> Estimate:
        assert self._applier.estimate is not None  # the motion is in the graph before anything is judged
        return self._applier.estimate

    def _with_basis(self, decision: Decision) -> Decision:
        """With what earlier stages found, where a stage has taken its time to decide."""
        before = self._undecided.pop(decision.id, None)
        return replace(decision, basis={**before.basis, **decision.basis}) if before else decision

    def _admit(
        self, proposed: Delta, stages: Sequence[Robust], reviewed: Mapping[str, Decision] | None = None
    ) -> None:
        """Through the stages, then into the graph. reviewed: by id, why a review lets a factor in; that is what is told."""
        passed = dict(reviewed or {})
        for stage in stages:
            if not proposed.add:
                break
            mine = tuple(factor for factor in proposed.add if factor.kind in stage.kinds)
            others = tuple(factor for factor in proposed.add if factor.kind not in stage.kinds)
            admitted, decisions = stage.admit(replace(proposed, add=mine), self._believed)
            proposed = replace(admitted, add=(*admitted.add, *others))
            kept = {factor.id for factor in proposed.add}
            for each in decisions:
                before = passed.get(each.id, each)
                last = before if reviewed and each.id in kept else each
                told = replace(last, basis={**before.basis, **each.basis})
                if each.id in kept:
                    passed[each.id] = told
                else:
                    self.decisions.append(told)
            decided = {each.id for each in decisions}
            self._undecided |= {id_: each for id_, each in passed.items() if id_ not in decided | kept}
        if proposed:
            self._editor.note(self.decisions)
            proposed, overruled = self._editor.respected(proposed, passed)
            self.decisions += overruled
            self._applier.apply(touched(proposed), passed)
        self.decisions += self._applier.take_decisions()
