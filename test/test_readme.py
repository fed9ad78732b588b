"""What the README shows runs as it stands there; the figures of the docs are there."""

import re
import shlex
from pathlib import Path

import pytest

from slam_backend import cli
from slam_backend.core.config import config_from

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.S)


def test_the_python_example_runs_and_prints_what_it_says(tmp_path, monkeypatch, capsys) -> None:
    (example,) = blocks("python")
    (tmp_path / "bags").symlink_to(ROOT / "bags")
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "README.md", "exec"), {})
    said = [line.partition("# ")[2] for line in example.splitlines() if line.startswith("print")]
    assert capsys.readouterr().out.splitlines() == said
    assert (tmp_path / "runs/warehouse/summary.json").exists()


def test_the_configuration_in_it_is_valid() -> None:
    import yaml

    (example,) = blocks("yaml")
    assert config_from(yaml.safe_load(example)).driver == "wheels"


@pytest.mark.parametrize("command", sorted(set(re.findall(r"`slam-backend (\w+)", README))))
def test_every_command_it_names_exists(command: str) -> None:
    assert command in cli.VERBS


def test_the_targets_it_names_exist_and_its_links_lead_somewhere() -> None:
    makefile = (ROOT / "Makefile").read_text()
    (shell,) = blocks("sh")
    for line in shell.splitlines():
        program, target, *_ = shlex.split(line, comments=True)
        assert program == "make"
        assert f"\n{target}:" in makefile
    for link in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / link).exists(), link


def test_the_figures_of_the_docs_are_there_small_and_made_by_the_script() -> None:
    from bench.figures import FIGURES, FOLDER

    named = [
        path.parent / link
        for path in (ROOT / "docs").glob("*.md")
        for link in re.findall(r"\]\((figures/[^)]+)\)", path.read_text())
    ]
    assert sorted(named) == sorted(FOLDER / f"{name}.png" for name in FIGURES)
    assert sorted(FOLDER.iterdir()) == sorted(named)
    assert all(figure.stat().st_size < 60_000 for figure in named)
