"""A master and a slave for the console's tests: on a real bus, with a hand, pictures, reports and answers."""

import json
import shutil
import threading
from pathlib import Path

import cv2
import msgspec
import numpy as np

from common.bus.bus import Bus
from common.calibration import CameraCalibration, HsvRange, load, save
from common.calibration.camera_settings import figures
from common.clock import now_ns
from common.errors import CalibrationError
from common.hand.model import TIPS
from common.messages import CheckItem, Checklist, Command, Gesture, HandPose, Health, Preview, Source
from tests.hand_helpers import RIGHT
from tests.results import pose_of
from tests.synthetic_run import hand_at

ROOT = Path(__file__).resolve().parents[3]
WIDTH, HEIGHT = 640, 480
COLOURS = {"thumb": 90, "index": 20, "middle": 120, "ring": 150, "little": 45, "back": 175}


def tree(folder: Path) -> Path:
    """A calibration tree with the desk rig, whose cameras know their colours."""
    calibration = folder / "calib_json"
    shutil.copytree(ROOT / "calib_json", calibration)
    for camera in ("left", "right"):
        path = calibration / "cameras" / f"{camera}.json"
        markers = {
            name: HsvRange(hsv_low=(hue - 5, 90, 40), hsv_high=((hue + 5) % 180, 255, 255))
            for name, hue in COLOURS.items()
        }
        save(path, msgspec.structs.replace(load(path, CameraCalibration), markers=markers))
    return calibration


class FakeSlave:
    """Answers as a slave does, and shows a picture for a while after `preview`. Holds what it was told."""

    def __init__(self, bus: Bus, camera: Path) -> None:
        self.path, self.camera = camera, load(camera, CameraCalibration)
        self.roi_margin = self.camera.roi_margin
        self.commands: list[Command] = []
        self.shown_ns: list[int] = []
        self.until_ns = 0
        self._bus, self._sent = bus, 0
        bus.announce(self.camera.name)
        bus.serve(self.camera.name, self.answer)

    @property
    def name(self) -> str:
        return self.camera.name

    @property
    def shows(self) -> bool:
        """Whether somebody asked for pictures of late."""
        return now_ns() < self.until_ns

    def verbs(self, verb: str) -> list[dict[str, object]]:
        """Bodies of all commands of that verb."""
        return [json.loads(one.body) if one.body else {} for one in self.commands if one.verb == verb]

    def answer(self, command: Command) -> Health:
        self.commands.append(command)
        body = json.loads(command.body) if command.body else {}
        match command.verb:
            case "preview":
                self.until_ns = now_ns() + 3_000_000_000
            case "set":
                self._set(body)
            case "pick":
                hue = int(180 * body["uv"][0] / WIDTH)
                self._set(
                    {"markers": {body["marker"]: {"hsv_low": [hue, 80, 60], "hsv_high": [hue, 250, 250]}}}
                )
            case "save":
                self.camera = msgspec.structs.replace(self.camera, roi_margin=self.roi_margin)
                save(self.path, self.camera)
            case "settings":
                pass
            case _:
                raise ValueError(f"no command {command.verb!r}")
        return self.health()

    def _set(self, body: dict[str, object]) -> None:
        body = dict(body)
        exposure = body.get("exposure_us")
        if isinstance(exposure, int | float) and exposure > 11_000:
            raise CalibrationError(
                f"{self.name}: exposure_us {exposure:g}: does not fit into a frame of 11111 us"
            )
        self.roi_margin = float(str(body.pop("roi_margin", self.roi_margin)))
        commands = msgspec.convert(body.pop("markers", {}), dict[str, HsvRange | None], strict=False)
        markers = {**(self.camera.markers or {}), **commands}
        self.camera = msgspec.structs.replace(
            self.camera,
            **{key: tuple(value) if isinstance(value, list) else value for key, value in body.items()},
            markers={name: colour for name, colour in markers.items() if colour is not None},
        )

    def health(self) -> Health:
        metrics = figures(self.camera) | {
            "roi_margin": self.roi_margin,
            "rate_hz": 90.0,
            "sensor_celsius": 48.5,
        }
        metrics |= {f"wanted.{name}": value for name, value in metrics.items()}
        for name, colour in (self.camera.markers or {}).items():
            for end, values in (("low", colour.hsv_low), ("high", colour.hsv_high)):
                for channel, value in zip("hsv", values, strict=True):
                    metrics[f"marker.{name}.{channel}_{end}"] = float(value)
        return Health(self.name, 5, now_ns(), {"frames": self._sent}, metrics)

    def tick(self) -> None:
        if self.shows:
            self._sent += 1
            t_ns = now_ns()
            self.shown_ns.append(t_ns)
            self._bus.publish("preview", self.name, Preview(self.name, t_ns, picture(self._sent)))


