"""The table of the firewall: every rule with its severity, what it says, and what to do about it.

An id is `stage/reason`, as in decisions. The live node, `replay` and `doctor` judge by the same rules, /diagnostics takes
severity and advice from here, and docs/firewall.md is this table.
"""

from collections.abc import Mapping
from typing import Literal, NamedTuple

from ..config import OdometrySource, Settle
from ..graph import Decision, Verdict
from ..measurement import Measurement, format_stamp

Severity = Literal["note", "warn", "error"]

LATEST = 1 << 31  # s since 1970
FARTHEST = 1e9  # m; beyond, double precision has no micrometres left
QUATERNION_TOLERANCE = 0.1  # of the squared norm; less is normalized
ABSURD_VARIANCE = 1e12  # m^2 or rad^2 on every used axis: a way to say "unknown"; no factor can come of it
VIOLENT = 1e4  # rad/s or m/s^2: no IMU measures so much
TINY_VARIANCE = 1e-18  # m^2 or rad^2: a sigma of a nanometre; what an integer in a float64 field looks like
ASYMMETRY = 1e-6  # relative to the largest entry
ACCELERATION = 20.0  # m/s^2 by which a speed that an odometry states may be outdone
AWAY = 0.5  # m from its origin: from there no odometry comes back to exactly that in one step
JITTER = 1.0  # m that a step may jump besides max_speed: odometry arrives in bursts
JUMP = 1.0  # s that stamps of the driving source may leap ahead before the next message is asked
WITNESSES = 3  # messages in a row, each following the other, that make a leap believed
USUAL = 4.0  # times its last step: slow sources leap by habit
SILENCE = 10.0  # s without the driving source that are worth a note
EPOCH = 3600.0  # s; a leap beyond is a clock that was set, not a pause
OVERSIZE = 8 << 20  # bytes of one message
MOST_WAITING = 50_000  # measurements of one source that wait: for the driving source, or for a keyframe


class Rule(NamedTuple):
    """severity: note: nothing is lost; warn: messages are lost or weakened; error: the source is of no use until it is mended.
    threshold: what the statistic of a decision is compared with; setting: where it comes from, if it can be changed.
    """

    severity: Severity
    what: str
    advice: str
    threshold: float | None = None
    unit: str = ""
    setting: str = ""


_DEFAULTS = OdometrySource(), Settle()
_CLOCK = "use one clock for all of the robot (chrony or PTP; use_sim_time everywhere or nowhere)"
_STAMP = "set header.stamp to the moment of the measurement"
_COVARIANCE = "mend its covariance; all zeros mean: use the configured default"

