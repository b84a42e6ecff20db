"""Check the files of a rig, before it runs or while it does.

Calibration files may be missing, or older than what they rest on. `phalanx check` prints the checklist of a
running master; the exit code states whether all is well.
"""

from argparse import Namespace
from collections.abc import Iterator, Mapping
from datetime import datetime, timedelta
from pathlib import Path
from typing import TypeVar

from msgspec import Struct

from common.bus.bus import Subscription
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.calibration.files import MonitoredFiles, Provenance
from common.command_line import echo
from common.errors import BusError, CalibrationError
from common.messages import CheckItem, Checklist
from common.messages.streams import MASTER
from master.checklist.facts import CameraPlan, Plan, keys_of
from master.commands.options import rigs_of
from master.run.process import join_bus

ANSWER_S = 3.0  # a master reports once a second


def check(options: Namespace) -> int:
    """Print current problems; return exit code 1 if there is any, else 0.

    Without a master: that, and what is wrong with the files that one would read.
    """
    items: tuple[CheckItem, ...] = ()
    try:
        connection = join_bus(options.bus, options.site)
    except BusError as error:
        rigs = rigs_of(options)
        start = f"`phalanx run --rig {' --rig '.join(rigs)}` starts one; --bus names that of another machine"
        echo(f"no_master  {options.bus}\n  {error}\n  -> {start}.")
        if (options.calibration / "rigs").is_dir():
            nothing = Plan(cameras=(), imus=(), groups=())
            echo("\n".join(lines(judge(options.calibration, tuple(rigs), nothing), "the files are well")))
        return 1
    try:
        lists = connection.subscribe("checklist", MASTER)
        items = newest(lists, options.bus)
        echo("\n".join(lines(items)))
        while options.watch:
            before, items = items, newest(lists, options.bus)
            if keys_of(items) != keys_of(before):
                echo("\n".join(["", *lines(items)]))
    except KeyboardInterrupt:
        pass
    finally:
        connection.close()
    return 1 if items else 0


def newest(lists: Subscription, where: str) -> tuple[CheckItem, ...]:
    """The next list; BusError: none comes."""
    answer = lists.get(ANSWER_S)
    if not isinstance(answer, Checklist):
        raise BusError(f"no checklist on {where} for {ANSWER_S:g} s: does a master run there?")
    return answer.items


def lines(items: tuple[CheckItem, ...], well: str = "all is well") -> list[str]:
    """The list for a person; `well`: there is nothing on it."""
    if not items:
        return [well]
    wide = max(len(item.code) for item in items)
    out: list[str] = []
    for item in items:
        out += [f"{item.code:<{wide}}  {item.subject}", f"  {item.sentence}", f"  -> {item.fix}"]
    return out


SAME_RUN = timedelta(minutes=1)  # one calibration writes several parts, one after the other
PartT = TypeVar("PartT", bound=Struct)


class FileMonitor:
    """Monitor of the files of the running rigs."""

    def __init__(self, calibration: Path, rigs: tuple[str, ...]) -> None:
        """Watch these rigs of a calib_json tree, and what they name."""
        self._calibration, self._rigs = calibration, rigs
        self._monitored = MonitoredFiles()
        self._hands: dict[Path, None] = {}  # that ever were: one that is gone has changed, too
        self._plan: Plan | None = None
        self._found: tuple[CheckItem, ...] = ()

    def look(self, plan: Plan) -> tuple[CheckItem, ...]:
        """What is wrong now; costs one `stat` a file where none was changed."""
        cameras = [self._calibration / "cameras" / f"{one.name}.json" for one in plan.cameras]
        rigs = [self._calibration / "rigs" / f"{name}.json" for name in self._rigs]
        self._hands |= dict.fromkeys(sorted((self._calibration / "hands").glob("*.json")))
        if self._monitored.changed([*rigs, *cameras, *self._hands]) or plan != self._plan:
            self._plan = plan
            self._found = judge(self._calibration, self._rigs, plan)
        return self._found


def judge(calibration: Path, rigs: tuple[str, ...], plan: Plan) -> tuple[CheckItem, ...]:
    """What is wrong with the files of rigs; `plan` is what the files in use state."""
    used = {one.name: one for one in plan.cameras}
    found: dict[tuple[str, str], CheckItem] = {}
    for name in rigs:
        for item in _judge_rig(calibration, name, used):
            found.setdefault((item.code, item.subject), item)
    return tuple(found.values())


