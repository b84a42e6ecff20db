"""A thing of a marker's colour beside the hand, through the whole line: rendered frames, detection, solving.

The same second of the standard scene is replayed as it is and with a disc of the marker's paint in one or both views.
Where the disc does not touch the marker, as many caps must be placed rightly as without it, and no more wrongly.
"""

from dataclasses import dataclass
from pathlib import Path
from shutil import copytree

import cv2
import numpy as np
import pytest

from common.arrays import Bool, Float, Image
from common.sim.record import record_scene
from common.sim.scene import Scene
from master.outputs.poses import Poses
from master.rig.setup import RigSetup, load_setup
from tests.replay.replayed import replay

SECONDS, RADIUS_PX, MARKER = 0.5, 8.0, 1
RIGHT_MM, WRONG_MM = 10.0, 20.0
SEED, START_S = 1, 9.5  # from then on both cameras see the finger


@dataclass(frozen=True)
class Recorded:
    """A rendered recording without clutter, and the truth of its T frames."""

    folder: Path
    setup: RigSetup
    uv: Float  # (T, C, M, 2) px
    area: Float  # (T, C, M) px^2
    visible: Float  # (T, C, M) share
    markers_m: Float  # (T, M, 3)
    placed_m: Float  # (T, M, 3) by a replay of it


@pytest.fixture(scope="module")
def recorded(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Rendered once."""
    tree, folder = root / "calib_json", tmp_path_factory.mktemp("scene") / "plain"
    setup = load_setup(tree, "desk")
    scene = Scene.standard(setup.rig, setup.cameras, setup.hand.profile, SEED)
    record_scene(folder, scene, SECONDS, START_S)
    with np.load(folder / "truth.npz") as truth:
        known = truth["uv"], truth["px"], truth["frac"], truth["paint_centroid"]
    return Recorded(folder, setup, *known, placed(folder, tree))


def with_disc(image: Image, uv: Float, bgr: Float, rng: np.random.Generator) -> None:
    """Paint a disc with a soft rim and two grey levels of noise."""
    u, v, reach = int(uv[0]), int(uv[1]), round(RADIUS_PX) + 3
    part = image[max(v - reach, 0) : max(v + reach, 0), max(u - reach, 0) : max(u + reach, 0)]
    if part.size == 0:
        return
    share = np.zeros(image.shape[:2], np.uint8)
    centre = (round(16 * float(uv[0])), round(16 * float(uv[1])))
    cv2.circle(share, centre, round(16 * RADIUS_PX), 255, -1, cv2.LINE_AA, 4)
    share = share[max(v - reach, 0) : max(v + reach, 0), max(u - reach, 0) : max(u + reach, 0), None] / 255.0
    mixed = part * (1.0 - share) + (bgr + rng.normal(0.0, 2.0, part.shape)) * share
    part[:] = np.clip(np.round(mixed), 0, 255).astype(np.uint8)


def painted(recorded: Recorded, folder: Path, places: Float) -> Path:
    """A copy of the recording with a disc at `places` (T, C, 2) [px]; NaN: none."""
    copytree(recorded.folder, folder)
    rng = np.random.default_rng(11)
    for c, camera in enumerate(recorded.setup.rig.cameras):
        for k in range(len(places)):
            if not np.isfinite(places[k, c]).all():
                continue
            path = folder / camera / f"{k:06d}.png"
            image = np.asarray(cv2.imread(str(path)), np.uint8)
            u, v = np.round(recorded.uv[k, c, MARKER]).astype(int)
            bgr = np.median(image[v - 1 : v + 2, u - 1 : u + 2].reshape(-1, 3), axis=0)
            with_disc(image, places[k, c], bgr, rng)
            assert cv2.imwrite(str(path), image, (cv2.IMWRITE_PNG_COMPRESSION, 0))
    return folder


def placed(folder: Path, tree: Path) -> Float:
    """Where a replay places the markers (T, M, 3) [m]."""
    out = replay(folder, folder.parent / f"{folder.name}-out", "--calibration", tree).out
    return Poses.load(out / "poses.npz").markers_raw_m


def apart(recorded: Recorded, places: Float) -> Bool:
    """(T,) frames in which the disc touches the marker in no camera, nor in those before and after."""
    distance = np.linalg.norm(places - recorded.uv[:, :, MARKER], axis=2)
    clear = ~(distance < RADIUS_PX + 1.3 * np.sqrt(recorded.area[:, :, MARKER] / np.pi) + 4.0).any(axis=1)
    near = np.concatenate([[True], clear, [True]])
    return near[:-2] & clear & near[2:]


def one_view(recorded: Recorded) -> Float:
    """At rest in the left image, 30 px from where the marker is in the middle of the run."""
    places = np.full(recorded.uv[:, :, MARKER].shape, np.nan)
    places[:, 0] = recorded.uv[len(places) // 2, 0, MARKER] + [24.0, -18.0]
    return places


def two_views_of_nothing(recorded: Recorded) -> Float:
    """At rest in both images, at places that are not one point."""
    middle = recorded.uv[len(recorded.uv) // 2, :, MARKER]
    return np.broadcast_to(middle + np.array([(24.0, -18.0), (-22.0, 20.0)]), recorded.uv[:, :, MARKER].shape)


def one_thing(recorded: Recorded) -> Float:
    """A thing at rest, 4.5 cm beside the marker."""
    place = recorded.markers_m[len(recorded.uv) // 2, MARKER] + [0.035, -0.025, 0.01]
    views = [model.project(place) for model in recorded.setup.models.values()]
    return np.broadcast_to(np.array(views), recorded.uv[:, :, MARKER].shape)


def along_its_row(recorded: Recorded) -> Float:
    """In the right image 30 px beside the marker, always: on its epipolar line."""
    places = np.full(recorded.uv[:, :, MARKER].shape, np.nan)
    places[:, 1] = recorded.uv[:, 1, MARKER] + [30.0, 0.0]
    return places


CLUTTER = {
    "one view": one_view,
    "two views of nothing": two_views_of_nothing,
    "one thing": one_thing,
    "along its row": along_its_row,
}


@pytest.mark.parametrize("clutter", CLUTTER)
def test_a_thing_of_its_colour_costs_no_marker(
    recorded: Recorded, clutter: str, root: Path, tmp_path: Path
) -> None:
    places = CLUTTER[clutter](recorded)
    placed_m = placed(painted(recorded, tmp_path / "painted", places), root / "calib_json")
    shown = apart(recorded, places) & (recorded.visible[:, :, MARKER] > 0.9).all(axis=1)
    assert shown.sum() >= 10, "the scene shows too little to judge by"
    off_mm, plain_mm = (
        1e3 * np.linalg.norm(found[shown, MARKER] - recorded.markers_m[shown, MARKER], axis=1)
        for found in (placed_m, recorded.placed_m)
    )
    assert (plain_mm < RIGHT_MM).mean() >= 0.9
    assert (off_mm > WRONG_MM).sum() <= (plain_mm > WRONG_MM).sum()
    assert (off_mm < RIGHT_MM).sum() >= 0.95 * (plain_mm < RIGHT_MM).sum()
