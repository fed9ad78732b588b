"""A scan finds its place in the map although the predicted pose is far off."""

import numpy as np
import pytest

from slam_backend.core.association.consensus import consensus


@pytest.mark.parametrize("d", [2, 3])
def test_pairs_as_far_apart_find_the_place_and_strangers_are_left_out(d: int) -> None:
    """Eight landmarks seen from a pose that is 7 m and 0.4 rad off, and three things that the map does not have."""
    rng = np.random.default_rng(1)
    landmarks = rng.uniform(-20, 20, (40, d))
    c, s = np.cos(0.4), np.sin(0.4)
    turn = np.eye(d)
    turn[:2, :2] = [[c, -s], [s, c]]
    shift = np.array([5.0, -5.0, 0.5])[:d]
    seen = (landmarks[:8] - shift) @ turn + rng.normal(0, 0.05, (8, d))
    strangers = rng.uniform(-20, 20, (3, d))
    found = consensus(np.vstack([seen, strangers]), landmarks, tolerance=0.5, reach=10.0)
    assert found is not None
    assert {k: found.pairs[k] for k in range(8)} == {k: k for k in range(8)}
    assert found.turned == pytest.approx(0.4, abs=0.03)


def test_a_place_that_the_map_does_not_have_is_not_found() -> None:
    """Other landmarks, farther off than the reach, or too few: no answer rather than a wrong one."""
    rng = np.random.default_rng(2)
    landmarks = rng.uniform(-20, 20, (30, 2))
    assert consensus(rng.uniform(-20, 20, (8, 2)), landmarks, tolerance=0.2, reach=10.0) is None
    assert consensus(landmarks[:8] + np.array([12.0, 0.0]), landmarks, tolerance=0.2, reach=10.0) is None
    assert consensus(landmarks[:3], landmarks, tolerance=0.2, reach=10.0) is None