def picture(number: int) -> bytes:
    """Half a frame: coloured caps on a desk, one of which moves."""
    image = np.full((HEIGHT // 2, WIDTH // 2, 3), (70, 78, 86), np.uint8)
    for k, hue in enumerate(COLOURS.values()):
        colour = cv2.cvtColor(np.full((1, 1, 3), (hue, 220, 230), np.uint8), cv2.COLOR_HSV2BGR)[0, 0].tolist()
        x, y = 40 + 46 * k, 120 - 22 * (k in (2, 3)) + int(8 * np.sin(number / 5 + k))
        cv2.line(image, (160, 230), (x, y), (120, 150, 190), 14, cv2.LINE_AA)
        cv2.circle(image, (x, y), 12, colour, -1, cv2.LINE_AA)
    return cv2.imencode(".jpg", image)[1].tobytes()


class FakeMaster:
    """Publishes a moving hand, gestures, reports and a checklist, until `close`. Holds what it was told."""

    def __init__(self, bus: Bus, slaves: list[FakeSlave], hand: bool = True) -> None:
        self.items: tuple[CheckItem, ...] = ()
        self.commands: list[Command] = []
        self.extra: dict[str, float] = {}
        self._bus, self._slaves, self._hand = bus, slaves, hand
        self._ended = threading.Event()
        bus.announce("master")
        bus.serve("master", self.answer)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def answer(self, command: Command) -> Health:
        self.commands.append(command)
        return self._health(0)

    def close(self) -> None:
        self._ended.set()
        self._thread.join()

    def _work(self) -> None:
        number = 0
        while not self._ended.wait(0.05):
            number += 1
            if self._hand:
                self._bus.publish("hand", "default-right", pose(number))
                for gesture in gestures(number):
                    self._bus.publish("gesture", "default-right", gesture)
            for slave in self._slaves:
                if number % 3 == 0:
                    slave.tick()
                if number % 20 == 0:
                    self._bus.publish("health", slave.name, slave.health())
            if number % 20 == 0:
                self._bus.publish("health", "master", self._health(number))
                self._bus.publish("checklist", "master", Checklist("master", 4, now_ns(), self.items))

    def _health(self, number: int) -> Health:
        metrics = {"latency_p50_ms": 7.0} | self.extra
        counts: dict[str, int] = {}
        for k, slave in enumerate(self._slaves):
            metrics[f"camera_hz.{slave.name}"] = 89.9 - k + 0.3 * np.sin(number / 40)
            metrics[f"{slave.name}.clock_offset_us"] = 3200.0 * (k + 1)
            metrics[f"{slave.name}.clock_sigma_us"] = 40.0 + 10 * k + 5 * np.sin(number / 60)
            counts[f"{slave.name}.lost"] = number // 60
            counts[f"{slave.name}.received"] = round(4.5 * number)
        return Health("master", 4, now_ns(), counts, {name: float(value) for name, value in metrics.items()})


def pose(number: int) -> HandPose:
    """A hand that sways, opens and closes; its little finger is held."""
    source = np.full(26, Source.SOLVED, np.uint8)
    source[list(TIPS)] = Source.MEASURED
    source[22:26] = Source.HELD
    return pose_of(
        RIGHT,
        hand_at(0.02 * number),
        hand="default-right",
        t_ns=now_ns(),
        tracked=source != Source.HELD,
        cov_m2=np.full((26, 3, 3), np.nan),
        source=source,
        markers_m=np.zeros((6, 3)),
        latency_ns=7_000_000 + 400_000 * (number % 9),
    )


def gestures(number: int) -> list[Gesture]:
    """A pose that is held, a pinch, a dial that turns, now and then a tap."""
    t_ns, hand = now_ns(), "default-right"
    phase = "begin" if number == 1 else "update"
    out = [
        Gesture(hand, t_ns, "pose", "small_grasp", phase, t_ns, 0.92),
        Gesture(hand, t_ns, "pinch", "index", phase, t_ns, 0.8, distance_m=0.012, strength=0.63),
        Gesture(hand, t_ns, "dial", "dial", phase, t_ns, 0.9, angle_rad=0.02 * number),
    ]
    return (
        [*out, Gesture(hand, t_ns, "tap", str(number % 10), "end", t_ns, 0.97)] if number % 30 == 0 else out
    )
