"""The services over DDS, of a node that holds nothing else, fed by a real worker; run as a script, this file is that node."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from nav_msgs.srv import GetPlan, LoadMap
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters, SetParametersAtomically
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from std_srvs.srv import SetBool, Trigger

import slam_backend as sb
from slam_backend.core.measurement import format_stamp
from slam_backend.io.bags import open_bag
from slam_backend.io.encode import encode_odometry
from slam_backend.io.feeder import Feeder
from slam_backend.io.journal import Journal
from slam_backend.ros.services import Services
from slam_backend.ros.session import Begin, Session, empty
from slam_backend.ros.snapshots import Snapshots
from slam_backend.ros.state import State

BAGS = Path(__file__).parents[2] / "bags"
LINE = 10_000  # keyframes of the long drive
STEP = 100_000_000  # ns between two of them
BEGIN = 1_700_000_000 * 1_000_000_000


# -- the node ----------------------------------------------------------------------------------------


class Host:
    """What the node does for its services: journal, worker, newest snapshot."""

    def __init__(self, data_dir: Path, records: str) -> None:
        self.data_dir, self.records = data_dir, records
        self.config = sb.load_config(BAGS / "warehouse.yaml")
        self.node = rclpy.create_node("slam_backend", namespace=records)
        self.state = State(lambda: None)
        self.sessions = 0
        self.begin()
        snapshots = Snapshots(self.state, lambda: self.session.feeder)
        self.services = Services(
            self.node, self.state, lambda: self.session, snapshots.ask, data_dir, self.config, self.reset
        )

    def begin(self, begin: Begin = empty) -> None:
        self.sessions += 1
        self.session = Session(self.data_dir / f"session{self.sessions}", self.state, say, self.config)
        begin(self.session)
        self.session.work(self.config)

    @property
    def journal(self) -> Journal:
        return self.session.journal

    @property
    def feeder(self) -> Feeder:
        assert self.session.feeder is not None
        return self.session.feeder

    def reset(self, begin: Begin = empty) -> None:
        self.session.end(30)
        self.state.clear()
        self.begin(begin)

    def feed(self) -> None:
        if self.records == "nothing":
            return
        if self.records == "line":
            for n in range(LINE):
                pose, noise = (n * 0.1, 0, 0, 0, 0, 0, 1), np.zeros(36)
                data = encode_odometry(BEGIN + n * STEP, "odom", "base", pose, noise, np.zeros(6), noise)
                self.journal.append("/odom", "nav_msgs/msg/Odometry", data)
        else:
            with open_bag(BAGS / "warehouse.mcap") as bag:
                for record in bag.records({"/odom", "/loops", "/landmarks", "/tf_static"}):
                    self.journal.append(record.topic, record.type, record.data)
                    time.sleep(0.01 if self.records == "slow" else 0)

    def spin(self) -> None:
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        say(f"node {os.getpid()} worker {self.feeder.pid} answers {self.services._answers.pid}")
        try:
            executor.spin()
        except (KeyboardInterrupt, ExternalShutdownException):
            self.services.close()
            self.feeder.close()
            rclpy.try_shutdown()
            say("ended")


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    rclpy.init()
    host = Host(Path(sys.argv[1]), sys.argv[2])
    threading.Thread(target=host.feed, daemon=True).start()
    host.spin()


# -- its client --------------------------------------------------------------------------------------


class Client:
    """Calls the services of one node in another process."""

    def __init__(self, folder: Path, records: str) -> None:
        self.folder, self.records = folder, records
        command = ["timeout", "-k", "5", "400", sys.executable, __file__, str(folder), records]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        words = self.process.stdout.readline().split()
        self.pid, self.worker, self.answers = int(words[1]), int(words[3]), int(words[5])
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("client", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.spinning = threading.Thread(target=self.spin)
        self.spinning.start()
        self.clients: dict[str, Any] = {}

    def spin(self) -> None:
        with suppress(ExternalShutdownException):
            self.executor.spin()

    def begin(self, name: str, request: Any, type_: Any) -> Any:
        if name not in self.clients:
            self.clients[name] = self.node.create_client(type_, f"/{self.records}/slam_backend/{name}")
            assert self.clients[name].wait_for_service(20), f"there is no service {name}"
            time.sleep(0.3)  # the service may not see its client yet, and would answer into the void
        return self.clients[name].call_async(request)

    def end(self, future: Any, seconds: float = 30) -> Any:
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        assert done.wait(seconds), f"no answer in {seconds} s"
        return future.result()

    def query(self, *names: str) -> list[Any]:
        """Numbers, JSON or an integer for each name; None for what is not known."""
        values = self.end(self.begin("query", GetParameters.Request(names=names), GetParameters)).values
        read = {
            ParameterType.PARAMETER_NOT_SET: lambda _: None,
            ParameterType.PARAMETER_DOUBLE_ARRAY: lambda v: np.array(v.double_array_value),
            ParameterType.PARAMETER_STRING: lambda v: json.loads(v.string_value),
            ParameterType.PARAMETER_INTEGER: lambda v: v.integer_value,
        }
        return [read[value.type](value) for value in values]

    def listed(self, *prefixes: str) -> Any:
        return self.end(self.begin("list", ListParameters.Request(prefixes=prefixes), ListParameters)).result

    def trigger(self, name: str) -> tuple[bool, Any]:
        return told(self.end(self.begin(name, Trigger.Request(), Trigger)))

    def edit(self, **given: Any) -> tuple[bool, Any]:
        """Lists of names, a name, or a bool by the name of a parameter."""
        request = SetParametersAtomically.Request()
        for name, value in given.items():
            parameter = Parameter(name=name)
            if isinstance(value, bool):
                parameter.value = ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=value)
            elif isinstance(value, str):
                parameter.value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)
            else:
                type_ = ParameterType.PARAMETER_STRING_ARRAY
                parameter.value = ParameterValue(type=type_, string_array_value=value)
            request.parameters.append(parameter)
        result = self.end(self.begin("edit", request, SetParametersAtomically)).result
        return result.successful, json.loads(result.reason)

    def load(self, url: str) -> int:
        return int(self.end(self.begin("load", LoadMap.Request(map_url=url), LoadMap)).result)

    def pause(self, on: bool) -> tuple[bool, Any]:
        return told(self.end(self.begin("pause", SetBool.Request(data=on), SetBool)))

    def trajectory(self, start: int = 0, goal: int = 0, period: float = 0.0, frame: str = "map") -> Any:
        """stamps (N,) and poses (N, 7), and the seconds they took to come."""
        request = GetPlan.Request(tolerance=period)
        request.start.header.frame_id = frame
        for pose, stamp in ((request.start, start), (request.goal, goal)):
            pose.header.stamp.sec, pose.header.stamp.nanosec = divmod(stamp, 10**9)
        future = self.begin("get_trajectory", request, GetPlan)
        since = time.monotonic()
        plan = self.end(future).plan
        seconds = time.monotonic() - since
        stamps = [p.header.stamp.sec * 10**9 + p.header.stamp.nanosec for p in plan.poses]
        poses = [(p.pose.position, p.pose.orientation) for p in plan.poses]
        sevens = [(p.x, p.y, p.z, q.x, q.y, q.z, q.w) for p, q in poses]
        return np.array(stamps), np.array(sevens).reshape(-1, 7), seconds

    def wait_for(self, stamp: int, seconds: float = 180) -> None:
        """Until the trajectory has reached a stamp."""
        until = time.monotonic() + seconds
        while self.query(f"pose@{format_stamp(stamp)}")[0] is None:
            assert time.monotonic() < until, "the trajectory did not get there"
            time.sleep(0.1)

    def newest(self) -> int:
        """The stamp of the newest keyframe."""
        return int(self.trajectory()[0][-1])

    def close(self) -> str:
        """What the node said at its end."""
        rclpy.try_shutdown(context=self.context)
        self.spinning.join()
        with suppress(ProcessLookupError):
            os.kill(self.worker, signal.SIGCONT)
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGINT)
        return self.process.communicate(timeout=10)[0]


def told(response: Any) -> tuple[bool, Any]:
    return response.success, json.loads(response.message)


def seconds_of(work: Any, times: int) -> list[float]:
    """How long each of many calls took, the quickest first."""
    found = []
    for _ in range(times):
        since = time.monotonic()
        work()
        found.append(time.monotonic() - since)
    return sorted(found)


def alive(pid: int) -> bool:
    path = Path(f"/proc/{pid}/stat")
    return path.exists() and path.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.fixture(scope="module")
def warehouse(tmp_path_factory) -> Iterator[Client]:
    """Of a drive that has been taken in whole."""
    client = Client(tmp_path_factory.mktemp("warehouse"), "warehouse")
    with open_bag(BAGS / "warehouse.mcap") as bag:
        *_, last = bag.records({"/odom"})
    client.wait_for(last.log_time - 2_000_000_000)
    yield client
    assert "ended" in client.close()


@pytest.fixture
def host(tmp_path) -> Iterator[Any]:
    """`host("slow")`: a node of the test's own that hears a hundred records a second."""
    clients = []

    def begin(records: str) -> Client:
        clients.append(Client(tmp_path, records))
        return clients[-1]

    yield begin
    for client in clients:
        client.close()


