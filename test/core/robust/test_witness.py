"""The witness: a far loop waits until others agree with it; a near one enters at once."""

from dataclasses import replace

import numpy as np
import pytest

from slam_backend.core.config import Gate
from slam_backend.core.robust.accord import Ruler
from slam_backend.core.robust.paths import Path
from slam_backend.core.robust.usual import Usual
from slam_backend.core.space import SPACES

from .conftest import ROUND, Drive, ends


def test_a_lone_far_loop_waits_and_says_how_many_more_it_takes(drive):
    (lone,) = drive.true(2, 1)
    ended = drive.run([lone], robust=["gate", "witness"], witness={"near": 0.5})
    (decision,) = ended.last.values()
    assert ended.kept == set()
    assert (decision.verdict, decision.reason, decision.statistic) == ("probation", "no_witness", 0)
    assert decision.basis["missing"] == 2
    assert "no witness" in decision.detail
    assert decision.basis["path_m"] > ROUND / 2


def test_the_third_of_three_that_agree_brings_all_of_them_in(drive):
    true = drive.true(2, 3, every=3)
    ended = drive.run(true, robust=["gate", "witness"], witness={"near": 0.5})
    assert ended.kept == ends(true)
    stages = [(d.verdict, d.reason) for d in ended.decisions if d.ends]
    assert stages.count(("probation", "no_witness")) == 2
    assert stages.count(("accepted", "clique")) == 3
    assert len(ended.last[next(iter(ends(true)))].basis["clique"]) == 3


def test_a_group_that_agrees_with_itself_but_not_with_odometry_stays_out(drive):
    """Aliasing: five loops to the wrong side of the round, consistent to the millimetre."""
    group = [drive._edge(60 + k, 30 + k, drive.space.identity) for k in range(0, 15, 3)]
    ended = drive.run(group, robust=["gate", "witness"])
    assert ended.kept == set()
    assert {d.stage for d in ended.last.values()} == {"gate"}


def test_a_lone_loop_enters_where_the_option_lets_it(drive):
    (lone,) = drive.true(2, 1)
    ended = drive.run([lone], robust=["gate", "witness"], witness={"near": 0.5, "lone": 0.99})
    assert ended.kept == ends([lone])
    assert next(iter(ended.last.values())).reason in ("lone", "exact")


@pytest.mark.parametrize("dimension", ["2d", "3d"])
def test_a_lone_loop_enters_once_the_graph_has_come_to_expect_it(dimension):
    """Odometry is three times worse than stated; forty loops further on, none within reach, mend what it says of the lone one."""
    drive = Drive(dimension, odometry=3.0)
    (lone,) = drive.true(2, 1)
    lone = replace(lone, information=np.eye(drive.space.dimension) / 0.1**2)
    far = {"near": 0.5, "reach": 8.0}
    scaled = {"odometry_scale": 10.0}
    alone = drive.run([lone], robust=["gate", "witness"], gate=scaled, witness=far)
    assert alone.kept == set()
    ended = drive.run([lone, *drive.true(14, 40, 1)], robust=["gate", "witness"], gate=scaled, witness=far)
    told = [(d.verdict, d.reason) for d in ended.decisions if d.ends == lone.ends]
    assert told == [("probation", "no_witness"), ("accepted", "exact")]


def test_what_is_expected_is_exact_only_where_noise_leaves_no_other_place_nearby():
    """Two standard deviations away either way: ten centimetres prove something, ten metres do not."""
    space = SPACES["2d"]
    ruler = Ruler(space, Gate(), Usual(space.dimension), near=2.0)
    for sigma, statistic in ((0.1, 4.0), (10.0, np.inf)):
        there = space.from_extrinsics((2 * sigma, 0.0, 0.0, 0.0, 0.0, 0.0))
        noise = np.eye(space.dimension) * sigma**2
        loop = Path(there, np.array([0 * noise, 0 * noise, noise]), 0.0)
        assert ruler.exact(loop, space.identity, 0 * noise) == pytest.approx(statistic)


def test_what_waits_is_bounded_and_the_oldest_goes_with_a_word(drive):
    true = drive.true(2, 2, every=20)
    ended = drive.run(true, robust=["gate", "witness"], witness={"near": 0.5, "reach": 1.0, "held": 1})
    assert [d.reason for d in ended.last.values()] == ["crowded_out", "no_witness"]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_of_many_random_wrong_loops_none_gets_in_and_the_true_ones_do(seed):
    drive = Drive("2d", seed=seed)
    rng = np.random.default_rng(seed)
    pairs = [
        (int(i), int(j)) for i, j in rng.integers(0, 2 * ROUND, (60, 2)) if i - j > 20 and (i - j) != ROUND
    ]
    wrong, true = drive.wrong(*dict.fromkeys(pairs)), drive.true(2, 15)
    kept = drive.run([*true, *wrong], robust=["gate", "witness"]).kept
    far = {(i, j) for i, j in ends(wrong) if drive.space.size(drive.truth[i].between(drive.truth[j]))[0] > 3}
    assert not kept & far
    assert ends(true) <= kept
