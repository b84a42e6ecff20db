"""The report of a simulated run of a wrist device: scores against its scene, a picture, a file for the viewer."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from common.errors import PhalanxError
from common.geometry.transforms import axis_rotation, matrix_to_quaternion, quaternion_to_matrix
from common.recording.frame_recording import Illumination
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene
from master.evaluation.report import Played, forearm_tilt, laser_scores, lit_view, report_scene
from master.rig.setup import RigSetup, load_setups
from tests.master.outputs.test_outputs_files import write
from tests.master.outputs.test_outputs_rerun import rows_of
from tests.wrist_run import CYCLE_NS, START_NS, true_poses, wrist_scene, wrist_setup

N = 40


@pytest.fixture(scope="module")
def setup(root: Path) -> RigSetup:
    return wrist_setup(root)


@pytest.fixture(scope="module")
def scene(setup: RigSetup) -> WristScene:
    return wrist_scene(setup, "curl")


def test_the_forearm_is_scored_against_the_vertical_whatever_its_heading(
    setup: RigSetup, scene: WristScene
) -> None:
    imu = setup.rig.imu
    assert imu is not None
    assert imu.q_rig_world is not None
    poses = true_poses(setup, [scene.truth(k * CYCLE_NS * 1e-9) for k in range(N)])
    assert forearm_tilt(poses, scene, START_NS) == {}
    rig_world = quaternion_to_matrix(np.array(imu.q_rig_world))
    times = (poses.t_ns - START_NS) * 1e-9
    lies = np.array([rig_world.T @ scene.motion.at(float(t)).T_rig_palm[:3, :3] for t in times])
    for tilt_deg in (0.0, 5.0):
        rotated = axis_rotation(2, 1.0) @ axis_rotation(0, np.radians(tilt_deg)) @ lies
        measured = replace(poses, palm_world_wxyz=matrix_to_quaternion(rotated))
        measured.palm_world_wxyz[:3] = np.nan
        assert forearm_tilt(measured, scene, START_NS)["forearm_tilt_deg"] == pytest.approx(
            tilt_deg, abs=1e-4
        )


@pytest.mark.parametrize("late_ms", [0, 30])
def test_a_run_is_scored_at_the_times_of_its_poses(
    setup: RigSetup, scene: WristScene, tmp_path: Path, late_ms: int
) -> None:
    poses = true_poses(setup, [scene.truth(k * CYCLE_NS * 1e-9 + 1.5) for k in range(N)])
    write(tmp_path / "poses.npz", poses.messages(), 0)
    epoch_ns = START_NS - 1_500_000_000 - late_ms * 1_000_000
    measured: list[str] = []
    full = report_scene(
        tmp_path / "poses.npz",
        setup,
        Played(wrist_scene=scene),
        epoch_ns,
        tmp_path,
        {"poses_per_s": 30.0},
        lambda what, _done, _total: measured.append(what),
    )
    assert full["poses_per_s"] == 30.0
    numbers = {name: value for name, value in full.items() if isinstance(value, float)}
    if late_ms:  # the truth is that of the same poses, a moment later: the scores see the motion between
        assert numbers["pip_rms_deg"] > 0.3
        assert numbers["laser_mm"] > 0.05
    else:
        assert numbers["laser_right"] == 1.0
        for name in ("laser_mm", "laser_missed", "pip_rms_deg", "pip_untracked", "pip_deg", "joint_mm"):
            assert numbers[name] == pytest.approx(0.0, abs=1e-3), name
    rows = rows_of(tmp_path / "run.rrd")
    assert rows["/world/laser/points"] == rows["/world/truth/laser"] == N
    assert rows["/world/cameras/wrist/image"] == 3  # 1.3 s, twice a second
    assert (tmp_path / "hand.png").stat().st_size > 50_000
    assert {"comparing with the truth", "drawing the hand", "rendering camera wrist"} <= set(measured)


def test_a_run_without_a_pose_keeps_its_figures(setup: RigSetup, scene: WristScene, tmp_path: Path) -> None:
    poses = true_poses(setup, [scene.truth(0.0)])
    write(tmp_path / "poses.npz", poses.messages(), 0)
    after_ns = START_NS + 1
    full = report_scene(
        tmp_path / "poses.npz",
        setup,
        Played(wrist_scene=scene),
        after_ns,
        tmp_path,
        {"poses": 0},
        lambda _what, _done, _total: None,
    )
    assert full == {"poses": 0}


def test_what_laser_and_leds_light_is_without_the_room(scene: WristScene) -> None:
    renderer = WristRenderer(scene, "wrist")
    shown = lit_view(renderer, 1.0).astype(np.float64)
    ambient = renderer.render(1.0, Illumination.AMBIENT)
    assert ambient[:100].mean() > 5.0  # the room behind the fingers
    assert shown[:100].mean() < 0.5 * ambient[:100].mean()
    assert shown.max() > 100.0


def test_a_hand_before_both_kinds_of_rig_is_played_by_one_motion(root: Path) -> None:
    (both,) = load_setups(root / "calib_json", ("desk", "wrist"))
    played = Played.of(both, "both-curl@dark", 5)
    assert played.shown is not None
    assert played.wrist_scene is not None
    assert played.wrist_scene.ambient == "dark"
    seen, device = (scene.motion.at(1.3).angles_rad for scene in (played.shown, played.wrist_scene))
    np.testing.assert_array_equal(seen, device)
    with pytest.raises(PhalanxError, match="see one hand only in grasp, both-poses"):
        Played.of(both, "standard", 5)
    (desk,), (wrist,) = (load_setups(root / "calib_json", (name,)) for name in ("desk", "wrist"))
    assert Played.of(desk, "grasp", 5).wrist_scene is Played.of(wrist, "curl@sun", 5).shown is None
    assert [Played.of(desk, name, 5).two_rigs for name in ("grasp", "poses")] == [True, False]


def test_laser_points_count_once_for_each_cycle(setup: RigSetup, scene: WristScene) -> None:
    poses = true_poses(setup, [scene.truth(k * CYCLE_NS * 1e-9 + 1.5) for k in range(6)])
    twice = replace(poses, laser_m=np.repeat(poses.laser_m[::2], 2, axis=0))
    measured: list[int] = []
    epoch_ns = START_NS - 1_500_000_000
    scores = laser_scores(twice, scene, epoch_ns, lambda _what, _done, total: measured.append(total))
    assert set(measured) == {3}
    assert scores["laser_mm"] == pytest.approx(0.0, abs=1e-9)
    assert (
        laser_scores(replace(poses, laser_m=np.full_like(poses.laser_m, np.nan)), scene, epoch_ns, print)
        == {}
    )