# -- answers -----------------------------------------------------------------------------------------


def test_the_trajectory_is_that_of_the_saved_run(warehouse) -> None:
    saved, content = warehouse.trigger("save")
    assert saved
    file = np.loadtxt(Path(content["run"]) / "trajectory.tum")
    stamps, poses, _ = warehouse.trajectory()
    assert len(stamps) == content["keyframes"] == len(file)
    assert stamps == pytest.approx(file[:, 0] * 1e9, abs=1e3)
    assert poses == pytest.approx(file[:, 1:], abs=1e-9)


def test_a_range_takes_both_its_ends(warehouse) -> None:
    every, all_poses, _ = warehouse.trajectory()
    stamps, poses, _ = warehouse.trajectory(int(every[100]), int(every[200]))
    assert np.array_equal(stamps, every[100:201])
    assert np.array_equal(poses, all_poses[100:201])
    assert np.array_equal(warehouse.trajectory(start=int(every[-5]))[0], every[-5:])
    assert np.array_equal(warehouse.trajectory(goal=int(every[5]) - 1)[0], every[:5])
    assert len(warehouse.trajectory(start=int(every[-1]) + 1)[0]) == 0


def test_a_resampled_trajectory_has_the_poses_that_a_query_gives(warehouse) -> None:
    begin = int(warehouse.trajectory()[0][10])
    stamps, poses, _ = warehouse.trajectory(begin, begin + 1_000_000_000, period=0.07)
    assert stamps.tolist() == [begin + n * 70_000_000 for n in range(15)]
    asked = warehouse.query(*(f"pose@{format_stamp(int(stamp))}" for stamp in stamps))
    assert np.array_equal(poses, asked)


