"""The configuration as a YAML file, and settings from the command line."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml

from ..core.config import Config, config_from, config_to
from ..core.errors import BadConfig
from .formats.lines import reason_of


def load_config(path: Path | str, settings: Iterable[str] = ()) -> Config:
    """Read a YAML file and apply `key.subkey=value` settings. BadConfig names the file, the place and what to do."""
    return config_from(override(read_yaml(Path(path)), settings), str(path))


def configured(config: Config, settings: Iterable[str]) -> Config:
    """A Config with `key.subkey=value` settings applied."""
    settings = list(settings)
    return config_from(override(config_to(config), settings), "--set") if settings else config


def read_yaml(path: Path) -> dict[str, Any]:
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), _Loader)  # noqa: S506  # a SafeLoader
    except OSError as error:
        raise BadConfig(f"{path}: cannot be read: {reason_of(error)}{_nearby(path)}") from None
    except UnicodeDecodeError:
        raise BadConfig(f"{path}: is not a text file") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
        raise BadConfig(f"{place}: not valid YAML: {getattr(error, 'problem', error)}") from None
    if data is None:
        return {}
    if not isinstance(data, Mapping):
        raise BadConfig(f"{path}: holds no settings (a list or a plain value instead of 'name: value' lines)")
    return dict(data)


@contextmanager
def blaming(path: Path | None) -> Iterator[None]:
    """What a configuration asks for in vain is said with the name of its file."""
    try:
        yield
    except BadConfig as error:
        if path is None or str(path) in str(error):
            raise
        raise BadConfig(f"{path}: {error}") from None


class _Loader(yaml.SafeLoader):
    """YAML forbids a key that stands twice; PyYAML takes the last and says nothing."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        lines: dict[str, int] = {}
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value != "<<":
                here = key.start_mark.line + 1
                if key.value in lines:
                    what = f"'{key.value}' stands here a second time; the first is in line {lines[key.value]}: keep one"
                    raise yaml.constructor.ConstructorError(None, None, what, key.start_mark)
                lines[key.value] = here
        return super().construct_mapping(node, deep)


def write_yaml(path: Path, config: Config) -> None:
    path.write_text(yaml.safe_dump(config_to(config), sort_keys=False, allow_unicode=True), encoding="utf-8")


def override(data: dict[str, Any], settings: Iterable[str]) -> dict[str, Any]:
    """With `a.b=value` applied, the value in YAML's spelling."""
    data = dict(data)
    for setting in settings:
        name, equals, text = setting.partition("=")
        if not equals or not name:
            raise BadConfig(f"--set {setting}: write name=value, for instance isam2.relinearize_skip=1")
        section = data
        *path, key = name.strip().split(".")
        for part in path:
            below = section.get(part)
            section[part] = dict(below) if isinstance(below, Mapping) else {}
            section = section[part]
        try:
            section[key] = yaml.safe_load(text)
        except yaml.YAMLError:
            raise BadConfig(f"--set {setting}: '{text}' is not a value") from None
    return data


def _nearby(path: Path) -> str:
    names = [p.name for p in path.parent.glob("*.y*ml")] if path.parent.is_dir() else []
    close = get_close_matches(path.name, names, n=1)
    return f"; did you mean '{path.parent / close[0]}'?" if close else ""


def flat(tree: Mapping[str, Any], above: str = "") -> list[tuple[str, Any]]:
    """`a.b.c` and the value, of every setting, as `--set` names them."""
    found: list[tuple[str, Any]] = []
    for name, value in tree.items():
        found += flat(value, f"{above}{name}.") if isinstance(value, Mapping) else [(f"{above}{name}", value)]
    return found
