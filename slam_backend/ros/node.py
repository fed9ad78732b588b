"""The ROS 2 node: a lifecycle node that journals what it hears, has a worker process solve it, and publishes the answers.

The way of a message: raw bytes -> journal -> worker (another process). The way back: report -> State -> a guard
condition wakes the executor -> publishers. ~/odometry is made in this process (locator.py), from the newest correction and
the newest odometry, so that it never waits for the solver. No callback blocks, and none ends the node.
"""

import threading
from collections.abc import Callable
from itertools import count
from pathlib import Path
from time import monotonic
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter

from ..core.backend import Update
from ..core.config import Config, config_from, config_to
from ..core.errors import SlamError
from ..core.graph import Decision
from ..core.measurement import SECOND
from ..io.feeder import Feeder, undisturbed
from ..io.restore import RUN, Examination
from ..io.typestore import typestore_of
from .diagnostics import Diagnostics
from .inputs import Inputs
from .intake import Flowing, Intake
from .locator import Locator
from .outputs import Outputs
from .parameters import changed, config_of, declare
from .restoring import Restoring
from .services import Services
from .session import Begin, Session, empty
from .snapshots import Snapshots
from .state import State
from .steadfast import SteadfastNode, explained, survived

LOOK = 0.3  # s between two looks at the graph
WATCHED = ("path", "trajectory", "landmarks", "graph")  # outputs that are made from a snapshot
FAREWELL = 30.0  # s in which the worker must come further at the end, and save
AGAIN = 5.0  # s after which the same incident is worth another line
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
        self._locator: Locator | None = None
        self._told: Update | None = None  # the newest that was published
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
        self._snapshots = self._answering = self._outputs = self._diagnostics = None
        self._intake = self._locator = None

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
        self._locator = None
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
        if self._outputs is not None:
            self._locator = Locator(config, self.state, self._outputs)
        if self._intake is not None:
            self._intake.use(config)
        session.work(config)

    def _end(self, session: Session) -> None:
        folder = self.data_dir / RUN
        if session.feeder is not None and (left := session.feeder.backlog):
            self.get_logger().info(
                f"ending: {left} records are yet to be read, then the run is saved to {folder}"
            )
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
        if self._locator is not None:
            self._locator.moved(told)

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
        if update is not None and update is not self._told:
            self._told = update
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
