"""Pairs of sightings and landmarks: the nearest, and those that are compatible together."""

import numpy as np

from slam_backend.core.association.compatibility import Prediction, jointly, nearest
from slam_backend.core.robust.chi2 import chi2_quantile


def prediction(seen: np.ndarray, landmarks: np.ndarray, shared: float, own: float = 0.1) -> Prediction:
    """A pose whose position is uncertain by `shared` (m), which moves all landmarks together."""
    count, d = landmarks.shape
    covariance = np.kron(np.ones((count, count)), shared**2 * np.eye(d))
    noises = np.tile(own**2 * np.eye(d), (len(seen), 1, 1))
    return Prediction(seen[:, None] - landmarks[None], noises, covariance)


def test_the_nearest_pairs_come_first_and_nobody_is_paired_twice() -> None:
    """Two sightings of one landmark: the closer one has it; beyond the gate there is no pair."""
    assert nearest(np.array([[4.0, 9.0], [1.0, 100.0]]), 9.2) == {0: 1, 1: 0}
    assert nearest(np.array([[4.0, 99.0], [1.0, 100.0]]), 9.2) == {1: 0}


def test_an_offset_that_all_share_turns_the_nearest_away_and_not_the_joint_search() -> None:
    """A row of trees 1 m apart, the pose 0.9 m off along the row: the nearest neighbour is the next tree, for all but one."""
    row = np.array([[float(k), 5.0 + 0.3 * (k % 3) ** 2] for k in range(5)])
    believed = prediction(row + np.array([0.9, 0.0]), row, shared=0.6)
    distances = believed.distances()
    assert nearest(distances, chi2_quantile(0.99, 2)) != {k: k for k in range(5)}
    assert jointly(believed, distances, 0.99) == {k: k for k in range(5)}


def test_pairs_that_contradict_each_other_are_not_accepted_together() -> None:
    """Each sighting fits its landmark within the uncertainty of the pose, one to the left and one to the right: only one can be."""
    landmarks = np.array([[5.0, 0.0], [0.0, 5.0]])
    believed = prediction(
        landmarks + np.diag([1.0, -1.0]) @ np.array([[1.0, 0.0], [1.0, 0.0]]), landmarks, shared=0.7
    )
    distances = believed.distances()
    assert len(nearest(distances, chi2_quantile(0.99, 2))) == 2
    assert len(jointly(believed, distances, 0.99)) == 1


def test_the_joint_distance_of_a_pair_is_the_one_it_has_by_itself() -> None:
    """Seeded: the two ways to compute it agree."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(8, 8))
    believed = Prediction(rng.normal(size=(3, 4, 2)), np.tile(np.eye(2), (3, 1, 1)), root @ root.T)
    for sighting, landmark in ((0, 0), (2, 3)):
        np.testing.assert_allclose(
            believed.joint({sighting: landmark}), believed.distances()[sighting, landmark]
        )
