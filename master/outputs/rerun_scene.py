"""The scene logs hands, rig and camera pictures to one Rerun recording.

Every row stands on the timeline "capture" at its `t_ns`. Entities:

    about                                text: what the colours mean
    world/volume                         box that the rig states
    world/cameras/CAM                    place, pinhole; /image; /markers: the raw caps as this camera should see them;
                                         /detections: centroids as it saw them, where they are known
    world/hand/HAND/skeleton             5 finger strips and the palm, coloured by source
    world/hand/HAND/joints               valid joints, bright = tracked; /at_limit: angle at its limit
    world/hand/HAND/uncertainty          2 sigma ellipsoids of the tips, up to 3 cm
    world/markers/raw, filtered          caps before and after the filter
    world/rays/CAM                       camera centre to each cap
    world/objects, contact, gestures; states; events       see `rerun_results`
    world/truth/skeleton, markers        where a truth is known
    plots/...                            latency, rate, jitter, error, PIP angles, bend of the wrist, counts, health

Of a wrist device; `world` is turned as the forearm is held (up is up) where an IMU measures it:

    world/laser/fan, points              its light as far as the rig specifies it; where it meets each finger
    world/rays/CAM/laser, /tips          from the camera to those points, and to the tips that are tracked
    world/cameras/CAM/laser              the same points as this camera should see them; /detections/laser, tips

Beside marker cameras `world/laser`, `world/rays/CAM` and `world/cameras/CAM` move with the device
(`DevicePlace`), and `world/hand/HAND/forearm`, `forearm_uncertainty` (a ring: its far end at 2 sigma of the
bend) and `plots/wrist_angles_deg` are added. Of several hands the first has these paths; markers, laser,
truth and plots of another carry its name behind the group (`world/markers/HAND/raw`).
"""

from collections.abc import Iterable, Mapping, Sequence

import cv2
import numpy as np
import numpy.typing as npt
import rerun as rr

from common.arrays import Bool, Float, Image, Int
from common.calibration import Volume
from common.errors import PictureError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import matrix_to_quaternion, quaternion_to_matrix
from common.hand.model import FINGER_JOINTS, FINGERS, PALM, TIPS, WRIST, HandModel
from common.hand.profiles import FLEXION
from common.messages import (
    FINGER_COUNT,
    Contact,
    Detections,
    Gesture,
    Health,
    MarkerDetections,
    ObjectPose,
    ResultMessage,
    Source,
    WristDetections,
)
from common.messages.picture_size import Size, jpeg_size
from master.outputs.drawing import (
    LASER_RGB,
    LIMIT_RGB,
    RAY_RGB,
    SOURCE_RGB,
    TRUTH_RGB,
    DevicePlace,
    dim,
    fan,
    fan_rays,
    pack,
    series_rgb,
)
from master.outputs.poses import Poses, PosesTruth, distance_m, mean_known
from master.outputs.rerun_blueprint import (
    PIXEL_CENTRE,
    TIMELINE,
    WORLD,
    Columns,
    States,
    camera_path,
    legend,
    seen,
)
from master.outputs.rerun_results import GesturesLayer, ObjectsLayer
from master.rig.setup import RigSetup, WristSetup

_FAN_LINE_M = 0.0003
_WRIST_ANGLES = ("flexion", "deviation")
_FINGER_RGB = [series_rgb(finger) for finger in range(FINGER_COUNT)]


