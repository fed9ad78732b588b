"""What an integrator starts with: launch file, configurations, RViz, Foxglove, and the executable of `ros2 run`."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from slam_backend.core.config import Config, config_from, config_to
from slam_backend.io.configfile import load_config

ROOT = Path(__file__).parents[1]
CONFIGS = sorted((ROOT / "config").glob("*.yaml"))
FOR_ROBOTS = [ROOT / f"config/{name}.yaml" for name in ("default", "indoor_2d", "outdoor_3d", "drone")]
TOPICS = {  # what the node publishes, and its type in RViz
    "/slam_backend/path": "Path",
    "/slam_backend/odometry": "Odometry",
    "/slam_backend/trajectory": "PointCloud2",
    "/slam_backend/landmarks": "PointCloud2",
    "/slam_backend/graph": "MarkerArray",
}


@dataclass
class Said:
    """Stands for a class of launch: remembers what it was made of."""

    arguments: tuple[Any, ...]
    settings: dict[str, Any]

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        self.arguments, self.settings = arguments, settings

    def perform(self, context: Mapping[str, str]) -> str:
        """Of a LaunchConfiguration."""
        return context[self.arguments[0]]


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The launch file, with stand-ins for launch and launch_ros."""
    names = {
        "launch": ["LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument", "OpaqueFunction"],
        "launch.substitutions": ["LaunchConfiguration"],
        "launch_ros": [],
        "launch_ros.actions": ["LifecycleNode", "Node"],
    }
    for module, classes in names.items():
        stand_in = ModuleType(module)
        for name in classes:
            setattr(stand_in, name, type(name, (Said,), {}))
        monkeypatch.setitem(sys.modules, module, stand_in)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    found = importlib.util.spec_from_file_location("backend_launch", ROOT / "launch/backend.launch.py")
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


def started(launch_file: ModuleType, **given: str) -> list[Any]:
    """The nodes for these arguments, with the declared defaults for the others."""
    (description,) = launch_file.generate_launch_description().arguments
    *declared, function = description
    arguments = {each.arguments[0]: each.settings["default_value"] for each in declared}
    return list(function.settings["function"]({**arguments, **given}))


def test_the_launch_file_starts_the_node_alone(launch_file: ModuleType) -> None:
    """Without arguments: the executable of this package under its own name, with the default configuration."""
    (node,) = started(launch_file)
    assert type(node).__name__ == "LifecycleNode"
    assert {name: node.settings[name] for name in ("package", "executable", "name", "namespace")} == {
        "package": "slam_backend",
        "executable": "backend",
        "name": "slam_backend",
        "namespace": "",
    }
    config, others = node.settings["parameters"]
    assert Path(config) == ROOT / "config/default.yaml"
    assert others == {"use_sim_time": False}


def test_its_arguments_reach_the_node_and_rviz(launch_file: ModuleType) -> None:
    given = {
        "config": "my.yaml",
        "namespace": "r1",
        "use_sim_time": "True",
        "data_dir": "/data",
        "rviz": "true",
    }
    node, rviz = started(launch_file, **given)
    assert node.settings["namespace"] == "r1"
    assert node.settings["parameters"] == ["my.yaml", {"use_sim_time": True, "data_dir": "/data"}]
    assert ("/slam_backend/path", "/r1/slam_backend/path") in rviz.settings["remappings"]
    assert rviz.settings["parameters"] == [{"use_sim_time": True}]
    assert Path(rviz.settings["arguments"][1]).exists()


def test_rviz_is_remapped_wherever_it_listens(launch_file: ModuleType) -> None:
    _, rviz = started(launch_file, rviz="true", namespace="/r1/")
    assert {old for old, _ in rviz.settings["remappings"]} == set(rviz_topics())
    assert all(new.startswith("/r1/slam_backend/") for _, new in rviz.settings["remappings"])


def test_a_switch_that_is_neither_true_nor_false_is_refused(launch_file: ModuleType) -> None:
    with pytest.raises(ValueError, match="use_sim_time:=yes: write true or false"):
        started(launch_file, use_sim_time="yes")


