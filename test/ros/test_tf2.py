"""tf2_msgs: built whole into a venv of ROS wheels, or one line that says why not; what was built speaks with every other Jazzy."""

import json
import shutil
import subprocess
import sys
import sysconfig
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from slam_backend.core.errors import MissingExtra, SlamError
from slam_backend.core.measurement import SECOND
from slam_backend.io.encode import encode_transforms
from slam_backend.ros import tf2

LISTENER = Path(__file__).parent / "listener.py"
STAMP = 1_700_000_000 * SECOND
needs_wheels = pytest.mark.skipif(
    not Path(sys.prefix, "lib", tf2.C).exists() or shutil.which("g++") is None,
    reason="needs the ROS wheels and gcc",
)
needs_tf2 = pytest.mark.skipif(find_spec("tf2_msgs") is None, reason="tf2_msgs is not there: `make tf`")


@pytest.fixture
def absent(monkeypatch):
    """As if tf2_msgs could not be imported."""
    monkeypatch.setattr(tf2, "present", lambda: None)


def built(folder):
    """Everything but the installation."""
    shop = tf2.Workshop(Path(sys.prefix), folder)
    tf2.generate(shop)
    tf2.link_all(shop, tf2.compile_all(shop))
    tf2.gather(shop)
    return shop


@needs_wheels
def test_it_builds_and_loads(tmp_path, monkeypatch):
    """Into a folder that stands for the venv: the message, its definition, and the markers that ament looks for."""
    shop = built(tmp_path)
    tf2.try_out(shop)
    target = tmp_path / "venv"
    monkeypatch.setattr(sysconfig, "get_path", lambda _: str(target / "site-packages"))
    assert tf2.install(tf2.Workshop(target, tmp_path)) == target / "site-packages/tf2_msgs"
    found = {str(path.relative_to(target)) for path in target.rglob("*") if path.is_file()}
    assert {
        "share/tf2_msgs/msg/TFMessage.msg",
        "share/tf2_msgs/msg/TFMessage.idl",
        "share/tf2_msgs/package.xml",
        "share/ament_index/resource_index/packages/tf2_msgs",
        "share/ament_index/resource_index/rosidl_interfaces/tf2_msgs",
        "site-packages/tf2_msgs/__init__.py",
        "site-packages/tf2_msgs/msg/__init__.py",
    } <= found
    assert sum(name.endswith(".so") for name in found) == 4


@needs_wheels
def test_another_definition_is_refused(tmp_path, monkeypatch):
    """Its hash is not the one that others know, so they would not understand each other."""
    monkeypatch.setattr(tf2, "DEFINITION", "geometry_msgs/TransformStamped[] frames\n")
    with pytest.raises(SlamError, match="its type hash is RIHS01_"):
        tf2.generate(tf2.Workshop(Path(sys.prefix), tmp_path))


@needs_wheels
def test_a_compiler_that_fails_leaves_nothing_and_says_why(absent, monkeypatch, capsys):
    monkeypatch.setattr(tf2, "compile_all", lambda shop: tf2.run(["gcc", "-c", shop.work / "absent.c"]))
    before = sorted(Path(sysconfig.get_path("platlib")).glob("*tf2_msgs*"))
    assert tf2.main() == 1
    said = capsys.readouterr()
    assert said.err.startswith("tf2_msgs cannot be built: gcc: ")
    assert "absent.c" in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""
    assert sorted(Path(sysconfig.get_path("platlib")).glob("*tf2_msgs*")) == before


@needs_wheels
def test_without_a_compiler_it_is_skipped_with_one_line(absent, monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert tf2.main() == 0
    assert (
        capsys.readouterr().out == "skipped: tf2_msgs is not built: gcc and g++ not found (apt install g++)\n"
    )


def test_without_the_wheels_it_is_skipped_with_one_line(absent, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    assert tf2.main() == 0
    assert capsys.readouterr().out.startswith(
        "skipped: tf2_msgs is not built: the ROS wheels are not installed in"
    )


def test_missing_headers_are_named(monkeypatch, tmp_path):
    (tmp_path / "lib" / tf2.C).mkdir(parents=True)
    (tmp_path / "lib" / tf2.C / tf2.C).touch()
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.setattr(shutil, "which", lambda tool: tool)
    monkeypatch.setattr(sysconfig, "get_path", lambda _: str(tmp_path))
    with pytest.raises(MissingExtra, match=r"Python\.h not found"):
        tf2.check_tools()


@needs_tf2
def test_where_it_is_nothing_is_done(capsys, monkeypatch):
    monkeypatch.setattr(tf2, "build", lambda _: pytest.fail("built again"))
    assert tf2.main() == 0
    assert capsys.readouterr().out.startswith("tf2_msgs is there: ")


@needs_tf2
def test_bytes_that_we_encode_arrive_as_transforms_under_the_right_type(start, context):
    """In another process, with rclpy's class; and the graph tells the hash that every Jazzy install tells."""
    import rclpy
    from tf2_msgs.msg import TFMessage

    node = rclpy.create_node("sender", context=context)
    publisher = node.create_publisher(TFMessage, "/tf", 10)
    listener = start(LISTENER, "/tf", "tf2_msgs/msg/TFMessage", "volatile")
    listener.wait_for("ready")
    until = time.monotonic() + 10
    while not publisher.get_subscription_count():
        assert time.monotonic() < until
        time.sleep(0.02)
    time.sleep(0.3)
    publisher.publish(
        encode_transforms(STAMP, "map", {"odom": [1, 2, 3, 0, 0, 0, 1], "base": [0, 0, 0, 0, 0, 0, 1]})
    )
    got = json.loads(listener.wait_for("/tf ").removeprefix("/tf "))["transforms"]
    assert [(t["header"]["frame_id"], t["child_frame_id"]) for t in got] == [("map", "odom"), ("map", "base")]
    assert got[0]["transform"]["translation"] == {"x": 1.0, "y": 2.0, "z": 3.0}
    (info,) = node.get_publishers_info_by_topic("/tf")
    assert str(info.topic_type_hash) == tf2.TYPE_HASH


def test_the_command_says_one_line():
    command = [sys.executable, "-m", "slam_backend.ros.tf2"]
    if find_spec("tf2_msgs") is None and Path(sys.prefix, "lib", tf2.C).exists():
        pytest.skip("it would build into the venv that runs this test")
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0
    assert ran.stdout.count("\n") == 1
    assert ran.stderr == ""
