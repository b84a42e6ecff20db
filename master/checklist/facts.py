"""Facts of the checklist: plan, present state, slaves' reports, recent counts."""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from common.messages import CheckCode, CheckItem, Health
from master.rig.setup import RigSetup
from master.run.link_senders import MarkerCounts, RejectedPeer


@dataclass(frozen=True, slots=True)
class CameraPlan:
    """What a camera is to be, by the files that the master uses."""

    name: str
    rate_hz: float
    size_px: tuple[int, int]
    wrist: bool  # it belongs to a wrist device and sends strobe cycles
    hands: tuple[tuple[str, ...], ...]  # of each hand that it watches, the markers that sit on it
    # all that its rigs name, those on objects too: what it reports of others is none of the rig's
    markers: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Plan:
    """Who is to be there."""

    cameras: tuple[CameraPlan, ...]  # each once
    imus: tuple[str, ...]
    # of each hand the marker cameras whose rays meet, and how many markers they watch
    groups: tuple[tuple[tuple[str, ...], int], ...]


@dataclass(frozen=True, slots=True)
class SenderNow:
    """State of one camera or IMU, as received by the master."""

    connected: bool  # received within the last second
    received: int  # messages that were taken so far
    missed: int  # messages that were sent and could not be taken (lost, or too late) so far
    clock_sigma_ns: float | None  # standard deviation of its clock's offset now [ns]; None: not known
    # where a second process under its name was rejected lately; None: there was none
    duplicate: RejectedPeer | None = None
    # where it speaks another wire version, and which; None: it does not
    unknown_peer: RejectedPeer | None = None
    # where somebody claims to be it, without its secret; None: nobody does
    unproven: RejectedPeer | None = None
    # how many markers it sends where its rig has another number; None: as many as the rig has
    markers: MarkerCounts | None = None


