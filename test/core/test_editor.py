"""Edits of a living graph: exact, all or nothing, taken back as if they had never been, and above what stages say."""

from dataclasses import replace

import numpy as np
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.command import command
from slam_backend.core.config import config_from
from slam_backend.core.errors import SlamError
from slam_backend.core.graph import Decision, Delta
from slam_backend.core.measurement import SECOND
from slam_backend.core.robust import ROBUST
from slam_backend.core.sensors.landmark import LandmarkObservation
from slam_backend.core.sensors.pose import AbsolutePose
from slam_backend.core.solvers.batch import solve
from slam_backend.core.solvers.descent import Options

FIRST = "relative/33.000000000/0"
SECOND_LOOP = "relative/41.000000000/0"
WRONG = "relative/60.000000000/0"


def driven(items, **given):
    backend = Backend(**{"robust": (), **given})  # nobody judges but the person
    for item in items:
        backend.add(item)
    return backend


def asked(backend, action="edit", **arguments):
    """The decisions that came of it, the one about the command last."""
    updates = backend.add(command("1", action, arguments))
    return updates[-1].decisions


def poses(backend):
    return backend.snapshot().trajectory.sevens


def optimum(factors, backend):
    """Poses at the batch optimum of factors, from where the backend is."""
    values = solve(factors, backend.estimate.values(), Options(polish=True)).values
    return backend.space.sevens(values, [k.pose for k in backend.timeline.in_order()])


@pytest.fixture
def wrong(laps, loop):
    """The drive, with a loop near its end that says what is not so."""
    return [*laps[:-4], loop(60 * SECOND, 5 * SECOND, 60 * SECOND, (3.0, -6.0, 1.0)), *laps[-4:]]


# -- exact -------------------------------------------------------------------------------------------


def test_what_is_disabled_leaves_no_trace(laps, wrong):
    """The optimum of the other factors, though the wrong one had bent everything."""
    backend, clean = driven(wrong), driven(laps)
    for each in (backend, clean):
        each.finish()
    assert np.abs(poses(backend) - poses(clean)).max() > 0.5
    *_, about, decision = asked(backend, disable=[WRONG])
    assert (about.id, about.verdict, about.stage, about.reason) == (WRONG, "removed", "edit", "disabled")
    assert WRONG not in backend.solver.factors
    assert poses(backend) == pytest.approx(optimum(clean.solver.factors.values(), clean), abs=1e-6)
    assert decision.basis["cost"]["change"] < 0
    assert decision.basis["largest_shift"]["m"] > 0.5
    assert decision.basis["factors"] == [WRONG]


def test_undo_and_redo_are_exact(laps):
    """After it the graph is the same to the factor, and its optimum that of a batch over them."""
    backend = driven(laps)
    backend.finish()
    whole = dict(backend.solver.factors)
    asked(backend, disable=[FIRST], reweight={SECOND_LOOP: 0.01})
    edited = poses(backend)
    *_, decision = asked(backend, "undo")
    assert decision.verdict == "accepted"
    assert backend.solver.factors == whole
    assert poses(backend) == pytest.approx(optimum(whole.values(), backend), abs=1e-6)
    asked(backend, "redo")
    assert poses(backend) == pytest.approx(edited, abs=1e-6)
    asked(backend, "undo")
    assert backend.solver.factors == whole


def test_the_drive_goes_on_after_an_edit_and_an_undo(laps):
    """What comes between them is no part of the edit, and stays."""
    backend, plain = driven(laps[:45]), driven(laps)
    asked(backend, disable=[FIRST])
    for item in laps[45:60]:
        backend.add(item)
    asked(backend, "undo")
    for item in laps[60:]:
        backend.add(item)
    for each in (backend, plain):
        asked(each, "optimize")
    assert backend.solver.factors.keys() == plain.solver.factors.keys()
    assert poses(backend) == pytest.approx(poses(plain), abs=1e-6)


def test_a_dry_run_says_what_the_edit_then_does_and_touches_nothing(wrong):
    backend, untouched = driven(wrong), driven(wrong)
    told = backend.dry_run("edit", {"disable": [WRONG]})
    assert poses(backend).tobytes() == poses(untouched).tobytes()
    assert WRONG in backend.solver.factors
    *_, decision = asked(backend, disable=[WRONG])
    assert {**decision.basis, "revision": told["revision"]} == told
    assert decision.basis["revision"] == told["revision"] + 1


