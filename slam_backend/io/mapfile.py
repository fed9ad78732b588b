"""What another session needs to go on in the map of a run, to the bit (map.npz).

    version, space, revision, run_hash
    graph, values                   bytes: the kept factors and every variable, as gtsam itself writes them
    ids, kinds, stamps, ends        (F,) of the factors, in the same order; ends (F, 2), -1: none
    moving, motions, spreads        (M,) factors with a motion beside them, its numbers (M, k) and its covariance (M, d, d)
    keyframe_stamps                 (K,) by index
    names, name_keys                (L,) of the landmarks
    keys, parts                     (V,) the component of each variable
    seen, seen_from, seen_at        (S,) variables other than keyframes, the first pose that each was tied to, and (bytes) values from there
    track_sizes, track_stamps, track_numbers, track_strands, track_covariances    the odometry of each session, one after the other
    origin                          of the earth: latitude, longitude, altitude; (0,) for a map without fixes
    online_stamps, online_sevens    what was believed of each keyframe when it was newest

graph.g2o cannot serve: it has no gauges, kernels, ids, bearings. gtsam's own text keeps every number to the bit.
"""

import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import gtsam
import numpy as np

from ..core.errors import BadFile
from ..core.graph import Factor, Motion, keyframe
from ..core.keyframes import Samples
from ..core.sessions import SavedMap
from ..core.space import SPACES
from ..core.trajectory import Trajectory
from ..core.variables import value_in

NAME = "map.npz"
VERSION = 2


def write_map(path: Path, saved: SavedMap) -> None:
    graph = gtsam.NonlinearFactorGraph()
    for factor in saved.factors:
        graph.add(factor.factor)
    stamps = [k.stamp for k in sorted(saved.keyframes, key=lambda k: k.index)]
    seen = list(saved.sighted.items())
    np.savez_compressed(
        path,
        version=VERSION, space=saved.space, revision=saved.revision, run_hash=saved.run_hash,
        origin=np.array(saved.origin or (), dtype=np.float64),
        graph=_packed(graph.serialize()), values=_packed(saved.values.serialize()),
        ids=_texts(factor.id for factor in saved.factors),
        kinds=_texts(factor.kind for factor in saved.factors),
        stamps=_integers(factor.stamp for factor in saved.factors),
        ends=_integers(stamp for factor in saved.factors for stamp in factor.stamps or (-1, -1)).reshape(-1, 2),
        **_motions(saved),
        keyframe_stamps=_integers(stamps),
        names=_texts(saved.landmarks), name_keys=_keys(saved.landmarks.values()),
        keys=_keys(saved.parts), parts=_keys(saved.parts.values()),
        seen=_keys(key for key, _ in seen), seen_from=_keys(pose for _, (pose, _) in seen),
        seen_at=_packed(_values((key, value) for key, (_, value) in seen).serialize()),
        track_sizes=_integers(len(track.stamps) for track in saved.tracks),
        track_stamps=np.concatenate([track.stamps for track in saved.tracks]),
        track_numbers=np.concatenate([track.numbers for track in saved.tracks]),
        track_strands=np.concatenate([track.strands for track in saved.tracks]),
        track_covariances=_covariances(saved.tracks),
        online_stamps=saved.online.stamps, online_sevens=saved.online.sevens,
    )  # fmt: skip


def read_map(run: Path) -> SavedMap:
    """Of a run directory. BadFile if it has none, or it is damaged."""
    path = run / NAME
    if not path.exists():
        what = (
            "there is no such directory"
            if not run.is_dir()
            else f"has no {NAME}; replay its inputs again to get one"
        )
        raise BadFile(f"{run}: {what}" if run.is_dir() else f"{run}: {what}; name what `replay --out` wrote")
    try:
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        if int(arrays["version"]) != VERSION:
            raise BadFile(f"{path}: is of version {arrays['version']}; known is {VERSION}")
        return _map(arrays)
    except OSError as error:
        raise BadFile(f"{path}: cannot be read: {error.strerror or error}") from None
    except (
        TypeError,
        ValueError,
        KeyError,
        IndexError,
        EOFError,
        RuntimeError,
        BadZipFile,
        zlib.error,
    ) as error:
        raise BadFile(f"{path}: is damaged: {(str(error).splitlines() or [''])[0][:160]}") from None


