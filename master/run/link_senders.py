"""Link of the master admits senders, rejects them or silences them for a while.

- Limits: `common.messages` refuses what no sensor can measure; here picture size, number of markers and rate
  are those of the sender's own files, and times are compared with the clock.
- `RejectedPeers`: who was rejected lately (second process, other wire version, wrong secret, other markers),
  for the checklist; bounded by the names of the rig, forgotten 1.5 s after the last time.
- `Quarantine`: what passes all bounds and still makes something raise is a fault of this program. It costs
  the sender a pause, and the others nothing. The pause doubles with each fault from `FIRST_NS` to
  `LONGEST_NS`, and begins anew after a sender was well for `LONGEST_NS`. Each failure is counted, and logged
  once with its cause.
"""

import logging
import traceback
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import hypot
from typing import Literal, NamedTuple, TypeAlias

from common.arrays import Float
from common.clock import TokenBucket
from common.link.clock_offset import ClockEstimate, OffsetEstimator
from common.link.datagram import HEADER, MAGIC, Address, Header, Kind, Opener, Refusal, Sealer
from common.link.handshake import Hello, RigKeys
from common.messages import (
    Detections,
    ImuSample,
    MarkerDetections,
    TagDetections,
    TrackerPose,
    WristDetections,
    restamped,
)
from master.rig.setup import RigSetup
from master.run.sequence import CYCLE_FRAMES, Counted, Sequence

READY_NS = 10_000_000_000  # between the exposure of a frame and the slave's having it
OLD_NS = 1_000_000_000  # no message is older when it comes: it would be of no use

SensorMessage: TypeAlias = Detections | TagDetections | ImuSample | TrackerPose


@dataclass(frozen=True, slots=True)
class SenderLimits:
    """Limits that the files state for one camera, IMU or tracker; None: not checked.

    Attributes:
        picture_px: Width and height.
        markers: How many markers its rig names.
        rate_hz: Messages per second and kind.
    """

    picture_px: tuple[int, int] | None = None
    markers: int | None = None
    rate_hz: float | None = None


def bucket_of(rate_hz: float | None) -> TokenBucket:
    """How many messages of a kind a sender may send; `rate_hz` of its files, or None."""
    # than the rate of the file: settings can be tried live; each message costs milliseconds of solving
    faster = 2.0
    any_hz = 10_000.0  # where no file states a rate
    least_hz = 60.0
    per_s = any_hz if rate_hz is None else max(faster * rate_hz, least_hz)
    # of it may come at once: at the rate of the file, what a second's halt of the network held up
    burst_s = 0.5
    return TokenBucket(per_s, per_s * burst_s)


def refused(message: SensorMessage, limits: SenderLimits) -> Refusal | None:
    """Why a message cannot be of a sender with these files; None: it can."""
    if isinstance(message, (ImuSample, TrackerPose)):  # a tuple: a union would be made anew for each message
        return None
    if abs(message.ready_t_ns - message.t_ns) > READY_NS:
        return Refusal.READY_TIME
    if isinstance(message, MarkerDetections) and limits.markers not in (None, len(message.area)):
        return Refusal.MARKER_COUNT
    if limits.picture_px is not None and any(_outside(uv, limits.picture_px) for uv in _points(message)):
        return Refusal.OUTSIDE_PICTURE
    return None


def limits_of(setups: Iterable[RigSetup]) -> dict[str, SenderLimits]:
    """Return the limits of all cameras, IMUs and trackers of these rigs, by name."""
    limits: dict[str, SenderLimits] = {}
    for setup in setups:
        for name, camera in setup.cameras.items():
            size = camera.width_px, camera.height_px
            own = None if name in setup.wrist_cameras else len(setup.rows.get(name, setup.markers))
            before = limits[name].markers if name in limits else None  # of a rig that watches several hands
            markers = own if before is None or own is None else own + before
            rate_hz = camera.frame_rate_hz / (CYCLE_FRAMES if name in setup.wrist_cameras else 1)
            limits[name] = SenderLimits(size, markers, rate_hz)
        for rig in (setup.rig, setup.wrist_rig):
            if rig is not None and rig.imu is not None:
                # than its file: a sensor has its own rates, and takes the next that is enough
                imu_faster = 2.0
                limits[rig.imu.name] = SenderLimits(rate_hz=imu_faster * rig.imu.rate_hz)
        tracker_hz = 500.0
        limits |= dict.fromkeys(setup.trackers, SenderLimits(rate_hz=tracker_hz))
    return limits


def _points(message: Detections | TagDetections) -> tuple[Float, ...]:
    if isinstance(message, WristDetections):
        return message.laser_uv, message.tip_uv
    if isinstance(message, MarkerDetections) and message.has_alternatives:
        return message.uv, message.alt_uv
    return (message.uv,)