def test_an_edit_is_all_or_nothing(laps):
    backend = driven(laps)
    before, factors = poses(backend), dict(backend.solver.factors)
    (decision,) = asked(backend, disable=[FIRST, "relative/17.000000000/0"])
    assert decision.verdict == "refused"
    assert "no factor 'relative/17" in decision.detail
    assert backend.solver.factors == factors
    assert poses(backend).tobytes() == before.tobytes()
    assert asked(backend, "undo")[-1].verdict == "refused"


def test_every_edit_is_a_revision(laps):
    backend = driven(laps)
    before = backend.snapshot().revision
    asked(backend, disable=[FIRST])
    asked(backend, "undo")
    assert backend.snapshot().revision == before + 2


def test_edits_in_any_order_are_undone_to_the_last(laps):
    """Ten edits drawn at random, a few keyframes between them; then all of them taken back."""
    rng = np.random.default_rng(7)
    backend, plain = driven(laps[:-10]), driven(laps)
    for item in laps[-10:]:
        names = [id_ for id_, f in backend.solver.factors.items() if f.kind != "gauge"]
        chosen = [str(name) for name in rng.choice(names, 3, replace=False)]
        what = rng.choice(["disable", "remove", "enable"])
        asked(backend, **{what: chosen[:2]}, reweight={chosen[2]: float(rng.uniform(0.1, 10))})
        backend.add(item)
    for _ in range(10):
        assert asked(backend, "undo")[-1].verdict == "accepted"
    assert asked(backend, "undo")[-1].verdict == "refused"
    whole = plain.solver.factors
    assert backend.solver.factors.keys() == whole.keys()
    assert poses(backend) == pytest.approx(optimum(whole.values(), plain), abs=1e-6)


# -- parts -------------------------------------------------------------------------------------------


def joined(loop):
    """Two drives without odometry that one loop joins: `relative` makes the keyframes, `joints` the joint."""
    sources = {
        "sources": ["relative", "joints"],
        "relative": {"kind": "relative"},
        "joints": {"kind": "relative"},
    }
    backend = Backend(config_from(sources))
    step = (1.0, 0.0, 0.1)
    for start in (0, 100):
        for n in range(1, 10):
            stamp = (start + n) * SECOND
            backend.add(loop(stamp + SECOND, stamp, stamp + SECOND, step))
    stamp = 110 * SECOND
    backend.add(replace(loop(stamp, 105 * SECOND, 5 * SECOND, (0.0, 2.0, 0.0)), source="joints"))
    backend.finish()
    return backend


def test_without_the_loop_that_joined_them_two_parts_are_two_again(loop):
    """The later one gets a gauge of its own and stays where it was; undo joins them as they were joined first."""
    backend = joined(loop)
    joint = "joints/110.000000000/0"
    assert len(backend.parts) == 1
    whole, factors = poses(backend), dict(backend.solver.factors)
    *_, decision = asked(backend, disable=[joint])
    assert decision.basis["parts"] == len(backend.parts) == 2
    assert sum(factor.kind == "gauge" for factor in backend.solver.factors.values()) == 2
    assert poses(backend) == pytest.approx(whole, abs=1e-6)
    asked(backend, "undo")
    assert len(backend.parts) == 1
    assert backend.solver.factors == factors
    assert poses(backend) == pytest.approx(whole, abs=1e-6)


def test_a_step_of_the_odometry_can_be_taken_out_where_loops_hold_the_rest(laps):
    backend = driven(laps)
    asked(backend, disable=["odometry/40.000000000/0"])
    assert len(backend.parts) == 1
    assert np.isfinite(poses(backend)).all()


def test_without_any_tie_a_step_taken_out_leaves_two_parts_and_the_drive_goes_on(laps):
    backend = driven(laps[:20])
    asked(backend, disable=["odometry/10.000000000/0"])
    assert len(backend.parts) == 2
    for item in laps[20:]:
        backend.add(item)
    assert len(backend.parts) == 1  # the loops of the second lap join them
    assert len(poses(backend)) == 64


