"""Rules judge what slaves report, what their cameras miss, and who moved.

A hand hides its own markers all the time, so what is not seen now means nothing. Three things mean that a
colour, a range of colours or a cap is wrong:

1. It was seen, its colours were changed, and now it is not: that was the change. Reported after 0.9 s.
2. It was never seen since this slave, or these colours, began: a hand soon shows all of its caps. After 5 s.
3. It has not been seen for as long as no pose hides it: 30 s. The cap has come off, or is dirty.

Only time counts in which at least three others (all, of a hand with fewer) are found in half of the frames.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import log

from common.calibration.camera_settings import WANTED
from master.checklist.facts import CameraPlan, SlaveReports, Verdict, Window, beyond
from master.checklist.link_rules import disk_verdict

COLOUR = "colour."  # metrics of the slave: a number that changes with the range of a marker
SEEN = "seen."


@dataclass(slots=True)
class _Marker:
    """When a marker was seen: ever with its present colours, or with those before."""

    colour: float | None = None
    ever: bool = False
    before_change: bool = False
    without_s: float = 0.0

    @property
    def limit_s(self) -> float:
        """How long it may be missing."""
        changed_s, never_s, gone_s = 0.9, 5.0, 30.0
        return gone_s if self.ever else changed_s if self.before_change else never_s

    @property
    def since(self) -> str:
        """How long it has been missing, in words."""
        if self.ever:
            return f"for {self.without_s:.0f} s"
        return f"not once since its {'colours were changed' if self.before_change else 'slave began'}"

    def recoloured(self, colour: float | None) -> bool:
        """Store the marker's colour; True: it changed, and the timing starts again."""
        changed = self.colour is not None and colour is not None and colour != self.colour
        if changed:
            self.before_change |= self.ever
            self.ever, self.without_s = False, 0.0
        self.colour = colour
        return changed


class UnseenMarkers:
    """Push machine on one slave's reports: how long each marker has been missing."""

    def __init__(self, camera: str, markers: tuple[str, ...]) -> None:
        """Watch these markers."""
        self._camera = camera
        self._markers = {name: _Marker() for name in markers}
        self._session: int | None = None

    def push(self, reports: SlaveReports) -> Iterator[Verdict]:
        """Take the newest report."""
        if reports.now.session != self._session:
            self._session = reports.now.session
            self._markers = {name: _Marker() for name in self._markers}
        frames = reports.increase("frames")
        if not frames:
            return
        share = {name: (reports.increase(SEEN + name) or 0) / frames for name in self._markers}
        others, half = 3, 0.5  # of the frames between two reports
        needed = min(others, len(share) - 1)
        for name, one in self._markers.items():
            if one.recoloured(reports.now.metrics.get(COLOUR + name)):
                pass  # of the frames of this report some were looked at with the colours of before
            elif share[name]:
                one.ever, one.without_s = True, 0.0
            elif needed and sum(other >= half for key, other in share.items() if key != name) >= needed:
                one.without_s += reports.seconds
            yield Verdict(
                "marker_unseen",
                f"{self._camera}.{name}",
                one.without_s >= one.limit_s,
                f"Camera {self._camera} does not find marker {name}, {one.since}, though it finds others.",
                "Show it to the camera. If it is in the picture: clean or repaint it, or calibrate its colours.",
                (self._camera,),
                (name,),
            )


# Setting -> relative and absolute distance from which what is read back is another setting. Cameras round exposure to
# rows (20 to 30 us) and gains to register codes (1/16); what an automatic does is much more.
OFF = {
    "exposure_us": (0.05, 100.0),
    "analogue_gain": (0.05, 0.125),
    "red_gain": (0.03, 0.03),
    "blue_gain": (0.03, 0.03),
}
ALIKE = "alike."  # metrics of the slave: hues between two markers as they are seen,
OVERLAP = "overlap."  # and by which the ranges in use of two markers overlap
BETWEEN = ".."  # the names of the two
AMBIGUOUS = "ambiguous."  # count: frames in which something beside the hand had the colour of a marker
UNCOLOURED = "uncalibrated."  # count: 1 of a marker without a colour
FLAGS = {1: "the supply is too weak", 2: "the clock is capped", 4: "it is throttled", 8: "it is too warm"}


class SlaveRules:
    """Push machine over the reports of one slave."""

    def __init__(self, camera: CameraPlan | None) -> None:
        """Of a camera, or of an IMU (None)."""
        self._camera = camera
        self._unseen = [] if camera is None else [UnseenMarkers(camera.name, hand) for hand in camera.hands]
        self._judged = -1
        self._kept: list[Verdict] = []

    def look(self, name: str, reports: SlaveReports, t_ns: int) -> Iterator[Verdict]:
        """All verdicts from the last reports of a slave; nothing where they are old."""
        if not reports.is_recent(t_ns):
            return
        if reports.number != self._judged:
            self._judged = reports.number
            self._kept = [] if self._camera is None else list(self._of_two(self._camera, reports))
        yield from self._kept
        if self._camera is not None:
            yield from _settings(name, reports)
            yield from _light(name, reports)
            yield from _collisions(self._camera, reports)
            yield from _file(self._camera, reports)
        yield from _machine(name, reports)

    def _of_two(self, camera: CameraPlan, reports: SlaveReports) -> Iterator[Verdict]:
        """What happened between two reports."""
        for unseen in self._unseen:
            yield from unseen.push(reports)
        yield from _background(camera, reports)
        if camera.wrist:
            yield from _strobe(camera.name, reports)


