"""One message as it travels and is stored: bytes, not yet understood."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """A message of a live topic, a bag or the journal.

    type: as ROS 2 spells it, `nav_msgs/msg/Odometry`.
    log_time: ns, when it was received or recorded; for order and diagnostics, never for a verdict.
    data: CDR, including the 4-byte encapsulation header.
    """

    topic: str
    type: str
    log_time: int
    data: bytes
