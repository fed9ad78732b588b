"""What a run reads: bags merged in order of arrival, or one pose graph."""

from itertools import pairwise

import numpy as np
import pytest

from slam_backend.core.config import config_from
from slam_backend.core.errors import BadConfig, BadFile
from slam_backend.core.graph import Decision
from slam_backend.core.measurement import SECOND
from slam_backend.io.bags import write_bag
from slam_backend.io.encode import encode_odometry
from slam_backend.io.formats.posegraph import PERIOD
from slam_backend.io.inputs import BagInputs, GraphInput, open_inputs
from slam_backend.io.records import Record

ODOMETRY = "nav_msgs/msg/Odometry"
WHEELS = {"sources": ["wheels"], "wheels": {"kind": "odometry", "topic": "/odom"}}
GRAPH = """VERTEX_SE2 3 0 0 0
VERTEX_SE2 5 1 0 0
VERTEX_SE2 9 2 0 0
VERTEX_XY 4 1 1
EDGE_SE2 5 9 1 0 0 1 0 0 1 0 1
EDGE_SE2 3 5 1 0 0 1 0 0 1 0 1
EDGE_SE2_XY 5 4 0 1 1 0 1
"""


def odometry(n, topic="/odom", log_time=None):
    seven = np.array([n, 0, 0, 0, 0, 0, 1.0])
    data = encode_odometry((n + 1) * SECOND, "odom", "base", seven, np.zeros(36), np.zeros(6), np.zeros(36))
    return Record(topic, ODOMETRY, n if log_time is None else log_time, data)


def stamps(inputs, config):
    with inputs:
        return [item.stamp // SECOND - 1 for item in inputs.stream(config_from(config))]


def test_several_bags_are_merged_by_log_time(tmp_path):
    write_bag(tmp_path / "a.mcap", [odometry(n) for n in range(0, 20, 2)])
    write_bag(tmp_path / "b", [odometry(n) for n in range(1, 20, 2)])
    inputs = open_inputs([tmp_path / "a.mcap", tmp_path / "b"])
    assert inputs.count == 20
    assert stamps(inputs, WHEELS) == list(range(20))
    assert inputs.read == 20


def test_only_the_topics_of_the_configuration_are_read_and_counted(tmp_path):
    rows = [odometry(n, topic) for n in range(10) for topic in ("/odom", "/other")]
    write_bag(tmp_path / "a.mcap", rows, strictly_increasing=True)
    inputs = open_inputs([tmp_path / "a.mcap"])
    assert isinstance(inputs, BagInputs)
    assert stamps(inputs, WHEELS) == list(range(10))
    assert (inputs.count, inputs.read) == (10, 10)


def test_a_topic_belongs_to_one_source(tmp_path):
    write_bag(tmp_path / "a.mcap", [odometry(0)])
    config = {
        "sources": ["wheels", "loops"],
        "wheels": WHEELS["wheels"],
        "loops": {"kind": "relative", "topic": "/odom"},
    }
    with pytest.raises(BadConfig, match="source 'loops': topic '/odom' belongs to source 'wheels' already"):
        stamps(open_inputs([tmp_path / "a.mcap"]), config)


def test_a_source_without_a_topic_is_said_with_what_there_is(tmp_path):
    write_bag(tmp_path / "a.mcap", [odometry(0)])
    config = {"sources": ["wheels"], "wheels": {"kind": "odometry"}}
    with pytest.raises(
        BadConfig, match=r"source 'wheels': states no topic; there are /odom \(nav_msgs/msg/Odometry\)"
    ):
        stamps(open_inputs([tmp_path / "a.mcap"]), config)


def test_a_message_that_cannot_be_decoded_is_a_decision_in_its_place(tmp_path):
    broken = Record("/odom", ODOMETRY, 5, odometry(5).data[:40])
    write_bag(tmp_path / "a.mcap", [*(odometry(n) for n in range(5)), broken, odometry(6)])
    with open_inputs([tmp_path / "a.mcap"]) as inputs:
        items = list(inputs.stream(config_from(WHEELS)))
    assert [n for n, item in enumerate(items) if isinstance(item, Decision)] == [5]
    assert (items[5].stage, items[5].source) == ("decode", "wheels")


def test_a_graph_comes_in_vertex_order_one_period_apart(tmp_path):
    (tmp_path / "a.g2o").write_text(GRAPH)
    inputs = open_inputs([tmp_path / "a.g2o"])
    assert isinstance(inputs, GraphInput)
    config = config_from(
        {"space": "2d", "sources": ["e", "l"], "e": {"kind": "relative"}, "l": {"kind": "landmark"}}
    )
    with inputs:
        items = list(inputs.stream(config))
    assert [(type(i).__name__, i.source, i.stamp // PERIOD) for i in items] == [
        ("RelativePose", "e", 2), ("LandmarkObservation", "l", 2), ("RelativePose", "e", 3),
    ]  # fmt: skip
    assert all(a.stamp <= b.stamp for a, b in pairwise(items))
    assert [inputs.vertex(k * PERIOD) for k in range(5)] == [None, 3, 5, 9, None]
    assert inputs.vertex(PERIOD + 1) is None
    assert inputs.count == inputs.read == 3


def test_a_graph_with_landmarks_wants_a_source_for_them(tmp_path):
    (tmp_path / "a.g2o").write_text(GRAPH)
    config = config_from({"space": "2d", "sources": ["e"], "e": {"kind": "relative"}})
    with pytest.raises(BadConfig, match=r"a\.g2o holds landmarks: configure a source of kind landmark"):
        list(open_inputs([tmp_path / "a.g2o"]).stream(config))


def test_a_graph_without_edges_has_nothing_to_optimize(tmp_path):
    (tmp_path / "a.g2o").write_text("VERTEX_SE2 0 0 0 0\n")
    with pytest.raises(BadFile, match=r"a\.g2o: holds no edges between poses"):
        open_inputs([tmp_path / "a.g2o"])