def _settings(name: str, reports: SlaveReports) -> Iterator[Verdict]:
    """Check that the camera has the settings that were requested."""
    metrics = reports.now.metrics
    wrong: list[str] = []
    for setting, (share, least) in OFF.items():
        want, got = metrics.get(WANTED + setting), metrics.get(setting)
        if want is not None and got is not None and abs(got - want) > max(share * want, least):
            wrong.append(f"{setting} is {got:.4g}, not {want:.4g}")
    # gain behind the sensor: rounding needs less
    if (digital := metrics.get("digital_gain", 1.0)) > 1.3:
        wrong.append(f"digital_gain is {digital:.3g}")
    wrong += [
        f"{auto.removeprefix('auto.')} is on"
        for auto in sorted(metrics)
        if auto.startswith("auto.") and metrics[auto]
    ]
    yield Verdict(
        "auto_mode",
        name,
        bool(wrong),
        f"Camera {name} reads back other settings than it was given: {'; '.join(wrong)}.",
        f"Something else sets it, or an automatic is on: close other programs that use it, then"
        f" `phalanx camera {name}`, or start its slave anew.",
    )


def _light(name: str, reports: SlaveReports) -> Iterator[Verdict]:
    """Whether the picture is as bright as at calibration."""
    exposure = reports.now.metrics.get("light_exposure")
    if exposure is None or exposure <= 0.0:
        return
    # against calibration, either way; the slave follows up to 2.5 (docs/light.md)
    bright, bright_well = 1.5, 1.35
    yield Verdict(
        "exposure_drift",
        name,
        beyond(abs(log(exposure)), log(bright), log(bright_well)),
        f"The picture of camera {name} is {exposure:.2g} times as bright as when its colours were calibrated.",
        "Light the scene as then, set the exposure back, or calibrate the colours under this light.",
    )


def _collisions(camera: CameraPlan, reports: SlaveReports) -> Iterator[Verdict]:
    """Whether two markers share colours, by their ranges or by their looks."""
    name = camera.name
    for metric, hues in reports.now.metrics.items():
        if not metric.startswith((OVERLAP, ALIKE)):
            continue
        overlap = metric.startswith(OVERLAP)
        pair = tuple(metric.removeprefix(OVERLAP if overlap else ALIKE).split(BETWEEN))
        both = " and ".join(pair)
        what = f"the colour ranges of {both} overlap by {hues:.0f} hues"
        if not overlap:
            what = f"{both} look alike, {hues:.0f} hues apart"
        if len(pair) != 2 or not {*camera.markers}.issuperset(pair):
            continue
        yield Verdict(
            "colour_collision",
            f"{name}.{'-'.join(pair)}",
            True,
            f"Camera {name}: {what}: one can be taken for the other.",
            "Calibrate the colours anew, or repaint one of the two in a colour that no other has.",
            (name,),
            pair,
        )


def _file(camera: CameraPlan, reports: SlaveReports) -> Iterator[Verdict]:
    """Whether the slave has colours, and a file of the same camera as the master's."""
    name = camera.name
    bare = tuple(marker for marker in camera.markers if UNCOLOURED + marker in reports.now.counts)
    yield Verdict(
        "calibration_absent",
        name,
        bool(bare),
        f"Camera {name} has no colour for {', '.join(bare)}: it does not see {'it' if len(bare) == 1 else 'them'}.",
        "Pick it in the picture: the set-up of the console; or calibrate all with `phalanx-slave colours`.",
        (name,),
        bare,
    )
    width, height = reports.now.metrics.get("width_px"), reports.now.metrics.get("height_px")
    if width is None or height is None:
        return
    yield Verdict(
        "calibration_stale",
        name,
        (width, height) != camera.size_px,
        f"Camera {name} gives {width:.0f} x {height:.0f} pixels, the master's file was measured with"
        f" {camera.size_px[0]} x {camera.size_px[1]}.",
        f"Give slave and master the same cameras/{name}.json, and calibrate the lens with that size.",
    )


