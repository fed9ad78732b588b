"""The configuration as ROS parameters: one YAML for node and replay, described, validated, changed live where it can be."""

from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter

from slam_backend.core.config import Config, config_from, config_to
from slam_backend.core.errors import BadConfig
from slam_backend.io.configfile import load_config
from slam_backend.ros.node import BackendNode
from slam_backend.ros.parameters import settings

FOR_ANY_NODE = """
/**:
  ros__parameters:
    space: 2d
    keyframes: {distance: 1.5, every: true}
    path: {rate: 5.0}
    extrinsics:
      camera: [0.3, 0.0, 0.5, 0.0, 0.0, 0.1]
    sources: [wheels, closures]
    wheels: {kind: odometry, topic: /odom, noise: twist}
    closures: {kind: relative, topic: closures, kernel: cauchy, sigma_translation: 0.25}
"""
PLAIN = {
    "space": "2d",
    "keyframes": {"distance": 1.5, "every": True},
    "path": {"rate": 5.0},
    "extrinsics": {"camera": [0.3, 0.0, 0.5, 0.0, 0.0, 0.1]},
    "sources": ["wheels", "closures"],
    "wheels": {"kind": "odometry", "topic": "/odom", "noise": "twist"},
    "closures": {"kind": "relative", "topic": "/closures", "kernel": "cauchy", "sigma_translation": 0.25},
}


@pytest.fixture
def node(context, tmp_path):
    """`node(YAML, *words, start=Config())`: a node of this process with a params file and further ROS arguments."""
    made = []

    def make(text="", *words, start=None):
        arguments = ["--ros-args", *words]
        if text:
            (tmp_path / "params.yaml").write_text(text)
            arguments += ["--params-file", str(tmp_path / "params.yaml")]
        made.append(BackendNode(start=start, context=context, cli_args=arguments))
        return made[-1]

    yield make
    for each in made:
        each.destroy_node()


def setting(node, name, value):
    (result,) = node.set_parameters([Parameter(name, value=value)])
    return result.successful, result.reason


@pytest.mark.parametrize("head", ["/**", "slam_backend", "/slam_backend", "/**/slam_backend"])
def test_a_params_file_says_what_the_plain_yaml_says(node, tmp_path, head) -> None:
    """Addressed to any node or to this one; and `replay --config` takes the same file."""
    text = FOR_ANY_NODE.replace("/**", head)
    assert node(text).config == config_from(PLAIN)
    (tmp_path / "same.yaml").write_text(text.replace("topic: closures", "topic: /closures"))
    assert load_config(tmp_path / "same.yaml") == config_from(PLAIN)


def test_a_params_file_for_another_node_says_nothing(node) -> None:
    assert node(FOR_ANY_NODE.replace("/**", "other")).config == Config()


def test_ros_arguments_stand_above_the_configuration(node) -> None:
    """`--config plain.yaml` is where the parameters start from; a number without a point is one all the same."""
    made = node(
        "", "-p", "keyframes.distance:=2", "-p", "wheels.topic:=/wheel/odom", "-p", "autostart:=false",
        start=config_from(PLAIN),
    )  # fmt: skip
    assert made.config.keyframes.distance == 2.0
    assert made.config.keyframes.every
    assert made.config.sources["wheels"].topic == "/wheel/odom"
    assert made.config.sources["closures"].kernel == "cauchy"
    assert not made.config.autostart
    assert made.get_parameter("wheels.noise").value == "twist"


def test_sources_given_as_parameters_replace_those_of_the_configuration(node) -> None:
    made = node("", "-p", "sources:=[legs]", "-p", "legs.kind:=odometry", start=config_from(PLAIN))
    assert {name: source.topic for name, source in made.config.sources.items()} == {"legs": "/legs"}


def test_topics_are_named_as_the_network_names_them(node) -> None:
    """Namespace and remapping included, since the journal will name them so."""
    made = node(FOR_ANY_NODE, "-r", "__ns:=/robot", "-r", "/odom:=wheel_odom")
    assert {name: source.topic for name, source in made.config.sources.items()} == {
        "wheels": "/robot/wheel_odom",
        "closures": "/robot/closures",
    }


def test_every_setting_is_declared_and_described(node) -> None:
    """With type, sentence, range or choice from the one place where it is written; only a few may change live."""
    made = node(FOR_ANY_NODE)
    names = list(settings(made.config))
    assert len(names) > 30
    told = dict(zip(names, made.describe_parameters(names), strict=True))
    for name, descriptor in told.items():
        assert made.has_parameter(name)
        if not name.startswith("extrinsics.") and not name.endswith(".kind"):
            assert len(descriptor.description) > 5, name
    assert {name for name in names if not told[name].read_only} == {"path.rate", "path.poses"}
    assert told["keyframes.distance"].floating_point_range[0].to_value == 1000
    assert told["isam2.extra_updates"].integer_range[0].to_value == 20
    assert told["closures.kernel"].additional_constraints.startswith("one of none, huber")
    assert (
        made.get_parameter("closures.sigma_rotation").value
        == config_to(made.config)["closures"]["sigma_rotation"]
    )


