"""Sessions and senders as the master's link keeps them.

Besides, whether it takes a message of a sender.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import hypot
from typing import TypeAlias

from common.link.clock_offset import ClockEstimate, OffsetEstimator
from common.link.datagram import Address, Opener, Refusal, Sealer
from common.link.session import Hello
from common.link.token_bucket import TokenBucket
from common.messages import ImuSample, TrackerPose, restamped
from master.run.admission import OLD_NS, SenderLimits, Sensed, bucket_of, refused
from master.run.sequence import Counted, Sequence

OLD_NONCES = 64
ASKED = 256  # echoes that wait for an answer; later ones are worth nothing

SensorMessage: TypeAlias = Sensed


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
    """What is kept of one camera, IMU or tracker.

    `kinds` are the kinds of message that it sends, the main one first.
    """

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
        """A sender of these kinds of message, within these limits.

        The number of each kind rises by the step in `steps` from one message to the next.
        """
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
        """Take note of a datagram that came late.

        It is of kind `own` or of none: in the gaps of other kinds it is no loss.
        """
        for kind in self.kinds.values():
            if kind is not own:
                kind.losses.late(counter, 0)


def not_admitted(message: SensorMessage, session: Session, sender: Sender, now_ns: int) -> Refusal | None:
    """Why a message that came at `now_ns` [ns] is not taken of this sender.

    None: it is taken.
    """
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

    They cannot while the clock is not known (data before the start), nor where the time is more than `AHEAD_NS` after
    `now_ns`, is older than `OLD_NS`, or is not after the last of its kind. Nothing was measured after it came: what is
    ahead by less is of now, and its standard deviation is as large as the error that this shows.
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