def _map(arrays: dict[str, Any]) -> SavedMap:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.deserialize(_unpacked(arrays["graph"]))
    values.deserialize(_unpacked(arrays["values"]))
    rows = zip(
        arrays["ids"].tolist(),
        arrays["kinds"].tolist(),
        arrays["stamps"].tolist(),
        arrays["ends"].tolist(),
        strict=True,
    )
    factors = []
    space = SPACES[str(arrays["space"])]
    moving = zip(arrays["moving"].tolist(), arrays["motions"].tolist(), arrays["spreads"], strict=True)
    motions = {n: Motion(space.pose_of_numbers(numbers), spread) for n, numbers, spread in moving}
    for n, (id_, kind, stamp, ends) in enumerate(rows):
        factor = graph.at(n)
        stamps = None if ends[0] < 0 else tuple(ends)
        factors.append(Factor(id_, kind, factor, tuple(factor.keys()), stamp, stamps, motions.get(n)))
    parts = dict(zip(arrays["keys"].tolist(), arrays["parts"].tolist(), strict=True))
    if set(parts) != set(values.keys()) or not parts:
        raise ValueError("its variables do not fit its factors")
    seen = gtsam.Values()
    seen.deserialize(_unpacked(arrays["seen_at"]))
    sighted = zip(arrays["seen"].tolist(), arrays["seen_from"].tolist(), strict=True)
    return SavedMap(
        space.name, tuple(factors), values,
        tuple(keyframe(n, stamp) for n, stamp in enumerate(arrays["keyframe_stamps"].tolist())),
        dict(zip(arrays["names"].tolist(), arrays["name_keys"].tolist(), strict=True)), parts,
        {key: (pose, value_in(space, seen, key)) for key, pose in sighted},
        _tracks(arrays), Trajectory(arrays["online_stamps"], arrays["online_sevens"]),
        int(arrays["revision"]), str(arrays["run_hash"]),
        tuple(arrays["origin"].tolist()) or None if "origin" in arrays else None,
    )  # fmt: skip


def _motions(saved: SavedMap) -> dict[str, Any]:
    space = SPACES[saved.space]
    found = [(n, f.motion) for n, f in enumerate(saved.factors) if f.motion is not None]
    size = space.dimension
    return {
        "moving": _integers(n for n, _ in found),
        "motions": np.array([space.numbers(motion.pose) for _, motion in found]),
        "spreads": np.array([motion.covariance for _, motion in found]).reshape(-1, size, size),
    }


def _tracks(arrays: dict[str, Any]) -> tuple[Samples, ...]:
    ends = np.cumsum(arrays["track_sizes"])[:-1]
    stamps, numbers, strands = (
        np.split(arrays[f"track_{name}"], ends) for name in ("stamps", "numbers", "strands")
    )
    covariances = arrays["track_covariances"]
    each = np.split(covariances, ends) if len(covariances) else [covariances] * len(stamps)
    return tuple(Samples(*parts) for parts in zip(stamps, numbers, each, strands, strict=True))


def _covariances(tracks: tuple[Samples, ...]) -> Any:
    """All sessions have them, or none is kept."""
    every = [track.covariances for track in tracks]
    return np.concatenate(every) if all(len(each) for each in every) else np.zeros(0)


def _values(pairs: Iterable[tuple[int, Any]]) -> gtsam.Values:
    values = gtsam.Values()
    for key, value in pairs:
        values.insert(key, value)
    return values


def _packed(text: str) -> Any:
    return np.frombuffer(text.encode(), dtype=np.uint8)


def _unpacked(numbers: Any) -> str:
    return bytes(numbers.tobytes()).decode()


def _texts(texts: Any) -> Any:
    return np.array(list(texts), dtype=np.str_)


def _integers(numbers: Any) -> Any:
    return np.array(list(numbers), dtype=np.int64)


def _keys(numbers: Any) -> Any:
    return np.array(list(numbers), dtype=np.uint64)