def _outside(uv: Float, size: tuple[int, int]) -> bool:
    """Whether a point (..., 2) is farther outside than a picture's size; NaN is not."""
    width, height = size
    points: list[list[float]] = uv.reshape(-1, 2).tolist()
    return any(u < -width or u > 2 * width or v < -height or v > 2 * height for u, v in points)


OLD_NONCES = 64
ASKED = 256  # echoes that wait for an answer; later ones are worth nothing


@dataclass(slots=True)
class Session:
    """One session of one slave, pending or live."""

    name: str
    hello: Hello
    session_nonce: bytes
    proof: bytes
    key_id: int
    address: Address
    sealer: Sealer
    opener: Opener
    since_ns: int
    received_ns: int
    next_echo_ns: int
    next_start_ns: int
    started: bool = False
    asked: dict[int, None] = field(default_factory=dict[int, None])
    clock: OffsetEstimator = field(default_factory=OffsetEstimator)


@dataclass(slots=True)
class Sender:
    """One camera, IMU or tracker, with its `kinds` of message, the main one first."""

    kinds: dict[type[SensorMessage], Counted]
    limits: SenderLimits
    buckets: dict[type[SensorMessage], TokenBucket]
    live: Session | None = None
    pending: Session | None = None
    old_nonces: deque[bytes] = field(default_factory=lambda: deque[bytes](maxlen=OLD_NONCES))
    steps_before: int = 0  # of the clock in sessions that are over
    restarts: int = 0
    refused: int = 0  # of what it sealed in a session

    @classmethod
    def of(cls, steps: Mapping[type[SensorMessage], int | None], limits: SenderLimits) -> "Sender":
        """A sender of the kinds in `steps`: how much each number rises per message."""
        kinds = {kind: Counted(Sequence(step)) for kind, step in steps.items()}
        return cls(kinds, limits, {kind: bucket_of(limits.rate_hz) for kind in kinds})

    def limit(self, limits: SenderLimits) -> None:
        """Let it be within other limits from now on."""
        if limits != self.limits:
            self.limits, self.buckets = limits, {kind: bucket_of(limits.rate_hz) for kind in self.kinds}

    @property
    def main(self) -> Counted:
        """What it sends all the time."""
        return next(iter(self.kinds.values()))

    def fill(self, counter: int, own: Counted | None = None) -> None:
        """Note a late datagram: in the gaps of other kinds than `own` it is no loss."""
        for kind in self.kinds.values():
            if kind is not own:
                kind.losses.late(counter, 0)


def not_admitted(message: SensorMessage, session: Session, sender: Sender, now_ns: int) -> Refusal | None:
    """Why a message that came at `now_ns` is not taken of this sender; None: it is."""
    kind = type(message)
    if message.session != session.hello.process:
        return Refusal.FOREIGN_SESSION
    if not sender.buckets[kind].take(now_ns):
        return Refusal.RATE
    if (why := refused(message, sender.limits)) is not None:
        return why
    return None if sender.kinds[kind].plausible(message.session, message.seq, now_ns) else Refusal.SEQUENCE


def on_master_clock(
    message: SensorMessage, clock: ClockEstimate | None, kind: Counted, now_ns: int
) -> SensorMessage | None:
    """The message with its times on the master's clock; None where they cannot be.

    They cannot while the clock is not known (data before the start), nor where the time is more than 50 ms
    after `now_ns`, is older than `OLD_NS`, or is not after the last of its kind. Nothing was measured after
    it came: what is ahead by less is of now, and its standard deviation is as large as the error that this
    shows.
    """
    if clock is None:
        return None
    stamped_ns = clock.to_local(message.t_ns)
    t_ns = min(stamped_ns, now_ns)
    ahead_ns = 50_000_000  # by how much the conversion of a time to this clock may be wrong
    if not now_ns - OLD_NS <= stamped_ns <= now_ns + ahead_ns or (
        kind.newest_ns is not None and t_ns <= kind.newest_ns
    ):
        return None
    kind.newest_ns = t_ns
    if isinstance(message, (ImuSample, TrackerPose)):
        return restamped(message, t_ns=t_ns)
    max_sigma_ns = 1e10
    return restamped(
        message,
        t_ns=t_ns,
        ready_t_ns=clock.to_local(message.ready_t_ns),
        t_sigma_ns=min(hypot(message.t_sigma_ns, clock.sigma_at(t_ns), stamped_ns - t_ns), max_sigma_ns),
    )


class RejectedPeer(NamedTuple):
    """Where somebody who was rejected sends from: host, and what wire version."""

    host: str
    version: int


