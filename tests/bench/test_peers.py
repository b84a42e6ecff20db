"""Our solvers and others on the same targets: all run, the known answers come out, and planted bad ones are seen."""

import xml.etree.ElementTree as ET
from collections.abc import Sequence

import msgspec
import numpy as np
import pytest

from bench import hand, hand_poses, ik, peers_mink, peers_scipy
from bench.hand_draws import FACING_ROTATION, MARKERS, Noise, bench_model, draw, seen
from bench.hand_score import score
from bench.peers_paper import Angles, PaperFingers, finger_solvers, tips_in_palm
from bench.row import Row
from bench.solved_hand import PointHand
from common.arrays import Float
from common.calibration import Couplings
from common.calibration.hand_presets import preset_limits
from common.geometry.transforms import quaternion_to_matrix, rotation_vector_to_matrix
from common.hand.model import FINGERS, HandModel
from common.hand.profiles import generated_profile
from master.estimator.settings import DEFAULT
from master.fabrik.rotations import Vector

MODEL = bench_model()
needs_mink = pytest.mark.skipif(not peers_mink.installed(), reason=f"mink: {peers_mink.INSTALL}")


def value(lines: list[Row], name: str) -> float:
    (found,) = [row.value for row in lines if row.name == name]
    return found


# -- fingers ----------------------------------------------------------------------------------------------------


def test_on_reachable_targets_ours_and_scipy_miss_none_and_the_papers_way_misses_many() -> None:
    lines = ik.rows(hands=80)
    for name in (ik.CLOSED, ik.WARM_STARTED, "scipy"):
        assert value(lines, f"{name}: missed by > 1 mm") == 0.0
    assert value(lines, f"{ik.CLOSED}: missed by > 1 um") == 0.0
    assert value(lines, f"{ik.WARM_STARTED}: missed by > 100 um") == 0.0
    found, _, _ = ik.timed(MODEL, ik.ways(MODEL)[ik.PAPER], draw(MODEL, 4, 12, coupling_off_rad=0.0))
    assert found.missed_percent > 10.0
    assert found.violations == 0
    assert all(row.value > 0.0 for row in lines if row.unit == "us")


def test_a_solver_that_leaves_the_limits_or_misses_is_seen() -> None:
    truth = draw(MODEL, 5, 10, coupling_off_rad=0.0)
    closed = ik.ways(MODEL)[ik.CLOSED]

    def bent_back(tips: Sequence[Vector]) -> Angles:
        angles = [list(finger) for finger in closed(tips)]
        angles[1][1] = -0.2
        return angles

    found, _, _ = ik.timed(MODEL, bent_back, truth)
    assert found.violations == 10
    assert found.worst_deg == pytest.approx(np.degrees(0.2))
    assert found.missed_percent == pytest.approx(20.0)  # the index of each hand


def test_the_papers_fingers_start_at_their_last_pose() -> None:
    truth = draw(MODEL, 6, 2, coupling_off_rad=0.0)
    first, second = (tips_in_palm(truth.T_rig_palm[k], truth.caps_m[k]) for k in range(2))
    warm, cold = PaperFingers(finger_solvers(MODEL)), PaperFingers(finger_solvers(MODEL))
    warm.push(first)
    assert not np.allclose(warm.push(second), cold.push(second))


# -- the whole hand ---------------------------------------------------------------------------------------------


def test_a_moving_hand_is_solved_in_every_way_and_a_fixed_palm_costs() -> None:
    lines = hand.rows(frames=21)
    ours = value(lines, f"{hand.WARM}: joints")
    assert ours < 3.0
    assert value(lines, "scipy: joints") < 3.0
    assert value(lines, "closed form, fixed palm: joints") > 3.0 * ours
    assert value(lines, "papers' way: joints") > 3.0 * ours
    assert value(lines, f"{hand.WARM}: times faster than scipy") > 1.0


def test_scipy_finds_the_hand_when_the_posture_prior_is_the_truth_and_markers_are_exact() -> None:
    way = peers_scipy.WholeHand.of(MODEL, hand.NOISE)
    angles = MODEL.clamp(way.parameters.angles(way.mean))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_vector_to_matrix(np.array([0.2, -0.1, 0.3])) @ FACING_ROTATION, 0.1
    caps = MODEL.marker_points(MODEL.forward(T, angles), MARKERS)
    start = T.copy()
    start[:3, :3] = FACING_ROTATION
    found, bent = way.solve(caps, start, np.zeros((5, 4)))
    np.testing.assert_allclose(found, T, atol=1e-4)
    np.testing.assert_allclose(np.degrees(bent), np.degrees(angles), atol=0.1)


