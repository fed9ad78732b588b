"""The configuration: every mistake is one line that names the place and says what to do."""

import pytest
from pydantic import ValidationError

from slam_backend.core.config import (
    Config,
    LandmarkSource,
    OdometrySource,
    PoseSource,
    RelativeSource,
    Section,
    config_from,
    config_hash,
    config_to,
)
from slam_backend.core.errors import BadConfig

WHOLE = {
    "space": "2d",
    "sources": ["wheels", "trees"],
    "wheels": {"kind": "odometry", "topic": "/odom", "noise": "twist"},
    "trees": {"kind": "landmark", "topic": "/trees", "kernel": "cauchy", "kernel_width": 2.0},
    "keyframes": {"distance": 1.5, "time": 3},
    "extrinsics": {"laser": [1, 2, 3, 0, 0, 0.5]},
}


def complaint(data, origin="robot.yaml") -> str:
    with pytest.raises(BadConfig) as caught:
        config_from(data, origin)
    text = str(caught.value)
    assert text.startswith(f"{origin}: ")
    assert "\n" not in text
    return text.removeprefix(f"{origin}: ")


def test_a_file_becomes_settings_of_the_right_types():
    config = config_from(WHOLE)
    assert config.space == "2d"
    assert isinstance(config.sources["wheels"], OdometrySource)
    assert isinstance(config.sources["trees"], LandmarkSource)
    assert config.sources["trees"].kernel == "cauchy"
    assert config.extrinsics["laser"] == (1, 2, 3, 0, 0, 0.5)
    assert config.keyframes.time == 3.0
    assert config.settle.lag == 0.2


def test_nothing_at_all_is_a_configuration():
    assert config_from({}) == Config()
    assert Config().driver is None


def test_a_configuration_never_changes():
    with pytest.raises(ValidationError):
        Config().space = "2d"


@pytest.mark.parametrize("data", [{}, WHOLE, {**WHOLE, "sources": ["trees", "wheels"]}])
def test_what_is_written_reads_as_the_same_configuration(data):
    config = config_from(data)
    again = config_from(config_to(config))
    assert again == config
    assert list(again.sources) == list(config.sources)
    assert config_hash(again) == config_hash(config)


def test_the_hash_ignores_the_order_of_keys_but_not_what_they_say():
    turned = dict(
        reversed([(k, dict(reversed(v.items())) if isinstance(v, dict) else v) for k, v in WHOLE.items()])
    )
    assert config_hash(config_from(turned)) == config_hash(config_from(WHOLE))
    other = {**WHOLE, "wheels": {**WHOLE["wheels"], "max_speed": 99}}
    assert config_hash(config_from(other)) != config_hash(config_from(WHOLE))


def test_a_parameter_file_of_the_node_is_taken_as_well():
    assert config_from({"slam_backend": {"ros__parameters": WHOLE}}) == config_from(WHOLE)
    assert config_from({"/**": {"ros__parameters": {}}}) == Config()


# -- who drives --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kinds", "driver"),
    [
        (["relative", "odometry", "odometry"], "s1"),
        (["landmark", "relative", "relative"], "s1"),
        (["odometry"], "s0"),
        (["gnss", "relative"], "s1"),
        (["landmark", "pose", "gnss"], "s2"),
        (["landmark", "pose"], "s1"),
    ],
)
def test_the_first_odometry_drives_else_the_first_relative(kinds, driver):
    sources = {f"s{n}": {"kind": kind} for n, kind in enumerate(kinds)}
    assert config_from({"sources": list(sources), **sources}).driver == driver


def test_sources_without_a_driver_are_refused():
    assert "add one of kind odometry, imu, relative, gnss or pose" in complaint(
        {"sources": ["a"], "a": {"kind": "landmark"}}
    )


# -- mistakes ----------------------------------------------------------------------------------------------------


def wheels(**settings) -> dict:
    return {"sources": ["wheels"], "wheels": {"kind": "odometry", **settings}}