RULES: Mapping[str, Rule] = {
    # -- bytes ---------------------------------------------------------------------------------------------------
    "decode/bad_message": Rule(
        "warn", "the bytes or fields of the message make no sense",
        "record or send it anew; its definition must be the one it was written with",
    ),
    "decode/unknown_type": Rule(
        "error", "a source of this kind has no messages of this type", "give the source another kind or another topic",
    ),
    "decode/oversize": Rule(
        "error", "the message is larger than any of its kind should be",
        "is it the right topic? send large batches in parts", OVERSIZE, "bytes",
    ),
    # -- stamps --------------------------------------------------------------------------------------------------
    "check/zero_stamp": Rule("error", "a stamp is zero or negative", _STAMP, 0.0, "ns"),
    "check/far_stamp": Rule("warn", "a stamp is beyond what a ROS header can say", _STAMP, LATEST, "s"),
    "settle/ahead": Rule(
        "error", "the stamp is too far ahead of the driving source", _CLOCK, _DEFAULTS[1].ahead, "s", "settle.ahead"
    ),
    "settle/jump": Rule(
        "warn", "the driving source leaps ahead, and what comes next does not follow", _STAMP, JUMP, "s"
    ),
    "settle/clock_jump": Rule(
        "error", "the clock of the driving source was set",
        "record after the clock is synchronized; live, on_clock_jump: reset begins a new session", EPOCH, "s",
    ),
    "settle/backward": Rule(
        "warn", "the driving source goes back in time by more than settle.lag",
        "is it published twice, or is a bag looped? else raise settle.lag", 0.0, "s", "settle.lag",
    ),
    "settle/late": Rule(
        "note", "it came after its turn; taken at its own stamp", "if it is often so, raise settle.lag", 0.0, "s", "settle.lag"
    ),
    "settle/gap": Rule(
        "note", "the driving source was silent; motion goes straight across", "look for lost messages or a stalled driver",
        SILENCE, "s",
    ),
    "recheck/duplicate": Rule(
        "warn", "a second message with this stamp, or the same relative pose again", "look for two publishers, or a topic recorded twice"
    ),
    # -- values --------------------------------------------------------------------------------------------------
    "check/not_finite": Rule(
        "warn", "a number is NaN, infinite or beyond 1e9", "mend the node that sends it: it diverged or never started", FARTHEST
    ),
    "check/quaternion": Rule(
        "error", "the quaternion is not of unit length", "fill in the orientation (no rotation is 0 0 0 1), normalized", 1.0
    ),
    "check/range": Rule("warn", "the landmark is where the sensor is, or behind it", "drop returns without an echo", 0.0, "m"),
    "recheck/teleport": Rule(
        "warn", "a lone jump, faster than max_speed or its own twist allows",
        "raise max_speed of the source if the robot is that fast; see that its twist is in m/s",
        _DEFAULTS[0].max_speed, "m/s", "<odometry>.max_speed",
    ),
    "recheck/origin": Rule("warn", "a lone pose of exactly zero", "does the driver publish before it knows?", AWAY, "m"),
    "recheck/restart": Rule(
        "warn", "the odometry jumped and stayed there: a new epoch; across the jump it measures nothing",
        "find out why the odometry was reset", _DEFAULTS[0].max_speed, "m/s", "<odometry>.max_speed",
    ),
    # -- IMU -----------------------------------------------------------------------------------------------------
    "recheck/integrated": Rule(
        "warn", "an IMU sample older than one that has been integrated", "raise settle.lag, or send samples in order", 0.0, "s",
        "settle.lag",
    ),
    "imu/gap": Rule(
        "warn", "the IMU was silent, or a stretch of it was lost; velocity and bias go on without it",
        "look for lost messages; max_gap says what is bridged", unit="s", setting="<imu>.max_gap",
    ),
    "imu/saturated": Rule(
        "warn", "the IMU reached the end of its range; the stretch is not used", "damp the mounting, or set a larger range", unit="s"
    ),
    "imu/interpolated": Rule(
        "warn", "for longer than a gap the samples lie on a straight line: somebody filled a gap with them; the stretch is not used",
        "send only what was measured: a gap is better than a guess", unit="s", setting="<imu>.max_gap",
    ),
    "imu/stuck": Rule(
        "warn", "for a second the six numbers of the IMU have not changed at all: a real one has noise; they are used, and this is told once",
        "look for a driver that repeats its last sample; a simulator without noise may do so", 1.0, "s",
    ),
    "imu/gravity": Rule(
        "error", "at the start the mean acceleration is nothing like gravity",
        "accelerations must be in m/s^2 and include gravity (at rest 9.81 upwards)", unit="m/s^2", setting="<imu>.gravity",
    ),
    "imu/degrees": Rule(
        "error", "the gyroscope turns tens of times as far as the odometry: rates in degrees per second? The stretch is not used",
        "angular_velocity must be in rad/s", unit="s",
    ),
    "imu/sideways": Rule(
        "warn", "gravity says that the robot lies on its side: is the IMU mounted so?",
        "tell its mounting: add its frame to 'extrinsics' or send it on /tf_static", unit="rad",
    ),
    "imu/at_rest": Rule(
        "note", "the robot stands still at first: the gyroscope's bias is its mean", "if it does not, say start: motion", unit="s",
        setting="<imu>.start",
    ),
    "imu/in_motion": Rule(
        "note", "the robot moves at first: velocity and bias come from other sensors", "standing still for a second tells more", unit="s",
        setting="<imu>.start",
    ),
    # -- nothing measures the motion -----------------------------------------------------------------------------
    "coast/no_heading": Rule(
        "note", "the robot does not move yet, so nothing tells where it looks: any heading is possible",
        "nothing: the first metres tell; an IMU or odometry would say more",
    ),
    "coast/restart": Rule(
        "warn", "positions in a row fit each other and not the motion before: constant velocity begins anew",
        "look for reflections and a receiver that starts up; if the robot moves so, raise coast.acceleration",
        None, "standard deviations", "coast.acceleration",
    ),
    # -- covariances: only the block that the space uses ---------------------------------------------------------
    "check/zero_covariance": Rule(
        "warn", "a variance of zero takes the configured default", "state a variance, or set the sigmas of the source", 0.0
    ),
    "check/covariance_swapped": Rule(
        "warn", "rotation seems to stand before translation", "ROS wants x y z first, then rotations about x y z"
    ),
    "check/covariance_capped": Rule(
        "note", "a variance beyond 1e12 counts as 1e12, correlated with nothing", "state 1e12 for: unknown", ABSURD_VARIANCE
    ),
    "check/covariance_not_finite": Rule("error", "the covariance holds NaN or infinity", _COVARIANCE),
    "check/covariance_negative": Rule("error", "a variance is negative", _COVARIANCE, 0.0),
    "check/covariance_absurd": Rule(
        "warn", "every used variance says: unknown", "nothing, if its sender means: lost", ABSURD_VARIANCE
    ),
    "check/covariance_tiny": Rule(
        "error", "a variance is absurdly small", "state a true one (was an integer written into a float64 field?)", TINY_VARIANCE
    ),
    "check/covariance_asymmetric": Rule(
        "error", "the covariance is not symmetric", "write all 36 numbers, row by row, in float64", ASYMMETRY
    ),
    "check/covariance_indefinite": Rule(
        "error", "the covariance is not positive definite",
        "write all 36 numbers, row by row; an axis of zero variance has no correlations", 0.0,
    ),
    "check/information_not_finite": Rule("error", "the information holds NaN or infinity", "mend the edge in the file"),
    "check/information_indefinite": Rule(
        "error", "the information is not positive definite", "mend the edge in the file", 0.0
    ),
    # -- frames and names ----------------------------------------------------------------------------------------
    "recheck/other_frame": Rule(
        "error", "an absolute pose that is not in the map's frame", "publish it in map_frame, or set that to the frame of this source"
    ),
    "recheck/frame_changed": Rule(
        "error", "a message from another frame than those before and after", "look for two publishers on the topic"
    ),
    "*/unknown_frame": Rule(
        "error", "nobody says where this frame is on the robot", "add it to 'extrinsics' or send it on /tf_static"
    ),
    "check/no_fix": Rule("note", "the receiver says that it has no fix", "nothing; if it is often so, look at the antenna", 0.0),
    "doubt/unexpected": Rule(
        "warn", "a fix is not where the odometry expects it; kept aside until others agree with it",
        "if it is often so: state larger sigmas for the odometry or the fixes, or set a kernel", None, "", "<gnss>.probability",
    ),
    "doubt/alone": Rule("warn", "a doubted fix with which no other agreed", "look for reflections; see doubt/unexpected"),
    "gnss/withheld": Rule("note", "kept back as a truth, as the configuration wants", "nothing; see withhold and withhold_every"),
    "check/off_earth": Rule(
        "error", "latitude or longitude is out of range, or both are zero",
        "degrees, WGS-84; a receiver without a fix must say so in status", 90.0, "degrees",
    ),
    "check/landmark_id": Rule("warn", "the id is no number", "give each landmark a whole number, the same at each sighting"),
    "check/landmark_kind": Rule(
        "error", "there is no landmark of this kind", "send position, bearing and range, or bearing: see docs/messages.md"
    ),
    "landmark/not_finite": Rule(
        "warn", "a planar map has a tilted sensor, and the sighting lacks an axis, or a covariance of all of them",
        "send x, y and z with their covariance, of a tag all six axes",
    ),
    "landmark/steep": Rule(
        "warn", "a planar map needs the yaw of a tag, and its x axis is not level", "set 'orientation: false', or mount the tag upright"
    ),
    "landmark/orientation": Rule(
        "warn", "a landmark that has an orientation is seen without one", "send one form of sighting for each landmark"
    ),
    "landmark/range": Rule(
        "warn", "the landmark is where the robot is", "drop returns without an echo; see that the mounting of the sensor is right", 0.0, "m"
    ),
    "landmark/quarantined": Rule(
        "warn", "another sighting of a landmark that has been taken out", "see quarantine/moved, moving and duplicate"
    ),
    "landmark/elsewhere": Rule(
        "warn", "a sighting of an id that is at two places, and of neither", "see splitting/moved and duplicate: give each landmark its own number"
    ),
    "landmark/ambiguous": Rule(
        "note", "an id is at two places, and the sighting may be of both", "give each landmark its own number; several in view tell where the robot is"
    ),
    "placing/undetermined": Rule(
        "note", "the sightings of a landmark seen by range or bearing alone do not place it yet", "drive round it; the first path is too straight"
    ),
    "placing/ambiguous": Rule(
        "note", "two places fit the sightings of a landmark", "leave the straight line: it tells one side from the other",
    ),
    "wait/undetermined": Rule(
        "note", "it waits for what it needs: more sightings of its landmark, the yaw of the earth, a joint of two parts of the map",
        "nothing at first: drive on; at the end it says what was missing",
    ),
    "association/nameless": Rule(
        "error", "a bearing or a range alone cannot be associated", "give its landmarks ids, or send positions"
    ),
    "association/ambiguous": Rule(
        "note", "too close to a landmark to be new, and not of it", "if it is often so: state larger sigmas for sightings or odometry",
        None, "", "<landmark>.gate",
    ),
    "association/unconfirmed": Rule("note", "seen too rarely to be a landmark", "nothing: people and leaves end so", None, "", "<landmark>.confirmations"),
    "quarantine/moved": Rule(
        "warn", "the landmark stands elsewhere now", "landmarks must not move: use other tags, or leave this one out"
    ),
    "quarantine/moving": Rule("warn", "the landmark does not stand still", "leave it out: it rides on something"),
    "quarantine/duplicate": Rule("warn", "there are two landmarks of that name", "give each its own number: look for a tag printed twice"),
    "budget/combined": Rule(
        "note", "with other sightings from its keyframe it became one factor", "nothing is lost", None, "", "budget.sightings"
    ),
    "budget/dropped": Rule(
        "note", "of too many sightings of a landmark one that says least", "for more certainty raise the budget", None, "", "budget.sightings"
    ),
    "pixels/no_baseline": Rule("error", "stereo pixels without a baseline", "set 'camera.baseline', or use the right camera's info"),
    "pixels/other_camera": Rule(
        "warn", "the CameraInfo is of another frame than the pixels", "set 'info_topic' to that of the camera which took the images; if it is, let both say one frame_id"
    ),
    "pixels/raw_stereo": Rule("error", "stereo pixels of raw images", "send pixels of rectified images, and set 'image: rectified'"),
    "pixels/id": Rule("warn", "the id of a feature is no whole number", "give each track a number of its own"),
    "pixels/not_finite": Rule("warn", "a pixel or its sigma is NaN, infinite or not positive", "drop features that are lost"),
    "pixels/absurd": Rule("warn", "a pixel or a sigma that no camera has", "pixels and their sigmas must be in pixels"),
    "pixels/behind": Rule(
        "warn", "the feature lies further right in the right image: behind the cameras", "see that u is of the left image and ur of the right"
    ),
    "pixels/twice": Rule("warn", "a feature is in the frame twice", "send each id once in a frame"),
    "pixels/second_frame": Rule("note", "its keyframe has a frame of this source", "nothing; one frame for each keyframe is used"),
    "pixels/outlier": Rule(
        "note", "the feature is not where its point is seen from there", "if it is often so: look at the calibration, and for things that move"
    ),
    "pixels/disagrees": Rule(
        "note", "no point is where all sightings of the feature see it", "if it is often so: look at the calibration, and for things that move"
    ),
    "points/outlier": Rule("note", "a sighting in the graph does not fit its point any more; taken out", "nothing, if it is rare"),
    "points/behind": Rule("note", "a point has come to lie behind a camera that saw it; taken out", "nothing, if it is rare"),
    "calibration/unobservable": Rule(
        "note", "a constant of a sensor cannot be told from the data yet; it stays as configured", "move in more ways, or give it: leave it out of 'calibrate'",
    ),
    "calibration/unsolvable": Rule(
        "warn", "constants and graph could not be solved together; all stay as they are", "calibrate fewer constants at once"
    ),
    "relative/one_keyframe": Rule(
        "note", "both ends of a relative pose land at the same keyframe", "nothing; 'keyframe: true' makes keyframes at its ends"
    ),
    "relative/overlap": Rule(
        "error", "one end of a relative pose lies in the map that is continued, and is no keyframe of it",
        "name a stamp of its keyframes: `query RUN pose@k<n>`, `~/list keyframes`",
    ),
    "*/no_camera": Rule(
        "error", "no calibration of the camera", "set 'camera' of the source, or 'info_topic' to that of its CameraInfo",
    ),
    "*/off_keyframe": Rule(
        "note", "an image between two keyframes", "nothing; 'keyframe: true' makes a keyframe at each image",
    ),
    # -- amounts -------------------------------------------------------------------------------------------------
    "settle/flood": Rule(
        "error", "more wait for the driving source than memory should hold; the oldest are dropped",
        "throttle the source; see that the driving source keeps coming", MOST_WAITING, "messages",
    ),
    "wait/flood": Rule(
        "error", "more wait for a keyframe, or for their landmark, than memory should hold; the oldest are dropped",
        "throttle the source, or set keyframes.time so that a parked robot makes keyframes", MOST_WAITING, "messages",
    ),
    "*/uncovered": Rule("warn", "no trajectory at its stamp", f"see that the driving source covers it; {_CLOCK}"),
}  # fmt: skip


def rule_of(id_: str) -> Rule | None:
    """The rule of a decision's `stage/reason`; None for verdicts that are not the firewall's."""
    return RULES.get(id_) or RULES.get(f"*/{id_.partition('/')[2]}")


class Fault(Exception):  # never leaves the firewall: how a judge names the rule that refuses
    def __init__(self, reason: str, statistic: float | None = None, threshold: float | None = None) -> None:
        """threshold: where it is not the table's."""
        super().__init__(reason)
        self.reason, self.statistic, self.threshold = reason, statistic, threshold


def decided(
    item: Measurement,
    verdict: Verdict,
    id_: str,
    statistic: float | None = None,
    threshold: float | None = None,
    count: int = 1,
) -> Decision:
    """A Decision about a record, in the words of its rule."""
    rule, (stage, _, reason) = RULES[id_], id_.partition("/")
    # One that is taken has its verdict, if it is a loop, still to come.
    ends = None if verdict == "accepted" else item.ends
    return Decision(
        item.stamp, f"{item.source}/{format_stamp(item.stamp)}", item.source, verdict, stage, reason,
        rule.what, statistic, rule.threshold if threshold is None else threshold, ends, count,
    )  # fmt: skip
