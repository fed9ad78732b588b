"""The ROS 2 node: a lifecycle node that journals what it hears, has a worker process solve it, and publishes the answers.

The way of a message: raw bytes -> journal -> worker (another process). The way back: report -> State -> a guard
condition wakes the executor -> publishers. ~/odometry is made here, from the newest correction and the newest odometry,
so that it never waits for the solver. No callback blocks, and none ends the node.
"""

import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path
from time import monotonic
from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from ..core.config import Config, config_from, config_to
from ..core.errors import SlamError
from ..core.graph import Decision
from ..core.inertial import ImuSample
from ..core.measurement import SECOND, StaticTransform
from ..core.sensors.odometry import OdometryPose
from ..io.feeder import Feeder, undisturbed
from ..io.restore import RUN, Examination
from ..io.typestore import typestore_of
from .diagnostics import Diagnostics
from .inputs import Inputs
from .intake import Flowing, Intake
from .outputs import Outputs
from .parameters import changed, config_of, declare
from .pose import Odometer, composed
from .propagation import Propagator
from .restoring import Restoring
from .services import Services
from .session import Begin, Session, empty
from .snapshots import Snapshots
from .state import State
from .steadfast import SteadfastNode, explained, survived

LOOK = 0.3  # s between two looks at the graph
BEAT = 0.1  # s within which a signal is heard
WATCHED = ("path", "trajectory", "landmarks", "graph")  # outputs that are made from a snapshot
FAREWELL = 30.0  # s that the worker may take to flush and save at the end
DEFAULT_ODOM = Config().odom_frame
AGAIN = 5.0  # s after which the same incident is worth another line
TRANSPORTS, OVER_UDP = (
    "FASTDDS_BUILTIN_TRANSPORTS",
    "UDPv4",
)  # through shared memory, each process that appears would stop all publishers for 0.3 s (Fast DDS issue 6535)
STEADY = Clock(clock_type=ClockType.STEADY_TIME)  # timers run whether or not /clock does


