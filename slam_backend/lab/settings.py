"""docs/settings.md, from the one place where each setting is written: `python -m slam_backend.lab.settings > docs/settings.md`."""

import sys
from collections.abc import Collection, Iterator
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from ..core.config import AnySource, Config, words_of

HEAD = """# Settings

Written by `make docs` from `core/config/`. In YAML the sources are named in a list and described at the top level; any setting can be given
on the command line as `--set name=value`, for instance `--set isam2.relinearize_skip=1`.
"""


def page() -> str:
    sections = {name: field for name, field in Config.model_fields.items() if _section(field)}
    lines = [HEAD, "## Top level", "", *_table(Config, skip={*sections, "sources"})]
    for name, field in sections.items():
        model = _section(field)
        assert model is not None
        lines += ["", f"## {name}", "", _sentence(model), "", *_table(model)]
    for model in get_args(get_args(AnySource)[0]):
        kind = model.model_fields["kind"].default
        lines += [
            "",
            f"## A source of kind `{kind}`",
            "",
            _sentence(model),
            "",
            *_table(model, skip={"kind"}),
        ]
    return "\n".join(lines) + "\n"


def _section(field: FieldInfo) -> type[BaseModel] | None:
    kind = field.annotation
    return kind if isinstance(kind, type) and issubclass(kind, BaseModel) else None


def _sentence(model: type[BaseModel]) -> str:
    return " ".join((model.__doc__ or "").split())


def _table(model: type[BaseModel], skip: Collection[str] = ()) -> Iterator[str]:
    yield "| setting | default | range | what |"
    yield "|---|---|---|---|"
    yield from _rows(model, skip)


def _rows(model: type[BaseModel], skip: Collection[str] = (), within: str = "") -> Iterator[str]:
    for name, field in model.model_fields.items():
        if name in skip:
            continue
        if below := _section(field):
            yield from _rows(below, within=f"{within}{name}.")
        else:
            yield f"| `{within}{name}` | {_default(field)} | {_range(field)} | {field.description or ''} |"


def _default(field: FieldInfo) -> str:
    value: Any = field.get_default(call_default_factory=True)
    if isinstance(value, tuple):
        return f"`[{', '.join(value)}]`"
    return "none" if value is None else f"`{str(value).lower() if isinstance(value, bool) else value or '-'}`"


def _range(field: FieldInfo) -> str:
    """Bounds, or the words that may stand there."""
    if words := words_of(field):
        return ", ".join(words)
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    bounds = [
        f"{sign} {value:g}"
        for rule in field.metadata
        for name, sign in signs.items()
        if (value := getattr(rule, name, None)) is not None
    ]
    return ", ".join(bounds)


if __name__ == "__main__":
    sys.stdout.write(page())
