"""The edge of the command line: what users type wrong, and what goes wrong, becomes one line and an exit code."""

import json
import os
import resource
import signal
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer

from slam_backend import cli
from slam_backend.cli.progress import progress
from slam_backend.core.errors import BadFile

ROOT = Path(__file__).parents[2]
Verb = Callable[[Callable[..., Any]], None]


@pytest.fixture
def verb(monkeypatch: pytest.MonkeyPatch) -> Verb:
    """Make a function the verb `probe`."""

    def make(function: Callable[..., Any]) -> None:
        monkeypatch.setattr(cli, "VERBS", {"probe": "A probe.", **cli.VERBS})
        monkeypatch.setitem(sys.modules, "slam_backend.cli.probe", module := types.ModuleType("probe"))
        module.command = function  # type: ignore[attr-defined]

    return make


def raising(error: BaseException) -> Callable[[], None]:
    def command() -> None:
        raise error

    return command


def run(*arguments: str, **settings: Any) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "slam_backend", *arguments]
    return subprocess.run(command, text=True, cwd=ROOT, check=False, **{"capture_output": True, **settings})


def test_every_row_of_the_table_is_a_file_and_every_file_a_row() -> None:
    files = {path.stem for path in Path(cli.__file__).parent.glob("*.py")}
    assert files - {"__init__", "interrupt", "progress"} == set(cli.VERBS)


@pytest.mark.parametrize("name", cli.VERBS)
def test_every_verb_has_help(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([name, "--help"]) == 0
    assert f"slam-backend {name}" in capsys.readouterr().out


def test_without_a_verb_the_overview_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 0
    shown = capsys.readouterr().out
    assert all(f" {name} " in shown for name in cli.VERBS)


def test_done_is_zero_and_a_failed_check_one(verb: Verb) -> None:
    verb(lambda: None)
    assert cli.main(["probe"]) == 0
    verb(raising(typer.Exit(1)))
    assert cli.main(["probe"]) == 1


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (BadFile("drive.mcap: byte 12:\n truncated"), 2, "slam-backend: drive.mcap: byte 12: truncated"),
        (PermissionError(13, "Permission denied", "/x"), 2, "slam-backend: /x: Permission denied"),
        (OSError(28, "No space left on device"), 2, "slam-backend: No space left on device"),
        (KeyboardInterrupt(), 130, "slam-backend: interrupted"),
    ],
)
def test_an_error_is_one_line_and_its_code(
    verb: Verb, capsys: pytest.CaptureFixture[str], error: BaseException, code: int, line: str
) -> None:
    verb(raising(error))
    assert cli.main(["probe"]) == code
    assert capsys.readouterr() == ("", f"{line}\n")


