"""Where the shared data lies, and how graphs are compared: to the bit."""

from pathlib import Path

import gtsam
import pytest

SHARED = Path(__file__).parents[3] / "../shared/data"
GTSAM = Path(gtsam.findExampleDataFile("w100.graph")).parent


@pytest.fixture
def shared():
    if not SHARED.is_dir():
        pytest.skip("the shared data is not here")
    return SHARED


@pytest.fixture
def shipped():
    """The data that gtsam's wheel brings."""
    return GTSAM


@pytest.fixture
def file(tmp_path):
    """file(name, *lines) writes a text file and gives its path."""

    def write(name, *lines):
        path = tmp_path / name
        path.write_text("\n".join(lines) + "\n")
        return path

    return write


def bits(array):
    return None if array is None else (array.shape, array.dtype, array.tobytes())


def assert_same(a, b, but=()):
    """Equal graphs, every number to the bit, notes aside."""
    assert a.space == b.space
    for name in ("ids", "states", "stamps", "landmarks", "positions", "fixed"):
        if name not in but:
            assert bits(getattr(a, name)) == bits(getattr(b, name)), name
    for part in ("edges", "sightings", "priors", "landmark_priors"):
        for name in ("i", "j", "states", "information", "covariance", "stamps"):
            if part not in but and f"{part}.{name}" not in but and len(getattr(a, part)):
                assert bits(getattr(getattr(a, part), name)) == bits(getattr(getattr(b, part), name)), (
                    part,
                    name,
                )
    for name in ("i", "j", "to_landmark", "ranges", "variances", "stamps"):
        if "ranges" not in but and len(a.ranges):
            assert bits(getattr(a.ranges, name)) == bits(getattr(b.ranges, name)), name


@pytest.fixture
def same():
    return assert_same