class WristLayer:
    """Logger of one wrist device to a recording that belongs to the caller."""

    def __init__(
        self,
        recording: rr.RecordingStream,
        camera: str,
        setup: WristSetup,
        spread: Float,
        group: str = "",
        *,
        in_rig: bool,
    ) -> None:
        """Log what never changes.

        Args:
            spread: Directions (K, 3) of the device's light, see `fan_rays`.
            group: What stands behind the paths of laser and plots, see `RerunScene`.
            in_rig: Poses are in the frame of a rig of markers, not of the device's camera.
        """
        self._rows, self._setup, self._in_rig = Columns(recording), setup, in_rig
        self._laser, self._group = f"{WORLD}/laser{group}", group
        self._level_world: Float | None = None
        self._camera, self._model = camera, setup.optics
        for i, name in enumerate(_WRIST_ANGLES if in_rig else ()):
            self._rows.name(f"plots/wrist_angles_deg{group}/{name}", name, series_rgb(i))
        lines = fan(setup.laser_m, spread)
        recording.log(
            f"{self._laser}/fan",
            rr.LineStrips3D(lines, colors=[(*LASER_RGB, 90)], radii=_FAN_LINE_M),
            static=True,
        )

    def log_poses(self, poses: Poses) -> None:
        """Log laser points, sights and how the forearm is held, of a batch of poses."""
        t, points, tips = poses.t_ns, poses.laser_m, poses.position_m[:, TIPS]
        if self._in_rig:
            place = DevicePlace.of(poses, self._setup.model)
            T = place.cameras(self._setup.T_camera_palm)
            self._log_placed(poses, place, T)
            points = np.where(np.isfinite(T[:, :1, 3:]), points, np.nan)  # of a lost hand nobody knows where
            tips = (tips - T[:, None, :3, 3]) @ T[:, :3, :3]
        else:
            self._log_held(poses)
        colours = np.broadcast_to(pack(_FINGER_RGB), points.shape[:2])
        point_m = 0.0025
        self._rows.points(f"{self._laser}/points", t, points, seen(points), colours, point_m)
        rays, centre = rr.new_entity_path([WORLD, "rays", self._camera]), self._model.centre
        self._rows.rays(f"{rays}/laser", t, centre, points, int(pack([RAY_RGB], alpha=150)[0]))
        tips = np.where(poses.tracked[:, TIPS, None], tips, np.nan)
        self._rows.rays(f"{rays}/tips", t, centre, tips, int(pack([TRUTH_RGB], alpha=90)[0]))
        point_px = 3.0
        self._rows.pixels(
            f"{camera_path(self._camera)}/laser", t, self._model.project(points), colours, point_px
        )
        self._rows.scalars(
            f"plots/seen{self._group}/laser_points", t, seen(points).sum(axis=1).astype(np.float64)
        )

    def _log_placed(self, poses: Poses, place: DevicePlace, T_rig_camera: Float) -> None:
        """Move the device to where the forearm is, and draw that."""
        known = np.flatnonzero(np.isfinite(T_rig_camera).all(axis=(1, 2)))
        if len(known):
            xyzw = np.roll(matrix_to_quaternion(T_rig_camera[known, :3, :3]), -1, axis=-1)
            for path in (
                camera_path(self._camera),
                self._laser,
                rr.new_entity_path([WORLD, "rays", self._camera]),
            ):
                columns = rr.Transform3D.columns(translation=T_rig_camera[known, :3, 3], quaternion=xyzw)
                self._rows.send(path, poses.t_ns[known], columns, None)
        root, t = rr.new_entity_path([WORLD, "hand", poses.hand]), poses.t_ns
        colour = int(pack([SOURCE_RGB[Source.WRIST]])[0])
        bone_m = 0.0025
        forearm_m = 0.16  # of it, as long as a hand
        self._rows.lines(f"{root}/forearm", t, place.arm_m(forearm_m), colour, bone_m)
        self._rows.lines(
            f"{root}/forearm_uncertainty", t, place.uncertainty_m(forearm_m), colour, _FAN_LINE_M
        )
        for i, name in enumerate(_WRIST_ANGLES):
            self._rows.scalars(
                f"plots/wrist_angles_deg{self._group}/{name}", t, np.degrees(place.wrist_angles_rad[:, i])
            )

    def _log_held(self, poses: Poses) -> None:
        """Turn the scene: y down along gravity, the first viewing direction ahead."""
        known = np.flatnonzero(np.isfinite(poses.palm_world_wxyz).all(axis=1))
        if not len(known):
            return
        world_camera = (
            quaternion_to_matrix(poses.palm_world_wxyz[known]) @ self._setup.T_camera_palm[:3, :3].T
        )
        if self._level_world is None:
            self._level_world = _level(world_camera[0])
        orientation = matrix_to_quaternion(self._level_world @ world_camera)
        columns = rr.Transform3D.columns(quaternion=orientation[:, [1, 2, 3, 0]])
        self._rows.send(WORLD, poses.t_ns[known], columns, None)

    def log_detections(self, frames: Sequence[WristDetections]) -> None:
        """Log laser and fingertips as the camera saw them; frames in order of time."""
        t = np.array([frame.t_ns for frame in frames], np.int64)
        colours = np.broadcast_to(pack(_FINGER_RGB), (len(frames), FINGER_COUNT))
        path = f"{camera_path(self._camera)}/detections"
        for name, uv in (
            ("laser", np.array([frame.laser_uv for frame in frames])),
            ("tips", np.array([frame.tip_uv for frame in frames])),
        ):
            detected_px = 4.0
            self._rows.pixels(f"{path}/{name}", t, uv, colours, detected_px)