@pytest.mark.parametrize(
    "wrong",
    [
        {"frame": "map@1800000000.000000000"},
        {"frame": "map@yesterday"},
        {"frame": "odom"},
        {"period": -1.0},
        {"period": float("nan")},
        {"period": 1e-6},
    ],
)
def test_what_cannot_be_answered_is_an_empty_plan(warehouse, wrong) -> None:
    assert len(warehouse.trajectory(**wrong)[0]) == 0


def test_what_was_believed_earlier_is_that_of_a_replay_which_halts_there(warehouse) -> None:
    """The trajectory and every name; the present is answered while the past is looked up."""
    run = sb.replay(BAGS / "warehouse.mcap", sb.load_config(BAGS / "warehouse.yaml"))
    first = int(warehouse.trajectory()[0][0])
    for t in (first + 30_000_000_123, first + 15_000_000_000):
        stamps, poses, _ = warehouse.trajectory(frame=f"map@{format_stamp(t)}")
        if t == first + 30_000_000_123:
            assert run.reach(t)
            believed = run.backend.snapshot()
            assert np.array_equal(stamps, believed.stamps)
            assert np.array_equal(poses, believed.trajectory.sevens)
        assert stamps[-1] == t // 100_000_000 * 100_000_000
    when = f"map@{format_stamp(first + 30_000_000_123)}"
    asked = warehouse.begin("query", GetParameters.Request(names=[f"{when}/pose@now#cov"]), GetParameters)
    now, then, landmark, unknown = warehouse.query(
        "pose@k5", f"{when}/pose@k5", f"{when}/landmark/{believed.names[0]}", f"{when}/pose@k4000"
    )
    assert np.array_equal(then, believed.trajectory.sevens[5])
    assert not np.array_equal(now, then)
    assert np.array_equal(landmark, believed.landmarks[0])
    assert unknown is None
    assert len(warehouse.end(asked).values[0].double_array_value) == 36


