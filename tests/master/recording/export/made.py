"""What the tests of exports share: hands that move at random, with and without faults, as runs and as recordings."""

from pathlib import Path

import numpy as np

from common.arrays import Bool, Float
from common.calibration import save
from common.geometry.transforms import rigid
from common.hand.model import HandModel
from common.hand.profiles import generated_profile
from common.messages import Contact, Gesture, HandPose, ObjectSource, ResultMessage
from master.outputs.poses import Poses
from master.recording.export.motion import Skeleton
from tests.hand_helpers import any_rotation, natural_angles
from tests.results import object_pose, pose_of

RIGHT = HandModel.of(generated_profile("made-right", "right"))
LEFT = HandModel.of(generated_profile("made-left", "left"))
REST = Skeleton.of(RIGHT)
STEP_NS = 16_666_667
BEGIN_NS = 5_000_000_000
NEAR_M = 1e-4


def poses_of(
    seed: int, count: int, model: HandModel = RIGHT, *, loose_m: float = 0.0, valid: Bool | None = None
) -> list[HandPose]:
    """Unrelated random poses at 60 Hz; `loose_m` moves every joint by that, so that no bone is rigid."""
    rng = np.random.default_rng(seed)
    out: list[HandPose] = []
    for i in range(count):
        joints = model.forward(rigid(any_rotation(rng), rng.uniform(-0.3, 0.6, 3)), natural_angles(rng))
        good = np.ones(26, np.bool_) if valid is None else valid[i]
        loose = rng.normal(0.0, loose_m, (26, 3)) if loose_m else np.zeros((26, 3))
        out.append(
            pose_of(
                model,
                joints,
                t_ns=BEGIN_NS + i * STEP_NS,
                position_m=np.where(good[:, None], joints.position_m + loose, np.nan),
                valid=good,
                tracked=good,
                cov_m2=np.tile(np.diag([1e-6, 4e-6, 4e-6]), (26, 1, 1)),
                angles_rad=np.full((5, 4), 0.1),
                markers_m=np.zeros((6, 3)),
            )
        )
    return out


def results(hand: str, t_ns: int = BEGIN_NS) -> list[ResultMessage]:
    """An object, unknown at first, contact with it, and a pinch."""
    nowhere = np.full(3, np.nan)
    lost = {
        "cov": np.full((6, 6), np.nan),
        "residual_m": np.nan,
        "source": ObjectSource.NONE,
        "tracked": False,
    }
    cup = object_pose(
        "cup", nowhere, np.full(4, np.nan), t_ns=t_ns, seen=0, expected=2, occluded=True, **lost
    )
    touch = Contact(
        hand=hand,
        object="cup",
        t_ns=t_ns,
        distance_m=np.array([0.01, -0.001, np.nan, 0.02, 0.03]),
        sigma_m=np.full(5, 0.002),
        point_m=np.zeros((5, 3)),
        touching=np.array([False, True, False, False, False]),
        palm_distance_m=0.05,
        held=False,
    )
    pinch = Gesture(
        hand=hand,
        t_ns=t_ns,
        kind="pinch",
        name="index",
        phase="begin",
        began_t_ns=t_ns,
        confidence=0.75,
        distance_m=0.002,
        strength=0.9,
        origin_m=np.array([0.1, 0.2, 0.3]),
    )
    return [cup, touch, pinch]


def stacked(poses: list[HandPose]) -> list[Poses]:
    """As a source gives them, in two batches."""
    half = max(len(poses) // 2, 1)
    return [Poses.of(part) for part in (poses[:half], poses[half:]) if part]


def positions(poses: list[HandPose]) -> Float:
    """(T, 26, 3) [m]."""
    return np.array([pose.position_m for pose in poses])


def hands_tree(folder: Path, *models: HandModel) -> Path:
    """A calibration tree with profiles of hands."""
    for model in models:
        save(folder / "hands" / f"{model.profile.name}.json", model.profile)
    return folder