def _level(world_camera: Float) -> Float:
    """Rotation from the IMU's world to x right, y down, z ahead.

    Ahead is where the camera looks, or its image's top where it looks up.
    """
    up = np.array([0.0, 0.0, 1.0])
    upright = 0.98  # cosine of 11 degrees off the vertical
    along = world_camera[:, 2] if abs(world_camera[2, 2]) < upright else -world_camera[:, 1]
    ahead = along - (along @ up) * up
    ahead /= np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), -up, ahead])


class CameraImages:
    """Logger of camera images to a recording that belongs to the caller."""

    def __init__(self, recording: rr.RecordingStream, models: Mapping[str, CameraModel]) -> None:
        """Take the cameras of the rig by name."""
        self._rec = recording
        self._models = models
        self._last_ns: dict[str, int] = {}
        self._size: dict[str, tuple[int, int]] = {}

    def log(self, camera: str, image: Image | bytes, t_ns: int, shown_ns: int | None = None) -> bool:
        """Show an image of a camera at its full size; return whether it was logged.

        Dropped are more than 10 a second, images of a camera that the rig does not have, bytes that are no JPEG, and
        what claims to be larger than the camera's picture.

        Args:
            image: (H, W, 3) BGR, (H, W) grey, or a whole JPEG file as bytes.
            t_ns: Capture time [ns].
            shown_ns: Where it stands on the timeline [ns]; None: at `t_ns`.
        """
        last = self._last_ns.get(camera)
        image_period_ns = 100_000_000  # images at most at 10 Hz: they cost the viewer more than all else
        if last is not None and 0 <= t_ns - last < image_period_ns:
            return False
        model = self._models.get(camera)
        size = _size(image)
        if model is None or size is None or size[0] > model.width_px or size[1] > model.height_px:
            return False
        self._last_ns[camera] = t_ns
        if isinstance(image, bytes):
            jpeg = image
        else:
            jpeg_quality = 80
            jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])[1].tobytes()
        path = f"{camera_path(camera)}/image"
        if self._size.get(camera) != size:
            # The pinhole and all centroids are in pixels of the camera; a preview has fewer.
            scale = [model.width_px / size[0], model.height_px / size[1], 1.0]
            self._rec.log(path, rr.Transform3D(scale=scale), static=True)
            self._size[camera] = size
        self._rec.set_time(TIMELINE, duration=np.timedelta64(t_ns if shown_ns is None else shown_ns, "ns"))
        self._rec.log(path, rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        return True


def _size(image: Image | bytes) -> Size | None:
    """Width and height [px]; None: no JPEG."""
    if not isinstance(image, bytes):
        return image.shape[1], image.shape[0]
    try:
        return jpeg_size(image)
    except PictureError:
        return None


_STRIPS = (*((WRIST, *joints) for joints in FINGER_JOINTS), (WRIST, 7, 12, 17, 22, WRIST))
_STRIP_SOURCE = (*TIPS.tolist(), WRIST)
# joint that angle (5, 4) turns
_HINGE_OF_ANGLE = np.array([[c[-4], c[-4], c[-3], c[-2]] for c in FINGER_JOINTS])
_AT_LIMIT_RAD = np.deg2rad(0.5)
_FRUSTUM_LINE_M = 0.0004


class RerunScene:
    """Logger of the hands and what observes them; the recording is the caller's."""

    def __init__(self, recording: rr.RecordingStream, setups: Sequence[RigSetup]) -> None:
        """Log what never changes; cameras that several setups have are shown once."""
        self._rec, self._rows = recording, Columns(recording)
        self._first = setups[0]
        self._setups = {setup.hand.profile.name: setup for setup in setups}
        self._models = {name: model for setup in setups for name, model in setup.models.items()}
        self._devices: dict[str, WristLayer] = {}
        objects = {profile.name: profile for setup in setups for profile in setup.objects}
        states = States(recording)
        self._objects = ObjectsLayer(recording, states, list(objects.values()))
        self._gestures = GesturesLayer(recording, states)
        self._joints: dict[tuple[str, int], Float] = {}  # hand and time -> tips and palm (6, 3) [m]
        self._recent_ns: Int = np.empty(0, np.int64)
        self._styled: set[str] = set()
        recording.log(WORLD, rr.ViewCoordinates.RDF, static=True)
        recording.log("about", rr.TextDocument(legend(), media_type="text/markdown"), static=True)
        if self._first.rig.volume is not None:
            self._log_volume(self._first.rig.volume)
        for name, model in self._models.items():
            self._log_camera(name, model)
        wrist_models = {
            name: setup.wrist.optics
            for setup in setups
            if setup.wrist is not None
            for name in setup.wrist_cameras
        }
        for name in wrist_models.keys() - self._models.keys():
            self._log_lens(name, wrist_models[name])  # beside markers; where it is changes
        self._images = CameraImages(recording, self._models | wrist_models)
        for hand, setup in self._setups.items():
            group = self._group(hand)
            if setup.wrist is not None and setup.wrist_rig is not None:
                spread, in_rig = fan_rays(setup.wrist_rig, setup.wrist), setup.has_markers
                camera = setup.wrist_rig.cameras[0]
                self._devices[hand] = WristLayer(recording, camera, setup.wrist, spread, group, in_rig=in_rig)
            for i, name in enumerate(setup.markers):
                self._rows.name(f"plots/jitter_mm{group}/{name}", name, series_rgb(i))
            for i, name in enumerate(FINGERS):
                self._rows.name(f"plots/pip_deg{group}/{name}", name, series_rgb(i))

    @property
    def last_t_ns(self) -> int | None:
        """Time of the newest pose logged, or None."""
        return int(self._recent_ns[-1]) if len(self._recent_ns) else None

    def log_poses(self, poses: Poses, truth: PosesTruth | None = None) -> None:
        """Log a batch of poses of one hand, and their truth row by row, in time order."""
        if not len(poses):
            return
        setup = self._setups.get(poses.hand, self._first)
        self._log_hand(rr.new_entity_path([WORLD, "hand", poses.hand]), poses, setup.hand)
        if (device := self._devices.get(setup.hand.profile.name)) is not None:
            device.log_poses(poses)
        if setup.has_markers:
            self._log_markers(poses, setup)
        self._log_plots(poses, setup)
        if truth is not None:
            self._log_truth(poses, truth)
        # contact and gestures are drawn at the joints of their own epoch
        at = np.where(poses.valid[..., None], poses.position_m, np.nan)[:, [*TIPS.tolist(), PALM]]
        self._joints |= {(poses.hand, t): row for t, row in zip(poses.t_ns.tolist(), at, strict=True)}
        remembered = 1024  # poses
        for old in list(self._joints)[: -max(remembered, len(poses))]:
            del self._joints[old]

    def log_results(self, results: Sequence[ResultMessage]) -> None:
        """Log objects, contact and gestures in time order, after their hands' poses."""
        self._objects.log_poses([one for one in results if isinstance(one, ObjectPose)])
        self._objects.log_contacts([one for one in results if isinstance(one, Contact)], self._joints)
        self._gestures.log([one for one in results if isinstance(one, Gesture)], self._joints)

    def log_detections(self, detections: Iterable[Detections]) -> None:
        """Log what one camera saw, in its image; frames in the order of time."""
        frames = list(detections)
        cycles = [frame for frame in frames if isinstance(frame, WristDetections)]
        for hand, device in self._devices.items():
            if cycles and cycles[0].camera in self._setups[hand].wrist_cameras:
                device.log_detections(cycles)
        markers = [frame for frame in frames if isinstance(frame, MarkerDetections)]
        if not markers:
            return
        uv = np.array([frame.uv for frame in markers])
        colours = np.broadcast_to(_marker_colours(uv.shape[1]), uv.shape[:2])
        t_ns = np.array([frame.t_ns for frame in markers], np.int64)
        detected_px = 4.0
        self._rows.pixels(f"{camera_path(markers[0].camera)}/detections", t_ns, uv, colours, detected_px)

    def log_image(self, camera: str, image: Image | bytes, t_ns: int, shown_ns: int | None = None) -> bool:
        """Show an image of a camera; see `CameraImages.log`."""
        return self._images.log(camera, image, t_ns, shown_ns)

    def log_health(self, health: Health, t_ns: int) -> None:
        """Plot every count and metric of a process at `t_ns` [ns] of the timeline."""
        for name, value in [*health.counts.items(), *health.metrics.items()]:
            path = rr.new_entity_path(["plots", "health", health.source, name])
            self._rows.scalars(path, np.array([t_ns], np.int64), np.array([float(value)]))

    def _log_volume(self, volume: Volume) -> None:
        low, high = np.array(volume.low_m), np.array(volume.high_m)
        box = rr.Boxes3D(
            centers=[(low + high) / 2.0],
            half_sizes=[(high - low) / 2.0],
            colors=[TRUTH_RGB],
            radii=_FRUSTUM_LINE_M,
            fill_mode="MajorWireframe",
        )
        self._rec.log(f"{WORLD}/volume", box, static=True)

    def _log_camera(self, name: str, model: CameraModel) -> None:
        pose = model.T_rig_camera
        place = rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
        self._rec.log(camera_path(name), place, static=True)
        self._log_lens(name, model)

    def _log_lens(self, name: str, model: CameraModel) -> None:
        matrix = model.matrix.copy()
        matrix[:2, 2] += PIXEL_CENTRE
        frustum_m, axes_m = 0.06, 0.01
        pinhole = rr.Pinhole(
            image_from_camera=matrix,
            resolution=(model.width_px, model.height_px),
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=frustum_m,
            color=TRUTH_RGB,
            line_width=_FRUSTUM_LINE_M,
        )
        self._rec.log(camera_path(name), rr.TransformAxes3D(axes_m), pinhole, static=True)

    def _group(self, hand: str) -> str:
        """What stands behind a group's path for the entities of a hand."""
        return "" if hand == self._first.hand.profile.name else rr.new_entity_path([hand])

    def _log_hand(self, root: str, poses: Poses, hand: HandModel) -> None:
        valid, at = poses.valid, poses.position_m
        shown = np.stack([valid[:, list(strip)].all(axis=1) for strip in _STRIPS], axis=1)
        palette = pack([SOURCE_RGB[source] for source in Source])
        # A code that this version does not know is shown like "no pose".
        colours = palette[np.where(poses.source < len(palette), poses.source, 0)]
        strips = _strips(at, shown)
        strip_colours = colours[:, _STRIP_SOURCE][shown]
        self._rows.strips(f"{root}/skeleton", poses.t_ns, strips, shown.sum(axis=1), strip_colours, 0.0018)
        colours = np.where(poses.tracked, colours, dim(colours))
        joint_shown = 0.45  # of its radius, so that the bones stay visible
        radii = (poses.radius_m * joint_shown)[valid]
        self._rows.points(f"{root}/joints", poses.t_ns, at, valid, colours, radii)
        limit = _at_limit(poses.angles_rad, hand) & valid
        red = np.full(limit.shape, pack([LIMIT_RGB])[0])
        self._rows.points(f"{root}/at_limit", poses.t_ns, at, limit, red, (poses.radius_m * 0.55)[limit])
        self._log_uncertainty(f"{root}/uncertainty", poses)

    def _log_uncertainty(self, path: str, poses: Poses) -> None:
        cov = poses.cov_m2[:, TIPS]
        known = np.isfinite(cov).all(axis=(-1, -2)) & poses.valid[:, TIPS]
        largest_m = 0.03  # half axis of the largest ellipsoid shown
        # A cloud larger than the fingers would hide the hand; what is that uncertain is seen by its colour.
        known[known] &= np.linalg.eigvalsh(cov[known])[:, -1] <= (largest_m / 2.0) ** 2
        variance, axes = np.linalg.eigh(cov[known])
        axes[np.linalg.det(axes) < 0, :, 0] *= -1.0  # a mirror image is no rotation
        wxyz = matrix_to_quaternion(axes)
        ellipsoids = rr.Ellipsoids3D.columns(
            centers=poses.position_m[:, TIPS][known],
            half_sizes=2.0 * np.sqrt(np.maximum(variance, 0.0)),
            quaternions=np.roll(wxyz, -1, axis=-1),
            colors=np.full(known.sum(), pack([TRUTH_RGB])[0]),
        )
        if path not in self._styled:
            ellipse_line_m = 0.0002
            style = rr.Ellipsoids3D.from_fields(fill_mode="MajorWireframe", line_radii=ellipse_line_m)
            self._rec.log(path, style, static=True)
            self._styled.add(path)
        self._rows.send(path, poses.t_ns, ellipsoids, known.sum(axis=1))

    def _log_markers(self, poses: Poses, setup: RigSetup) -> None:
        group = self._group(poses.hand)
        colours = np.broadcast_to(_marker_colours(poses.marker_count), poses.markers_m.shape[:2])
        for name, at, radius in (("raw", poses.markers_raw_m, 0.0025), ("filtered", poses.markers_m, 0.004)):
            tint = dim(colours) if name == "raw" else colours
            self._rows.points(f"{WORLD}/markers{group}/{name}", poses.t_ns, at, seen(at), tint, radius)
        raw = poses.markers_raw_m
        for name, model in setup.models.items():
            path = rr.new_entity_path([WORLD, "rays", name])
            self._rows.rays(
                f"{path}{group}", poses.t_ns, model.centre, raw, int(pack([RAY_RGB], alpha=110)[0])
            )
            uv = model.project(raw)
            marker_px = 3.0
            self._rows.pixels(f"{camera_path(name)}/markers{group}", poses.t_ns, uv, colours, marker_px)

    def _log_plots(self, poses: Poses, setup: RigSetup) -> None:
        t, group = poses.t_ns, self._group(poses.hand)
        if poses.latency_ns.any():  # all zero: an offline run, which has none
            self._rows.scalars(f"plots/latency_ms{group}", t, poses.latency_ns.astype(np.float64) * 1e-6)
        self._rows.scalars(f"plots/rate_hz{group}", t, self._rate_hz(t))
        step = distance_m(poses.markers_raw_m, poses.markers_m) * 1e3
        for m in range(poses.marker_count):
            name = setup.markers[m] if m < len(setup.markers) else f"marker-{m}"
            self._rows.scalars(f"plots/jitter_mm{group}{rr.new_entity_path([name])}", t, step[:, m])
        for f, name in enumerate(FINGERS):
            pip = 2
            self._rows.scalars(f"plots/pip_deg{group}/{name}", t, np.rad2deg(poses.angles_rad[:, f, pip]))
        self._rows.scalars(
            f"plots/seen{group}/joints_tracked", t, poses.tracked.sum(axis=1).astype(np.float64)
        )
        if setup.has_markers:
            markers = seen(poses.markers_raw_m).sum(axis=1)
            self._rows.scalars(f"plots/seen{group}/markers", t, markers.astype(np.float64))

    def _log_truth(self, poses: Poses, truth: PosesTruth) -> None:
        t, at, group = poses.t_ns, truth.joints_m, self._group(poses.hand)
        known = np.stack([np.isfinite(at[:, list(strip)]).all(axis=(1, 2)) for strip in _STRIPS], axis=1)
        grey = int(pack([TRUTH_RGB])[0])
        path = f"{WORLD}/truth{group}/skeleton"
        self._rows.strips(path, t, _strips(at, known), known.sum(axis=1), grey, 0.0008)
        name, points = ("markers", truth.markers_m) if truth.laser_m is None else ("laser", truth.laser_m)
        colours = np.full(points.shape[:2], grey, np.uint32)
        self._rows.points(f"{WORLD}/truth{group}/{name}", t, points, seen(points), colours, 0.002)
        for i, (name, error) in enumerate(truth.errors_m(poses).items()):
            path = f"plots/error_mm{group}/{name}"
            if path not in self._styled:
                self._rows.name(path, name, series_rgb(i))
                self._styled.add(path)
            self._rows.scalars(path, t, mean_known(error) * 1e3)

    def _rate_hz(self, t_ns: Int) -> Float:
        """Poses per second (T,) over the second up to each row; NaN for the very first."""
        times = np.concatenate([self._recent_ns, t_ns])
        rows = np.arange(len(self._recent_ns), len(times))
        first = np.searchsorted(times, times[rows] - 1_000_000_000)
        span = (times[rows] - times[first]).astype(np.float64) * 1e-9
        self._recent_ns = times[times > times[-1] - 1_000_000_000]
        return np.divide(rows - first, span, out=np.full(len(rows), np.nan), where=span > 0)


def _marker_colours(count: int) -> npt.NDArray[np.uint32]:
    return pack([series_rgb(i) for i in range(count)])


def _at_limit(angles_rad: Float, hand: HandModel) -> Bool:
    """Mask (T, 26) of joints with an angle, other than a fixed one, at its limit."""
    low, high = hand.limits_at(angles_rad[..., FLEXION])
    reached = (angles_rad <= low + _AT_LIMIT_RAD) | (angles_rad >= high - _AT_LIMIT_RAD)
    reached &= high - low > 2 * _AT_LIMIT_RAD
    joints = np.zeros((len(angles_rad), 26), np.bool_)
    for finger, angle in np.ndindex(5, 4):
        joints[:, _HINGE_OF_ANGLE[finger, angle]] |= reached[:, finger, angle]
    return joints


def _strips(at: Float, shown: Bool) -> list[Float]:
    """Line strips of joints (T, 26, 3), one for each True of `shown` (T, 6)."""
    rows, strips = np.nonzero(shown)
    return [at[i, list(_STRIPS[k])] for i, k in zip(rows.tolist(), strips.tolist(), strict=True)]
