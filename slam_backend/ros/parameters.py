"""The configuration as ROS parameters: every setting once, declared from where it is written."""

from array import array
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import ParameterAlreadyDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter

from ..core.config import AnySource, Config, config_from, config_to, words_of
from ..core.errors import BadConfig

FOREIGN = ("use_sim_time", "qos_overrides", "start_type_description_service")  # rclpy's own parameters
HUGE = 1e308


def config_of(node: Node, start: Config) -> Config:
    """`start`, overridden by the parameters that the node was given. BadConfig names the setting."""
    given: dict[str, Any] = {}
    for name, parameter in node.get_parameters_by_prefix("").items():
        if name.split(".")[0] in FOREIGN:
            continue
        *path, leaf = name.split(".")
        section = given
        for part in path:
            section = section.setdefault(part, {})
            if not isinstance(section, dict):
                break
        if not isinstance(section, dict) or isinstance(section.get(leaf), dict):
            raise BadConfig(f"parameters: {name}: a setting cannot have a value and settings below it")
        value = parameter.value
        section[leaf] = (
            list(value) if isinstance(value, Sequence | array) and not isinstance(value, str) else value
        )
    data = config_to(start)
    for source in data["sources"]:
        if source not in given.get("sources", data["sources"]):
            del data[source]
    return config_from(_merged(data, given), "parameters")


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """What stands above holds."""
    merged = dict(below)
    for key, value in above.items():
        old = merged.get(key)
        merged[key] = (
            _merged(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
        )
    return merged


def declare(node: Node, config: Config) -> None:
    """Declare what was not given, and describe all: type, range, unit, sentence."""
    for name, (value, field) in settings(config).items():
        descriptor = _descriptor(field)
        try:
            node.declare_parameter(name, value, descriptor)
        except ParameterAlreadyDeclaredException:
            node.set_descriptor(name, descriptor)


def changed(config: Config, parameters: Sequence[Parameter]) -> tuple[Config, SetParametersResult]:
    """The configuration with live settings changed, or the reason why not."""
    known = settings(config)
    data = config_to(config)
    for parameter in parameters:
        if parameter.name not in known:
            continue  # of rclpy, or of nobody: not ours to judge
        *path, leaf = parameter.name.split(".")
        section = data
        for part in path:
            section = section[part]
        section[leaf] = parameter.value
    try:
        return config_from(data, "parameters"), SetParametersResult(successful=True)
    except BadConfig as error:
        return config, SetParametersResult(successful=False, reason=str(error))


def settings(config: Config) -> dict[str, tuple[Any, FieldInfo | None]]:
    """Dotted name -> value and the field that describes it."""
    found: dict[str, tuple[Any, FieldInfo | None]] = {}
    data = config_to(config)
    found["sources"] = (data["sources"], Config.model_fields["sources"])
    models = {model.model_fields["kind"].default: model for model in get_args(get_args(AnySource)[0])}
    for name, field in Config.model_fields.items():
        if name in ("sources", "extrinsics"):
            continue
        found.update(_leaves(name, data[name], field))
    for name in data["sources"]:
        fields = models[data[name]["kind"]].model_fields
        for key, value in data[name].items():
            found.update(_leaves(f"{name}.{key}", value, fields[key]))
    return found | {f"extrinsics.{frame}": (list(six), None) for frame, six in data["extrinsics"].items()}


def _leaves(name: str, value: Any, field: FieldInfo) -> Iterator[tuple[str, tuple[Any, FieldInfo | None]]]:
    kind = field.annotation
    if isinstance(value, Mapping) and isinstance(kind, type) and issubclass(kind, BaseModel):
        for key, below in value.items():
            yield f"{name}.{key}", (below, kind.model_fields[key])
    else:
        yield name, (value, field)


def _descriptor(field: FieldInfo | None) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(dynamic_typing=True, read_only=True)
    if field is None:
        return descriptor
    extra = field.json_schema_extra
    descriptor.read_only = not (isinstance(extra, dict) and extra.get("live"))
    descriptor.description = field.description or ""
    if words := words_of(field):
        descriptor.additional_constraints = f"one of {', '.join(words)}"
    low, high = _bound(field, "gt", "ge"), _bound(field, "lt", "le")
    if low is None and high is None:
        return descriptor
    if field.annotation is int:
        bounds = IntegerRange(from_value=int(low or 0), to_value=int(high if high is not None else 2**53))
        descriptor.integer_range = [bounds]
    else:
        top = float(high) if high is not None else HUGE
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low or 0.0), to_value=top)]
    return descriptor


def _bound(field: FieldInfo, *names: str) -> float | None:
    found = [
        getattr(rule, name)
        for rule in field.metadata
        for name in names
        if getattr(rule, name, None) is not None
    ]
    return found[0] if found else None
