"""The ROS 2 node: a lifecycle node that journals what it hears, has a worker process solve it, and publishes the answers.

The way of a message: raw bytes -> journal -> worker (another process). The way back: report -> State -> a guard
condition wakes the executor -> publishers. ~/odometry is made here, from the newest correction and the newest odometry,
so that it never waits for the solver. No callback blocks.
"""

import signal
import sys
import threading
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from time import monotonic
from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter

from ..core.config import Config, config_from, config_to
from ..core.errors import BadFile, SlamError
from ..core.measurement import SECOND
from ..core.sensors.odometry import OdometryPose
from ..io.cdr import Decoder
from ..io.discover import is_truth, kind_of, name_of
from ..io.feeder import Feeder
from ..io.inputs import TF_STATIC
from ..io.journal import NAME as JOURNAL
from ..io.journal import Journal
from ..io.records import Record
from ..io.typestore import typestore_of
from .diagnostics import Diagnostics
from .inputs import Inputs
from .outputs import Outputs
from .parameters import changed, config_of, declare, overrides
from .pose import Odometer
from .services import Services
from .state import State

LOOK = 0.3  # s between two looks at the graph
JUMP = SECOND  # ns that the driving source must go back for its clock to have jumped
WATCHED = ("path", "trajectory", "landmarks", "graph")  # outputs that are made from a snapshot
FAREWELL = 30.0  # s that the worker may take to flush and save at the end


