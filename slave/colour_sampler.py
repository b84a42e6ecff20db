"""Marker colour from a click on the picture of a running slave.

It finds the frame, the light and the other colours.
"""

from collections.abc import Callable, Mapping

from msgspec.structs import replace

from common.arrays import Image
from common.calibration import CameraCalibration
from common.calibration.camera_settings import ColourPick
from common.errors import CameraError
from slave.markers.colour_sampling import SampledColours
from slave.markers.reloadable import ReloadableDetector
from slave.sources import Frame


class ColourSampler:
    """Holds what was picked since the start. Its callers take turns."""

    def __init__(
        self, detector: ReloadableDetector, shown: Callable[[int], Frame | None], markers: tuple[str, ...]
    ) -> None:
        """Pick colours of `markers`, those of the rig.

        Args:
            detector: Has the newest frame, and knows the light.
            shown: Time of a preview [ns] -> its frame, if that is still there.
            markers: Others in a camera file belong to other rigs, and collide with nothing here.
        """
        self._detector, self._shown, self._markers = detector, shown, markers
        self._picked = SampledColours()

    def pick(
        self, wish: ColourPick, camera: CameraCalibration
    ) -> tuple[CameraCalibration, Mapping[str, float]]:
        """Return the camera file with the colour at the clicked position.

        Also returns how many pixels it has, and what its range holds.

        Raises:
            CameraError: No frame was read yet.
            FitError: As `SampledColours.sample`.
        """
        every = camera.markers or {}
        ranges = {name: every[name] for name in self._markers if name in every}
        light = self._detector.log_gains
        done = self._picked.sample(self._image(wish.t_ns), light, wish.marker, wish.uv, ranges)
        report = {
            "pick.pixels": float(done.row.pixels),
            "pick.own_share": done.row.own,
            "pick.skin_share": done.row.skin,
            "pick.background_px": done.row.background_px,
        }
        return replace(camera, markers=every | done.ranges), report

    def _image(self, t_ns: int | None) -> Image:
        """The picture that was clicked on, or else the newest one."""
        if t_ns is not None and (frame := self._shown(t_ns)) is not None:
            return frame.image
        newest = self._detector.newest
        if newest is None:
            raise CameraError(
                "pick: no frame was read yet: the camera is away, or the slave waits for a master"
            )
        return newest[0]
