"""Rules on the links of the master, and on its disk.

Senders that are away, lost datagrams, clocks, rates.
"""

from collections.abc import Iterator

from common.messages import WIRE_VERSION
from master.checklist.facts import (
    CameraPlan,
    MasterNow,
    Plan,
    SenderNow,
    SlaveReports,
    Verdict,
    Window,
    beyond,
)

SETTLED_NS = 2_000_000_000  # a sender that has just come has a clock, and frames, after that


class _Received:
    """Reception history of one sender so far."""

    def __init__(self) -> None:
        self.since_ns: int | None = None  # connected since
        self.ever = False
        self.came_ns = 0  # last message
        span_ns = 1_400_000_000  # what counts as now: with two looks to notice it stays below two seconds
        self.messages = Window(span_ns)
        # of the slave's reports: of a wrist device not every frame is a message
        self.frames = Window(span_ns)
        self.report = 0

    def push(self, t_ns: int, now: SenderNow) -> None:
        if not now.connected:
            self.since_ns = None
            self.messages.clear()
            self.frames.clear()
            return
        if self.since_ns is None:
            self.since_ns = self.came_ns = t_ns
        self.ever = True
        self.messages.push(t_ns, now.received, now.missed)
        if self.messages.moved:
            self.came_ns = t_ns

    def settled(self, t_ns: int, after_ns: int = SETTLED_NS) -> bool:
        return self.since_ns is not None and t_ns - self.since_ns >= after_ns


class LinkRules:
    """Push machine of the link rules."""

    def __init__(self) -> None:
        """Start with no sender received."""
        self._first_ns: int | None = None
        self._started_ns: int | None = None
        self._received: dict[str, _Received] = {}

    def present(self, name: str) -> bool:
        """Whether a sender is there, as of the last look."""
        received = self._received.get(name)
        return received is not None and received.since_ns is not None

    def look(
        self, plan: Plan, now: MasterNow, reports: dict[str, SlaveReports], t_ns: int
    ) -> Iterator[Verdict]:
        """What the links of all senders are like."""
        self._first_ns = t_ns if self._first_ns is None else self._first_ns
        if now.started and self._started_ns is None:
            self._started_ns = t_ns
        for name, sender in now.senders.items():
            self._received.setdefault(name, _Received()).push(t_ns, sender)
        for camera in plan.cameras:
            sender, report = now.senders[camera.name], reports.get(camera.name)
            yield self._camera_absent(camera, sender, report, t_ns)
            yield self._slow(camera, report, t_ns)
        for name in plan.imus:
            yield self._imu_silent(name, now.senders[name], t_ns)
        for name in (*(camera.name for camera in plan.cameras), *plan.imus):
            yield from self._way(name, now.senders[name], t_ns)
            yield from _rejected_peers(name, now.senders[name])
        if now.disk_free_mb is not None:
            yield disk_verdict("master", now.disk_free_mb)

    def _is_silent(self, name: str, sender: SenderNow, t_ns: int) -> bool | None:
        """Whether a sender is not received; with a grace period if it never was."""
        assert self._first_ns is not None
        if sender.connected:
            return False
        grace_ns = 5_000_000_000  # from the first look: processes come up one after another
        return self._received[name].ever or t_ns - self._first_ns >= grace_ns or None

    def _mute(self, name: str, t_ns: int) -> bool:
        """Return true if a sender is connected and sends nothing though it should."""
        received = self._received[name]
        started = self._started_ns is not None and t_ns - self._started_ns >= SETTLED_NS
        mute_ns = 1_200_000_000  # connected and nothing comes: the sensor is away
        return started and received.settled(t_ns) and t_ns - received.came_ns >= mute_ns

    def _not_received(self, name: str) -> str:
        return "is not received any more" if self._received[name].ever else "was never received"

    def _camera_absent(
        self, camera: CameraPlan, sender: SenderNow, reports: SlaveReports | None, t_ns: int
    ) -> Verdict:
        name, silent = camera.name, self._is_silent(camera.name, sender, t_ns)
        if silent is not False:
            return Verdict(
                "camera_absent",
                name,
                silent,
                f"Camera {name} {self._not_received(name)}.",
                f"Is its slave running (phalanx-slave run --name {name}), on this network, with the same rig key?",
            )
        mute = self._mute(name, t_ns)
        if camera.wrist:  # without a hand there are no strobe cycles: it is the frames that count
            recent = None if reports is None or not reports.is_recent(t_ns) else reports
            mute = mute and recent is not None and recent.increase("frames") == 0
        return Verdict(
            "camera_absent",
            name,
            mute,
            f"The slave of camera {name} is there, but no frame comes.",
            "Is the camera plugged in? The slave opens it again by itself; its log says why it cannot.",
        )

    def _imu_silent(self, name: str, sender: SenderNow, t_ns: int) -> Verdict:
        silent = self._is_silent(name, sender, t_ns)
        if silent is not False:
            return Verdict(
                "imu_silent",
                name,
                silent,
                f"IMU {name} {self._not_received(name)}.",
                f"Is its slave running (phalanx-slave run --name {name} --imu DRIVER), and the IMU plugged in?",
            )
        return Verdict(
            "imu_silent",
            name,
            self._mute(name, t_ns),
            f"The slave of IMU {name} is there, but no sample comes.",
            "Is the IMU plugged in and switched on? The slave opens it again by itself; see its log.",
        )

    def _slow(self, camera: CameraPlan, reports: SlaveReports | None, t_ns: int) -> Verdict:
        """Of what is sent, not of what comes: loss has a code of its own."""
        received, rate_hz = self._received[camera.name], float("nan")
        if camera.wrist:
            if reports is not None and reports.is_recent(t_ns) and reports.number != received.report:
                received.report = reports.number
                received.frames.push(reports.now.t_ns, reports.now.counts.get("frames", 0))
                if received.settled(t_ns) and received.frames.full and received.frames.moved:
                    rate_hz = received.frames.increase()[0] / received.frames.seconds
        elif received.settled(t_ns) and received.messages.full and received.messages.moved:
            rate_hz = sum(received.messages.increase()) / received.messages.seconds
        share = rate_hz / camera.rate_hz
        # of the rate of the file; a camera that halves its rate for the light has 0.5
        slow, slow_well = 0.85, 0.92
        wrong = beyond(-share, -slow, -slow_well) if share == share else None
        return Verdict(
            "rate_low",
            camera.name,
            wrong,
            f"Camera {camera.name} gives {rate_hz:.0f} frames per second, its file says {camera.rate_hz:g}.",
            "Too slow a computer, USB hub or exposure: see detect_us and camera.skipped of its health, or lower"
            f" frame_rate_hz of cameras/{camera.name}.json.",
        )

    def _way(self, name: str, sender: SenderNow, t_ns: int) -> Iterator[Verdict]:
        """Loss, and the clock."""
        received = self._received[name]
        settled = received.settled(t_ns)
        clock_settled_ns = 1_000_000_000  # a clock is known after five echoes, a hundred a second
        clocked = received.settled(t_ns, clock_settled_ns)
        came, missed = received.messages.increase() or (0, 0)
        share = missed / max(came + missed, 1)
        # share of the messages; tracks bridge single frames, at 3 % two in a row are daily
        loss, loss_well = 0.03, 0.01
        lossy = beyond(share, loss, loss_well) if settled and received.messages.full else None
        loss_least = 2  # messages in the window: one that is lost is no trend
        if lossy and missed < loss_least:
            lossy = None
        yield Verdict(
            "packet_loss",
            name,
            lossy,
            f"{100.0 * share:.0f} % of what {name} sends is lost on the way.",
            "Use a cable instead of Wi-Fi, another channel, or a switch that is not overloaded.",
        )
        sigma = sender.clock_sigma_ns
        if sigma is None:
            reports, wrong = "is not known", clocked or None
        else:
            reports = f"is known to {1e-6 * sigma:.1f} ms only"
            # 1.5 ms between two cameras cost 2 % of depth at 1 m/s (docs/sync.md)
            clock_ns, clock_well_ns = 1.0e6, 0.7e6
            wrong = beyond(sigma, clock_ns, clock_well_ns) if clocked else None
        yield Verdict(
            "clock_unsynchronised",
            name,
            wrong,
            f"The clock of {name} against the master's {reports}: its times are worth nothing for moving hands.",
            "The network is slow or uneven: use a cable; wait half a minute after it was mended.",
        )


