"""The back-end, and RViz if wanted: `ros2 launch slam_backend backend.launch.py config:=my.yaml rviz:=true`.

The node configures and activates itself; with `autostart: false` in the config a lifecycle manager does.
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node

from launch import LaunchDescription

SHARE = Path(__file__).parents[1]  # installed, or the source tree
ARGUMENTS = {
    "config": (
        str(SHARE / "config" / "default.yaml"),
        "YAML with the settings; `replay --config` takes the same file",
    ),
    "namespace": ("", "namespace of the node"),
    "use_sim_time": ("false", "take the time from /clock"),
    "data_dir": (
        "",
        "where journal and saved runs go; empty: as the config says, else ~/.ros/slam_backend/<node>",
    ),
    "rviz": ("false", "open RViz on what the node publishes"),
}
SHOWN = ("odometry", "path", "graph")  # topics of the node that config/backend.rviz shows


def generate_launch_description():
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, (value, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes)])


def nodes(context):
    """The processes, once the arguments are known."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    sim_time = {"use_sim_time": truth("use_sim_time", given)}
    data_dir = {"data_dir": given["data_dir"]} if given["data_dir"] else {}
    backend = LifecycleNode(
        package="slam_backend",
        executable="backend",
        name="slam_backend",
        namespace=given["namespace"],
        parameters=[given["config"], {**sim_time, **data_dir}],
        output="screen",
    )
    inside = f"/{given['namespace'].strip('/')}/slam_backend".replace("//", "/")
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", str(SHARE / "config" / "backend.rviz")],
        remappings=[(f"/slam_backend/{topic}", f"{inside}/{topic}") for topic in SHOWN],
        parameters=[sim_time],
    )
    return [backend, rviz] if truth("rviz", given) else [backend]


def truth(name, given):
    value = given[name].lower()
    if value not in ("true", "false"):
        raise ValueError(f"{name}:={given[name]}: write true or false")
    return value == "true"