def test_what_is_listed_can_be_queried(warehouse) -> None:
    groups = warehouse.listed().prefixes
    assert groups == ["decisions", "keyframes", "landmarks", "loops", "revisions"]
    for group in groups:
        names = warehouse.listed(group).names
        assert names
        assert all(value is not None for value in warehouse.query(*names[:50]))
    assert warehouse.listed("nonsense").names == []
    assert warehouse.listed("keyframes/1700000100.1").names == ["pose@1700000100.100000000"]


def test_a_query_answers_what_is_known_and_leaves_out_the_rest(warehouse) -> None:
    loop = warehouse.listed("loops").names[0]
    pose, unknown, between, nonsense, landmark, decision, revision = warehouse.query(
        "pose@k3", "pose@17.0", "between@k3,k3", "pose@", "landmark/1", loop, "revision"
    )
    assert pose.shape == (7,)
    assert unknown is None
    assert nonsense is None
    assert between == pytest.approx([0, 0, 0, 0, 0, 0, 1])
    assert landmark.shape == (3,)
    assert loop == f"decision/{decision['id']}"
    assert revision >= 0


def test_a_covariance_comes_from_the_worker(warehouse) -> None:
    covariance = warehouse.query("pose@k300#cov")[0].reshape(6, 6)
    assert covariance == pytest.approx(covariance.T, abs=1e-12)
    assert (np.diag(covariance)[[0, 1, 5]] > 0).all()


def test_a_map_to_load_is_refused(warehouse) -> None:
    request = LoadMap.Request(map_url="/etc/passwd")
    refused = LoadMap.Response.RESULT_UNDEFINED_FAILURE
    assert warehouse.end(warehouse.begin("load", request, LoadMap)).result == refused


# -- what is asked of the map ------------------------------------------------------------------------


def test_an_optimization_is_answered_and_decided(warehouse) -> None:
    """Twice: the second finds nothing to do. The answer is the decision that the journal's replay will make too."""
    done, content = warehouse.trigger("optimize")
    assert done
    assert content["cost"]["after"] <= content["cost"]["before"]
    assert content["iterations"] >= 1
    assert set(content["largest_shift"]) == {"m", "rad"}
    again = warehouse.trigger("optimize")[1]
    assert again["largest_shift"]["m"] < 1e-6
    assert again["revision"] == content["revision"]
    names = list(warehouse.listed("decisions/command").names)
    assert [decision["basis"] for decision in warehouse.query(*names)] == [content, again]


def test_an_edit_is_tried_done_undone_and_redone(warehouse) -> None:
    loops = [name.removeprefix("decision/") for name in warehouse.listed("loops").names][:3]
    warehouse.trigger("optimize")
    before = warehouse.query("pose@now")[0]
    tried, would = warehouse.edit(disable=loops, dry_run=True)
    assert tried, would
    assert np.array_equal(warehouse.query("pose@now")[0], before)
    done, content = warehouse.edit(disable=loops)
    assert done
    assert content["cost"] == would["cost"]
    assert content["largest_shift"] == would["largest_shift"]
    assert content["revision"] == would["revision"] + 1
    verdict = warehouse.query(f"decision/{loops[0]}")[0]
    assert (verdict["verdict"], verdict["stage"], verdict["reason"]) == ("removed", "edit", "disabled")
    assert warehouse.trigger("undo")[0]
    assert warehouse.query(f"decision/{loops[0]}")[0]["verdict"] == "restored"
    assert warehouse.query("pose@now")[0] == pytest.approx(before, abs=1e-6)
    assert warehouse.trigger("redo")[0]
    assert warehouse.trigger("undo")[0]
    assert warehouse.trigger("undo")[1] == {"error": "there is no edit to undo"}


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({}, "nothing to edit"),
        ({"disable": "loops/17.0/0"}, "no factor 'loops/17.0/0'"),
        ({"explode": "loops"}, "parameter 'explode'"),
        ({"disable": True}, "no string"),
        ({"reweight": "loops"}, "NAME=FACTOR"),
        ({"enable": "nobody", "dry_run": True}, "no factors of 'nobody'"),
    ],
)
def test_an_edit_that_cannot_be_says_why(warehouse, given, why) -> None:
    done, content = warehouse.edit(**given)
    assert not done
    assert why in content["error"]


