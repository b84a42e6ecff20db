"""Inputs of the checklist: the plan and the present state.

How things were planned (the files), and how the master finds them at one look.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from common.messages import CheckCode, CheckItem
from master.rig.setup import RigSetup
from master.run.rejected_peers import MarkerCounts, RejectedPeer


@dataclass(frozen=True, slots=True)
class CameraPlan:
    """What a camera is to be, by the files that the master uses.

    Attributes:
        name: Camera.
        rate_hz: Frames per second.
        size_px: Width and height.
        wrist: It belongs to a wrist device and sends strobe cycles.
        hands: Of each hand that it watches, the markers that sit on it.
        markers: All that its rigs name, those on objects too: what it reports of others is none of the rig's.
    """

    name: str
    rate_hz: float
    size_px: tuple[int, int]
    wrist: bool
    hands: tuple[tuple[str, ...], ...]
    markers: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Plan:
    """Who is to be there.

    Attributes:
        cameras: All cameras, each once.
        imus: All IMUs.
        groups: Of each hand the marker cameras whose rays meet, and how many markers they watch.
    """

    cameras: tuple[CameraPlan, ...]
    imus: tuple[str, ...]
    groups: tuple[tuple[tuple[str, ...], int], ...]


@dataclass(frozen=True, slots=True)
class SenderNow:
    """State of one camera or IMU, as received by the master.

    Attributes:
        connected: Received within the last second.
        received, missed: Messages that were taken, and that were sent and could not be (lost, or too late), so far.
        clock_sigma_ns: Standard deviation of its clock's offset now [ns]; None: not known.
        duplicate: Where a second process under its name was rejected lately; None: there was none.
        unknown_peer: Where it speaks another wire version, and which; None: it does not.
        unproven: Where somebody claims to be it, without its secret; None: nobody does.
        markers: How many markers it sends where its rig has another number; None: as many as the rig has.
    """

    connected: bool
    received: int
    missed: int
    clock_sigma_ns: float | None
    duplicate: RejectedPeer | None = None
    unknown_peer: RejectedPeer | None = None
    unproven: RejectedPeer | None = None
    markers: MarkerCounts | None = None


@dataclass(frozen=True, slots=True)
class MasterNow:
    """What the master counted by one look.

    Attributes:
        started: The start was given: cameras send.
        senders: Camera or IMU -> how it is received.
        groups: Of each group of the plan what its pipeline counted.
        disk_free_mb: Left on the disk that the master writes to [MB]; None: not known.
        files: What is wrong with the files.
    """

    started: bool
    senders: Mapping[str, SenderNow]
    groups: Sequence[Mapping[str, int]]
    disk_free_mb: float | None
    files: tuple[CheckItem, ...] = ()


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict of one rule on one subject at one look.

    Attributes:
        code, subject, sentence, fix: As of `CheckItem`.
        wrong: None: not known, or between the two bounds.
        senders: Which cameras or IMUs are concerned; none named: the subject itself.
        markers: Which of their markers; none named: all of the sender.
    """

    code: CheckCode
    subject: str
    wrong: bool | None
    sentence: str
    fix: str
    senders: tuple[str, ...] = ()
    markers: tuple[str, ...] = ()

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
    """Compare `value` with two thresholds, with hysteresis.

    Above `show`: wrong; below `clear`: well; between them nothing changes.
    """
    return True if value >= show else False if value < clear else None


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
            wrist = name in setup.wrist_cameras
            before = cameras[name].hands if name in cameras else ()
            hands = before if wrist else (*before, setup.hand_markers)
            size = file.width_px, file.height_px
            known = cameras[name].markers if name in cameras else ()
            markers = tuple(dict.fromkeys((*known, *setup.markers)))
            cameras[name] = CameraPlan(name, file.frame_rate_hz, size, wrist, hands, markers)
    return Plan(tuple(cameras.values()), tuple(imus), tuple(groups))