def test_a_landmark_that_nobody_sees_any_more_is_gone_until_undo(laps):
    backend = driven(seeing(laps))
    whole, there = poses(backend), backend.snapshot().landmarks
    assert backend.snapshot().names == ("tree",)
    asked(backend, disable=["landmark"])
    assert backend.snapshot().names == ()
    assert len(backend.parts) == 1
    asked(backend, "undo")
    for each in (backend, reference := driven(seeing(laps))):
        asked(each, "optimize")
    assert backend.snapshot().names == ("tree",)
    assert poses(backend) == pytest.approx(poses(reference), abs=1e-6)
    assert np.abs(backend.snapshot().landmarks - there).max() < 0.1
    assert np.abs(poses(backend) - whole).max() < 0.1


def test_a_landmark_cannot_be_left_with_less_than_holds_it(laps):
    """Without its position a bearing alone does not say where the tree is: the edit is refused whole."""

    def sightings():
        for item in laps:
            yield item
            if item.source != "odometry" or item.stamp not in (2 * SECOND, 6 * SECOND):
                continue
            x, y, yaw = item.pose[0], item.pose[1], 2 * np.arctan2(item.pose[5], item.pose[6])
            if item.stamp == 2 * SECOND:
                form, value, noise = "position", np.array([3.0 - x, 4.0 - y, 0.0]), np.diag([0.01] * 3)
            else:
                form, noise = "bearing", np.diag([1e-4, 1e-4])
                value = np.array([np.arctan2(4.0 - y, 3.0 - x) - yaw, 0.0])
            yield LandmarkObservation(item.stamp, "landmark", "", "tree", form, value, noise)

    backend = driven(sightings())
    ids = [id_ for id_, factor in backend.solver.factors.items() if factor.kind == "landmark"]
    assert len(ids) == 2
    before = poses(backend)
    with pytest.raises(SlamError, match="do not hold every pose and landmark"):
        backend.dry_run("edit", {"disable": ids[:1]})
    (decision,) = asked(backend, disable=ids[:1])
    assert decision.verdict == "refused"
    assert set(ids) <= backend.solver.factors.keys()
    assert poses(backend).tobytes() == before.tobytes()
    assert asked(backend, disable=ids)[-1].verdict == "accepted"
    assert backend.snapshot().names == ()


def seeing(items):
    """A tree at (3, 4), seen from three places."""
    noise = np.diag([0.01, 0.01, 0.01])
    for item in items:
        yield item
        if item.stamp in (2 * SECOND, 3 * SECOND, 4 * SECOND) and item.source == "odometry":
            n = item.stamp // SECOND - 1
            value = np.array([3.0 - n, 4.0, 0.0])
            yield LandmarkObservation(item.stamp, "landmark", "", "tree", "position", value, noise)


def test_without_its_absolute_poses_a_part_gets_a_gauge_where_it_is(laps):
    fix = AbsolutePose(20 * SECOND, "pose", "", np.array([50.0, 20.0, 0, 0, 0, 0, 1]), np.zeros(36))
    backend = driven([*laps[:22], fix, *laps[22:]])
    placed = poses(backend)
    assert placed[:, 0].min() > 30
    assert not [f for f in backend.solver.factors.values() if f.kind == "gauge"]
    asked(backend, disable=["pose"])
    assert len([f for f in backend.solver.factors.values() if f.kind == "gauge"]) == 1
    assert poses(backend) == pytest.approx(placed, abs=0.1)
    asked(backend, "undo")
    assert not [f for f in backend.solver.factors.values() if f.kind == "gauge"]
    assert poses(backend) == pytest.approx(placed, abs=0.1)


# -- above the stages --------------------------------------------------------------------------------


class Distrust:
    """A stage that lets nothing in, until it is told to let in what it refused, or to take it out."""

    kinds = frozenset({"loop"})

    def __init__(self):
        self.refused, self.wants, self.rejects = {}, [], []

    def admit(self, proposed, estimate):  # noqa: ARG002
        self.refused |= {factor.id: factor for factor in proposed.add}
        return replace(proposed, add=()), tuple(self.said(f, "probation") for f in proposed.add)

    def review(self, estimate):  # noqa: ARG002
        add = tuple(self.refused[id_] for id_ in self.wants)
        delta = Delta(add, tuple(self.rejects))
        said = [self.said(f, "accepted") for f in add] + [
            self.said(self.refused[r], "refused") for r in self.rejects
        ]
        self.wants, self.rejects = [], []
        return delta, tuple(said)

    def said(self, factor, verdict):
        return Decision(
            factor.stamp, factor.id, factor.source, verdict, "distrust", "mood", ends=factor.stamps
        )