def test_nothing_is_optimized_before_there_is_something(host) -> None:
    done, content = host("nothing").trigger("optimize")
    assert not done
    assert "nothing to optimize yet" in content["error"]


def test_a_command_while_paused_is_refused_and_not_done_later(host) -> None:
    client = host("slow")
    client.wait_for(1_700_000_001 * 10**9)
    client.pause(True)
    done, content = client.trigger("optimize")
    assert not done
    assert "paused" in content["error"]
    client.pause(False)
    assert client.trigger("optimize")[0]
    assert len(client.listed("decisions/command").names) == 1


def test_a_command_outlives_the_worker_that_it_was_meant_for(host) -> None:
    """Stopped, asked, killed: the next one comes to the same command in the journal, and answers."""
    client = host("slow")
    client.wait_for(1_700_000_001 * 10**9)
    os.kill(client.worker, signal.SIGSTOP)
    asked = client.begin("optimize", Trigger.Request(), Trigger)
    time.sleep(0.3)
    assert not asked.done()
    os.kill(client.worker, signal.SIGKILL)
    assert told(client.end(asked))[0]


# -- what is done ------------------------------------------------------------------------------------


def test_two_saves_at_once_are_two_whole_runs(warehouse) -> None:
    both = [warehouse.begin("save", Trigger.Request(), Trigger) for _ in range(2)]
    contents = [told(warehouse.end(future))[1] for future in both]
    runs = [Path(content["run"]) for content in contents]
    assert runs[0] != runs[1]
    assert contents[0]["run_hash"] == contents[1]["run_hash"]
    for run in runs:
        assert run.parent == warehouse.folder / "runs"
        assert json.loads((run / "summary.json").read_text())["run_hash"] == contents[0]["run_hash"]
    assert [path for path in runs[0].parent.iterdir() if path.name.startswith(".")] == []


def test_a_save_that_fails_leaves_nothing_behind(host) -> None:
    client = host("slow")
    client.wait_for(1_700_000_001 * 10**9)
    os.kill(client.worker, signal.SIGSTOP)
    saving, runs = client.begin("save", Trigger.Request(), Trigger), client.folder / "runs"
    until = time.monotonic() + 10
    while not (runs.exists() and list(runs.iterdir())):
        assert time.monotonic() < until, "it has not begun to save"
        time.sleep(0.02)
    os.kill(client.worker, signal.SIGKILL)
    saved, content = told(client.end(saving))
    assert not saved
    assert "the worker ended" in content["error"]
    assert list(runs.iterdir()) == []


def test_what_a_killed_node_had_not_saved_whole_is_removed_by_the_next(host, tmp_path) -> None:
    for name in (".2026-01-01T00-00-00Z", "2026-01-01T00-00-00Z"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "trajectory.tum").touch()
    host("nothing")
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["2026-01-01T00-00-00Z"]


def test_nothing_is_saved_before_there_is_something(host) -> None:
    client = host("nothing")
    saved, content = client.trigger("save")
    assert not saved
    assert "nothing to save" in content["error"]
    assert client.query("pose@now", "revision") == [None, None]
    assert len(client.trajectory()[0]) == 0


def test_while_paused_the_records_wait_in_the_journal(host) -> None:
    client = host("slow")
    client.wait_for(1_700_000_001 * 10**9)
    assert client.pause(True)[1]["paused"]
    time.sleep(0.5)  # what was on its way arrives
    before, waiting = client.newest(), client.pause(True)[1]["backlog"]
    time.sleep(0.5)
    assert client.newest() == before
    assert client.pause(False)[1]["backlog"] > waiting
    client.wait_for(before + 1_000_000_000)


def test_after_a_reset_the_map_starts_anew(host) -> None:
    client = host("slow")
    client.wait_for(1_700_000_001 * 10**9)
    before = client.newest()
    assert client.trigger("reset") == (True, {"session": "new"})
    until = time.monotonic() + 20
    while not len(stamps := client.trajectory()[0]):
        assert time.monotonic() < until, "the new session did not begin"
        time.sleep(0.1)
    assert stamps[0] >= before


