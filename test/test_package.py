"""The package says the same thing everywhere, and what pip installs runs."""

import ast
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = Path(sys.executable).parent / "slam-backend"


def setup_arguments() -> dict[str, Any]:
    """The literal keyword arguments of `setup(...)`."""
    calls = [
        node for node in ast.walk(ast.parse((ROOT / "setup.py").read_text())) if isinstance(node, ast.Call)
    ]
    call = next(call for call in calls if isinstance(call.func, ast.Name) and call.func.id == "setup")
    found = {}
    for keyword in call.keywords:
        try:
            found[str(keyword.arg)] = ast.literal_eval(keyword.value)
        except ValueError:
            continue
    return found


def package_xml() -> ET.Element:
    return ET.parse(ROOT / "package.xml").getroot()


def requirement_names(lines: list[str]) -> set[str]:
    return {re.split(r"[\[<>=! ]", line, maxsplit=1)[0].lower().replace("_", "-") for line in lines}


def test_setup_and_package_xml_agree() -> None:
    arguments, xml = setup_arguments(), package_xml()
    assert xml.findtext("version") == arguments["version"]
    assert xml.findtext("license") == arguments["license"]
    assert xml.findtext("name") == "slam_backend"
    assert xml.findtext("export/build_type") == "ament_python"


def test_pip_takes_its_metadata_from_setup_alone() -> None:
    """A [project] or [build-system] table would hide setup.py from colcon or from pip."""
    tables = re.findall(r"^\[+([^\].]+)", (ROOT / "pyproject.toml").read_text(), flags=re.MULTILINE)
    assert set(tables) == {"tool"}


def test_every_base_and_dev_requirement_is_pinned() -> None:
    arguments = setup_arguments()
    wanted = (
        arguments["install_requires"]
        + arguments["extras_require"]["dev"]
        + arguments["extras_require"]["ros"]
    )
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and line[0] != "#"]
    assert requirement_names(wanted) - requirement_names(lines) == set()


def test_the_ament_marker_is_there_and_empty() -> None:
    assert (ROOT / "resource" / "slam_backend").read_bytes() == b""


def test_python_m_shows_the_overview() -> None:
    command = [sys.executable, "-m", "slam_backend", "--help"]
    assert (
        "Usage: slam-backend"
        in subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    )


@pytest.mark.skipif(not SCRIPT.exists(), reason="not installed: runs from the source tree")
def test_the_installed_script_runs(tmp_path: Path) -> None:
    """From any directory, with the version that setup.py states."""
    scripts = entry_points(group="console_scripts", name="slam-backend")
    assert all(callable(script.load()) for script in scripts)
    ran = subprocess.run([SCRIPT, "--version"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert ran.stdout == f"slam-backend {setup_arguments()['version']}\n"


@pytest.mark.slow
def test_pip_installs_script_and_ament_files(tmp_path: Path) -> None:
    """Into an empty prefix: the script in bin/, the marker and the manifest where ament looks."""
    built = tmp_path / "wheel"
    pip = [sys.executable, "-m", "pip"]
    subprocess.run([*pip, "wheel", "-q", "--no-deps", "-w", built, copied(tmp_path)], check=True)
    (wheel,) = built.glob("*.whl")
    prefix = tmp_path / "prefix"
    into = ["--ignore-installed", "--prefix", prefix]  # otherwise pip removes the one that runs this test
    subprocess.run([*pip, "install", "-q", "--no-deps", *into, wheel], check=True)
    assert (prefix / "bin" / "slam-backend").exists()
    assert (prefix / "share/ament_index/resource_index/packages/slam_backend").exists()
    assert (prefix / "share/slam_backend/package.xml").exists()
    assert os.access(prefix / "lib/slam_backend/backend", os.X_OK)  # where `ros2 run` looks
    assert next(prefix.rglob("slam_backend/py.typed"))


def copied(tmp_path: Path) -> Path:
    """The tracked files alone, so that building leaves nothing in the checkout."""
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    for name in listed:
        target = tmp_path / "source" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / name).exists():
            shutil.copy(ROOT / name, target)  # with its mode
    return tmp_path / "source"
