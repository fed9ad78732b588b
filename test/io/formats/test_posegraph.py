"""A graph replayed as if live: stamps by rank, everything once both its ends exist."""

import time

import gtsam
import numpy as np
import pytest

from slam_backend.core.measurement import SECOND
from slam_backend.core.sensors.landmark import LandmarkObservation
from slam_backend.core.sensors.relative import RelativePose
from slam_backend.io.formats import g2o, read_graph
from slam_backend.io.formats.posegraph import PERIOD, PoseGraph, measurements, name_of, sevens_of, states_of

UNIT = "1 0 0 1 0 1"


def ranks(record, period=PERIOD):
    return record.stamp_i // period - 1, record.stamp_j // period - 1


def test_a_vertex_has_the_stamp_of_its_rank_counted_from_one_period(file):
    """Ids may be robot keys far beyond what a stamp could hold."""
    key = 97 << 56
    graph = g2o.read(file("a.g2o", f"EDGE_SE2 {key} {key + 7} 1 0 0 {UNIT}"))
    (edge,) = measurements(graph, period=SECOND)
    assert (edge.stamp_i, edge.stamp_j, edge.stamp) == (SECOND, 2 * SECOND, 2 * SECOND)


def test_edges_come_when_their_later_end_exists_and_motion_first(file):
    """Into vertex 3 lead a loop from 0, motion from 2 and a backward edge; 1 and 2 come before, whatever the file says."""
    pairs = ((0, 3), (3, 1), (2, 3), (1, 2), (0, 1), (0, 3))
    graph = g2o.read(file("a.g2o", *(f"EDGE_SE2 {i} {j} {n} 0 0 {UNIT}" for n, (i, j) in enumerate(pairs))))
    records = list(measurements(graph))
    assert [ranks(record) for record in records] == [(0, 1), (1, 2), (2, 3), (3, 1), (0, 3), (0, 3)]
    assert [record.pose[0] for record in records][-2:] == [0, 5]  # equals in the order of the file


def test_a_record_carries_the_files_information_and_the_pose_as_seven(file):
    graph = g2o.read(file("a.g2o", "EDGE_SE2 0 1 1 2 0.5 10 1 2 20 3 30"))
    (edge,) = measurements(graph, source="loops")
    assert isinstance(edge, RelativePose)
    assert (edge.source, edge.frame_i, edge.frame_j) == ("loops", "", "")
    np.testing.assert_allclose(edge.pose, [1, 2, 0, 0, 0, np.sin(0.25), np.cos(0.25)])
    assert edge.information.tolist() == [[10, 1, 2], [1, 20, 3], [2, 3, 30]]
    assert not edge.covariance.any()
    assert not any(array.flags.writeable for array in (edge.pose, edge.covariance, edge.information))


def test_sightings_come_at_their_vertex_after_its_edges(file):
    graph = g2o.read(
        file("a.g2o", "EDGE_SE2_XY 0 9 1 2 4 1 3", f"EDGE_SE2 0 1 1 0 0 {UNIT}", "EDGE_SE2_XY 1 9 0 2 4 1 3")
    )
    first, edge, second = measurements(graph, landmark_source="trees")
    assert isinstance(first, LandmarkObservation)
    assert (first.stamp, edge.stamp, second.stamp) == (PERIOD, 2 * PERIOD, 2 * PERIOD)
    assert (first.source, first.landmark, first.form, first.frame) == ("trees", "9", "position", "")
    assert first.value.tolist() == [1, 2, 0]
    np.testing.assert_allclose(first.covariance[:2, :2] @ [[4, 1], [1, 3]], np.eye(2), atol=1e-12)


def test_a_direction_without_information_gets_a_large_sigma_and_none_at_all_the_default(file):
    graph = g2o.read(file("a.g2o", "EDGE_SE2_XY 0 9 1 2 4 0 0", "EDGE_SE2_XY 0 8 1 2 0 0 0"))
    first, second = measurements(graph)
    assert np.sqrt(first.covariance[1, 1] / first.covariance[0, 0]) > 1e4
    assert np.isnan(np.diag(second.covariance)[:2]).all()


def test_everything_in_a_file_is_replayed_in_order_of_stamp(shared):
    for name in ("pgo_sesync/parking-garage.g2o", "pyfg_cora/mrclam/range_and_rpm/mrclam3b/mrclam3b.pyfg"):
        graph = read_graph(shared / name)
        records = list(measurements(graph))
        assert len(records) == len(graph.edges) + len(graph.sightings)
        stamps = [record.stamp for record in records]
        assert stamps == sorted(stamps)
        assert stamps[0] >= PERIOD


def test_twenty_thousand_edges_take_less_than_half_a_second(shared):
    graph = read_graph(shared / "pgo_sesync/city10000.g2o")
    start = time.process_time()
    assert len(list(measurements(graph))) == 20687
    assert time.process_time() - start < 0.5


def test_states_and_sevens_are_inverse_to_each_other():
    rng = np.random.default_rng(5)
    states = np.column_stack([rng.normal(size=(50, 2)), rng.uniform(-3.1, 3.1, 50)])
    np.testing.assert_allclose(states_of("2d", sevens_of(states)), states, atol=1e-14)
    for state, seven in zip(states, sevens_of(states), strict=True):
        yaw = gtsam.Rot3(seven[6], *seven[3:6]).yaw()
        assert yaw == pytest.approx(state[2])


@pytest.mark.parametrize(
    ("key", "name"), [(5, "5"), (int(gtsam.symbol("A", 12)), "A12"), (2**64 - 1, str(2**64 - 1))]
)
def test_robot_keys_have_readable_names(key, name):
    assert name_of(key) == name


def test_an_empty_graph_has_nothing_to_say():
    assert list(measurements(PoseGraph("2d", np.zeros(0, dtype=np.uint64)))) == []
