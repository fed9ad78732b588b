"""Configuration files: what they say is what runs; what they get wrong is said in one line with its place."""

from pathlib import Path

import pytest

from slam_backend.core.config import Config, config_from
from slam_backend.core.errors import BadConfig
from slam_backend.io.configfile import blaming, configured, load_config, override, write_yaml

GOOD = """
space: 2d
sources: [wheels, trees]
wheels: {kind: odometry, topic: /odom}
trees: {kind: landmark, topic: /trees, kernel: cauchy}
"""


@pytest.fixture
def yaml(tmp_path):
    def write(text, name="config.yaml"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


def said(path, settings=()):
    with pytest.raises(BadConfig) as caught:
        load_config(path, settings)
    line = str(caught.value)
    assert "\n" not in line
    return line


def test_a_file_is_read_and_written_back_the_same(yaml, tmp_path):
    config = load_config(yaml(GOOD))
    assert list(config.sources) == ["wheels", "trees"]
    assert config.sources["trees"].kernel == "cauchy"
    write_yaml(tmp_path / "again.yaml", config)
    assert load_config(tmp_path / "again.yaml") == config


def test_an_empty_file_is_the_default(yaml):
    assert load_config(yaml("")) == load_config(yaml("# nothing\n")) == Config()


def test_a_parameter_file_of_the_node_is_taken_as_well(yaml):
    indented = "".join(f"    {line}\n" for line in GOOD.splitlines())
    assert load_config(yaml(f"slam_backend:\n  ros__parameters:\n{indented}")) == load_config(yaml(GOOD))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("keyframe: {distance: 1}", ["keyframe", "did you mean 'keyframes'?"]),
        ("keyframes: {distanse: 1}", ["keyframes.distanse", "did you mean 'distance'?"]),
        (GOOD + "  # \nqqq: 1\n", ["qqq", "there is no such setting", "known: ", "space"]),
        (GOOD.replace("topic: /odom", "topik: /odom"), ["wheels", "topik", "did you mean 'topic'?"]),
        (GOOD.replace("kind: odometry", "kind: odometer"), ["wheels", "odometer", "'odometry'"]),
        (GOOD.replace("cauchy", "couchy"), ["trees", "kernel", "couchy", "'cauchy'"]),
        ("keyframes: {distance: 0.5m}", ["keyframes.distance", "'0.5m'"]),
        ("keyframes: {angle: 11.5}", ["keyframes.angle", "6.3", "11.5"]),
        ("keyframes: {distance: .nan}", ["keyframes.distance", "finite"]),
        ("settle: {lag: 200}", ["settle.lag", "60", "200"]),
        ("space: 4d", ["space", "'2d' or '3d'", "4d"]),
        ("sources: [wheels]", ["'wheels' is listed in 'sources' but not described"]),
        ("sources: [a@b]\na@b: {kind: odometry}", ["a@b"]),
        (GOOD.replace("odometry", "landmark"), ["no source drives the keyframes"]),
        ("- a\n- list\n", ["holds no settings (a list or a plain value"]),
        ("just words", ["holds no settings"]),
        ("extrinsics: {camera: [0, 0, 1]}", ["extrinsics.camera"]),
    ],
)  # fmt: skip
def test_what_a_file_gets_wrong_is_said_with_its_place(yaml, text, words):
    path = yaml(text)
    line = said(path)
    assert line.startswith(f"{path}: ")
    assert [word for word in words if word not in line] == [], line


@pytest.mark.parametrize(
    ("text", "place"),
    [("space: [2d\nwheels: 3\n", ":2:"), ("a: b: c\n", ":1:5"), ("\tspace: 2d\n", ":1:"), ("a: *b", ":1:4")],
)
def test_broken_syntax_is_said_with_line_and_column(yaml, text, place):
    path = yaml(text)
    assert said(path).startswith(f"{path}{place}")


def test_files_that_cannot_be_read_are_said(yaml, tmp_path):
    yaml(GOOD, "outdoor.yaml")
    assert f"did you mean '{tmp_path}/outdoor.yaml'?" in said(tmp_path / "outdor.yaml")
    assert "cannot be read" in said(tmp_path)
    (tmp_path / "picture.yaml").write_bytes(b"\x89PNG\xff\xfe\x00")
    assert "is not a text file" in said(tmp_path / "picture.yaml")


def test_settings_reach_every_depth_and_win_over_the_file(yaml):
    config = load_config(yaml(GOOD), ["keyframes.distance=2", "trees.kernel=huber", "space=3d"])
    assert config.keyframes.distance == 2
    assert config.sources["trees"].kernel == "huber"
    assert config.space == "3d"
    assert configured(config, ["isam2.relinearize_skip=1"]).isam2.relinearize_skip == 1
    assert configured(config, []) is config


@pytest.mark.parametrize("setting", ["keyframes.distance", "=3", "keyframes.distance=[1"])
def test_settings_that_are_none_are_said(yaml, setting):
    assert setting in said(yaml(GOOD), [setting])


def test_a_setting_that_does_not_exist_is_said():
    with pytest.raises(BadConfig, match=r"--set: isam2\.skip: there is no such setting"):
        configured(config_from({}), ["isam2.skip=1"])


def test_override_leaves_what_it_was_given():
    data = {"keyframes": {"distance": 1}}
    override(data, ["keyframes.distance=2"])
    assert data["keyframes"] == {"distance": 1}


def test_a_key_that_stands_twice_is_named_with_both_lines(tmp_path):
    """YAML forbids it; the second would win without a word."""
    path = tmp_path / "twice.yaml"
    path.write_text("space: 2d\nsources: [w]\nw: {kind: odometry}\nspace: 3d\n")
    with pytest.raises(
        BadConfig, match=r"twice.yaml:4:1: .*'space' stands here a second time; the first is in line 1"
    ):
        load_config(path)
    path.write_text("sources: [w]\nw:\n  kind: odometry\n  topic: /a\n  topic: /b\n")
    with pytest.raises(BadConfig, match=r"twice.yaml:5:3: .*'topic'"):
        load_config(path)


def test_what_a_file_asks_for_in_vain_is_said_with_its_name():
    path = Path("robot.yaml")
    with pytest.raises(BadConfig, match=r"^robot.yaml: no topic '/odom'$"), blaming(path):
        raise BadConfig("no topic '/odom'")
    with pytest.raises(BadConfig, match=r"^robot.yaml:3: bad$"), blaming(path):
        raise BadConfig("robot.yaml:3: bad")
    with pytest.raises(BadConfig, match=r"^no topic$"), blaming(None):
        raise BadConfig("no topic")