# -- whoever is busy, and whoever dies ---------------------------------------------------------------


def test_answers_come_while_the_worker_does_not(warehouse) -> None:
    os.kill(warehouse.worker, signal.SIGSTOP)
    try:
        saving = warehouse.begin("save", Trigger.Request(), Trigger)
        times = seconds_of(lambda: warehouse.query("pose@k5"), 50)
        assert times[25] < 5  # and not the half minute that a worker may take
        assert len(warehouse.trajectory()[0])
        asking = warehouse.begin("query", GetParameters.Request(names=["pose@k5#cov"]), GetParameters)
        assert len(warehouse.query("pose@k5")[0]) == 7  # overtakes what only the worker knows
        assert not saving.done()
        assert not asking.done()
    finally:
        os.kill(warehouse.worker, signal.SIGCONT)
    assert told(warehouse.end(saving))[0]
    warehouse.end(asking)
    assert len(warehouse.query("pose@k5#cov")[0]) == 36


def test_the_process_of_get_trajectory_is_replaced_when_it_dies(host) -> None:
    client = host("slow")
    client.wait_for(1_700_000_001 * 10**9)
    assert len(client.trajectory()[0])
    os.kill(client.answers, signal.SIGKILL)
    assert client.query("pose@now")[0] is not None
    del client.clients["get_trajectory"]
    until = time.monotonic() + 15
    while True:  # a request to the one that died is never answered
        try:
            request = client.begin("get_trajectory", GetPlan.Request(), GetPlan)
            assert client.end(request, 1).plan.poses
            break
        except AssertionError:
            assert time.monotonic() < until


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_nothing_of_a_node_outlives_it(host, number) -> None:
    client = host("nothing")
    os.kill(client.pid, number)
    until = time.monotonic() + 20
    while alive(client.answers) or alive(client.worker):
        assert time.monotonic() < until
        time.sleep(0.05)


def test_ten_thousand_poses_come_whole(host) -> None:
    """How fast is measured by `bench live`."""
    client = host("line")
    client.wait_for(BEGIN + (LINE - 10) * STEP)
    stamps, poses, _ = client.trajectory()
    assert len(stamps) > LINE - 10
    middle = int(stamps[5000])
    assert np.array_equal(client.query(f"pose@{format_stamp(middle)}")[0], poses[5000])


if __name__ == "__main__":
    main()


# -- a saved map -------------------------------------------------------------------------------------


def test_a_session_goes_on_in_a_saved_map(host) -> None:
    """What was saved is there and stays, what is heard next is joined to it, and a replay of the journal does the same."""
    client = host("slow")
    until = time.monotonic() + 60
    while len(client.trajectory()[0]) < 300:
        assert time.monotonic() < until
        time.sleep(0.3)
    saved, content = client.trigger("save")
    assert saved
    run = Path(content["run"])
    (client.folder / "shortcut").symlink_to(client.folder.parent)
    for wrong in ("", "..", "runs/../..", "/", "shortcut/anywhere", "runs/none", "session1"):
        assert client.load(wrong) == LoadMap.Response.RESULT_UNDEFINED_FAILURE
    assert client.load(f"runs/{run.name}") == LoadMap.Response.RESULT_SUCCESS
    while len(client.trajectory()[0]) < content["keyframes"] + 30:
        assert time.monotonic() < until + 60
        time.sleep(0.3)
    old = np.loadtxt(run / "trajectory.tum")
    stamps, poses, _ = client.trajectory()
    assert stamps[: len(old)] == pytest.approx(old[:, 0] * 1e9, abs=1e3)
    assert poses[: len(old), :3] == pytest.approx(old[:, 1:4], abs=0.5)
    assert client.trigger("reset")[0]
    session = client.folder / "session2"
    summary = json.loads((session / "run/summary.json").read_text())
    assert summary["counts"]["parts"] == 1
    assert len(summary["sessions"]) == 2
    again = sb.replay(session / "journal.db3", sb.load_config(BAGS / "warehouse.yaml")).result.summary
    assert again["run_hash"] == summary["run_hash"]