def _explained(
    transition: Callable[..., TransitionCallbackReturn],
) -> Callable[..., TransitionCallbackReturn]:
    """Rclpy swallows what a transition raises; say it, and fail."""

    @wraps(transition)
    def wrapped(node: "BackendNode", state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except SlamError as error:
            node.get_logger().error(str(error))
        except Exception as error:  # noqa: BLE001  # whatever it is, it must be said
            node.get_logger().error(f"{transition.__name__}: {type(error).__name__}: {error}")
        return TransitionCallbackReturn.FAILURE

    return wrapped


class BackendNode(LifecycleNode):
    def __init__(self, name: str = "slam_backend", **options: Any) -> None:
        """BadConfig when the parameters make no configuration."""
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **options)
        self.config = config_of(self)
        declare(self, self.config)
        self.add_on_set_parameters_callback(self._set_parameters)
        self.state = State(self._wake)
        self._typestore = typestore_of(())
        self._changed = self.create_guard_condition(self._publish)
        self._refresh = threading.Event()
        self._journal: Journal | None = None
        self._feeder: Feeder | None = None
        self._inputs: Inputs | None = None
        self._outputs: Outputs | None = None
        self._answering: Services | None = None
        self._decoder: Decoder | None = None
        self._beats: list[Any] = []
        self._kinds: dict[str, str | None] = {}  # topics whose first message has been looked at
        self._odometer = Odometer(self.config)
        self._closing = False

    @property
    def data_dir(self) -> Path:
        """Of this node alone; nothing is written outside of it."""
        name = str(self.get_fully_qualified_name()).strip("/").replace("/", "_")
        return Path(self.config.data_dir or f"~/.ros/slam_backend/{name}").expanduser()

    # -- lifecycle -------------------------------------------------------------------------------

    @_explained
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:  # noqa: ARG002
        self._open()
        self._closing = False
        self._outputs = Outputs(
            self,
            self.config,
            self.config.map_frame,
            self.config.odom_frame,
            self.config.base_frame or "base_link",
        )
        self._answering = Services(
            self, self.state, lambda: self._feeder, self._refresh.set, self.data_dir, self.config, self.reset
        )
        self._diagnostics = Diagnostics(self, self.state)
        threading.Thread(target=self._snapshots, name="snapshots", daemon=True).start()
        return TransitionCallbackReturn.SUCCESS

    @_explained
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:  # noqa: ARG002
        self._inputs = Inputs(self, self._received)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # timers run whether or not /clock does
        self._beats = [
            self.create_timer(LOOK, self._look, clock=steady),
            self.create_timer(1.0 / self.config.path.rate, self._refresh_if_watched, clock=steady),
            self.create_timer(1.0, self._diagnose, clock=steady),
        ]
        if self._outputs is not None:
            self._outputs.set_active(True)
        self._look()
        return TransitionCallbackReturn.SUCCESS

    @_explained
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:  # noqa: ARG002
        self._silence()
        if self._outputs is not None:
            self._outputs.set_active(False)
        return TransitionCallbackReturn.SUCCESS

    @_explained
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:  # noqa: ARG002
        self.close()
        return TransitionCallbackReturn.SUCCESS

    @_explained
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:  # noqa: ARG002
        self.close()
        return TransitionCallbackReturn.SUCCESS

    def _LifecycleNodeMixin__on_change_state(self, request: Any, response: Any) -> Any:  # noqa: N802
        """A transition that is not legal here is answered, not died of: rclpy raises it out of spin."""
        try:
            return super()._LifecycleNodeMixin__on_change_state(request, response)
        except Exception as error:  # noqa: BLE001  # RCLError is no public class
            self.get_logger().warning(f"transition refused: {str(error).splitlines()[0]}")
            response.success = False
            return response

    def close(self) -> None:
        """Flush, save the run, let go of everything. Safe to call twice."""
        if self._closing:
            return
        self._closing = True
        self._silence()
        self._end_session("run")
        for part in (self._answering, self._outputs):
            if part is not None:
                part.close()
        self._answering = self._outputs = None

    def reset(self) -> None:
        """A new session: the run so far is saved, its journal set aside, the map starts empty. Takes a while; any thread."""
        self._end_session("run")
        self.state.clear()
        self._kinds.clear()
        self._open()
        self.get_logger().info("a new session has begun")

    # -- session ---------------------------------------------------------------------------------

    def _open(self) -> None:
        """Journal and worker. BadFile where the data directory cannot be used."""
        folder = self.data_dir
        _set_aside(folder / JOURNAL)
        self._journal = Journal(folder, self._incident)
        self._odometer = Odometer(self.config)
        if self.config.sources:
            self._start(self.config)

    def _start(self, config: Config) -> None:
        """A worker for these sources; one that runs already is replaced, and reads the journal from its start."""
        assert self._journal is not None
        if self._feeder is not None:
            self._feeder.close()
        self.config = config
        resolve = self.resolve_topic_name
        table = {resolve(source.topic): (name, source.kind) for name, source in config.sources.items()}
        self._decoder = Decoder(self._typestore, table)
        self._feeder = Feeder(
            self._journal, config, table | {TF_STATIC: (TF_STATIC, "static")}, self.state.take, self._incident
        )

    def _end_session(self, folder: str) -> None:
        journal, feeder = self._journal, self._feeder
        self._journal = self._feeder = None
        if journal is not None:
            journal.close()
        if feeder is None:
            return
        try:
            summary = feeder.finish(str(self.data_dir / folder), FAREWELL)
            self.get_logger().info(f"saved {self.data_dir / folder}: run hash {summary['run_hash'][:16]}")
        except SlamError as error:
            self.get_logger().error(
                f"the run was not saved ({error}); its journal is {journal.path if journal else 'lost'}"
            )

    def _silence(self) -> None:
        for timer in self._beats:
            self.destroy_timer(timer)
        self._beats = []
        if self._inputs is not None:
            self._inputs.close()
            self._inputs = None

    def _incident(self, what: str) -> None:
        self.state.incidents.append(what)
        self.get_logger().error(what)

    # -- the way in ------------------------------------------------------------------------------

    def _look(self) -> None:
        if self._inputs is not None:
            self._inputs.look(self.config)

    def _received(self, topic: str, type_: str, data: bytes) -> None:
        if self._journal is None:
            return
        self._journal.append(topic, type_, data)
        if topic not in self._kinds and topic != TF_STATIC:
            self._recognize(Record(topic, type_, 0, data))
        if self._decoder is not None:
            for item in self._decoder.decode(Record(topic, type_, 0, data)) if self._drives(topic) else ():
                if isinstance(item, OdometryPose):
                    self._moved(item)

    def _drives(self, topic: str) -> bool:
        driver = self.config.driver
        return driver is not None and self.resolve_topic_name(self.config.sources[driver].topic) == topic

    def _moved(self, odometry: OdometryPose) -> None:
        if self._odometer.jumped_back(odometry.stamp, JUMP):
            self._incident(
                f"the clock of '{odometry.source}' jumped back; on_clock_jump: {self.config.on_clock_jump}"
            )
            if self.config.on_clock_jump == "reset":
                threading.Thread(target=self.reset, name="reset", daemon=True).start()
                return
        pose = self._odometer.locate(odometry, self.state.update, self.state.covariance)
        if pose is not None and self._outputs is not None:
            self._outputs.odometry(
                odometry.stamp,
                pose.seven,
                pose.covariance,
                odometry.child or "base_link",
                odometry.twist,
                odometry.twist_covariance,
            )
            self._outputs.map_to_odom(odometry.stamp, pose.correction)

    def _recognize(self, record: Record) -> None:
        """Without configured sources: what a topic is, by its first message."""
        resolve = self.resolve_topic_name
        if any(resolve(source.topic) == record.topic for source in self.config.sources.values()):
            self._kinds[record.topic] = None
            return
        kind = None if is_truth(record.topic) else kind_of(record, self._typestore)
        self._kinds[record.topic] = kind
        driver = self.config.driver
        odometry_known = driver is not None and self.config.sources[driver].kind == "odometry"
        if kind is None or (kind == "odometry" and odometry_known):
            return
        found = {"kind": kind, "topic": record.topic}
        data = config_to(self.config)
        name = name_of(record.topic)
        sources = [*data["sources"], name]
        config = config_from({**data, "sources": sources, name: found}) if kind != "pose" or driver else None
        if config is None or config.driver is None:
            del self._kinds[record.topic]  # to be looked at again when something drives
            return
        self.get_logger().info(f"{record.topic} is used as {kind}")
        self._start(config)

    # -- the way out -----------------------------------------------------------------------------

    def _wake(self) -> None:
        """From the feeder's thread: let the executor publish."""
        if not self._closing:
            self._changed.trigger()

    def _publish(self) -> None:
        outputs, update = self._outputs, self.state.update
        if outputs is None:
            return
        if decisions := self.state.untold_decisions():
            outputs.decisions(decisions)
        if update is not None and self._odometer.is_new(update):
            outputs.pose(update, self.state.covariance)
        snapshot = self.state.take_snapshot()
        if snapshot is not None:
            outputs.path(snapshot)
            outputs.trajectory(snapshot)
            outputs.landmarks(snapshot)
            outputs.graph(snapshot, list(self.state.decided.values()))

    def _snapshots(self) -> None:
        """A thread: fetch a snapshot when one is asked for and there is something new."""
        shown = -1
        while not self._closing:
            self._refresh.wait()
            self._refresh.clear()
            feeder, update = self._feeder, self.state.update
            if feeder is None or update is None or update.keyframe.index == shown:
                continue
            begin = monotonic()
            try:
                self.state.show(feeder.request("snapshot", timeout=FAREWELL))
            except SlamError:
                continue  # the worker is being replaced; there will be another
            shown = update.keyframe.index
            threading.Event().wait(4 * (monotonic() - begin))  # at most a fifth of the worker's time

    def _refresh_if_watched(self) -> None:
        if self._outputs is not None and any(map(self._outputs.has_listeners, WATCHED)):
            self._refresh.set()

    def _diagnose(self) -> None:
        if self._inputs is not None:
            self._diagnostics.publish(self._inputs.flows, self._feeder, self._journal, self.config)

    def _set_parameters(self, parameters: list[Parameter]) -> Any:
        config, result = changed(self.config, parameters)
        if result.successful:
            self.config = config
            if self._outputs is not None:
                self._outputs.config = config
        return result


