"""Wrong loops for a recorded drive: wrong, plausible, the same for the same seed; groups agree among themselves."""

from itertools import combinations

import numpy as np
import pytest

from slam_backend.core.config import config_from
from slam_backend.core.measurement import SECOND, frozen
from slam_backend.core.sensors.relative import RelativePose
from slam_backend.core.space import SPACES
from slam_backend.core.trajectory import Trajectory
from slam_backend.io.inputs import open_inputs
from slam_backend.io.replay import Run
from slam_backend.lab.wrong import APART, FARTHER, Injected, Wrongs, wanted

SPACE = SPACES["2d"]
COUNT = 400
INFORMATION = np.diag([1e4, 1e4, 1e4])


@pytest.fixture
def drive():
    """Twice around a block of 50 m, half a metre a keyframe, and two recorded loops."""
    turns = np.where(np.arange(COUNT) % 25 == 24, np.pi / 2, 0.0)
    poses = [SPACE.identity]
    for turn in turns[:-1]:
        poses.append(poses[-1].compose(SPACE.pose_of_numbers((0.5, 0.0, turn))))
    stamps = (np.arange(COUNT, dtype=np.int64) + 1) * SECOND
    reference = Trajectory(stamps, np.array([SPACE.seven(pose) for pose in poses]))
    return reference, [recorded(stamps, 200, 0), recorded(stamps, 310, 110)]


def recorded(stamps, i, j):
    there = SPACE.pose_of_numbers((0.1, -0.05, 0.02))
    seven, unstated = frozen(SPACE.seven(there)), frozen(np.zeros(36))
    ends = int(stamps[i]), int(stamps[j])
    return RelativePose(max(ends), "edges", *ends, "", "", seven, unstated, frozen(INFORMATION))


def off(loop, reference):
    """By how many metres and radians a loop disagrees with the drive."""
    return SPACE.size(SPACE.pose(loop.pose.tolist()).between(true(loop, reference)))


def true(loop, reference):
    i, j = (SPACE.pose(seven) for seven in reference.at(list(loop.ends)))
    return i.between(j)


@pytest.mark.parametrize("size", [1, 5])
def test_they_are_wrong_far_apart_and_as_many_as_wanted(drive, size):
    reference, like = drive
    loops = Wrongs(reference, like, SPACE, seed=3).loops(40, size)
    assert len(loops) == 40
    assert len({frozenset(loop.ends) for loop in loops}) == 40
    assert [loop.stamp for loop in loops] == sorted(max(loop.ends) for loop in loops)
    for loop in loops:
        meters, turned = off(loop, reference)
        assert meters > FARTHER[0] or turned > FARTHER[1]
        assert abs(loop.stamp_i - loop.stamp_j) / SECOND * 0.5 >= APART - 1e-9
        assert loop.stamp_i > loop.stamp_j, "as the recorded ones have it"
        assert loop.information is like[0].information or loop.information is like[1].information


def test_single_ones_look_like_those_that_were_recorded(drive):
    reference, like = drive
    lengths = [np.linalg.norm(loop.pose[:3]) for loop in Wrongs(reference, like, SPACE, seed=0).loops(60)]
    assert max(lengths) < 2.0


def test_a_group_agrees_with_itself_to_within_its_noise_and_two_groups_do_not(drive):
    """The cycle loop m, drive, loop n inverted, drive closes as well as for two true loops."""
    reference, like = drive
    loops = Wrongs(reference, like, SPACE, seed=5).loops(4, 4)
    others = Wrongs(reference, like, SPACE, seed=6).loops(4, 4)

    def disagreement(m, n):
        there, back = (SPACE.pose(loop.pose.tolist()) for loop in (m, n))
        i = between(reference, m.stamp_i, n.stamp_i)
        j = between(reference, m.stamp_j, n.stamp_j)
        return SPACE.size(there.compose(j).between(i.compose(back)))[0]

    assert max(disagreement(m, n) for m, n in combinations(loops, 2)) < 0.5
    assert max(disagreement(m, n) for m in loops for n in others) > 1.0


def between(reference, a, b):
    first, second = (SPACE.pose(seven) for seven in reference.at([a, b]))
    return first.between(second)


def test_the_same_seed_gives_the_same_loops_and_another_seed_others(drive):
    def numbers(seed):
        return np.array([[*loop.ends, *loop.pose] for loop in Wrongs(*drive, SPACE, seed).loops(10)])

    np.testing.assert_array_equal(numbers(1), numbers(1))
    assert not np.array_equal(numbers(1), numbers(2))


def test_a_drive_that_is_too_short_gives_fewer_and_ends(drive):
    reference, like = drive
    short = Trajectory(reference.stamps[:10], reference.sevens[:10])
    assert Wrongs(short, like, SPACE, seed=0).loops(5) == []
    assert Wrongs(short, like, SPACE, seed=0).loops(5, 5) == []


def test_the_share_is_of_all_loops():
    assert [wanted(share, 100) for share in (0.0, 0.3, 0.5, 0.75)] == [0, 43, 100, 300]


def test_injected_loops_arrive_as_soon_as_both_ends_are_there(tmp_path):
    path = tmp_path / "drive.g2o"
    path.write_text("".join(f"EDGE_SE2 {k} {k + 1} 0.5 0 0 1e4 0 0 1e4 0 1e4\n" for k in range(60)))
    config = config_from({"space": "2d", "sources": ["edges"], "edges": {"kind": "relative"}, "robust": []})
    period = SECOND // 10
    loops = [recorded((np.arange(70) + 1) * period, *ends) for ends in ((30, 5), (60, 20))]
    inputs = Injected(open_inputs([path]), loops)
    run = Run(inputs, config, [])
    newest = {}
    for update in run:
        newest |= {
            d.id: update.keyframe.index for d in update.decisions if d.ends and d.verdict == "accepted"
        }
    assert inputs.count == inputs.read == 62
    assert newest == {"edges/3.100000000/1": 30, "edges/6.100000000/1": 60}