class BackendNode(SteadfastNode):
    def __init__(self, name: str = "slam_backend", start: Config | None = None, **options: Any) -> None:
        """start: what the parameters override. BadConfig when they make no configuration."""
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **options)
        given = config_of(self, start or Config())
        declare(self, given)
        self.config = self._given = _resolved(given, self.resolve_topic_name)
        self.add_on_set_parameters_callback(lambda new: changed(self.config, new)[1])
        self.add_post_set_parameters_callback(self._parameters_were_set)
        self.state = State(self._wake)
        self._typestore = typestore_of(())
        self._changed = self.create_guard_condition(self._publish)
        self.session: Session | None = None
        self._intake: Intake | None = None
        self._snapshots: Snapshots | None = None
        self._inputs: Inputs | None = None
        self._outputs: Outputs | None = None
        self._answering: Services | None = None
        self._diagnostics: Diagnostics | None = None
        self._odometer, self._propagator = Odometer(self.config), Propagator(self.config)
        self._restoring = Restoring(0, self.get_logger().info)
        self._beats: dict[str, Any] = {}
        self._count = count(1)
        self._changing = threading.Lock()  # a session ends, or begins
        self._closed = threading.Event()
        self._closed.set()

    @property
    def data_dir(self) -> Path:
        """Of this node alone; nothing is written outside of it."""
        name = str(self.get_fully_qualified_name()).strip("/").replace("/", "_")
        return Path(self.config.data_dir or f"~/.ros/slam_backend/{name}").expanduser()

    # -- lifecycle -------------------------------------------------------------------------------

    @explained
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:  # noqa: ARG002
        self._closed = threading.Event()
        self.state.clear()
        self.state.paused = False
        self.config = self._given
        self._intake = Intake(self, self._typestore, finding=not self._given.sources)
        frames = self.config.map_frame, self.config.odom_frame, self.config.base_frame or "base_link"
        self._outputs = Outputs(self, self.config, *frames)
        self._outputs.set_active(False)
        self._diagnostics = Diagnostics(self, self.state)
        self.session = self._opened()
        self._snapshots = Snapshots(self.state, self._feeder)
        with undisturbed():  # the services start a process
            self._answering = Services(
                self,
                self.state,
                lambda: self.session,
                self._snapshots.ask,
                self.data_dir,
                self.config,
                self.reset,
            )
        return TransitionCallbackReturn.SUCCESS

    @explained
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:  # noqa: ARG002
        self._inputs = Inputs(self, self._received, finding=not self._given.sources)
        table: dict[str, tuple[float, Callable[[], None]]] = {
            "look": (LOOK, self._look),
            "refresh": (1.0 / self.config.path.rate, self._refresh_if_watched),
            "diagnose": (1.0, self._diagnose),
        }
        self._beats = {name: self.create_timer(*beat, clock=STEADY) for name, beat in table.items()}
        if self._outputs is not None:
            self._outputs.set_active(True)
        self._look()
        return TransitionCallbackReturn.SUCCESS

    @explained
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:  # noqa: ARG002
        self._silence()
        return TransitionCallbackReturn.SUCCESS

    @explained
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:  # noqa: ARG002
        self.close()
        return TransitionCallbackReturn.SUCCESS

    @explained
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:  # noqa: ARG002
        self.close()
        return TransitionCallbackReturn.SUCCESS

    def close(self) -> None:
        """Save the run, let go of everything. Safe to call twice."""
        self._closed.set()
        self._silence()
        with self._changing:
            if self._intake is not None:
                self._intake.drain()
            session, self.session = self.session, None
            if session is not None:
                self._end(session)
        for part in (self._snapshots, self._answering, self._outputs, self._diagnostics):
            if part is not None:
                part.close()
        self._snapshots = self._answering = self._outputs = self._diagnostics = self._intake = None

    def reset(self, begin: Begin = empty) -> None:
        """A new session: the run so far is saved, its journal set aside, the map starts empty. Takes a while; any thread.

        begin: journals what the session begins with. What is heard meanwhile waits for the new session. SlamError if there can be none.
        """
        with self._changing:
            if self._closed.is_set():
                raise SlamError("there is no session: the node is not configured")
            session, self.session = self.session, None
            self._renew(session, begin)

    def _renew(self, ended: Session | None, begin: Begin = empty) -> None:
        if ended is not None:
            self._end(ended)
        self.state.clear()
        self._odometer, self._propagator = Odometer(self.config), Propagator(self.config)
        self.session = self._opened(begin, fresh=True)
        self.get_logger().info("a new session has begun")

    def _renew_in_background(self, ended: Session | None) -> None:
        """A thread, which has been given the lock."""
        try:
            while not self._closed.is_set() or ended is not None:
                try:
                    return self._renew(ended)
                except SlamError as error:
                    self.incident(str(error))
                    ended = None
                    self._closed.wait(AGAIN)
        finally:
            self._changing.release()

    def _silence(self) -> None:
        """Neither listen nor publish."""
        for timer in self._beats.values():
            self.destroy_timer(timer)
        self._beats = {}
        if self._inputs is not None:
            self._inputs.close()
            self._inputs = None
        if self._outputs is not None:
            self._outputs.set_active(False)

    # -- session ---------------------------------------------------------------------------------

    def _opened(self, begin: Begin = empty, *, fresh: bool = False) -> Session:
        """Journal and worker. BadFile where the data directory cannot be used."""
        session = Session(self.data_dir, self.state, self.incident, self.config, fresh=fresh)
        begin(session)
        config = session.config(self.config)
        if session.past is not None:
            self._explain(session.past, config)
        if self._intake is not None:
            self._intake.begin(session)
        if config.sources:
            self.work(session, config)
        return session

    def _explain(self, past: Examination, config: Config) -> None:
        """A session goes on: say so, and what is different."""
        log = self.get_logger()
        log.info(f"{past.path}: its session was not ended, and goes on: {past.records} records are restored")
        if past.torn:
            log.warning(f"{past.path}: {past.torn}")
        if not past.is_solved_alike(config):
            log.warning(
                "the configuration is not that of the session so far: its trajectory will be another one"
            )
        self._restoring = Restoring(past.records, log.info)

    def work(self, session: Session, config: Config) -> None:
        """Solve with these sources from the start of the session on."""
        for name in set(config.sources) - set(self.config.sources):
            self.get_logger().info(f"{config.sources[name].topic} is used as {config.sources[name].kind}")
        self.config = config
        self._odometer, self._propagator = Odometer(config), Propagator(config)
        if self._intake is not None:
            self._intake.use(config)
        session.work(config)

    def _end(self, session: Session) -> None:
        folder = self.data_dir / RUN
        try:
            summary = session.end(FAREWELL)
        except SlamError as error:
            self.get_logger().error(f"the run was not saved: {error}; its journal is {session.journal.path}")
            return
        self.get_logger().info(
            f"saved {folder}: run hash {summary['run_hash'][:16]}"
            if summary
            else "nothing was heard: there is no run to save"
        )

    def _feeder(self) -> Feeder | None:
        session = self.session
        return session.feeder if session is not None else None

    def incident(self, what: str) -> None:
        """Say that something went wrong; from any thread."""
        past = list(self.state.incidents)
        stamp = self.state.update.keyframe.stamp if self.state.update else 0
        decision = Decision(
            stamp, f"incident/{next(self._count)}", "node", "removed", "node", "incident", what
        )
        self.state.happen(what, decision)
        if not any(said == what and monotonic() - when < AGAIN for when, said in past):
            self.get_logger().error(what)

    # -- the way in ------------------------------------------------------------------------------

    @survived
    def _look(self) -> None:
        if self._intake is not None and self._inputs is not None:
            self._intake.drain()  # what came while a new session began, and nothing has come since
            self._inputs.look(self.config)

    @survived
    def _received(self, topic: str, type_: str, data: bytes) -> None:
        if self._intake is not None:
            self._intake.receive(topic, type_, data)

    def ignore(self, topic: str, why: str) -> None:
        """What comes on this topic is of no use."""
        if self._inputs is not None and topic in self._inputs.flows:
            self.get_logger().info(f"{topic} is left aside: {why}")
            self._inputs.ignore(topic)

    def begins_anew(self, source: str) -> bool:
        """The clock of a source has jumped: whether a new session is on its way. Then messages wait for it."""
        choice = self.config.on_clock_jump
        self.incident(f"the clock of '{source}' jumped back; on_clock_jump: {choice}")
        if choice != "reset" or not self._changing.acquire(blocking=False):
            return False
        session, self.session = self.session, None
        threading.Thread(target=self._renew_in_background, args=(session,), name="reset", daemon=True).start()
        return True

    def moved(self, told: Flowing) -> None:
        """The driving odometry or the IMU said something sound: where the robot is in the map, at once."""
        if isinstance(told, StaticTransform):
            self._propagator.mounted(told)
        elif isinstance(told, ImuSample):
            self._carried_on(told)
        else:
            self._moved(told)

    def _carried_on(self, sample: ImuSample) -> None:
        """By the IMU: its rate is that of ~/odometry."""
        outputs, update = self._outputs, self.state.update
        carried = self._propagator.carry(sample, update, self.state.covariance)
        if outputs is None or update is None or carried is None:
            return
        outputs.odometry(sample.stamp, carried.seven, carried.covariance, twist=carried.twist)
        if self._propagator.drives:
            outputs.map_to_odom(sample.stamp, composed(update.correction, update.origin))

    def _moved(self, odometry: OdometryPose) -> None:
        """By the odometry; where an IMU carries on from the newest keyframe, that tells ~/odometry."""
        self._propagator.named(odometry.child)
        outputs = self._outputs
        if outputs is None or not self._odometer.goes_on(odometry.stamp):
            return
        pose = self._odometer.locate(odometry, self.state.update, self.state.covariance)
        if pose is None:
            return
        if odometry.frame not in ("", self.config.map_frame) and self.config.odom_frame == DEFAULT_ODOM:
            outputs.odom_frame = odometry.frame
        if not self._propagator.carries(odometry.stamp):
            outputs.odometry(
                odometry.stamp,
                pose.seven,
                pose.covariance,
                odometry.child,
                odometry.twist,
                odometry.twist_covariance,
            )
        outputs.map_to_odom(odometry.stamp, pose.correction)

    # -- the way out -----------------------------------------------------------------------------

    def _wake(self) -> None:
        """From the feeder's thread: let the executor publish."""
        if not self._closed.is_set():
            self._changed.trigger()

    @survived
    def _publish(self) -> None:
        outputs, update = self._outputs, self.state.update
        if outputs is None or not self._beats:
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

    @survived
    def _refresh_if_watched(self) -> None:
        outputs, snapshots = self._outputs, self._snapshots
        if outputs is not None and snapshots is not None and any(map(outputs.has_listeners, WATCHED)):
            snapshots.ask()

    @survived
    def _diagnose(self) -> None:
        session = self.session
        self._restoring.look(self.state.applied)
        if self._inputs is not None and self._diagnostics is not None:
            self._diagnostics.publish(
                self._inputs, self._feeder(), session.journal if session else None, self.config
            )

    @survived
    def _parameters_were_set(self, parameters: list[Parameter]) -> None:
        self._given, _ = changed(self._given, parameters)
        self.config, _ = changed(self.config, parameters)
        if self._outputs is not None:
            self._outputs.config = self.config
        if "refresh" in self._beats:
            self._beats["refresh"].timer_period_ns = round(SECOND / self.config.path.rate)


