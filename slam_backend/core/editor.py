"""What a person asks of the graph, done between two measurements; ACTIONS is the list of it.

An action makes a plan and touches nothing: the graph put together anew, solved to its optimum, and what that would come to.
To carry it out is to start the solver from there; a dry run leaves it at the plan.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam

from .adopted import Adopted
from .apply import Applier
from .assembly import Assembly, assembled
from .command import Command
from .edits import Wishes, edit_of, weighted
from .errors import SlamError, SolverFailure
from .graph import Decision, Delta, Factor, Verdict, is_pose
from .solvers import Solver
from .solvers.batch import Solution, polish, solve
from .solvers.descent import SINGULAR, Options
from .solvers.initialize import cost_of
from .space import Space

NOTICEABLE = (1e-3, 1e-4)  # m, rad: a correction of a pose that counts as a revision
OUT = frozenset({"probation", "refused", "removed"})  # verdicts that keep a factor out


@dataclass(frozen=True, slots=True)
class Shift:
    """The largest change of any pose: m, rad."""

    meters: float
    radians: float

    @property
    def noticeable(self) -> bool:
        return self.meters > NOTICEABLE[0] or self.radians > NOTICEABLE[1]


@dataclass(frozen=True, slots=True)
class History:
    """What is wished now; what was before, the newest last; what has been undone."""

    now: Wishes = field(default_factory=Wishes)
    past: tuple[Wishes, ...] = ()
    undone: tuple[Wishes, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """reason: of the decisions about single factors. told: plain data for whoever asked. revised: poses that are published change."""

    history: History
    graph: Assembly
    solution: Solution
    reason: str
    told: Mapping[str, Any]
    revised: bool


class Editor:
    """Acts on the graph as a whole. What it cannot do is a SlamError, and has changed nothing."""

    def __init__(
        self, solver: Solver, space: Space, applier: Applier, stamp_of: Callable[[int], int]
    ) -> None:
        """stamp_of: of a keyframe, by the key of its pose."""
        self._solver, self._space, self._applier = solver, space, applier
        self._stamp_of = stamp_of
        self._history = History()
        # without weights: what stages judge, and what a person has edited
        self._known: dict[str, Factor] = {}
        self._said: dict[str, Verdict] = {}  # of those: the last verdict that was not a person's
        self._overruled: dict[str, str] = {}  # of those: why, where that is what was told last
        self._wanted: dict[
            str, bool
        ] = {}  # of those: whether it would be in the graph without a person's wish

    @property
    def wishes(self) -> Wishes:
        return self._history.now

    @property
    def edited_variables(self) -> set[int]:
        """Of the factors about which a person has decided something."""
        return {key for id_ in self.wishes.ids for key in self._known[id_].keys}

    @property
    def left_out(self) -> list[Factor]:
        return [factor for id_, factor in self._known.items() if id_ not in self._solver.factors]

    # -- what a person asks ----------------------------------------------------------------------

    def plan(self, action: str, arguments: Mapping[str, Any]) -> Plan:
        """What it would come to."""
        if action not in ACTIONS:
            raise SlamError(f"there is no action '{action}'; known: {', '.join(ACTIONS)}")
        if self._applier.estimate is None:
            raise SlamError("there is no keyframe yet")
        return ACTIONS[action](self, arguments)

    def carry_out(self, command: Command) -> tuple[Plan, list[Decision]]:
        """And the decisions about the factors that it is about."""
        plan = self.plan(command.action, command.arguments)
        before, held = self._history.now, dict(self._solver.factors)
        estimate = self._solver.restart(plan.graph.factors, plan.solution.values)
        for id_ in plan.history.now.ids - before.ids:
            self._wanted[id_] = id_ in held
            self._known[id_] = held[id_] if id_ in held else self._known[id_]
        self._history = plan.history
        now = self._solver.factors
        added = [factor for id_, factor in now.items() if held.get(id_) is not factor]
        removed = [id_ for id_, factor in held.items() if now.get(id_) is not factor]
        # gtsam's planar factors are noisy near their optimum, to some micrometres: until the next update the batch's answer holds
        exact = Adopted(plan.solution.values, self._space, estimate)
        self._applier.replace(exact, plan.graph.parts, added, removed)
        changed = sorted(_changed(before, plan.history.now))
        return plan, [self._decision(self._known[id_], plan.reason, command) for id_ in changed]

    def optimize(self, arguments: Mapping[str, Any]) -> Plan:  # noqa: ARG002  # one signature for the table
        """The optimum of the kept factors; the solver goes on from there, linearized anew."""
        return self._planned(self._history, "optimized")

    def edit(self, arguments: Mapping[str, Any]) -> Plan:
        """Single factors disabled, enabled, removed or reweighted: all, or none."""
        past = self._history
        wishes = edit_of(arguments).applied(past.now, self._nameable())
        return self._planned(History(wishes, (*past.past, past.now)), "edited")

    def undo(self, arguments: Mapping[str, Any]) -> Plan:  # noqa: ARG002
        """The last edit taken back. What came since, and what others decided, stays."""
        past = self._history
        if not past.past:
            raise SlamError("there is no edit to undo")
        return self._planned(History(past.past[-1], past.past[:-1], (*past.undone, past.now)), "undone")

    def redo(self, arguments: Mapping[str, Any]) -> Plan:  # noqa: ARG002
        past = self._history
        if not past.undone:
            raise SlamError("nothing has been undone")
        return self._planned(History(past.undone[-1], (*past.past, past.now), past.undone[:-1]), "redone")

    # -- what others decide ----------------------------------------------------------------------

    def offered(self, factors: Iterable[Factor]) -> None:
        """Stages are about to judge these: a person may overrule what they say."""
        self._known.update((factor.id, factor) for factor in factors)

    def note(self, decisions: Iterable[Decision]) -> None:
        """What others decided about factors counts again where a person's wish is taken back."""
        for each in decisions:
            if each.stage == "budget" and each.verdict == "removed":
                self._known.pop(each.id, None)  # others have taken over what it said: it cannot come back
            elif each.stage == "edit":
                self._overruled[each.id] = each.reason
            elif each.id in self._known:
                self._said[each.id] = each.verdict
                self._overruled.pop(each.id, None)

    def respected(self, delta: Delta, passed: Mapping[str, Decision]) -> tuple[Delta, list[Decision]]:
        """The change that stages want, without what a person has decided otherwise; and the decisions that say so, once: a stage that
        proposes the same again is told nothing new.

        passed: by id, why a factor may enter, told where it does not either.
        """
        wishes, held = self._history.now, self._solver.factors
        self._known.update((factor.id, factor) for factor in delta.add)  # as a stage may have made it anew
        self._wanted |= dict.fromkeys(delta.remove, False) | {factor.id: True for factor in delta.add}
        stays = [id_ for id_ in delta.remove if id_ in wishes.forced or id_ not in held]
        leaves = set(delta.remove) - set(stays)
        overruled = {
            f.id: f for f in delta.add if f.id in wishes.out or (f.id in held and f.id not in leaves)
        }
        decisions: list[Decision] = []
        for id_ in (*overruled, *(id_ for id_ in stays if id_ in self._known)):
            told = self._decision(self._known[id_], "edited")
            before = passed.get(id_) if id_ in overruled else None
            news = before is not None and before.verdict != self._said.get(id_)
            if news or self._overruled.get(id_) != told.reason:
                decisions += [told] if before is None else [before, told]
        self.note(decisions)
        add = tuple(weighted(f, wishes.weights.get(f.id, 1.0)) for f in delta.add if f.id not in overruled)
        remove = tuple(id_ for id_ in delta.remove if id_ not in stays)
        return replace(delta, add=add, remove=remove), decisions

    # -- how -------------------------------------------------------------------------------------

    def _nameable(self) -> list[Factor]:
        held = self._solver.factors
        others = [factor for id_, factor in self._known.items() if id_ not in held]
        return [factor for factor in (*held.values(), *others) if factor.kind != "gauge"]

    def _planned(self, history: History, reason: str) -> Plan:
        assert self._applier.estimate is not None
        held, before = self._solver.factors, self._applier.estimate.values()
        wishes = history.now
        edited = wishes.ids | self._history.now.ids
        if spent := edited - self._known.keys() - held.keys():
            gone = min(spent)
            raise SlamError(f"'{gone}' has been summarized since: what became of it says decision/{gone}")
        kept = [factor for factor in held.values() if factor.kind != "gauge" and factor.id not in edited]
        fresh: list[Factor] = []
        for id_ in sorted(edited):
            if self._enters(id_, wishes):
                factor = weighted(self._original(id_), wishes.weights.get(id_, 1.0))
                (kept if id_ in held else fresh).append(factor)
        gauges = [factor for factor in held.values() if factor.kind == "gauge"]
        graph = assembled(self._space, kept, fresh, gauges, before, self._applier.sighted, self._stamp_of)
        near = reason == "optimized"
        solution = (
            polish(graph.factors, graph.values)
            if near
            else solve(graph.factors, graph.values, Options(polish=True))
        )
        if solution.stop == SINGULAR:
            raise SolverFailure("the factors that are left do not hold every pose and landmark", ())
        shift = self._shift(before, solution.values)
        cost = {"before": cost_of(list(held.values()), before), "after": solution.cost}
        told = {
            "cost": cost | {"change": cost["after"] - cost["before"]},
            "largest_shift": {"m": shift.meters, "rad": shift.radians},
            "iterations": len(solution.iterations),
            "stop": solution.stop,
            "parts": len(graph.parts),
        }
        if not near:
            told["factors"] = sorted(_changed(self._history.now, wishes))
        return Plan(history, graph, solution, reason, told, shift.noticeable if near else True)

    def _enters(self, id_: str, wishes: Wishes) -> bool:
        if id_ in wishes.out or id_ in wishes.forced:
            return id_ not in wishes.out
        return self._wanted[id_] if id_ in self._history.now.ids else id_ in self._solver.factors

    def _original(self, id_: str) -> Factor:
        """Without a weight."""
        held = self._solver.factors
        return self._known[id_] if id_ in self._history.now.ids or id_ not in held else held[id_]

    def _decision(self, factor: Factor, reason: str, command: Command | None = None) -> Decision:
        """What holds for a factor by what a person wishes, or, where that has been taken back, by what others said last."""
        out, forced, weight = self._history.now.of(factor.id)
        verdict: Verdict = "restored"
        if out or not (forced or self._wanted[factor.id]):
            said = self._said.get(factor.id)
            verdict = said if said is not None and said in OUT and not out else "removed"
        why = out or ("forced" if forced else "reweighted" if weight != 1.0 else reason)
        return Decision(
            factor.stamp, factor.id, factor.source, verdict, "edit", why,
            f"by command {command.id}" if command else "by an earlier command, whatever others say",
            statistic=weight if weight != 1.0 else None, ends=factor.stamps,
        )  # fmt: skip

    def _shift(self, before: gtsam.Values, after: gtsam.Values) -> Shift:
        keys = [key for key in before.keys() if is_pose(key)]  # noqa: SIM118  # no mapping
        pose_in, size = self._space.pose_in, self._space.size
        sizes = [size(pose_in(before, key).between(pose_in(after, key))) for key in keys]
        return Shift(max((m for m, _ in sizes), default=0.0), max((r for _, r in sizes), default=0.0))


def _changed(one: Wishes, other: Wishes) -> set[str]:
    return {id_ for id_ in one.ids | other.ids if one.of(id_) != other.of(id_)}


ACTIONS: Mapping[str, Callable[[Editor, Mapping[str, Any]], Plan]] = {
    "optimize": Editor.optimize,
    "edit": Editor.edit,
    "undo": Editor.undo,
    "redo": Editor.redo,
}
