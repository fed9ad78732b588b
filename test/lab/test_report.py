"""The page of a run has what there is to see, works in a real browser, and needs no network."""

import re

import numpy as np
import pytest

from slam_backend.cli import main
from slam_backend.core.errors import BadFile
from slam_backend.io.configfile import load_config
from slam_backend.io.finished import FinishedRun
from slam_backend.io.history import History, Recorded
from slam_backend.io.replay import replay
from slam_backend.io.rundir import write_run
from slam_backend.lab.report import write_report
from slam_backend.lab.report.sparsity import _cliques
from slam_backend.lab.report.subject import Subject
from slam_backend.lab.simulate import Options, simulate, write_simulation

ALWAYS = ["Summary", "Trajectory", "Drift", "Residuals", "Factor graph", "Sparsity", "Timing", "Input health"]


def replayed(folder, scenario, options, final="none", watched=True):
    """A run of a simulated drive in folder/run, as the command line makes it."""
    drive = write_simulation(simulate(scenario, 3, options), folder / "drive.mcap")
    run = replay(drive.bag, load_config(drive.config), final=final)
    history = History(run)
    for update in run:
        history.see(update)
    write_run(run.result, folder / "run")
    if watched:
        history.write(folder / "run" / "history.npz")
    return run, folder / "run"


@pytest.fixture(scope="module")
def plane(tmp_path_factory):
    options = Options(poses=400, loop_rate=0.3, landmarks=30)
    return replayed(tmp_path_factory.mktemp("plane"), "square", options, "batch")


@pytest.fixture(scope="module")
def space(tmp_path_factory):
    return replayed(tmp_path_factory.mktemp("space"), "spiral", Options(poses=300, loop_rate=0.3))


def page_of(out):
    write_report(Subject(out), out / "report.html")
    return (out / "report.html").read_text()


def titles(page):
    return re.findall(r"<h2>(.*?)</h2>", page)


def test_every_section_with_something_to_show_is_there(plane):
    page = page_of(plane[1])
    assert titles(page) == [
        "Summary", "Trajectory", "As it went", "What each loop did", "Drift", "Residuals", "Factor graph", "Final batch",
        "Sparsity", "Timing", "Input health",
    ]  # fmt: skip
    assert len(page) < 4e6
    outside = re.sub(r'<script type="text/plain" id="plotly">.*?</script>', "", page)
    assert "http" not in re.sub(r"http://www.w3.org\S*", "", outside)


def test_a_section_without_data_is_absent(tmp_path):
    """No loops, no final batch, nobody watched."""
    _, out = replayed(tmp_path, "square", Options(poses=60, loop_rate=0.0, landmarks=5), watched=False)
    assert titles(page_of(out)) == ALWAYS


def test_the_history_tells_each_update_and_each_loop(plane):
    run, out = plane
    history = Recorded(out / "history.npz")
    assert history["keyframes"][-1] == len(run.result.trajectory)
    assert history["factors"][-1] == len(run.result.factors)
    accepted = [d.id for d in run.decisions if d.ends and d.verdict == "accepted"]
    assert sorted(history["loop_ids"].tolist()) == sorted(accepted)
    assert (history["loop_largest"] >= history["loop_newest"]).all()
    assert history["loop_newest"].max() > 0.05  # the drive drifts, and loops take it back
    at, points = history.frames[-1]
    found = run.result.trajectory.at(at)[:, :3]
    assert np.abs(found - points).max() < 0.1


def test_to_watch_a_run_does_not_change_it(plane):
    _, out = plane
    summary = FinishedRun(out).summary
    alone = replay(summary["input"], load_config(out / "config.yaml"), final="batch").result
    assert alone.summary["run_hash"] == summary["run_hash"]


def test_what_a_loop_moved_is_what_the_online_path_jumped(plane):
    """The newest pose, carried on by odometry from where it was believed to be, lies that far from where it is believed to be after."""
    run, out = plane
    history = Recorded(out / "history.npz")
    online, odometry = run.online, run.result.snapshot.odometry
    largest = int(np.argmax(history["loop_newest"]))
    row = int(np.searchsorted(online.stamps, history["loop_stamps"][largest]))
    steps = [
        np.linalg.norm(each[row, :2] - each[row - 1, :2])
        for each in (online.sevens, odometry.at(online.stamps))
    ]
    assert abs(steps[0] - steps[1]) <= history["loop_newest"][largest] + 1e-6


