"""The witness: a far loop waits until others agree with it; a near one enters at once."""

import numpy as np
import pytest

from .conftest import ROUND, ends


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


def test_what_waits_is_bounded_and_the_oldest_goes_with_a_word(drive):
    true = drive.true(2, 2, every=20)
    ended = drive.run(true, robust=["gate", "witness"], witness={"near": 0.5, "reach": 1.0, "held": 1})
    assert [d.reason for d in ended.last.values()] == ["crowded_out", "no_witness"]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_of_many_random_wrong_loops_none_gets_in_and_the_true_ones_do(seed):
    from .conftest import Drive

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