def test_live_settings_change_and_are_checked(node) -> None:
    made = node(FOR_ANY_NODE)
    assert setting(made, "path.rate", 10.0) == (True, "")
    assert setting(made, "path.poses", 50) == (True, "")
    assert (made.config.path.rate, made.config.path.poses) == (10.0, 50)
    assert setting(made, "path.rate", 2) == (True, "")
    for name, value in (("path.rate", 0.0), ("path.rate", 51.0), ("path.poses", 0), ("path.rate", "fast")):
        successful, reason = setting(made, name, value)
        assert not successful
        assert reason
        assert "\n" not in reason
    assert (made.config.path.rate, made.config.path.poses) == (2.0, 50)


def test_all_others_are_refused_with_a_reason(node) -> None:
    made = node(FOR_ANY_NODE)
    successful, reason = setting(made, "keyframes.distance", 3.0)
    assert not successful
    assert "read-only" in reason
    assert made.config.keyframes.distance == 1.5


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["-p", "keyframes.distanze:=1.0"], "keyframes.distanze: there is no such setting; did you mean 'distance'"),
        (["-p", "keyframes.distance:=-1.0"], "keyframes.distance: "),
        (["-p", "space:=4d"], "space: "),
        (["-p", "space.more:=1"], "space: "),
        (["-p", "path.rate.more:=1", "-p", "path.rate:=1.0"], "path.rate: a setting cannot have a value and settings below it"),
        (["-p", "sources:=[wheels]"], "source 'wheels' is listed in 'sources' but not described"),
        (["-p", "spaze:=2d"], "spaze: there is no such setting; did you mean 'space'"),
    ],
)  # fmt: skip
def test_a_setting_that_cannot_be_is_named(node, words, line) -> None:
    with pytest.raises(BadConfig) as told:
        node("", *words)
    assert str(told.value).startswith("parameters: ")
    assert line in str(told.value)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("case", ["misspelt", "no file", "no yaml", "no argument"])
def test_the_command_ends_with_one_line(start, tmp_path, case) -> None:
    """And exit code 2, whether we or ROS cannot read it."""
    (tmp_path / "params.yaml").write_text("/**: {ros__parameters: [")
    words = {
        "misspelt": ["-p", "spaze:=2d"],
        "no file": ["--params-file", tmp_path / "nothing.yaml"],
        "no yaml": ["--params-file", tmp_path / "params.yaml"],
        "no argument": ["--nonsense"],
    }[case]
    process = start("-m", "slam_backend", "run", "--data-dir", tmp_path / "data", "--", *words)
    assert process.wait(20) == 2
    lines = [line for line in process.output.splitlines() if line.startswith("slam-backend: ")]
    assert len(lines) == 1, process.output
    assert "Traceback" not in process.output
    assert not (tmp_path / "data").exists()


@pytest.mark.slow
def test_parameters_over_their_services(backend, peer) -> None:
    """As `ros2 param` does it: read, change, be refused."""
    settings = ["sources=[wheels]", "wheels={kind: odometry, topic: /odom}"]
    backend(None, "-p", "keyframes.distance:=2.5", settings=settings)
    names = ["keyframes.distance", "wheels.topic", "sources", "no.such"]
    got = peer.call(
        GetParameters, "/slam_backend/get_parameters", GetParameters.Request(names=names[:3])
    ).values
    assert (got[0].double_value, got[1].string_value, list(got[2].string_array_value)) == (
        2.5,
        "/odom",
        ["wheels"],
    )
    changes = [
        Parameter("path.rate", value=4.0),
        Parameter("keyframes.distance", value=1.0),
        Parameter("path.rate", value=-1.0),
    ]
    request = SetParameters.Request(parameters=[change.to_parameter_msg() for change in changes])
    results = peer.call(SetParameters, "/slam_backend/set_parameters", request).results
    assert [result.successful for result in results] == [True, False, False]
    assert all(result.reason for result in results[1:])
    got = peer.call(
        GetParameters, "/slam_backend/get_parameters", GetParameters.Request(names=["path.rate"])
    ).values
    assert got[0].double_value == 4.0


def test_the_example_files_are_taken(node) -> None:
    """Those that the package ships, by the node as by replay."""
    for path in sorted((Path(__file__).parents[2] / "config").glob("*.yaml")):
        config = load_config(path)
        assert node("", start=config).config.keyframes == config.keyframes
