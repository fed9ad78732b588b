"""The gate: what contradicts odometry stays out, with what would let it pass; what outvotes gets in."""

from dataclasses import replace

import numpy as np
import pytest

from slam_backend.core.config import Gate
from slam_backend.core.robust.accord import Noise, Ruler
from slam_backend.core.robust.paths import Path
from slam_backend.core.robust.usual import FEWEST, Usual
from slam_backend.core.space import SPACES

from .conftest import ends


def path(space, pose, sigma, meters):
    covariance = np.eye(space.dimension) * sigma**2
    turns = np.outer(*(np.diag(space.diagonal(1.0, 0.0)),) * 2)
    return Path(pose, covariance, covariance * turns, 0 * covariance, meters)


def measured(space, pose, sigma):
    covariance = np.eye(space.dimension) * sigma**2
    return Path(pose, 0 * covariance, 0 * covariance, covariance, 0.0)


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


def test_a_loop_that_only_another_one_contradicts_names_it_and_three_of_them_depose_it(drive):
    """Four metres off is within what sixty steps leave open: the wrong one comes first, and is believed."""
    off = drive.space.from_extrinsics((4.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    wrong, true = drive._edge(61, 1, off), drive.true(3, 8)
    ended = drive.run([wrong, *true], robust=["gate"])
    first = next(d for d in ended.decisions if d.verdict == "refused")
    assert first.basis["absent"] == ["edges/1061.000000000/1"]
    assert ended.kept == ends(true)
    assert [d.verdict for d in ended.decisions if d.ends == wrong.ends][:2] == ["accepted", "removed"]
