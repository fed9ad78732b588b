"""The file formats of pose graphs and trajectories: one module each, this table is the list of them."""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from ...core.errors import BadFile

if TYPE_CHECKING:
    from .posegraph import Convention, PoseGraph
    from .trajectory import Trajectory

Kind = Literal["graph", "trajectory"]


class Format(NamedTuple):
    """name: of the module here that has `read(path)` and `write(path, what)`. extensions: which of ours it answers to."""

    name: str
    kind: Kind
    extensions: tuple[str, ...]
    what: str

    @property
    def module(self) -> Any:
        """Imported when it is needed, so that listing formats costs nothing."""
        return import_module(f".{self.name}", __name__)


FORMATS: tuple[Format, ...] = (
    Format("g2o", "graph", (".g2o",), "g2o: SE2, SE3:QUAT, XY, TRACKXYZ"),
    Format("toro", "graph", (".graph", ".toro"), "TORO: VERTEX2/3, EDGE2/3"),
    Format("pyfg", "graph", (".pyfg",), "PyFG: poses, landmarks, ranges, priors"),
    Format("tum", "trajectory", (".tum", ".txt"), "TUM: stamp x y z qx qy qz qw"),
    Format("kitti", "trajectory", (".kitti",), "KITTI: 3x4 matrices, no stamps"),
    Format("euroc", "trajectory", (".euroc", ".euroc.csv"), "EuRoC: ns, x, y, z, qw, qx, qy, qz"),
    Format("csv", "trajectory", (".csv",), "CSV: stamp_ns,x,y,z,qx,qy,qz,qw"),
)
HEAD = 65536  # bytes that are looked at to tell the format of a file


def endings(kind: Kind) -> tuple[str, ...]:
    """The extensions of all formats of a kind."""
    return tuple(end for form in FORMATS if form.kind == kind for end in form.extensions)


def read_graph(path: Path, rotation_information: "Convention" = "gtsam") -> "PoseGraph":
    """A pose graph of any format, told by its content. BadFile: `<file>:<line>: <words>: <what is wrong>`.

    rotation_information: how 3-D information of a g2o file is meant (see g2o.py); other formats have but one meaning.
    """
    form = format_of(path)
    if form.kind != "graph":
        raise BadFile(f"{path}: holds a trajectory ({form.name}), not a pose graph")
    convention = {"rotation_information": rotation_information} if form.name == "g2o" else {}
    graph: PoseGraph = form.module.read(path, **convention)
    return graph


def write_graph(
    path: Path, graph: "PoseGraph", rotation_information: "Convention" = "gtsam"
) -> tuple[str, ...]:
    """Write in the format that the extension names; what that format cannot say is returned in words."""
    form = _named(path, "graph")
    convention = {"rotation_information": rotation_information} if form.name == "g2o" else {}
    left_out: tuple[str, ...] = form.module.write(path, graph, **convention)
    return left_out


def read_trajectory(path: Path) -> "Trajectory":
    """A trajectory of any format; the vertices of a graph file that states them count as one."""
    form = format_of(path)
    if form.kind == "graph":
        return _vertices_of(path, read_graph(path))
    trajectory: Trajectory = form.module.read(path)
    return trajectory


def write_trajectory(path: Path, trajectory: "Trajectory") -> tuple[str, ...]:
    """Write in the format that the extension names (.txt: TUM); what it cannot say is returned in words."""
    left_out: tuple[str, ...] = _named(path, "trajectory").module.write(path, trajectory)
    return left_out


def convert(source: Path, target: Path, *, rotation_information: "Convention" = "gtsam") -> str:
    """Read `source`, write `target`, say in one line what was done and what was lost. BadFile if it cannot be done."""
    form, written = format_of(source), _named(target, None)
    if target.exists() and target.samefile(source):
        raise BadFile(f"{target}: is the input itself, which would be overwritten; name another file")
    if form.kind == "trajectory":
        if written.kind == "graph":
            raise BadFile(
                f"{source}: a trajectory has no edges: it cannot become a pose graph ({target.name})"
            )
        trajectory = read_trajectory(source)
        size, notes = f"{len(trajectory.stamps)} poses", trajectory.notes
        left = write_trajectory(target, trajectory)
    else:
        graph = read_graph(source, rotation_information)
        size, notes = _size(graph, form), graph.notes
        if written.kind == "graph":
            left = write_graph(target, graph, rotation_information)
        else:
            trajectory = _vertices_of(source, graph)
            left = (f"{len(graph.edges)} edges", *write_trajectory(target, trajectory))
            notes = (*notes, *trajectory.notes)
        if "g2o" in (form.name, written.name) and graph.space == "3d" and len(graph.edges):
            notes = (*notes, f"3-D rotation information as {rotation_information} means it")
    lost = (f"left out: {', '.join(left)}",) if left else ()
    return "; ".join([f"{source} ({form.name}) -> {target} ({written.name}): {size}", *lost, *notes])


def format_of(path: Path) -> Format:
    """The format of an existing file: what its first lines look like, else what its extension says."""
    from .sniff import name_of_format

    known = {form.name: form for form in FORMATS}
    if name := name_of_format(path):
        return known[name]
    if path.suffix in {".txt", ".csv"} or (form := _by_extension(path, None)) is None:
        raise BadFile(f"{path}: is none of {', '.join(known)}: neither its content nor its name says so")
    return form


def _named(path: Path, kind: Kind | None) -> Format:
    form = _by_extension(path, kind)
    if form is None:
        known = [end for form in FORMATS for end in form.extensions if kind in {None, form.kind}]
        raise BadFile(f"{path}: cannot tell what to write from its name: end it in {', '.join(known)}")
    return form


def _by_extension(path: Path, kind: Kind | None) -> Format | None:
    """The format with the longest extension that the name ends in."""
    fits = [
        (len(end), form)
        for form in FORMATS
        for end in form.extensions
        if path.name.lower().endswith(end) and kind in {None, form.kind}
    ]
    return max(fits, key=lambda fit: fit[0])[1] if fits else None


def _vertices_of(path: Path, graph: "PoseGraph") -> "Trajectory":
    from .trajectory import Trajectory

    if graph.poses is None:
        raise BadFile(f"{path}: states no vertices, only edges: there is no trajectory in it")
    notes = () if graph.stamps is not None else ("no stamps in the file: vertex k has (k + 1) times 0.1 s",)
    return Trajectory(graph.stamps_at() if graph.stamps is None else graph.stamps, graph.poses, notes)


def _size(graph: "PoseGraph", form: Format) -> str:
    counts = (
        ("vertices", len(graph.ids)), ("edges", len(graph.edges)), ("landmarks", len(graph.landmarks)),
        ("sightings", len(graph.sightings)), ("ranges", len(graph.ranges)),
        ("priors", len(graph.priors) + len(graph.landmark_priors)),
    )  # fmt: skip
    return f"{graph.space} {form.kind}, " + ", ".join(f"{count} {name}" for name, count in counts if count)