@dataclass(frozen=True, slots=True)
class MasterNow:
    """What the master counted by one look."""

    started: bool  # the start was given: cameras send
    senders: Mapping[str, SenderNow]
    groups: Sequence[Mapping[str, int]]  # of each group of the plan what its pipeline counted
    disk_free_mb: float | None  # left on the disk that the master writes to [MB]; None: not known
    files: tuple[CheckItem, ...] = ()  # what is wrong with the files


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict of one rule on one subject at one look; fields as in `CheckItem`."""

    code: CheckCode
    subject: str
    wrong: bool | None  # None: not known, or between the two bounds
    sentence: str
    fix: str
    senders: tuple[str, ...] = ()  # which cameras or IMUs are concerned; none named: the subject itself
    markers: tuple[str, ...] = ()  # which of their markers; none named: all of the sender

    @property
    def key(self) -> tuple[CheckCode, str]:
        """What it is about."""
        return self.code, self.subject

    def touches(self, other: "Verdict") -> bool:
        """Whether both concern one sender and, where both name markers, one of these."""
        if not {*(self.senders or (self.subject,))} & {*(other.senders or (other.subject,))}:
            return False
        return not self.markers or not other.markers or bool({*self.markers} & {*other.markers})

    def item(self) -> CheckItem:
        """Return the verdict as a published checklist item."""
        return CheckItem(self.code, self.subject[:64], self.sentence[:500], self.fix[:500])


def beyond(value: float, show: float, clear: float) -> bool | None:
    """Compare with hysteresis: `show` or more: wrong; below `clear`: well; else None."""
    return True if value >= show else False if value < clear else None


def keys_of(items: Iterable[CheckItem]) -> list[tuple[str, str]]:
    """Code and subject of each item: the numbers in sentences change all the time."""
    return [(item.code, item.subject) for item in items]


def plan_of(setups: Iterable[RigSetup]) -> Plan:
    """Who is to be there by these setups, one of each hand."""
    cameras: dict[str, CameraPlan] = {}
    imus: dict[str, None] = {}
    groups: list[tuple[tuple[str, ...], int]] = []
    for setup in setups:
        imus |= dict.fromkeys(setup.imus)
        if setup.has_markers:
            groups.append((setup.rig.cameras, len(setup.hand_markers)))
        for name, file in setup.cameras.items():
            wrist, size_px = name in setup.wrist_cameras, (file.width_px, file.height_px)
            before = cameras.get(name, CameraPlan(name, file.frame_rate_hz, size_px, wrist, ()))
            hands = before.hands if wrist else (*before.hands, setup.hand_markers)
            markers = tuple(dict.fromkeys((*before.markers, *setup.markers)))
            cameras[name] = CameraPlan(name, file.frame_rate_hz, size_px, wrist, hands, markers)
    return Plan(tuple(cameras.values()), tuple(imus), tuple(groups))


class Window:
    """Push machine that keeps counters of the last `span_ns`, and one look before."""

    def __init__(self, span_ns: int) -> None:
        """Look back so far [ns]."""
        self._span_ns = span_ns
        self._looks: deque[tuple[int, tuple[int, ...]]] = deque()

    def push(self, t_ns: int, *counters: int) -> None:
        """Add a look; where a counter has fallen, another process counts: start again."""
        if self._looks and any(now < old for now, old in zip(counters, self._looks[-1][1], strict=True)):
            self._looks.clear()
        self._looks.append((t_ns, counters))
        while len(self._looks) > 2 and t_ns - self._looks[1][0] >= self._span_ns:
            self._looks.popleft()

    def clear(self) -> None:
        """Forget: what comes next has nothing to do with it."""
        self._looks.clear()

    @property
    def full(self) -> bool:
        """Whether it reaches back as far as it is to."""
        return bool(self._looks) and self._looks[-1][0] - self._looks[0][0] >= self._span_ns

    @property
    def seconds(self) -> float:
        """How far it reaches back [s]."""
        return 1e-9 * (self._looks[-1][0] - self._looks[0][0]) if self._looks else 0.0

    def increase(self) -> tuple[int, ...]:
        """By how much each counter rose in it; () before the first look."""
        if not self._looks:
            return ()
        return tuple(now - old for now, old in zip(self._looks[-1][1], self._looks[0][1], strict=True))

    @property
    def moved(self) -> bool:
        """Whether the first counter rose since the look before."""
        return len(self._looks) > 1 and self._looks[-1][1][0] > self._looks[-2][1][0]


class SlaveReports:
    """Push machine over the reports of one process."""

    def __init__(self, health: Health, t_ns: int) -> None:
        """Start with a first report, which came at `t_ns` [ns]."""
        self.now = health  # the newest
        self.number = 0  # of comparisons: a rule looks at each once
        self._before: Health | None = None
        self._came_ns = t_ns

    def push(self, health: Health, t_ns: int) -> None:
        """Take a report that came at `t_ns` [ns]."""
        self._came_ns = t_ns
        # between two reports that are compared: an answer to a command may come just after one
        least_ns = 400_000_000
        if health.session != self.now.session:
            self._before = None
        elif health.t_ns - self.now.t_ns < least_ns:
            return
        else:
            self._before = self.now
            self.number += 1
        self.now = health

    def is_recent(self, t_ns: int) -> bool:
        """Whether the newest report is recent."""
        stale_ns = 3_000_000_000  # reports come twice a second; of an older one nothing is concluded
        return t_ns - self._came_ns < stale_ns

    def increase(self, event: str) -> int | None:
        """How often an event happened between the last two reports; None: not known."""
        if self._before is None or event not in self.now.counts:
            return None
        return max(self.now.counts[event] - self._before.counts.get(event, 0), 0)

    @property
    def seconds(self) -> float:
        """Between the last two reports, on the slave's clock [s]; 0: there are no two."""
        return 0.0 if self._before is None else 1e-9 * (self.now.t_ns - self._before.t_ns)