def _background(camera: CameraPlan, reports: SlaveReports) -> Iterator[Verdict]:
    """Whether things beside the hand have the colour of a marker."""
    frames = reports.increase("frames")
    if not frames:
        return
    for marker in camera.markers:
        event = AMBIGUOUS + marker
        if event not in reports.now.counts:
            continue
        share = (reports.increase(event) or 0) / frames
        u, v = reports.now.metrics.get(f"{event}.u"), reports.now.metrics.get(f"{event}.v")
        where = "" if u is None or v is None else f", near pixel {u:.0f}, {v:.0f}"
        ambiguous_share, ambiguous_well = 0.5, 0.1  # of the frames
        yield Verdict(
            "background_in_range",
            f"{camera.name}.{marker}",
            beyond(share, ambiguous_share, ambiguous_well),
            f"Camera {camera.name} sees something else in the colour of marker {marker}{where}.",
            "Take it away or cover it; or paint the marker in another colour.",
            (camera.name,),
            (marker,),
        )


def _strobe(name: str, reports: SlaveReports) -> Iterator[Verdict]:
    """Whether laser and LEDs are on in the frames in which they should be."""
    frames, out, unlit = (
        reports.increase(event) for event in ("frames", "strobe.out_of_step", "strobe.unlit")
    )
    if not frames or out is None:
        return
    cycle = 3  # frames: ambient, laser, LEDs
    cycles = frames / cycle
    # share and number of the cycles between two reports that are out of order
    slipped, slipped_least = 0.04, 2
    wrong = beyond(out / cycles, slipped, 0.5 * slipped)
    if wrong and (out < slipped_least or (unlit or 0) > 0.5 * cycles):
        wrong = None  # one frame that slipped; or nothing is lit, because there is no hand
    yield Verdict(
        "strobe_slipped",
        name,
        wrong,
        f"Wrist device {name}: in {out} of {cycles:.0f} strobe cycles laser or LEDs are on in the wrong frame.",
        "Check the wires of the lights and lead_us of the strobe; a slave that is too slow loses frames: see dropped.",
    )


def _machine(name: str, reports: SlaveReports) -> Iterator[Verdict]:
    """Whether the slave's computer is hot, throttled, or its disk full."""
    metrics = reports.now.metrics
    now, limit = metrics.get("temperature_c"), metrics.get("temperature_limit_c")
    hot: bool | None = False
    why: list[str] = []
    if now is not None and limit is not None:
        hot_well_c = 5.0
        hot = beyond(now, limit, limit - hot_well_c)
        why = [f"{now:.0f} °C, {limit:.0f} are its limit"] if now >= limit else []
    flags = int(metrics.get("throttled", 0.0))
    held = [text for bit, text in FLAGS.items() if flags & bit]
    if now is not None or "throttled" in metrics:
        yield Verdict(
            "too_hot",
            name,
            True if held else hot,
            f"The computer of {name}: {'; '.join(why + held) or 'still warm'}.",
            "Give it air, a heat sink or a fan, and a supply of its own that is strong enough (Pi 5: 5 A).",
        )
    if (free := metrics.get("disk_free_mb")) is not None:
        yield disk_verdict(name, free)


class MovedRule:
    """Push machine over the counters of one pipeline: whether the rays still meet."""

    def __init__(self) -> None:
        """Nothing was counted yet."""
        span_ns = 1_000_000_000
        self._window = Window(span_ns)
        self._cameras: tuple[str, ...] = ()

    def clear(self) -> None:
        """What was counted so far was of something else: a camera was away."""
        self._window.clear()

    def look(
        self, cameras: tuple[str, ...], markers: int, counts: Mapping[str, int], t_ns: int
    ) -> Iterator[Verdict]:
        """Judge the poses of the last second."""
        if cameras != self._cameras:
            self._cameras = cameras
            self._window.clear()
        # characters of a name in counts
        out = [counts.get(f"mostly_rejected.{name}"[:64], 0) for name in cameras]
        self._window.push(t_ns, counts.get("poses", 0), counts.get("epipolar_outliers", 0), *out)
        poses, outliers, *rejected = self._window.increase()
        least_poses = 6  # in the window: fewer are a hand that comes or goes
        enough = self._window.full and poses >= least_poses
        if len(cameras) == 2:
            share = outliers / max(poses * markers, 1)
            # share of the hand's markers whose rays miss each other, two cameras
            begins_share, ends_share = 0.15, 0.05
            yield _verdict(
                cameras,
                beyond(share, begins_share, ends_share) if enough else None,
                f"What cameras {' and '.join(cameras)} see does not fit together: the rays of"
                f" {100.0 * share:.0f} % of the markers miss each other.",
            )
            return
        for name, number in zip(cameras, rejected, strict=True):
            # share of the poses that leave most of what a camera sees out, three or more
            mostly, mostly_well = 0.5, 0.2
            yield _verdict(
                (name,),
                beyond(number / max(poses, 1), mostly, mostly_well) if enough else None,
                f"What camera {name} sees does not fit what the others see; it is left out.",
            )


def _verdict(cameras: tuple[str, ...], wrong: bool | None, sentence: str) -> Verdict:
    fix = "A camera was knocked, or has another lens: measure the places anew, `phalanx calibrate cameras stereo`."
    return Verdict("camera_moved", "-".join(cameras), wrong, sentence, fix, cameras)
