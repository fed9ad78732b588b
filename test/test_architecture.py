"""Who may import whom, and what the core must never touch; held by reading the source of every module."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from slam_backend.cli import VERBS

PACKAGE = Path(__file__).parents[1] / "slam_backend"

MAY_IMPORT = {  # layer -> layers
    "core": {"core"},
    "perception": {"core", "perception"},
    "io": {"core", "io"},
    "lab": {"core", "perception", "io", "lab"},
    "ros": {"core", "perception", "io", "ros"},
    "cli": {"core", "perception", "io", "lab", "cli"},
}
MAY_IMPORT_ALSO = {  # layer of the importer -> modules outside its row
    "io": "slam_backend.perception.decode",  # images and clouds become measurements like everything else
}
ROOT = {"slam_backend", "slam_backend.__main__"}  # the public names and `python -m`: not below any layer
ONLY_LAZILY_FROM = {"ros": {"slam_backend.cli.run", "slam_backend.cli.play"}}

CORE_LIBRARIES = {"numpy": "slam_backend.core", "gtsam": "slam_backend.core"} | {
    "pydantic": "slam_backend.core.config",
    "pymap3d": "slam_backend.core.sensors.gnss",
}
PURE = {  # modules of the standard library that know no clock, file, process, thread or chance
    *(
        "__future__",
        "abc",
        "array",
        "bisect",
        "collections",
        "contextlib",
        "copy",
        "dataclasses",
        "difflib",
        "enum",
    ),
    *("fractions", "functools", "hashlib", "heapq", "itertools", "json", "math", "operator", "re", "string"),
    *("struct", "types", "typing"),
}
IMPURE_CALLS = {"__import__", "breakpoint", "eval", "exec", "input", "open", "print"}
IMPURE_ATTRIBUTES = {
    "numpy": {"fromfile", "genfromtxt", "load", "loadtxt", "memmap", "save", "savetxt", "savez"},
    "gtsam": {"findExampleDataFile", "load2D", "load3D", "readG2o", "writeG2o"},
}
SEEDED = {"Generator", "PCG64", "Philox", "SeedSequence", "default_rng"}  # of numpy.random
ROS_PACKAGES = {"ament_index_python", "builtin_interfaces", "launch", "launch_ros", "rcl_interfaces", "rclpy"}
HEAVY = {"gtsam", "matplotlib", "numpy", "pydantic", "rclpy", "rosbags"}


def modules() -> Iterator[tuple[str, str, bool]]:
    """(dotted name, source, whether it is a package) of every module that ships."""
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        is_package = parts[-1] == "__init__"
        yield ".".join(parts[:-1] if is_package else parts), path.read_text(), is_package


def complaints(module: str, source: str, is_package: bool = False) -> list[str]:
    """What `module` does that it must not, one line each."""
    tree = ast.parse(source)
    names, found = aliases(tree), []
    for node, lazy in walk(tree):
        for target in targets(node, module, is_package):
            found += [f"{module}:{node.lineno}: {bad}" for bad in judge(module, target, lazy)]
        if layer_of(module) == "core":
            found += [f"{module}:{node.lineno}: {bad}" for bad in impurities(node, names)]
    return found


def walk(node: ast.AST, lazy: bool = False) -> Iterator[tuple[ast.AST, bool]]:
    """Every node, and whether it lies inside a function."""
    yield node, lazy
    inside = lazy or isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
    for child in ast.iter_child_nodes(node):
        yield from walk(child, inside)


def targets(node: ast.AST, module: str, is_package: bool) -> list[str]:
    """Absolute names of the modules that an import statement reaches (with the imported name, where it may be one)."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if not isinstance(node, ast.ImportFrom):
        return []
    parts = module.split(".")
    up = node.level - is_package  # one dot means the package itself
    parents = parts[: len(parts) - up] if node.level else []
    origin = ".".join((*parents, *([node.module] if node.module else [])))
    return [f"{origin}.{alias.name}" for alias in node.names]