def _rejected_peers(name: str, sender: SenderNow) -> Iterator[Verdict]:
    """Yield a verdict for each process that claims to be `name` and is rejected."""
    duplicate, other = sender.duplicate, sender.unknown_peer
    unproven, markers = sender.unproven, sender.markers
    yield Verdict(
        "duplicate_sender",
        name,
        duplicate is not None,
        f"Two processes send as {name}; the one at {duplicate and duplicate.host} is ignored while the other works.",
        "End one of them, or give it its own name (--name) and files.",
    )
    yield Verdict(
        "version_mismatch",
        name,
        other is not None,
        f"{name} at {other and other.host} speaks wire version {other and other.version}, this master {WIRE_VERSION}:"
        " neither takes the other.",
        "Install the same version of Phalanx on both, for example by phalanx fleet deploy.",
    )
    yield Verdict(
        "secret_mismatch",
        name,
        unproven is not None,
        f"Somebody at {unproven and unproven.host} claims to be {name}, without the secret"
        " that this master has for it.",
        f"phalanx fleet deploy brings it, device-{name}.secret; both sides need --keys, or both the rig key alone."
        " If that machine is not yours: phalanx fleet keys --revoke.",
    )
    yield Verdict(
        "marker_mismatch",
        name,
        markers is not None,
        f"{name} sends {markers and markers.sent} markers, the rig of this master has"
        f" {markers and markers.expected}: nothing of it is used.",
        "Give both the same rig file: phalanx fleet deploy brings this one's to the slave; then restart the master"
        " if the file here has changed since it began.",
    )


def disk_verdict(subject: str, free_mb: float) -> Verdict:
    """Whether a disk is full."""
    reserve_mb, reserve_well_mb = 200.0, 250.0  # as much as a recording leaves free
    return Verdict(
        "disk_full",
        subject,
        beyond(-free_mb, -reserve_mb, -reserve_well_mb),
        f"The disk of {subject} has {free_mb:.0f} MB left; below {reserve_mb:g} MB nothing is recorded.",
        "Move recordings away, or delete some.",
    )