def _judge_rig(calibration: Path, name: str, used: Mapping[str, CameraPlan]) -> Iterator[CheckItem]:
    rig = _read(calibration / "rigs" / f"{name}.json", RigCalibration)
    if isinstance(rig, str):
        yield _absent(name, f"The file of rig {name} cannot be used: {rig}", _MEND)
        return
    hand = _read(calibration / "hands" / f"{rig.hand}.json", HandProfile)
    if isinstance(hand, str):
        yield _absent(rig.hand, f"The file of hand {rig.hand} cannot be used: {hand}", _MEND)
    if rig.kind == "markers" and not rig.T_rig_camera:
        yield _absent(
            name,
            f"Rig {name}: the places of its cameras are not measured.",
            "`phalanx calibrate cameras stereo`.",
        )
    for key in ("laser_plane", "T_camera_palm") if rig.kind == "wrist" else ():
        if getattr(rig, key) is None:
            yield _absent(name, f"Rig {name}: {key} is not measured.", "`phalanx calibrate --help`: wrist.")
    if rig.imu is not None and not rig.imu.placed:
        yield _absent(
            rig.imu.name,
            f"IMU {rig.imu.name}: how it is mounted is not known; its orientation is not used.",
            "`phalanx calibrate wrist extrinsics`.",
        )
    for camera in rig.cameras:
        yield from _judge_camera(calibration, rig, camera, used.get(camera))


def _judge_camera(
    calibration: Path, rig: RigCalibration, name: str, used: CameraPlan | None
) -> Iterator[CheckItem]:
    file = _read(calibration / "cameras" / f"{name}.json", CameraCalibration)
    if isinstance(file, str):
        yield _absent(name, f"The file of camera {name} cannot be used: {file}", _MEND)
        return
    sensor = file.sensor
    if file.intrinsics is None:
        about = (
            "" if sensor is None else f" That of a {sensor.title} sees some {sensor.view_deg[0]:.0f} degrees."
        )
        yield _absent(
            name,
            f"Camera {name}: its lens is not measured.{about}",
            "`phalanx calibrate cameras intrinsics`.",
        )
    elif (
        sensor is not None
        and abs(file.intrinsics.fx_px / sensor.nominal.fx_px - 1.0) > 3.0 * sensor.focal_share
    ):
        yield _stale(
            name,
            f"The lens of camera {name} has {file.intrinsics.fx_px:.0f} pixels of focal length, a {sensor.title} has"
            f" {sensor.nominal.fx_px:.0f}.",
            "Measure it in the mode that is used; of another lens, take `sensor` out of its file.",
        )
    if used is not None and (file.width_px, file.height_px) != used.size_px:
        yield _stale(
            name,
            f"The file of camera {name} says {file.width_px} x {file.height_px} pixels, in use are"
            f" {used.size_px[0]} x {used.size_px[1]}.",
            "Measure the lens with the size that is used, or start master and slave anew.",
        )
    lens = file.provenance.get("intrinsics")
    for key, part in (("T_rig_camera", "the places of the cameras"), *_NEEDS_LENS[rig.kind]):
        if _older(rig.provenance.get(key), lens):
            yield _stale(
                name,
                f"The lens of camera {name} was measured after {part} of rig {rig.name}, which rest on it.",
                f"Measure {part} anew: `phalanx calibrate --help`.",
            )
    law = rig.depth_model
    if law != "stereo" and _older(rig.provenance.get(law), rig.provenance.get("T_rig_camera")):
        yield _stale(
            rig.name,
            f"The cameras of rig {rig.name} were placed anew after its depth model was fitted.",
            "Fit it anew: `phalanx calibrate depth`.",
        )


_MEND = "Mend it, or take the copy that was in use; meanwhile everything goes on with what was read before."
_NEEDS_LENS = {
    "markers": (),
    "wrist": (("laser_plane", "the plane of the laser"), ("T_camera_palm", "the palm")),
}


def _older(part: Provenance | None, base: Provenance | None) -> bool:
    """Whether `part` was measured before its `base`; undated: not known, False."""
    if part is None or base is None:
        return False
    return datetime.fromisoformat(part.date) + SAME_RUN < datetime.fromisoformat(base.date)


def _read(path: Path, kind: type[PartT]) -> PartT | str:
    """The file, or why it cannot be used."""
    try:
        return load(path, kind)
    except CalibrationError as error:
        return str(error).replace(str(path), path.name)


def _absent(subject: str, sentence: str, fix: str) -> CheckItem:
    return CheckItem("calibration_absent", subject, sentence[:500], fix)


def _stale(subject: str, sentence: str, fix: str) -> CheckItem:
    return CheckItem("calibration_stale", subject, sentence[:500], fix)
