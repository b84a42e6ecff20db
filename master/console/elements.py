"""Elements of the console's pages that NiceGUI does not have.

They are a camera's picture and the hand in 3D.
"""

from collections.abc import Callable
from typing import cast

from nicegui.element import Element
from nicegui.events import GenericEventArguments


class CameraView(Element, component="static/camera_view.js"):
    """Live camera picture, shown as long as the page is visible.

    With `on_pick`, a click, or a cross moved by keys, picks a point.
    """

    def __init__(
        self, camera: str, label: str, on_pick: Callable[[float, float, int], object] | None = None
    ) -> None:
        """Show `camera`.

        Args:
            camera: Its name.
            label: What a screen reader reads.
            on_pick: Called with the place in the picture, as shares (0..1) of its width and height, and its time [ns].
        """
        super().__init__()
        self._props["camera"] = camera
        self._props["label"] = label
        self._props["mask"] = []
        self._props["picks"] = on_pick is not None
        self.on("pick", lambda event: None if on_pick is None else on_pick(*_place(event)))

    def tint(self, markers: tuple[str, ...]) -> None:
        """Tint the pixels in the ranges of these markers."""
        self._props["mask"] = list(markers)


class HandBox(Element, component="static/hand_box.js"):
    """All hands and objects in 3D, as long as the page is visible."""

    def reset(self) -> None:
        """Look from where it looked at first."""
        self.run_method("reset")


def _place(event: GenericEventArguments) -> tuple[float, float, int]:
    args = cast(dict[str, float | str], event.args)
    x, y = (min(max(float(args[key]), 0.0), 1.0) for key in ("x", "y"))
    return x, y, int(args["taken"])


def full_frame_uv(x: float, y: float, width_px: int, height_px: int) -> tuple[float, float]:
    """Convert shares of a picture to a pixel of the whole frame.

    (0, 0) is the centre of the top-left pixel.
    """
    return x * width_px - 0.5, y * height_px - 0.5