def _set_aside(journal: Path) -> None:
    """An earlier session's journal stays, under the next free name."""
    if not journal.exists():
        return
    n = 1
    while (kept := journal.with_name(f"journal-{n}.db3")).exists():
        n += 1
    try:
        for ending in ("", "-wal", "-shm"):
            part = journal.with_name(journal.name + ending)
            if part.exists():
                part.rename(kept.with_name(kept.name + ending))
    except OSError as error:
        raise BadFile(f"{journal}: cannot be set aside: {error}") from None


def main(arguments: list[str] | None = None, config: Config | None = None) -> int:
    """Run the node until it is told to stop; exit code 2 with one line for a wrong configuration.

    config: what the parameters start from; ROS arguments override it.
    """
    rclpy.init(args=arguments)
    try:
        node = BackendNode(parameter_overrides=overrides(config) if config else [])
    except SlamError as error:
        sys.stderr.write(f"slam-backend: {error}\n")
        rclpy.try_shutdown()
        return 2
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        if node.config.autostart:
            if node.trigger_configure() != TransitionCallbackReturn.SUCCESS:
                return 2  # the reason has been logged
            node.trigger_activate()
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass  # both are how one ends a node
    finally:
        for wish in (signal.SIGINT, signal.SIGTERM):
            signal.signal(wish, signal.SIG_IGN)  # a second Ctrl-C must not tear the saving
        node.close()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
