"""What format a file has, told by its first lines."""

from pathlib import Path

from ...core.errors import BadFile
from . import HEAD, g2o, pyfg, toro
from .csv import HEADER
from .lines import read_bytes


def name_of_format(path: Path) -> str | None:
    """The name of a format whose line the file has among its first; None if no line looks like any. BadFile if unreadable."""
    head = read_bytes(path, HEAD)
    if not head.strip():
        raise BadFile(f"{path}: is empty")
    if b"\0" in head:
        raise BadFile(f"{path}: is a binary file, not text")
    for line in head.decode("utf-8-sig", errors="replace").split("\n"):
        if name := _name_of_line(line.strip()):
            return name
    return None


def _name_of_line(line: str) -> str | None:
    if "," in line:
        return _name_of_csv(line)
    words = line.partition("#")[0].split()
    if not words:
        return None
    if words[0] in {*g2o.TAGS, *pyfg.TAGS, *toro.TAGS}:
        named = any(
            word[:1].isalpha() for word in words[1:3]
        )  # PyFG has names where the others have integers
        return "pyfg" if named or words[0] not in {*g2o.TAGS, *toro.TAGS} else _owner(words[0])
    if all(map(_is_number, words)):
        return {8: "tum", 12: "kitti"}.get(len(words))
    return None


def _owner(tag: str) -> str:
    return "g2o" if tag in g2o.TAGS else "toro"


def _name_of_csv(line: str) -> str | None:
    words = [word.strip() for word in line.split(",")]
    if ",".join(words) == HEADER:
        return "csv"
    if len(words) >= 8 and (words[0].startswith("#timestamp") or all(map(_is_number, words))):
        return "euroc"
    return None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
