"""From what is heard to the journal: what is worth keeping, what drives, when a clock has jumped."""

from collections.abc import Sequence
from typing import Any, Protocol

from ..core.check import checked
from ..core.config import Config
from ..core.measurement import SECOND, ImuSample, StaticTransform
from ..core.sensors.odometry import TRANSFORMS, OdometryPose
from ..io.cdr import Decoder, header_stamp
from ..io.inputs import TF_STATIC
from ..io.journal import LIMIT, LIMIT_BYTES
from ..io.records import Record
from .backlog import Backlog
from .finder import Finder
from .session import Session

JUMP = SECOND  # ns that the driving source must go back for its clock to have jumped
DOUBTFUL, DOUBTFUL_BYTES = 10_000, 64 << 20  # messages at most that are kept in case its clock has jumped


Flowing = OdometryPose | ImuSample | StaticTransform


class Host(Protocol):
    """What the intake needs of its node. session: None while a new one begins: messages wait for it."""

    config: Config
    session: Session | None

    def work(self, session: Session, config: Config) -> None:
        """Solve with these sources from the start of the session on."""

    def begins_anew(self, source: str) -> bool:
        """The clock of a source has jumped: whether a new session is on its way."""

    def moved(self, told: Flowing) -> None:
        """The driving odometry or the IMU said something sound, or where that is mounted."""

    def ignore(self, topic: str, why: str) -> None:
        """What comes on it is of no use."""


class Intake:
    """Of one configured time of a node; for the executor's thread. finding: sources are found while they come."""

    def __init__(self, host: Host, typestore: Any, *, finding: bool) -> None:
        self._host, self._typestore = host, typestore
        self._finder = Finder(typestore) if finding else None
        self._early = Backlog(LIMIT, LIMIT_BYTES)  # heard between two sessions
        self._doubtful = Backlog(
            DOUBTFUL, DOUBTFUL_BYTES
        )  # what went back in time; the odometry's next message tells whether its clock did
        self._static: dict[bytes, str] = {}  # what came on /tf_static, and its type
        self._driving = ""
        self._decoder = Decoder(typestore, {})
        self._jumps = Jumps()

    def use(self, config: Config) -> None:
        """The driving source is decoded here too, for ~/odometry."""
        driver = config.driver
        source = config.sources[driver] if driver is not None else None
        drives = source is not None and source.kind == "odometry"
        self._driving = source.topic if source is not None and drives else ""
        self._early.protected = self._doubtful.protected = source.topic if source is not None else ""
        table = {self._driving: (str(driver), "odometry")} if drives else {}
        imus = {
            source.topic: (name, "imu") for name, source in config.sources.items() if source.kind == "imu"
        }
        static = {TF_STATIC: ("", "static")} if imus else {}
        self._decoder = Decoder(self._typestore, {**table, **imus, **static})

    def begin(self, session: Session) -> None:
        """What is latched comes once, and is for every session."""
        for data, type_ in self._static.items():
            session.journal.append(TF_STATIC, type_, data)

    def receive(self, topic: str, type_: str, data: bytes) -> None:
        self._early.append((topic, type_, data))
        self.drain()

    def drain(self) -> None:
        """Take what waits for a session, if there is one."""
        while self._early and (session := self._host.session) is not None:
            if self._early.dropped:
                session.journal.miss(
                    self._early.dropped, "more came between two sessions than memory should hold"
                )
                self._early.dropped.clear()
            self._take(session, *self._early.popleft())

    def _take(self, session: Session, topic: str, type_: str, data: bytes) -> None:
        record = Record(topic, type_, 0, data)
        if topic == TF_STATIC:
            self._static[data] = type_
        elif self._finder is not None and not self._is_wanted(session, record, self._finder):
            return
        told = self._sound(record)
        odometry = [item for item in told if isinstance(item, OdometryPose)]
        if any(self._jumps.jumped_back(item.stamp) for item in odometry) and self._host.begins_anew(
            odometry[0].source
        ):
            self._early.dropped += self._doubtful.dropped
            self._early.put_back([*self._doubtful.clear(), (topic, type_, data)])
            return
        if self._jumps.doubts or self._is_behind(record):
            self._doubtful.append((topic, type_, data))
        elif odometry:
            self._doubtful.clear()
        if type_ == TRANSFORMS and topic == self._driving and not odometry:
            return  # of other frames
        if not session.journal.append(topic, type_, data):
            self._early.put_back([(topic, type_, data)])  # the session has just ended
            return
        for item in told:
            self._host.moved(item)

    def _is_wanted(self, session: Session, record: Record, finder: Finder) -> bool:
        """Without configured sources: whether the message is worth keeping; a new source gets a worker that knows it."""
        config = finder.look(record, self._host.config)
        if config is not self._host.config:
            self._host.work(session, config)
        if record.topic in finder.unused:
            self._host.ignore(record.topic, finder.unused[record.topic])
        return finder.wants(record, self._host.config)

    def _is_behind(self, record: Record) -> bool:
        """Whether it may be of the time after a jump of which the driving source has not told yet; or it is just late."""
        stamp = header_stamp(self._typestore, record)
        return stamp is not None and self._jumps.goes_back(stamp)

    def _sound(self, record: Record) -> Sequence[Flowing]:
        """What the driving odometry or the IMU says in it, unless it cannot be right; where that is mounted."""
        told = self._decoder.decode(record)
        config = self._host.config
        return [item for item in checked(told, config) if isinstance(item, Flowing)] if told else []


class Jumps:
    """Of the stamps of one source."""

    def __init__(self) -> None:
        self._newest = 0
        self._behind: int | None = None  # a stamp that went back, and waits for a second

    @property
    def doubts(self) -> bool:
        """Whether the newest stamp went back, and the next one tells whether it was a jump."""
        return self._behind is not None

    def goes_back(self, stamp: int) -> bool:
        """Whether a stamp (ns), of any source, lies more than JUMP before the newest."""
        return stamp < self._newest - JUMP

    def jumped_back(self, stamp: int) -> bool:
        """Whether this stamp (ns) confirms a jump: the second in a row that lies more than JUMP back; told once for each."""
        behind = self.goes_back(stamp)
        jumped = behind and self._behind is not None and self._behind < stamp < self._behind + JUMP
        self._behind = stamp if behind and not jumped else None
        self._newest = stamp if jumped else max(self._newest, stamp)
        return jumped