def judge(module: str, target: str, lazy: bool) -> Iterator[str]:
    here, top = layer_of(module), target.partition(".")[0]
    if top == "slam_backend":
        yield from judge_layer(module, target, lazy)
    elif is_ros(top) and here != "ros":
        yield f"imports {top}, which only slam_backend.ros may"
    elif here == "core" and top not in PURE:
        home = CORE_LIBRARIES.get(top)
        if home is None or not within(module, home):
            yield f"imports {top}, which has no place in {'the core' if home is None else 'this file'}"


def judge_layer(module: str, target: str, lazy: bool) -> Iterator[str]:
    here, there = layer_of(module), layer_of(target)
    if module in ROOT:
        return
    if there not in MAY_IMPORT:
        yield f"imports {target} from the package's root, which imports everything"
    elif there in ONLY_LAZILY_FROM and here != there:
        if module not in ONLY_LAZILY_FROM[there] or not lazy:
            yield f"imports {target}, which only a function of {' or '.join(sorted(ONLY_LAZILY_FROM[there]))} may"
    elif there not in MAY_IMPORT.get(here, set()) and not within(
        target, MAY_IMPORT_ALSO.get(here, "nothing")
    ):
        yield f"imports {target}, and {here} may not import {there}"


def impurities(node: ast.AST, names: dict[str, str]) -> Iterator[str]:
    """Files, output and chance that need no import of their own."""
    if isinstance(node, ast.Name) and node.id in IMPURE_CALLS:
        yield f"uses {node.id}"
    bare = isinstance(node, ast.Call) and not node.args and not node.keywords
    if bare and dotted(node.func, names) == "numpy.random.default_rng":
        yield "calls default_rng without a seed"
    if isinstance(node, (ast.Attribute, ast.Name)):
        top, _, rest = dotted(node, names).partition(".")
        if rest in IMPURE_ATTRIBUTES.get(top, ()):
            yield f"uses {top}.{rest}"
        first, _, name = rest.partition(".")
        if top == "numpy" and first == "random" and name and name not in SEEDED:
            yield f"uses the global generator of numpy: {rest}"


def aliases(tree: ast.AST) -> dict[str, str]:
    """Local name -> what it stands for, of everything imported."""
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {
                a.asname or a.name.split(".")[0]: a.name if a.asname else a.name.split(".")[0]
                for a in node.names
            }
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names |= {a.asname or a.name: f"{node.module}.{a.name}" for a in node.names}
    return names


def dotted(node: ast.AST, names: dict[str, str]) -> str:
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value, names)}.{node.attr}"
    return names.get(node.id, "") if isinstance(node, ast.Name) else ""


def layer_of(module: str) -> str:
    return (*module.split("."), "")[1]


def within(module: str, home: str) -> bool:
    return f"{module}.".startswith(f"{home}.")


def is_ros(top: str) -> bool:
    return top in ROS_PACKAGES or top.endswith(("_msgs", "_srvs")) or top.startswith("tf2_")


def test_every_module_keeps_to_the_import_table() -> None:
    assert [line for module in modules() for line in complaints(*module)] == []