def test_up_to_three_mistakes_are_named_and_the_rest_counted():
    text = complaint({f"nonsense{n}": 1 for n in range(5)})
    assert [f"nonsense{n}: there is no such setting" in text for n in range(5)] == [
        True,
        True,
        True,
        False,
        False,
    ]
    assert text.endswith("; and 2 more")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({**wheels(), "wheel": {"kind": "landmark"}}, ["did you mean 'wheels'?"]),
        ({"sources": ["wheels"], "whels": {"kind": "odometry"}}, ["not described", "did you mean 'whels'?"]),
        ({"keyframe": {}}, ["keyframe:", "did you mean 'keyframes'?"]),
        ({"settle": {"lagg": 1}}, ["settle.lagg:", "did you mean 'lag'?"]),
        ({"settle": {"xyzzy": 1}}, ["settle.xyzzy:", "known: ahead, lag"]),
        (wheels(max_sped=3), ["wheels.max_sped:", "did you mean 'max_speed'?"]),
        ({**wheels(), "wheel": {"kind": "landmark"}}, ["wheel:", "there is no such setting"]),
    ],
)
def test_a_misspelt_key_is_named_with_its_place_and_the_right_spelling(data, said):
    text = complaint(data)
    assert all(part in text for part in said), text


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({"settle": {"lag": "200 ms"}}, ["settle.lag:", "'200 ms'"]),
        ({"keyframes": {"angle": 30}}, ["keyframes.angle:", "6.3", "30"]),
        ({"keyframes": {"distance": 0}}, ["keyframes.distance:", "greater than 0"]),
        ({"keyframes": {"distance": float("nan")}}, ["keyframes.distance:", "finite"]),
        (wheels(max_speed="3 m/s"), ["wheels.max_speed:", "'3 m/s'"]),
        (wheels(noise="modell"), ["wheels.noise:", "'model'", "'modell'"]),
        ({"space": "2D"}, ["space:", "'2d' or '3d'", "'2D'"]),
        ({"extrinsics": {"cam": [1, 2, 3]}}, ["extrinsics.cam.3:"]),
        ({"extrinsics": {"cam": [1, 2, 3, 0, 0, float("inf")]}}, ["extrinsics.cam.5:", "finite"]),
        ({"settle": 3}, ["settle:"]),
        (wheels(max_speed=-1, noise=3), ["wheels.noise", "; wheels.max_speed"]),
    ],
)
def test_a_wrong_value_is_named_with_its_place_and_what_it_said(data, said):
    text = complaint(data)
    assert all(part in text for part in said), text


def test_an_unknown_kind_lists_the_known_ones():
    text = complaint({"sources": ["a"], "a": {"kind": "odometri"}})
    assert text.startswith("a: ")
    assert all(kind in text for kind in ("'odometri'", "'odometry'", "'relative'", "'landmark'", "'pose'"))
    assert "kind" in complaint({"sources": ["a"], "a": {"topic": "/x"}})


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({"sources": ["a"]}, "'a' is listed in 'sources' but not described"),
        ({"sources": [{"a": {"kind": "odometry"}}]}, "a list of names"),
        ({"sources": [3]}, "a list of names"),
        ({"sources": "wheels"}, "write sources: [wheels]"),
        ({"sources": ["a"], "a": 3}, "a: "),
        ({"sources": ["a"], "a": None}, "a: "),
        ({"sources": ["a/b"], "a/b": {"kind": "odometry"}}, "'/' or '@'"),
        ({"sources": [""], "": {"kind": "odometry"}}, "must not be empty"),
        ({"sources": ["settle"], "settle": {"kind": "odometry"}}, "meaning of its own"),
        ({"sources": ["gauge"], "gauge": {"kind": "odometry"}}, "meaning of its own"),
        ({"node": {"ros__parameters": None}}, "node:"),
        ({3: 4}, "3:"),
    ],
)
def test_sources_that_cannot_be_are_one_clear_line(data, said):
    assert said in complaint(data)


def test_a_source_that_is_listed_twice_is_refused():
    with pytest.raises(BadConfig, match="names 'wheels' twice"):
        config_from({**wheels(), "sources": ["wheels", "wheels"]})


def test_sources_may_be_given_as_a_mapping_too():
    assert config_from({"sources": {"wheels": {"kind": "odometry"}}}) == config_from(wheels())


def settings_of(model):
    """Every setting below a model, sections opened."""
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            yield from settings_of(field.annotation)
        elif name != "kind":
            yield f"{model.__name__}.{name}", field


@pytest.mark.parametrize("model", [Config, OdometrySource, RelativeSource, LandmarkSource, PoseSource])
def test_every_setting_has_a_sentence(model):
    """YAML, --help and docs are derived from these."""
    assert [name for name, field in settings_of(model) if not field.description] == []
