"""~/edit's parameters, as the arguments of a command."""

from collections.abc import Sequence
from typing import Any

from rcl_interfaces.msg import Parameter, ParameterType

from ..core.edits import edit_of, weights_of
from ..core.errors import BadConfig

LISTS = ("disable", "enable", "remove", "reweight")
DRY_RUN = "dry_run"


def edit_in(parameters: Sequence[Parameter]) -> tuple[dict[str, Any], bool]:
    """The arguments, and whether it is a dry run. BadConfig names what is unknown, given twice or of another type."""
    lists: dict[str, list[str]] = {}
    dry = False
    for parameter in parameters:
        name, value = parameter.name, parameter.value
        if name == DRY_RUN and value.type == ParameterType.PARAMETER_BOOL:
            dry = value.bool_value
        elif name not in LISTS or name in lists:
            known = f"known: {', '.join(LISTS)} (names of factors) and {DRY_RUN} (a bool), each once"
            raise BadConfig(f"parameter '{name}' of an edit; {known}")
        elif value.type == ParameterType.PARAMETER_STRING_ARRAY:
            lists[name] = list(value.string_array_value)
        elif value.type == ParameterType.PARAMETER_STRING:
            lists[name] = [value.string_value]
        else:
            raise BadConfig(f"parameter '{name}' of an edit is no string and no list of strings")
    weights = weights_of(lists.pop("reweight", []))
    arguments: dict[str, Any] = {**lists, "reweight": weights}
    edit_of(arguments)  # what no session could carry out is refused before it is journaled
    return arguments, dry