def test_the_walk_sees_the_whole_package() -> None:
    names = {name for name, _, _ in modules()}
    assert {
        "slam_backend",
        "slam_backend.core.graph",
        "slam_backend.core.sensors",
        "slam_backend.cli",
    } <= names


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("slam_backend.core.graph", "from ..io import bags"),
        ("slam_backend.core.graph", "from .. import io"),
        ("slam_backend.core.sensors.odometry", "from ...io.cdr import Layout"),
        ("slam_backend.core.graph", "def f():\n    from slam_backend.lab import report"),
        ("slam_backend.core.graph", "import slam_backend.cli"),
        ("slam_backend.core.graph", "from slam_backend import Config"),
        ("slam_backend.io.bags", "from ..lab import simulate"),
        ("slam_backend.io.bags", "from ..perception.features import detect"),
        ("slam_backend.lab.report", "from ..cli import main"),
        ("slam_backend.lab.report", "def f():\n    from ..ros import node"),
        ("slam_backend.cli.run", "from ..ros import node"),
        ("slam_backend.cli.play", "from ..ros.player import Player"),
        ("slam_backend.cli.replay", "def f():\n    from ..ros import node"),
        ("slam_backend.ros.node", "from ..lab import simulate"),
        ("slam_backend.io.bags", "import rclpy"),
        ("slam_backend.cli.run", "def f():\n    import rclpy"),
        ("slam_backend.lab.simulate", "from nav_msgs.msg import Odometry"),
        ("slam_backend.io.bags", "from tf2_ros import Buffer"),
        ("slam_backend.core.graph", "import time"),
        ("slam_backend.core.graph", "from datetime import datetime"),
        ("slam_backend.core.graph", "import os.path"),
        ("slam_backend.core.graph", "def f():\n    from pathlib import Path"),
        ("slam_backend.core.graph", "import logging"),
        ("slam_backend.core.graph", "from threading import Lock"),
        ("slam_backend.core.graph", "import multiprocessing as mp"),
        ("slam_backend.core.graph", "import random"),
        ("slam_backend.core.graph", "import scipy.sparse"),
        ("slam_backend.core.graph", "import pydantic"),
        ("slam_backend.core.sensors.landmark", "import pymap3d"),
        ("slam_backend.core.graph", "import evo"),
        ("slam_backend.core.graph", "print('here')"),
        ("slam_backend.core.graph", "show = print"),
        ("slam_backend.core.graph", "open('x')"),
        ("slam_backend.core.graph", "import numpy as np\nnp.random.normal()"),
        ("slam_backend.core.graph", "import numpy as np\nnp.random.seed(1)"),
        ("slam_backend.core.graph", "from numpy.random import rand\nrand()"),
        ("slam_backend.core.graph", "from numpy import random\nrandom.rand()"),
        ("slam_backend.core.graph", "import numpy as np\nnp.random.default_rng()"),
        ("slam_backend.core.graph", "import numpy as np\nnp.loadtxt('x')"),
        ("slam_backend.core.graph", "import gtsam\ngtsam.readG2o('x', True)"),
    ],
)
def test_a_breach_is_seen(module: str, source: str) -> None:
    assert complaints(module, source)


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("slam_backend.core.sensors.odometry", "from ..measurement import Measurement\nfrom . import pose"),
        ("slam_backend.core.config", "import json\nfrom pydantic import Field"),
        ("slam_backend.core.sensors.gnss", "import pymap3d"),
        ("slam_backend.core.graph", "import gtsam\nimport numpy as np\nfrom collections.abc import Mapping"),
        ("slam_backend.core.graph", "import numpy as np\nnp.random.default_rng(7).normal()"),
        ("slam_backend.core.graph", "self.open = 1\nself.print()"),
        ("slam_backend.io.bags", "import os, time\nfrom rosbags.typesys.stores import ros2_jazzy\nopen('x')"),
        ("slam_backend.io.records", "from ..perception.decode.image import decode"),
        ("slam_backend.lab.simulate", "from ..io.bags import write\nfrom ..core import graph"),
        ("slam_backend.cli.run", "def command():\n    from ..ros.node import main"),
        ("slam_backend.cli.play", "def command():\n    from ..ros.player import Player"),
        ("slam_backend.ros.node", "import rclpy\nfrom nav_msgs.msg import Path\nfrom ..io import worker"),
        ("slam_backend", "from .core.config import Config\nfrom .io.replay import replay"),
        ("slam_backend.__main__", "from .cli import main"),
    ],
)
def test_what_is_allowed_passes(module: str, source: str) -> None:
    assert complaints(module, source) == []


def test_a_package_resolves_its_dots_from_itself() -> None:
    assert targets(
        ast.parse("from .errors import SlamError").body[0], "slam_backend.core", is_package=True
    ) == ["slam_backend.core.errors.SlamError"]
    assert complaints("slam_backend.io", "from ..core import graph", is_package=True) == []


@pytest.mark.parametrize("arguments", [(), *((verb,) for verb in VERBS)])
def test_help_imports_nothing_heavy(arguments: tuple[str, ...]) -> None:
    command = [sys.executable, "-X", "importtime", "-m", "slam_backend", *arguments, "--help"]
    ran = subprocess.run(command, capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    imported = {
        line.rsplit("|", 1)[1].strip().split(".")[0] for line in ran.stderr.splitlines() if "|" in line
    }
    assert "typer" in imported
    assert imported & HEAVY == set()