@pytest.mark.parametrize("noise", [hand.NOISE, hand_poses.SCENARIOS["depth 4.5 mm"].noise], ids=str)
def test_the_estimator_ends_where_scipy_ends_on_the_same_residuals(noise: Noise) -> None:
    count = 20
    way = peers_scipy.WholeHand.of(MODEL, noise)
    exact = DEFAULT._replace(tolerance=1e-12, tolerance_share=0.0)  # to the end
    solver = PointHand(MODEL, MARKERS, continuous=False, natural=True, faces=False, settings=exact)
    truth = draw(MODEL, 21, count)
    points, _ = seen(truth, noise, 21)

    def cost(T: Float, angles: Float, k: int) -> float:
        return 0.5 * float(np.square(way.residuals(T, way.parameters.of_angles(angles), points[k])).sum())

    same = 0
    for k in range(count):
        found = solver.push(k, points[k], noise.cov_m2).solution
        assert found is not None
        ours = cost(found.T_rig_palm, found.angles_rad, k)
        theirs, bent = way.solve(points[k], found.T_rig_palm, found.angles_rad)
        assert ours == pytest.approx(cost(theirs, bent, k), rel=1e-6)
        off = MODEL.forward(theirs, bent).position_m - found.joints.position_m
        assert np.linalg.norm(off, axis=1).max() < 1e-5
        # From the truth there may be another minimum, either way; nearly always it is the same.
        elsewhere = cost(*way.solve(points[k], truth.T_rig_palm[k], truth.angles_rad[k]), k)
        same += ours == pytest.approx(elsewhere, rel=1e-6)
    assert same >= count - 1


# -- mink -------------------------------------------------------------------------------------------------------


def placed(element: ET.Element, angles: Float, T: Float, sites: dict[str, Float]) -> None:
    """Walk the bodies of an MJCF, by MuJoCo's documented rule: place, turn, then the hinge of the body."""
    for joint in element.findall("joint"):
        finger, angle = str(joint.get("name")).rsplit("_", 1)
        q = angles[FINGERS.index(finger), ("abduction", "flexion", "pip", "dip").index(angle)]
        axis = np.array([float(v) for v in str(joint.get("axis")).split()])
        T = T.copy()
        T[:3, :3] = T[:3, :3] @ rotation_vector_to_matrix(q * axis)
    for site in element.findall("site"):
        sites[str(site.get("name"))] = T[:3, :3] @ np.array(str(site.get("pos")).split(), float) + T[:3, 3]
    for body in element.findall("body"):
        local = np.eye(4)
        if body.get("pos") is not None:
            local[:3, 3] = [float(v) for v in str(body.get("pos")).split()]
            local[:3, :3] = quaternion_to_matrix(np.array(str(body.get("quat")).split(), float))
        placed(body, angles, T @ local, sites)


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_hand_written_for_mujoco_moves_like_ours(side: str) -> None:
    profile = msgspec.structs.replace(generated_profile("made", side), limits_rad=preset_limits("D"))
    model = HandModel.of(profile)
    angles = np.random.default_rng(2).uniform(model.limits_rad[..., 0], model.limits_rad[..., 1])
    world = ET.fromstring(peers_mink.hand_mjcf(model, free_palm=True)).find("worldbody")
    assert world is not None
    sites: dict[str, Float] = {}
    placed(world, angles, np.eye(4), sites)
    expected = model.marker_points(model.forward(np.eye(4), angles), MARKERS)
    np.testing.assert_allclose([sites[name] for name in MARKERS], expected, atol=1e-12)


def test_the_hand_written_for_mujoco_has_limits_coupling_and_no_joint_without_room() -> None:
    tree = ET.fromstring(peers_mink.hand_mjcf(MODEL, free_palm=False))
    joints = {str(j.get("name")): j for j in tree.iter("joint") if j.get("name") is not None}
    assert len(joints) == 19  # K leaves the middle finger no abduction
    assert "middle_abduction" not in joints
    low, high = (float(v) for v in str(joints["ring_pip"].get("range")).split())
    assert (low, np.degrees(high)) == (0.0, pytest.approx(110.0))
    coupled = tree.findall("equality/joint")
    assert [c.get("joint1") for c in coupled] == ["index_dip", "middle_dip", "ring_dip", "little_dip"]
    loose = msgspec.structs.replace(MODEL.profile, couplings=Couplings(dip_per_pip=None))
    assert not ET.fromstring(peers_mink.hand_mjcf(HandModel.of(loose), free_palm=False)).findall(
        "equality/joint"
    )
    assert tree.find("worldbody/body/freejoint") is None


def test_without_mink_the_table_says_so_and_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers_mink, "installed", lambda: False)
    assert "mink" not in ik.ways(MODEL)
    assert "mink" not in hand.ways(MODEL)
    (row,) = [row for row in hand.rows(frames=2) if row.name.startswith("mink")]
    assert (row.name, row.value, row.unit) == ("mink: skipped", 0.0, "")
    assert "pip install mink" in row.note


@needs_mink
def test_mink_hits_every_reachable_target_inside_the_limits() -> None:
    truth = draw(MODEL, 8, 20, coupling_off_rad=0.0)
    found, _, _ = ik.timed(MODEL, ik.ways(MODEL)["mink"], truth)
    assert found.missed_percent == 0.0
    assert found.worst_deg < 1e-3
    assert found.pip_rms_deg < 1.0


@needs_mink
def test_mink_finds_a_moving_hand_about_as_well_as_scipy() -> None:
    truth = hand.motion(MODEL, 20)
    found, _, _ = hand.timed(MODEL, hand.ways(MODEL)["mink"], truth, truth.caps_m)
    assert found.joints_mm.mean() < 3.0
    again = score(MODEL, truth, truth.T_rig_palm, truth.angles_rad, truth.caps_m)
    assert again.joints_mm.max() < found.joints_mm.mean()