def leaves(data: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from leaves(value, (*path, key))
        else:
            yield (*path, key), value


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_every_configuration_is_one(path: Path) -> None:
    assert isinstance(load_config(path), Config)


@pytest.mark.parametrize("path", FOR_ROBOTS, ids=lambda path: path.name)
def test_a_configuration_says_only_what_differs(path: Path) -> None:
    """Besides the names, kinds and topics of its sources."""
    (said,) = yaml.safe_load(path.read_text()).values()
    said = said["ros__parameters"]
    sources = said.get("sources", [])
    plain = {name: {"kind": said[name]["kind"]} for name in sources}
    default = config_to(Config.model_validate({"sources": plain}))
    for place, value in leaves(said):
        if place[0] not in ("sources", "extrinsics") and place[-1] not in ("kind", "topic"):
            section: Any = default
            for name in place:
                section = section[name]
            assert value != section, f"{'.'.join(place)} is the default"


@pytest.mark.parametrize("path", FOR_ROBOTS, ids=lambda path: path.name)
def test_a_configuration_is_a_params_file_too(path: Path) -> None:
    """For a node of any name; read by rclpy it is what `replay` reads."""
    rclpy = pytest.importorskip("rclpy")
    context = rclpy.Context()
    rclpy.init(args=["node", "--ros-args", "--params-file", str(path)], context=context)
    try:
        node = rclpy.create_node(
            "any", namespace="/r1", context=context, automatically_declare_parameters_from_overrides=True
        )
        given = {name: each.value for name, each in node.get_parameters_by_prefix("").items()}
        node.destroy_node()
    finally:
        rclpy.try_shutdown(context=context)
    assert config_from(nested(given)) == load_config(path)


def nested(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """`wheels.kind` of a node as `wheels: {kind: ...}`, without rclpy's own parameters."""
    found: dict[str, Any] = {}
    for name, value in parameters.items():
        *path, leaf = name.split(".")
        section = found
        for part in path:
            section = section.setdefault(part, {})
        section[leaf] = list(value) if isinstance(value, array) else value
    return {
        name: value
        for name, value in found.items()
        if name not in ("use_sim_time", "start_type_description_service")
    }


def rviz_topics() -> dict[str, str]:
    """Topic -> type of display."""
    rviz = yaml.safe_load((ROOT / "config/backend.rviz").read_text())
    displays = rviz["Visualization Manager"]["Displays"]
    return {each["Topic"]["Value"]: each["Class"].split("/")[1] for each in displays if "Topic" in each}


def test_rviz_shows_what_the_node_publishes() -> None:
    shown = rviz_topics()
    assert set(shown) == {"/slam_backend/path", "/slam_backend/odometry", "/slam_backend/graph"}
    assert shown.items() <= TOPICS.items()


def test_foxglove_shows_what_the_node_publishes() -> None:
    layout = json.loads((ROOT / "config/foxglove_layout.json").read_text())
    panels = layout["configById"]
    (scene,) = [panel for name, panel in panels.items() if name.startswith("3D!")]
    assert set(scene["topics"]) == set(TOPICS)
    placed = re.findall(r'"(?:first|second)": "([^"]+)"', json.dumps(layout["layout"]))
    assert sorted(placed) == sorted(panels)
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    assert {path.split(".")[0] for path in paths} == {"/slam_backend/map_to_odom", "/slam_backend/pose"}


@pytest.mark.parametrize("venv", [True, False])
def test_ros2_run_finds_the_python_that_has_the_solver(tmp_path: Path, venv: bool) -> None:
    """The prefix's own python if there is one, else that of the environment; arguments arrive as they are."""
    executable = tmp_path / "prefix/lib/slam_backend/backend"
    executable.parent.mkdir(parents=True)
    executable.write_bytes((ROOT / "resource/backend").read_bytes())
    executable.chmod(0o755)
    for folder in ("prefix/bin", "bin"):
        stand_in = tmp_path / folder / "python3"
        stand_in.parent.mkdir()
        stand_in.write_text('#!/bin/sh\necho "$0"\nprintf "%s\\n" "$@"\n')
        stand_in.chmod(0o755)
    if not venv:
        (tmp_path / "prefix/bin/python3").unlink()
    environment = {"PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}"}
    command = [executable, "--ros-args", "-r", "__ns:=/r 1"]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    python, _, code, *arguments = ran.stdout.splitlines()
    assert Path(python).resolve() == tmp_path / ("prefix/bin/python3" if venv else "bin/python3")
    assert arguments == ["--ros-args", "-r", "__ns:=/r 1"]
    compile(code, "backend", "exec")


def test_the_executable_is_executable() -> None:
    assert os.access(ROOT / "resource/backend", os.X_OK)
