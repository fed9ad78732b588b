"""The commands under "By hand" on docs/ros.md do what the page says: their YAML makes the message or request, as `ros2` would have it."""

import re
import shlex
from importlib import import_module
from pathlib import Path

import pytest
import yaml

pytest.importorskip("rclpy")

PAGE = Path(__file__).parents[2] / "docs" / "ros.md"
BY_HAND = PAGE.read_text().partition("## By hand")[2]


def commands(*head):
    """The words that follow, of each command that begins so."""
    blocks = "\n".join(re.findall(r"```sh\n(.*?)```", BY_HAND, re.DOTALL))
    lines = [shlex.split(line) for line in re.findall(r'^ros2 (?:[^"\n]|"[^"]*")*', blocks, re.MULTILINE)]
    return [line[len(head) + 1 :] for line in lines if line[1 : len(head) + 1] == list(head)]


def class_of(type_):
    package, kind, name = type_.split("/")
    return getattr(import_module(f"{package}.{kind}"), name)


def filled(message, content):
    """The message, with the fields that the content names."""
    for name, value in content.items():
        setattr(message, name, filled(getattr(message, name), value) if isinstance(value, dict) else value)
    return message


def joins_two_stamps(status):
    """Whether it is the verdict on a loop."""
    return {"a", "b"} <= {value.key for value in status.values}


def test_the_examples_do_what_they_say(backend, peer, drive) -> None:
    """A loop closure by hand is judged; every request is answered with what it asks for."""
    node = backend()
    told = peer.hear("/slam_backend/decisions", "diagnostic_msgs/msg/DiagnosticArray")
    odometry = [record for record in drive.records if record.topic == "/odom"]
    peer.play(odometry[:550])
    ((topic, type_, text),) = commands("topic", "pub", "--once")
    loop = filled(class_of(type_)(), yaml.safe_load(text))
    publisher = peer.publisher(topic, type_)
    peer.until(publisher.get_subscription_count)
    peer.spin(0.5)
    publisher.publish(loop)
    peer.spin(0.5)
    peer.play(odometry[550:])
    peer.until(lambda: any(joins_two_stamps(status) for message in told for status in message.status))
    answers = {}
    for service, type_, text in commands("service", "call"):
        request = filled(class_of(type_).Request(), yaml.safe_load(text))
        answer = peer.call(class_of(type_), service, request)
        answers.setdefault(service.rpartition("/")[2], []).append(answer)
    (query,), (plan,), (listed,) = (answers.pop(name) for name in ("query", "get_trajectory", "list"))
    assert [len(value.double_array_value) for value in query.values] == [7, 7]
    stamps = [pose.header.stamp.sec + pose.header.stamp.nanosec * 1e-9 for pose in plan.plan.poses]
    assert stamps[0] == 1_700_000_010
    assert stamps[1] - stamps[0] == pytest.approx(0.5)
    assert "decision/loops/1700000050.000000000/0" in listed.result.names
    assert set(answers) == {"pause", "save"}
    assert all(answer.success for found in answers.values() for answer in found)
    assert len(list((node.folder / "runs").iterdir())) == 1
    assert node.end()["counts"]["loops_offered"] == 1
