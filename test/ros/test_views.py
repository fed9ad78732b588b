"""What RViz and Foxglove are told to show is what a running node publishes: topics, types, QoS, fields, frames, namespaces."""

import json
import re
from pathlib import Path

import pytest
import yaml

CONFIG = Path(__file__).parents[2] / "config"
DRAWS = {  # what RViz's displays draw
    "rviz_default_plugins/Path": "nav_msgs/msg/Path",
    "rviz_default_plugins/Odometry": "nav_msgs/msg/Odometry",
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
}
FOXGLOVE_DRAWS = {  # what its 3D panel can draw
    *DRAWS.values(), "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseWithCovarianceStamped",
}  # fmt: skip


@pytest.fixture(scope="module")
def rviz():
    described = yaml.safe_load((CONFIG / "backend.rviz").read_text())["Visualization Manager"]
    shown = {each["Topic"]["Value"]: each for each in described["Displays"] if "Topic" in each}
    return described["Global Options"]["Fixed Frame"], shown


@pytest.fixture(scope="module")
def foxglove():
    return json.loads((CONFIG / "foxglove_layout.json").read_text())


def panels(layout):
    """Ids of the panels that are laid out."""
    if isinstance(layout, str):
        return [layout]
    return [*panels(layout["first"]), *panels(layout["second"])]


def topics_of(layout):
    """Topic -> whether it is drawn in 3-D, of all panels; and the message paths of the plots."""
    settings = layout["configById"]
    drawn = {topic: True for each in settings.values() for topic in each.get("topics", {})}
    told = {each["topicToRender"]: False for each in settings.values() if "topicToRender" in each}
    paths = [path["value"] for each in settings.values() for path in each.get("paths", ())]
    return drawn | told, paths


def value_at(message, path):
    """What a message path such as `.pose.covariance[7]` finds; AttributeError or IndexError if nothing."""
    for name, index in re.findall(r"\.(\w+)|\[(\d+)\]", path):
        message = getattr(message, name) if name else message[int(index)]
    return message


def test_every_panel_that_is_laid_out_is_described(foxglove):
    assert sorted(panels(foxglove["layout"])) == sorted(foxglove["configById"])


@pytest.mark.slow
def test_views_show_what_a_running_node_publishes(backend, peer, drive, rviz, foxglove) -> None:
    frame, displays = rviz
    shown, paths = topics_of(foxglove)
    node = backend(drive.config)
    types = {}

    def published():
        types.update(peer.node.get_topic_names_and_types())
        return {*displays, *shown} <= {topic for topic in types if peer.node.count_publishers(topic)}

    peer.until(published, why=lambda: f"{sorted({*displays, *shown} - types.keys())} are not there")
    assert {topic: types[topic] for topic in displays} == {
        t: [DRAWS[d["Class"]]] for t, d in displays.items()
    }
    assert {types[topic][0] for topic, drawn in shown.items() if drawn} <= FOXGLOVE_DRAWS
    assert {types[topic][0] for topic, drawn in shown.items() if not drawn} == {
        "diagnostic_msgs/msg/DiagnosticArray"
    }
    plotted = {topic for topic in types if any(path.startswith(f"{topic}.") for path in paths)}
    heard = {
        t: peer.hear(t, types[t][0], latched=_is_latched(displays.get(t)))
        for t in {*displays, *shown, *plotted}
    }
    peer.play(drive.records, rate=10)  # slow enough for ~/odometry to have a keyframe to go on from
    peer.until(lambda: all(heard.values()), why=lambda: f"silent: {[t for t, m in heard.items() if not m]}")
    for path in paths:
        topic = max((topic for topic in heard if path.startswith(f"{topic}.")), key=len)
        assert isinstance(value_at(heard[topic][-1], path.removeprefix(topic)), float), path
    for topic, display in displays.items():
        _judge(topic, display, peer)
        if hasattr(heard[topic][-1], "header"):
            assert heard[topic][-1].header.frame_id == frame
    markers = heard["/slam_backend/graph"][-1].markers
    assert {each.ns for each in markers if each.ns} <= displays["/slam_backend/graph"]["Namespaces"].keys()
    assert {each.header.frame_id for each in markers if each.ns} == {frame}
    node.end()


def _is_latched(display):
    return display is not None and display["Topic"]["Durability Policy"] == "Transient Local"


def _judge(topic, display, peer):
    """RViz asks for no more than the node gives: else DDS matches nothing, and the screen stays empty."""
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    (publisher,) = peer.node.get_publishers_info_by_topic(topic)
    given, asked = publisher.qos_profile, display["Topic"]
    if asked["Reliability Policy"] == "Reliable":
        assert given.reliability == ReliabilityPolicy.RELIABLE, topic
    if asked["Durability Policy"] == "Transient Local":
        assert given.durability == DurabilityPolicy.TRANSIENT_LOCAL, topic
