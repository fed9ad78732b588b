"""Text files as rows of words that know where they stand, so that every complaint names file, line and word."""

import errno
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation, localcontext
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.errors import BadFile
from ...core.measurement import SECOND, Array, format_stamp

HINTS: Mapping[int, str] = {
    errno.ENOENT: "check the path",
    errno.EISDIR: "name a file in it",
    errno.ENOTDIR: "check the path",
    errno.EACCES: "check its permissions",
    errno.EROFS: "write somewhere else",
    errno.ENOSPC: "make room, or write somewhere else",
}
Ids = NDArray[np.uint64]
Ranks = NDArray[np.int64]
Stamps = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Rows:
    """Lines of one kind. `numbers` their line numbers, from 1; `words` what stands in each of them."""

    path: Path
    numbers: list[int]
    words: list[list[str]]
    ended: bool = True  # the last line, with a line feed: else the file may have been cut in it

    def __len__(self) -> int:
        return len(self.words)

    def bad(self, row: int, word: str, what: str) -> BadFile:
        """The error for row `row`: `<file>:<line>: <word>: <what is wrong>`."""
        return BadFile(f"{self.path}:{self.numbers[row]}: {shown(word)}: {what}")

    def bad_line(self, row: int, what: str, words: int = 3) -> BadFile:
        """The same about a whole line, of which the first words are shown."""
        return self.bad(row, " ".join(self.words[row][:words]), what)

    def expect(self, count: int, layout: str) -> "Rows":
        """Itself, if every row has `count` words."""
        for row, words in enumerate(self.words):
            if len(words) != count:
                raise self.bad_line(row, f"{len(words)} words where {count} are needed: {layout}")
        return self

    def floats(self, start: int, stop: int) -> Array:
        """Words start..stop of each row as (len, stop - start) finite numbers."""
        flat = [word for words in self.words for word in words[start:stop]]
        joined = " ".join(flat)
        array = None
        if "_" not in joined and joined.isascii():  # float() would take 1_000 and digits of other scripts
            with suppress(ValueError):
                array = np.array(list(map(float, flat)), dtype=np.float64)
        if array is None:
            raise self._first(flat, stop - start, _is_number, "is not a number")
        if not np.isfinite(array).all():
            raise self._first(flat, stop - start, _is_finite, "is not a finite number")
        return array.reshape(len(self.words), stop - start)

    def ids(self, column: int) -> Ids:
        """A word of each row as unsigned 64-bit integers."""
        flat = [words[column] for words in self.words]
        if not all(map(_is_id, flat)):
            raise self._first(flat, 1, _is_id, "is not an id (an integer from 0 to 2^64 - 1)")
        return np.array(list(map(int, flat)), dtype=np.uint64)

    def seconds(self, column: int) -> Stamps:
        """A word of each row, decimal seconds, as nanoseconds: exact, never through a float."""
        return self.integers(column, parse_seconds, "is not a time in seconds")

    def nanoseconds(self, column: int) -> Stamps:
        return self.integers(column, _parse_nanoseconds, "is not a time in whole nanoseconds")

    def integers(self, column: int, parse: Callable[[str], int], what: str) -> Stamps:
        values = []
        for row, words in enumerate(self.words):
            try:
                values.append(parse(words[column]))
            except ValueError:
                raise self.bad(row, words[column], what) from None
        return np.array(values, dtype=np.int64)

    def _first(self, flat: list[str], width: int, good: Callable[[str], bool], what: str) -> BadFile:
        index = next(index for index, word in enumerate(flat) if not good(word))
        return self.bad(index // width, flat[index], what)


def read_rows(path: Path, separator: str | None = None, comment: str = "#") -> Rows:
    """Every line that holds anything but a comment, cut into words (at `separator`; none: at white space)."""
    numbers, words = [], []
    text = read_text(path)
    for number, line in enumerate(text.split("\n"), start=1):
        body = line.partition(comment)[0] if comment in line else line
        cut = body.split() if separator is None else [word.strip() for word in body.split(separator)]
        if cut and cut != [""]:
            numbers.append(number)
            words.append(cut)
    if not words:
        raise BadFile(f"{path}: holds nothing but comments and white space")
    return Rows(path, numbers, words, text.endswith("\n"))


def by_tag(rows: Rows, known: Iterable[str]) -> tuple[Mapping[str, Rows], tuple[str, ...]]:
    """Rows by their first word, a `Rows` for each known tag; and a note on every tag that is not known."""
    groups = {tag: Rows(rows.path, [], []) for tag in known}
    strange: dict[str, list[int]] = {}
    for number, words in zip(rows.numbers, rows.words, strict=True):
        group = groups.get(words[0])
        if group is None:
            strange.setdefault(words[0], []).append(number)
        else:
            group.numbers.append(number)
            group.words.append(words)
    if not any(groups.values()):
        raise rows.bad(0, rows.words[0][0], f"no line of this file has a known tag ({', '.join(groups)})")
    notes = [
        f"{len(lines)} lines '{shown(tag)}' skipped (the first is line {lines[0]})"
        for tag, lines in strange.items()
    ]
    if not rows.ended:
        notes.append(
            f"line {rows.numbers[-1]} ends without a line feed: if the file was cut there, its last number is wrong"
        )
    return groups, tuple(notes)


def read_text(path: Path) -> str:
    """A text file as one string; BadFile if it is missing, empty or binary."""
    data = read_bytes(path)
    if b"\0" in data:
        raise BadFile(f"{path}: is a binary file, not text")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise BadFile(f"{path}:{line}: byte 0x{data[error.start]:02x}: is not text (UTF-8)") from None
    if not text.strip():
        raise BadFile(f"{path}: is empty")
    return text


def read_bytes(path: Path, limit: int = -1) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(limit)
    except (OSError, ValueError) as error:  # ValueError: a path with a null byte
        raise BadFile(f"{path}: cannot be read: {reason_of(error)}") from None


def write_lines(path: Path, lines: Iterable[str]) -> None:
    text = "".join(f"{line}\n" for line in lines)
    try:
        path.write_text(text, encoding="utf-8", newline="\n")
    except (OSError, ValueError) as error:
        raise BadFile(f"{path}: cannot be written: {reason_of(error)}") from None


def exact(values: Array) -> list[str]:
    """Each row of (n, k) finite numbers as words that read back to the same bits."""
    return [" ".join(map(repr, row)) for row in values.tolist()]


def parse_seconds(text: str) -> int:
    """Decimal seconds (`12.5`, `1.3e9`, `-0.25`) to nanoseconds, digits past the ninth rounded. ValueError if it is none."""
    whole, dot, fraction = text.partition(".")
    if len(whole) <= 9 + whole.startswith("1") and len(fraction) <= 9 and text.isascii() and whole.isdigit():
        if fraction.isdigit():
            return int(whole) * SECOND + int(fraction.ljust(9, "0"))
        if not dot:
            return int(whole) * SECOND
    return _parse_decimal(text, SECOND)


def written_seconds(stamps: Stamps) -> list[str]:
    return [format_stamp(stamp) for stamp in stamps.tolist()]


def shown(word: str) -> str:
    """A word of the file as an error line can bear it: short and printable."""
    short = word if len(word) <= 40 else f"{word[:37]}..."
    return short if short.isprintable() else ascii(short)[1:-1]


def _parse_nanoseconds(text: str) -> int:
    if len(text) <= 18 and text.isascii() and text.isdigit():
        return int(text)
    return _parse_decimal(text, 1)


def _parse_decimal(text: str, scale: int) -> int:
    try:
        value = Decimal(text)
    except InvalidOperation:
        raise ValueError(text) from None
    if "_" in text or not text.isascii() or not value.is_finite() or value.adjusted() > 19:
        raise ValueError(text)
    with localcontext() as context:
        context.prec = 60
        scaled = value * scale
        rounded = scaled.to_integral_value()
    if abs(rounded) >= 2**63 or (scale == 1 and rounded != scaled):
        raise ValueError(text)
    return int(rounded)


def _is_id(word: str) -> bool:
    return word.isdigit() and word.isascii() and len(word) <= 20 and int(word) < 2**64


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word and word.isascii()


def _is_finite(word: str) -> bool:
    return bool(np.isfinite(float(word)))


def reason_of(error: OSError | ValueError) -> str:
    """Why a file cannot be read or written, and what to do where that is plain."""
    why = (error.strerror if isinstance(error, OSError) else None) or str(error)
    hint = HINTS.get(error.errno or 0) if isinstance(error, OSError) else None
    return f"{why}; {hint}" if hint else why