def test_an_unexpected_error_is_one_short_line_that_says_how_to_see_more(
    verb: Verb, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As long as the complaint of a wrapped constructor that prints the arguments it was given."""
    monkeypatch.delenv(cli.TRACEBACK, raising=False)
    verb(raising(TypeError("incompatible arguments:\n" + "x 1.0\n" * 200_000)))
    assert cli.main(["probe"]) == 3
    line = capsys.readouterr().err
    assert line.startswith("slam-backend: internal error: TypeError: incompatible arguments: x 1.0 ")
    assert line.endswith("...; run with SLAM_BACKEND_TRACEBACK=1 for the traceback\n")
    assert len(line) < 600
    assert line.count("\n") == 1


def test_the_traceback_is_there_when_asked_for(
    verb: Verb, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(cli.TRACEBACK, "1")
    verb(raising(ZeroDivisionError("no")))
    assert cli.main(["probe"]) == 3
    assert "in command" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["datset", "x"], "'dataset'"),
        (["nothing-like-it"], "No such command 'nothing-like-it'"),
        (["dataset", "--nope"], "No such option: --nope"),
        (["dataset", "a", "b"], "unexpected extra argument"),
        (["--nope"], "No such option: --nope"),
        (["probe", "--n", "three"], "valid integer"),
    ],
)
def test_a_mistyped_line_is_answered_by_one_line(
    verb: Verb, capsys: pytest.CaptureFixture[str], arguments: list[str], says: str
) -> None:
    def command(n: int = 1) -> None:
        """Take a number."""

    verb(command)
    assert cli.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("slam-backend: ")
    assert says in captured.err
    assert captured.err.count("\n") == 1


def test_a_reader_that_leaves_is_no_trouble() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    ran = run("--help", capture_output=False, stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert (ran.returncode, ran.stderr) == (141, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_one_line() -> None:
    with Path("/dev/full").open("w") as full:
        ran = run("--help", capture_output=False, stdout=full, stderr=subprocess.PIPE)
    assert (ran.returncode, ran.stderr) == (2, "slam-backend: No space left on device\n")


def test_an_interrupt_while_working_is_one_line() -> None:
    """Sent to the process as Ctrl-C does, while the verb works."""
    source = (
        "import sys, time, types; from slam_backend import cli\n"
        "def command():\n    print('ready', flush=True); time.sleep(60)\n"
        "sys.modules['slam_backend.cli.probe'] = types.SimpleNamespace(command=command)\n"
        "cli.VERBS = {'probe': ''}; sys.exit(cli.main(['probe']))\n"
    )
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, "-c", source], cwd=ROOT, stdout=pipe, stderr=pipe, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=20)[1] == "slam-backend: interrupted\n"
    assert process.returncode == 130


@pytest.mark.parametrize("module", ["slam_backend.cli", "typer", "slam_backend.cli.replay"])
def test_an_interrupt_while_it_starts_shows_no_traceback(module: str) -> None:
    """Ctrl-C at the moment when this module is to be imported."""
    source = (
        "import os, runpy, signal, sys\n"
        "class Interrupt:\n"
        "    def find_spec(name, path=None, target=None):\n"
        f"        if name == '{module}': sys.meta_path.remove(Interrupt); os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Interrupt); sys.argv = ['slam-backend', 'replay', '--help']\n"
        "runpy.run_module('slam_backend', run_name='__main__')\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", source], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert ran.returncode in (-signal.SIGINT, 130)
    assert ran.stderr in ("", "slam-backend: interrupted\n")
    assert ran.stdout == ""


@pytest.mark.parametrize("arguments", [(), *((name,) for name in cli.VERBS)])
def test_help_is_quick(arguments: tuple[str, ...]) -> None:
    """In CPU time, which a busy machine does not spoil; the best of three."""

    def cpu() -> float:
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime

    def once() -> float:
        before = cpu()
        assert run(*arguments, "--help").returncode == 0
        return cpu() - before

    assert min(once() for _ in range(3)) < 0.5


def test_progress_is_silent_without_a_terminal(capfd: pytest.CaptureFixture[str]) -> None:
    with progress("replay", 10) as advance:
        advance(10)
    assert capfd.readouterr() == ("", "")


def test_progress_on_a_terminal_goes_to_stderr_with_its_rate(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "100")
    with progress("replay", 10) as advance:
        advance(4)
        advance(6)
    captured = capfd.readouterr()
    assert captured.out == ""
    assert "replay" in captured.err
    assert "10/10" in captured.err


def test_data_sets_can_be_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["dataset", "--list", "--json"]) == 0
    assert "victoria_park" in json.loads(capsys.readouterr().out)


def test_an_unknown_data_set_is_the_users_mistake(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert cli.main(["dataset", "victoria_prak", "--out", str(tmp_path / "x.mcap")]) == 2
    assert "victoria_park" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_not_converted_onto_itself(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    graph, text = tmp_path / "a.g2o", "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
    graph.write_text(text)
    assert cli.main(["convert", str(graph), str(tmp_path / "." / "a.g2o")]) == 2
    assert "is the input itself" in capsys.readouterr().err
    assert graph.read_text() == text


def test_a_missing_file_comes_with_a_hint(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert cli.main(["solve", str(tmp_path / "missing.g2o")]) == 2
    assert capsys.readouterr().err.endswith("No such file or directory; check the path\n")
    assert cli.main(["solve", str(tmp_path)]) == 2
    assert capsys.readouterr().err.endswith("Is a directory; name a file in it\n")


def test_solve_says_what_it_wrote_and_when_a_file_may_have_been_cut(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    graph, out = tmp_path / "a.g2o", tmp_path / "b.g2o"
    graph.write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 12")
    assert cli.main(["solve", str(graph), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert f"written: {out}" in said
    assert "line 1 ends without a line feed" in said


def test_a_converted_graph_says_what_became_of_it(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    graph, out = tmp_path / "two.g2o", tmp_path / "two.toro"
    graph.write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 100 0 0 100 0 400\n")
    assert cli.main(["convert", str(graph), str(out), "--json"]) == 0
    assert "2 vertices, 1 edges" in json.loads(capsys.readouterr().out)["done"]
    assert out.exists()


def test_a_simulated_drive_comes_with_its_truth_and_its_configuration(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "drive.mcap"
    assert (
        cli.main(["simulate", "square", "--out", str(out), "--seed", "3", "--set", "poses=50", "--json"]) == 0
    )
    made = json.loads(capsys.readouterr().out)
    assert made["messages"] >= 100
    assert {Path(made[name]).name for name in ("bag", "truth", "config")} == {
        path.name for path in tmp_path.iterdir()
    }


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("pose=3", "did you mean 'poses'?"),
        ("poses=many", "poses needs a whole number"),
        ("dropout", "dropout needs a number"),
        ("dropout=7", "dropout"),
    ],
)
def test_a_wrong_option_of_a_drive_is_named(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, setting: str, says: str
) -> None:
    assert cli.main(["simulate", "square", "--out", str(tmp_path / "x.mcap"), "--set", setting]) == 2
    assert says in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
