"""A damaged journal: whole records in their order, or words about what is missing; never something else in silence."""

import sqlite3

import numpy as np
import pytest

from bench.damage import LOG, NAME, TAIL, content_of, cut, ends, flip, is_whole_commit, lies, read, write
from slam_backend.io.storage.wal import torn

PAGE = 4096  # of SQLite


@pytest.fixture(scope="module", params=["closed", "crashed"])
def journal(request, tmp_path_factory):
    """Its files and its records; crashed: nearly all of it lies in the write-ahead log."""
    folder = tmp_path_factory.mktemp(request.param)
    whole = write(folder, 400, closed=request.param == "closed")
    assert len(whole) == 400
    assert (folder / LOG).exists() == (request.param == "crashed")
    return content_of(folder), whole


def test_whole_it_is_read_without_a_word(journal, tmp_path) -> None:
    content, whole = journal
    name = max(content, key=lambda name: len(content[name]))
    assert read(cut(content, name, len(content[name]), tmp_path / "copy")) == (whole, [])


def test_cut_anywhere_it_is_its_beginning(journal, tmp_path) -> None:
    content, whole = journal
    name = max(content, key=lambda name: len(content[name]))
    size, shorter = len(content[name]), 0
    for at in np.random.default_rng(1).integers(max(size - TAIL, 0), size, 40):
        found, damage = read(cut(content, name, int(at), tmp_path / "cut"))
        assert not lies(found, damage, whole) or is_whole_commit(found, whole)
        shorter += len(found) < len(whole)
    assert shorter > 20


def test_cut_anywhere_it_is_read_to_the_last_whole_record(journal, tmp_path) -> None:
    """On a whole page with its checksum on another (which is written after those of its commit), or in a whole commit of the log."""
    content, whole = journal
    name = max(content, key=lambda name: len(content[name]))
    size, last, left_out = len(content[name]), ends(content, whole), []
    for at in np.random.default_rng(4).integers(max(size - TAIL, 0), size, 20):
        path = cut(content, name, int(at), tmp_path / "cut")
        found, _ = read(path)
        assert found == whole[: len(found)]
        if name == LOG:
            (held,) = sqlite3.connect(path).execute("SELECT count(*) FROM messages").fetchone()
            assert len(found) == held
        else:
            left_out.append(int((last <= at // PAGE * PAGE).sum()) - len(found))
    assert np.median(left_out or [0]) == 0
    assert max(left_out, default=0) <= 10


def test_a_flipped_byte_is_found_or_does_no_harm(journal, tmp_path) -> None:
    content, whole = journal
    rng, harmed = np.random.default_rng(2), 0
    for _ in range(40):
        found, damage = read(flip(content, rng, tmp_path / "flip"))
        assert not lies(found, damage, whole)
        harmed += found != whole
    assert harmed > 20


def test_what_comes_after_a_damaged_page_is_still_read(tmp_path) -> None:
    """A page of noise in the middle costs the records that lie on it."""
    whole = write(tmp_path, 400, closed=True)
    raw = bytearray((tmp_path / NAME).read_bytes())
    page = PAGE * (len(raw) // PAGE // 2)
    raw[page : page + PAGE] = np.random.default_rng(0).bytes(PAGE)
    (tmp_path / NAME).write_bytes(raw)
    found, damage = read(tmp_path / NAME)
    assert not lies(found, damage, whole)
    assert 380 <= len(found) < 400
    assert any("records are missing or damaged, and left out: rows " in line for line in damage)


def test_a_log_is_whole_up_to_its_last_commit(journal, tmp_path) -> None:
    """As SQLite has it, whose own count of pages is the measure."""
    content, _ = journal
    if LOG not in content:
        pytest.skip("there is no log")
    page, rng = PAGE + 24, np.random.default_rng(3)
    for at in (len(content[LOG]), *rng.integers(32, len(content[LOG]), 15)):
        path = cut(content, LOG, int(at), tmp_path / "log")
        said = torn(path.with_name(LOG))
        _, used, _ = sqlite3.connect(path).execute("PRAGMA wal_checkpoint").fetchone()
        assert bool(said) == (32 + max(used, 0) * page < at)
    bent = bytearray(content[LOG])
    bent[20] ^= 1  # a salt in the log's own header
    path.with_name(LOG).write_bytes(bent)
    assert "the log's header is damaged" in torn(path.with_name(LOG))