def _resolved(config: Config, resolve: Callable[[str], str]) -> Config:
    """With the topics as they are called on the network, remapping included: so the journal and its replay name them."""
    data = config_to(config)
    for name in data["sources"]:
        data[name]["topic"] = resolve(data[name]["topic"] or name)
    return config_from(data, "parameters")


def main(arguments: list[str] | None = None, config: Config | None = None) -> int:
    """Run the node until it is told to stop; exit code 2 with one line for a wrong configuration.

    config: what the parameters start from; ROS arguments override it.
    """
    os.environ.setdefault(TRANSPORTS, OVER_UDP)
    wishes: list[int] = []
    for wish in (signal.SIGINT, signal.SIGTERM):
        signal.signal(wish, lambda number, _: wishes.append(number))  # more than one changes nothing
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        node = BackendNode(start=config)
    except Exception as error:  # noqa: BLE001  # rclpy's for malformed arguments are no public classes
        sys.stderr.write(f"slam-backend: {' '.join(str(error).split())}\n")
        rclpy.try_shutdown()
        return 2
    try:
        return _run(node, wishes)
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown()


def _run(node: BackendNode, wishes: Sequence[int]) -> int:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    node.create_timer(BEAT, lambda: None, clock=STEADY)  # Python hears a signal between two callbacks only
    if node.config.autostart:
        if node.trigger_configure() != TransitionCallbackReturn.SUCCESS:
            return 2  # the reason has been logged
        node.trigger_activate()
    gc.collect()
    gc.freeze()  # modules and message types: to look through them again and again would stop all threads for 50 ms each time
    while not wishes and rclpy.ok():
        executor.spin_once()
    return 0


if __name__ == "__main__":
    sys.exit(main())