def test_a_source_that_states_its_noise_truly_is_consistent(plane):
    page = page_of(plane[1])
    verdicts = dict(re.findall(r"<tr><td>(wheels|loops|landmarks)</td>.*?<td>([^<]*)</td></tr>", page))
    assert set(verdicts) == {"wheels", "loops", "landmarks"}
    assert set(verdicts.values()) == {"consistent"}


def test_a_filter_and_the_truth_are_drawn_beside_the_run(plane, tmp_path):
    pytest.importorskip("evo")
    run, out = plane
    drive = run.inputs.paths[0]
    arguments = ["--config", str(out / "config.yaml"), "--estimator", "ekf", "--no-report", "--out"]
    assert main(["replay", str(drive), *arguments, str(tmp_path / "filter")]) == 0
    page, truth = tmp_path / "page.html", drive.with_suffix(".truth.tum")
    assert (
        main(
            [
                "report",
                str(out),
                "--out",
                str(page),
                "--truth",
                str(truth),
                "--beside",
                str(tmp_path / "filter"),
            ]
        )
        == 0
    )
    rows = dict(
        re.findall(r"<tr><td>([^<]*)</td><td>([\d.]*)</td>", page.read_text())
    )  # the medians among them
    assert float(rows["smoothed"]) < float(rows["filter"]) < float(rows["odometry alone"])


def test_wrong_loops_that_were_kept_out_are_shown_in_a_map_that_took_them(tmp_path):
    options = Options(poses=400, loop_rate=0.3, wrong_loop_rate=0.3)
    drive = write_simulation(simulate("square", 3, options), tmp_path / "drive.mcap")
    arguments = [
        "replay",
        drive.bag,
        "--config",
        drive.config,
        "--set",
        "robust=[pcm]",
        "--out",
        tmp_path / "run",
    ]
    assert main(list(map(str, arguments))) == 0
    page = (tmp_path / "run" / "report.html").read_text()
    assert "Without judges" in titles(page)
    away = float(re.search(r"poses would lie ([\d.]+) m", page).group(1))
    assert away > 1.0  # the map that took them is bent


def test_cliques_of_a_chain_and_of_a_full_graph() -> None:
    assert sorted(_cliques([[0, 1], [1, 2], [2, 3], [3]])) == [2, 2, 2]
    assert _cliques([[0, 1, 2], [1, 2], [2]]) == [3]


def test_the_command_writes_the_page_and_names_what_is_damaged(plane, tmp_path, capsys):
    assert main(["report", str(plane[1]), "--out", str(tmp_path / "page.html")]) == 0
    assert (tmp_path / "page.html").stat().st_size > 1e6
    (tmp_path / "history.npz").write_bytes(b"nothing")
    with pytest.raises(BadFile, match=r"history.npz: is damaged"):
        Recorded(tmp_path / "history.npz")
    capsys.readouterr()
    assert main(["report", str(tmp_path)]) == 2
    assert "no run directory" in capsys.readouterr().err


def test_slider_and_click_work_in_a_browser(plane, browser):
    page_of(plane[1])
    browser.open(plane[1] / "report.html")
    whole = browser.run("document.getElementById('playback').data[1].x.length")
    label = browser.run("document.getElementById('moment-told').textContent")
    browser.run("(() => { const s = document.getElementById('moment'); s.value = 3; s.oninput(); })()")
    early = browser.run("document.getElementById('playback').data[1].x.length")
    assert early < whole
    assert browser.run("document.getElementById('moment-told').textContent") != label
    where = browser.run("""(() => { const place = document.getElementById('path'); place.scrollIntoView();
        const marks = place._fullData.find(each => each.mode === 'markers' && each.customdata), x = place._fullLayout.xaxis, y = place._fullLayout.yaxis;
        const box = place.getBoundingClientRect();
        return [box.left + x._offset + x.l2p(marks.x[0]), box.top + y._offset + y.l2p(marks.y[0])]; })()""")
    browser.click(*where)
    told = "document.getElementById('loop-told').textContent"
    browser.run(
        f"new Promise(done => {{ const look = () => {told}.startsWith('loops/') ? done() : setTimeout(look, 50); look(); setTimeout(done, 5000); }})"
    )
    assert browser.run(told).startswith("loops/")
    browser.run("(() => { const w = document.getElementById('which'); w.value = 50; w.oninput(); })()")
    assert browser.run("document.getElementById('neighbours').data.length") > 10
    assert browser.empty == []
    assert browser.errors == []


def test_a_run_in_space_is_drawn_in_a_browser(space, browser):
    page_of(space[1])
    browser.open(space[1] / "report.html")
    assert browser.empty == []
    assert browser.run("document.getElementById('path').data[0].type") == "scatter3d"
    assert browser.errors == []