def last(updates, id_):
    """The last word about a factor."""
    return [d for update in updates for d in update.decisions if d.id == id_][-1]


@pytest.fixture
def doubted(laps):
    """The drive up to some keyframes before its end, of which a stage has let in no loop; and the rest of it."""
    stage = Distrust()
    return driven(laps[:-4], robust=[stage]), stage, laps[-4:]


def test_what_is_forced_enters_and_stays(doubted):
    backend, stage, rest = doubted
    assert FIRST not in backend.solver.factors
    *_, about, _ = asked(backend, enable=[FIRST])
    assert (about.verdict, about.reason) == ("restored", "forced")
    stage.rejects = [FIRST]
    assert last(backend.add(rest[0]), FIRST).reason == "forced"
    stage.rejects = [FIRST]
    assert last(backend.add(rest[1]), FIRST).reason == "forced"
    stage.wants = [FIRST]  # it changes its mind, for what is there already
    backend.add(rest[2])
    assert FIRST in backend.solver.factors
    asked(backend, "undo")
    assert FIRST in backend.solver.factors  # since the stage wants it by now


def test_a_force_taken_back_gives_the_stage_its_word_back(doubted):
    backend, _, rest = doubted
    asked(backend, enable=[FIRST])
    *_, about, _ = asked(backend, "undo")
    assert FIRST not in backend.solver.factors
    assert (about.verdict, about.reason) == ("probation", "undone")
    backend.add(rest[0])
    assert FIRST not in backend.solver.factors


def test_what_is_disabled_stays_out_whatever_a_stage_says(doubted):
    backend, stage, rest = doubted
    asked(backend, disable=[FIRST])
    stage.wants = [FIRST]
    updates = backend.add(rest[0])
    assert FIRST not in backend.solver.factors
    assert last(updates, FIRST).verdict == "removed"
    assert [d.verdict for u in updates for d in u.decisions if d.id == FIRST] == ["accepted", "removed"]
    stage.wants = [FIRST]
    assert not [d for u in backend.add(rest[1]) for d in u.decisions if d.id == FIRST], "nothing new"
    asked(backend, "undo")
    assert FIRST in backend.solver.factors  # what the stage said meanwhile counts


@pytest.mark.parametrize("stage", ROBUST)
def test_a_wish_holds_beside_every_stage_until_it_is_taken_back(stage, wrong):
    """A true loop kept out and a wrong one forced in, in the midst of the drive; both stay so to its end, and may then go."""
    backend = Backend(config_from({"robust": [stage]}))
    updates = [update for item in wrong[:-2] for update in backend.add(item)]
    edit = {"disable": [FIRST], "enable": [WRONG], "reweight": {SECOND_LOOP: 0.5}}
    updates += backend.add(command("1", "edit", edit))
    assert updates[-1].decisions[-1].verdict == "accepted"
    updates += [update for item in wrong[-2:] for update in backend.add(item)] + backend.finish()
    assert FIRST not in backend.solver.factors
    assert WRONG in backend.solver.factors
    assert [last(updates, id_).verdict for id_ in (FIRST, WRONG)] == ["removed", "restored"]
    *_, decision = asked(backend, "undo")
    assert decision.verdict == "accepted"
    assert np.isfinite(poses(backend)).all()


def test_undo_brings_a_loop_back_as_the_stage_had_made_it(laps):
    """With the kernel that the stage has put around its noise, though its verdict was that it weighs little."""
    backend = Backend(config_from({"robust": ["switchable"]}))
    for item in laps:
        backend.add(item)
    backend.finish()
    whole = dict(backend.solver.factors)
    asked(backend, disable=["relative"])
    assert len(backend.solver.factors) == len(whole) - 4
    asked(backend, "undo")
    assert backend.solver.factors == whole


def test_a_dry_run_that_cannot_be_says_why(laps):
    with pytest.raises(SlamError, match="no factors of 'nobody'"):
        driven(laps).dry_run("edit", {"disable": ["nobody"]})