class MarkerCounts(NamedTuple):
    """How many markers a slave sends, and how many the master's rig has."""

    sent: int
    expected: int


Rejected: TypeAlias = Literal["duplicate", "version", "unproven", "markers"]


class RejectedPeers:
    """Push machine: when each sender was last rejected, why, and from where."""

    def __init__(self, keys: RigKeys, names: Iterable[str]) -> None:
        self._keys, self._names = keys, frozenset(names)
        self._seen: dict[tuple[Rejected, str], tuple[int, RejectedPeer | MarkerCounts]] = {}
        self._next_ns: int | None = None

    def note(self, why: Rejected, name: str, found: RejectedPeer | MarkerCounts, t_ns: int) -> None:
        """Record what was rejected as `name` at `t_ns`.

        A second process while the first was well ("duplicate"), a hello without that device's secret
        ("unproven"), or another number of markers than its rig has here ("markers").
        """
        self._seen[why, name] = t_ns, found

    def other_version(self, datagram: bytes, host: str, t_ns: int) -> None:
        """Record a datagram of another wire version, if it is a sealed hello of this rig."""
        if len(datagram) < HEADER.size or (self._next_ns is not None and t_ns < self._next_ns):
            return
        magic, version, kind, _, rig, key_id, counter = HEADER.unpack_from(datagram)
        if magic != MAGIC or kind != Kind.HELLO or rig != self._keys.rig_tag:
            return
        poll_ns = 100_000_000  # a flood of hellos of another version costs one unsealing in so long
        self._next_ns = t_ns + poll_ns
        name = self._keys.name_in(Header(Kind.HELLO, key_id, counter), datagram)
        if name in self._names:
            self.note("version", name, RejectedPeer(host, version), t_ns)

    def lately(self, why: Rejected, t_ns: int) -> dict[str, RejectedPeer]:
        """Name -> from where it was rejected for this as of `t_ns`, but for markers."""
        return {name: found for name, found in self._of(why, t_ns) if isinstance(found, RejectedPeer)}

    def marker_counts(self, t_ns: int) -> dict[str, MarkerCounts]:
        """Name -> how many markers it sent and has here, where these differ."""
        return {name: found for name, found in self._of("markers", t_ns) if isinstance(found, MarkerCounts)}

    def _of(self, why: Rejected, t_ns: int) -> list[tuple[str, RejectedPeer | MarkerCounts]]:
        lately_ns = 1_500_000_000  # both send a hello again within a second
        return [
            (name, found)
            for (kind, name), (seen_ns, found) in self._seen.items()
            if kind == why and t_ns - seen_ns < lately_ns
        ]


FIRST_NS = 1_000_000_000
LONGEST_NS = 60_000_000_000
MAX_CAUSES = 256  # that are remembered: later ones are counted, not logged
_LOG = logging.getLogger(__name__)


class Quarantine:
    """Push machine over faults; `fault` and `holds` may be called on several threads."""

    def __init__(self) -> None:
        self._silences: dict[str, tuple[int, int]] = {}  # until when, and how long [ns]
        self._causes: set[tuple[str, str]] = set()
        self.faults: Counter[str] = Counter()

    def fault(self, sender: str, error: Exception, t_ns: int) -> None:
        """A message of `sender` made something raise `error` at `t_ns` [ns]."""
        until_ns, before_ns = self._silences.get(sender, (-LONGEST_NS, 0))
        again = before_ns > 0 and t_ns < until_ns + LONGEST_NS
        length_ns = min(2 * before_ns, LONGEST_NS) if again else FIRST_NS
        self._silences[sender] = t_ns + length_ns, length_ns
        self.note(sender, error)

    def note(self, sender: str, error: Exception) -> None:
        """Count a fault, and log it if its cause is news; nobody is silenced."""
        self.faults[sender] += 1
        cause = sender, _place(error)
        if cause not in self._causes and len(self._causes) < MAX_CAUSES:
            self._causes.add(cause)
            _LOG.error("a message of %s could not be used: %r", sender, error, exc_info=error)

    def release(self, sender: str) -> None:
        """It was another one: forget that `sender` was silenced."""
        self._silences.pop(sender, None)

    def holds(self, sender: str, t_ns: int) -> bool:
        """Whether `sender` is silenced at `t_ns` [ns]."""
        until_ns, _ = self._silences.get(sender, (t_ns, 0))
        return t_ns < until_ns


def _place(error: Exception) -> str:
    """Kind and place of an error, which name its fault whatever its text."""
    frames = traceback.extract_tb(error.__traceback__)
    return (
        f"{type(error).__name__} {frames[-1].filename}:{frames[-1].lineno}" if frames else repr(type(error))
    )
