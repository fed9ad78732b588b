"""A rosbag2 folder: `metadata.yaml`, if the recorder came to write it, and one or more storage files."""

from contextlib import ExitStack
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import yaml
import zstandard

from ...core.errors import BadFile
from .parts import Source

_ZSTD = b"\x28\xb5\x2f\xfd"  # how a compressed file begins
_ENDINGS = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")


class Folder(NamedTuple):
    """files: in the order of recording. compressed: each message is. damage: what the folder itself lacks."""

    files: tuple[Path, ...]
    compressed: bool
    damage: tuple[str, ...]


def read_folder(path: Path) -> Folder:
    """BadFile if there is no bag in it."""
    present = sorted((p for p in path.iterdir() if p.name.endswith(_ENDINGS)), key=_natural)
    damage: list[str] = []
    files, compressed = present, False
    metadata = path / "metadata.yaml"
    if metadata.exists():
        try:
            told = _metadata(metadata)
            compressed = str(told.get("compression_mode") or "").lower() == "message"
            listed = [path / PurePath(name).name for name in told["relative_file_paths"]]
            files = sorted((p for p in set(listed) if p.exists()), key=_natural)
            damage += [
                f"{p}: is named in metadata.yaml but missing: its messages are lost"
                for p in listed
                if p not in files
            ]
            damage += [f"{p}: is not named in metadata.yaml: not read" for p in present if p not in listed]
        except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError, AttributeError):
            damage.append(f"{metadata}: cannot be understood: read without it")
    if not files:
        raise BadFile(f"{path}: no .mcap or .db3 file in this folder; name the bag's own folder or file")
    return Folder(tuple(files), compressed, tuple(damage))


def _metadata(path: Path) -> dict[str, Any]:
    told: dict[str, Any] = yaml.safe_load(path.read_text())["rosbag2_bagfile_information"]
    return told


def _natural(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Sorts run_2 before run_10."""
    pieces = "".join(c if c.isdigit() else f" {c} " for c in path.name).split()
    return tuple((0, int(p), "") if p.isdigit() else (1, 0, p) for p in pieces)


def open_file(path: Path, stack: ExitStack) -> Source:
    """The file, or a temporary unpacked copy if it is compressed as a whole."""
    source = Source(path)
    stack.callback(source.close)
    if source.read(0, 4) != _ZSTD:
        return source
    copy = Path(stack.enter_context(TemporaryDirectory())) / path.stem
    whole = _unpack(path, copy)
    unpacked = Source(copy, str(path))
    stack.callback(unpacked.close)
    if not whole:
        unpacked.say("the compressed file is cut off or damaged: read as far as it goes, the rest is lost")
    return unpacked


def _unpack(path: Path, copy: Path) -> bool:
    """Decompress into `copy` as far as possible; False if that is not all."""
    decompressor = zstandard.ZstdDecompressor().decompressobj()
    with path.open("rb") as packed, copy.open("wb") as file:
        try:
            while not decompressor.eof and (piece := packed.read(1 << 16)):
                file.write(decompressor.decompress(piece))
        except zstandard.ZstdError:
            return False
    return decompressor.eof
