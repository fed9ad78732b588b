"""The gate: what contradicts odometry stays out, with what would let it pass; what outvotes gets in."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slam_backend.core.backend import Backend
from slam_backend.core.config import Gate, config_from
from slam_backend.core.robust import paths as ways
from slam_backend.core.robust.accord import Noise, Ruler
from slam_backend.core.robust.usual import FEWEST, Usual
from slam_backend.core.space import SPACES
from slam_backend.io.formats import read_graph
from slam_backend.io.formats.posegraph import measurements

from .conftest import ends, vertices


def path(space, pose, sigma, meters):
    covariance = np.eye(space.dimension) * sigma**2
    turns = np.outer(*(np.diag(space.diagonal(1.0, 0.0)),) * 2)
    return ways.Path(pose, np.array([covariance, covariance * turns, 0 * covariance]), meters)


def measured(space, pose, sigma):
    covariance = np.eye(space.dimension) * sigma**2
    return ways.Path(pose, np.array([0 * covariance, 0 * covariance, covariance]), 0.0)


@pytest.mark.parametrize("name", ["2d", "3d"])
@pytest.mark.parametrize("away", [(2.0, 0.0), (0.5, 0.3), (30.0, 1.0), (0.0, 3.0)])
def test_with_the_remedy_and_no_less_the_same_comparison_passes(name, away):
    space = SPACES[name]
    config = Gate()
    ruler = Ruler(space, config, Usual(space.dimension))
    way = path(space, space.identity, 0.05, 4.0)
    loop = measured(space, space.from_extrinsics((away[0], 0.0, 0.0, 0.0, 0.0, away[1])), 0.02)
    assert not ruler.compare(loop, way)
    noise, drift = ruler.remedy(loop, way)
    assert ruler.compare(loop, way, noise, drift)
    less = {cause: 1 + (getattr(noise, cause) - 1) * 0.99 for cause in ("rotation", "odometry", "loop")}
    if noise != Noise():
        assert not ruler.compare(loop, way, replace(noise, **less), drift)
    if drift > config.drift:
        assert not ruler.compare(loop, way, noise, config.drift + (drift - config.drift) * 0.99)


def test_the_gate_closes_when_accepted_loops_lie_much_closer_than_stated():
    usual = Usual(3)
    for _ in range(FEWEST - 1):
        usual.add(0.02)
    assert usual.factor() == 1
    usual.add(0.02)
    assert usual.factor() < 0.05
    for _ in range(300):
        usual.add(50.0)
    assert usual.factor() == 1, "it never opens further than configured"


def test_wrong_loops_stay_out_and_say_what_would_let_them_pass(drive):
    true, wrong = drive.true(2, 8), drive.wrong((70, 30), (80, 40), (90, 50))
    ended = drive.run([*true, *wrong], robust=["gate"])
    assert ended.kept == ends(true)
    for pair in ends(wrong):
        decision = ended.last[pair]
        assert (decision.verdict, decision.stage) == ("refused", "gate")
        assert decision.statistic > decision.threshold
        assert decision.basis["would_pass"]
        assert "would pass if" in decision.detail


def explained(backend, decisions):
    """Each refusal of the gate has everything; what it says would let the loop pass does, in the very comparison of the gate."""
    ruler, paths = backend.jury.stages[0]._ruler, backend._paths
    loops = {factor.id: factor for factor in backend.left_out}
    refused = [d for d in {d.id: d for d in decisions if d.ends}.values() if d.verdict == "refused"]
    for decision in refused:
        assert (decision.stage, decision.reason) in (("gate", "distance"), ("gate", "drift"))
        assert decision.statistic > decision.threshold
        remedy = dict(decision.basis["would_pass"])
        drift = remedy.pop("drift", None)
        measured, path = paths.path_of(loops[decision.id]), paths.cheapest(loops[decision.id].keys)
        assert not ruler.compare(measured, path)
        assert ruler.compare(measured, path, Noise(**remedy), drift)
        if remedy:
            ((cause, factor),) = remedy.items()
            less = Noise(**{cause: 1 + (factor - 1) * 0.999})
            assert not ruler.compare(measured, path, less, drift)
    return len(refused)


def test_every_refusal_of_a_run_is_explained(drive):
    wrong = drive.wrong((70, 30), (80, 40), (90, 50), (100, 20), (115, 80))
    ended = drive.run(wrong, robust=["gate"])
    assert explained(ended.backend, ended.decisions) == 5


@pytest.mark.parametrize("alpha", ["0.05", "0.15", "0.40"])
def test_every_refusal_of_a_real_drive_is_explained(alpha):
    """KITTI 07: no loop enters, so at the end all is as it was when each was refused."""
    file = Path(__file__).parents[4] / "shared/data/kitti_vo_loops/07" / f"kitti_07_alpha_{alpha}.g2o"
    if not file.is_file():
        pytest.skip(f"{file} is not there")
    graph = read_graph(file)
    backend = Backend(config_from({"sources": ["edges"], "edges": {"kind": "relative"}}))
    updates = [update for each in measurements(graph) for update in backend.add(each)]
    decisions = [d for update in (*updates, *backend.finish()) for d in update.decisions]
    assert explained(backend, decisions) > 50
    waiting = [d for d in {d.id: d for d in decisions if d.ends}.values() if d.verdict != "refused"]
    assert {d.reason for d in waiting} == {"no_witness"}
    assert all(d.basis["missing"] > 0 and d.statistic < d.threshold for d in waiting)


def test_a_loop_that_two_others_contradict_names_both_and_enters_without_them(drive):
    """The smallest set: neither of the two alone is enough."""
    off = drive.space.from_extrinsics((4.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    first = drive._edge(61, 1, off)
    round_ = drive.truth[63].between(drive.truth[61])
    second = drive._edge(63, 1, round_.compose(off))
    (true,) = drive.true(5, 1)
    ended = drive.run([first, second, true], robust=["gate"])
    refused = ended.last[vertices(true)]
    ids = {vertices(d): d.id for d in ended.decisions if d.ends}
    assert refused.verdict == "refused"
    assert set(refused.basis["absent"]) == {ids[vertices(first)], ids[vertices(second)]}
    for without in (first, second):
        others = [loop for loop in (first, second, true) if loop is not without]
        assert drive.run(others, robust=["gate"]).last[vertices(true)].verdict == "refused"
    assert drive.run([true], robust=["gate"]).kept == ends([true])


def test_a_loop_that_only_another_one_contradicts_names_it_and_three_of_them_depose_it(drive):
    """Four metres off is within what sixty steps leave open: the wrong one comes first, and is believed."""
    off = drive.space.from_extrinsics((4.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    wrong, true = drive._edge(61, 1, off), drive.true(3, 8)
    ended = drive.run([wrong, *true], robust=["gate"])
    first = next(d for d in ended.decisions if d.verdict == "refused")
    assert first.basis["absent"] == ["edges/1061.000000000/1"]
    assert ended.kept == ends(true)
    assert [d.verdict for d in ended.decisions if d.ends == wrong.ends][:2] == ["accepted", "removed"]
