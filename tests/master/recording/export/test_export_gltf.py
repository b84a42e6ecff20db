import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from common.arrays import Float
from common.hand.model import JOINTS
from common.messages import HandPose
from master.recording.export.gltf import skin_of, write_gltf
from master.recording.export.motion import complete
from tests.browser import WAIT_MS, chromium
from tests.master.recording.export.made import NEAR_M, REST, STEP_NS, poses_of, positions, stacked

KINDS = {5126: "<f4", 5125: "<u4", 5121: "u1"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
FLIP = np.array([1.0, -1.0, -1.0])


class Model:
    """A .glb read by hand, from the specification alone."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert (kind, size % 4) == (b"JSON", 0)
        self.json: dict[str, Any] = json.loads(data[20 : 20 + size])
        rest, kind = struct.unpack_from("<I4s", data, 20 + size)
        assert (kind, 28 + size + rest) == (b"BIN\0", len(data))
        self.blob = data[28 + size :]

    def values(self, accessor: int) -> Float:
        one = self.json["accessors"][accessor]
        view = self.json["bufferViews"][one["bufferView"]]
        width = WIDTHS[one["type"]]
        start = view.get("byteOffset", 0) + one.get("byteOffset", 0)
        dtype = np.dtype(KINDS[one["componentType"]])
        assert start % dtype.itemsize == 0
        flat = np.frombuffer(self.blob, dtype, one["count"] * width, start)
        return flat.reshape(one["count"], width).astype(np.float64)

    def world(self, key: int | None) -> dict[str, Float]:
        """Name -> matrix (4, 4) in the scene at a key of the animation, or at rest."""
        nodes = [dict(node) for node in self.json["nodes"]]
        clip = self.json["animations"][0]
        for channel in clip["channels"] if key is not None else ():
            sampler = clip["samplers"][channel["sampler"]]
            target = channel["target"]
            nodes[target["node"]][target["path"]] = self.values(sampler["output"])[key]
        out: dict[str, Float] = {}

        def process_noise(number: int, above: Float) -> None:
            node = nodes[number]
            own = np.eye(4)
            own[:3, :3] = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
            own[:3, 3] = node.get("translation", [0, 0, 0])
            out[node["name"]] = above @ own
            for child in node.get("children", ()):
                process_noise(child, out[node["name"]])

        for number in self.json["scenes"][self.json["scene"]]["nodes"]:
            process_noise(number, np.eye(4))
        return out


def written(path: Path, poses: list[HandPose]) -> Model:
    write_gltf(path, complete(stacked(poses), REST), REST, "y")
    return Model(path)


@pytest.mark.parametrize(("loose_m", "count"), [(0.0, 4), (0.004, 3), (0.0, 1)])
def test_joints_are_where_they_were_and_turned_as_they_were(
    tmp_path: Path, loose_m: float, count: int
) -> None:
    poses = poses_of(11, count, loose_m=loose_m)
    model = written(tmp_path / "hand.glb", poses)
    (times,) = {sampler["input"] for sampler in model.json["animations"][0]["samplers"]}
    np.testing.assert_allclose(model.values(times)[:, 0], np.arange(count) * STEP_NS * 1e-9, atol=1e-6)
    for key, pose in enumerate(poses):
        found = model.world(key)
        places = np.array([found[name][:3, 3] for name in JOINTS])
        assert np.abs(places - FLIP * pose.position_m).max() < NEAR_M
        rotated = Rotation.from_matrix([found[name][:3, :3] for name in JOINTS])
        true = Rotation.from_matrix(np.diag(FLIP)) * Rotation.from_quat(np.roll(pose.orientation_wxyz, -1, 1))
        assert np.degrees((rotated.inv() * true).magnitude()).max() < 0.01


def test_the_skin_is_bound_to_the_joints_at_rest(tmp_path: Path) -> None:
    model = written(tmp_path / "hand.glb", poses_of(1, 2))
    skin = model.json["skins"][0]
    names = [model.json["nodes"][number]["name"] for number in skin["joints"]]
    assert tuple(names) == JOINTS
    bind = model.values(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)  # by columns
    rest = model.world(None)
    for name, matrix in zip(names, bind, strict=True):
        np.testing.assert_allclose(rest[name] @ matrix, np.eye(4), atol=1e-6)
    parts = model.json["meshes"][0]["primitives"][0]
    vertices = model.values(parts["attributes"]["POSITION"])
    np.testing.assert_allclose(model.values(parts["attributes"]["WEIGHTS_0"]).sum(axis=1), 1.0)
    assert model.values(parts["attributes"]["JOINTS_0"]).max() < 26
    assert model.values(parts["indices"]).max() == len(vertices) - 1
    bounds = model.json["accessors"][parts["attributes"]["POSITION"]]
    np.testing.assert_allclose(vertices.min(axis=0), bounds["min"], atol=1e-7)


def test_the_skin_goes_about_every_bone_and_looks_outwards() -> None:
    skin = skin_of(REST)
    for joint, at in enumerate(REST.position_m):
        radius = REST.radius_m[joint]
        near = np.linalg.norm(skin.vertex_m - at, axis=1)
        assert near.min() < 1.6 * radius, JOINTS[joint]
    assert np.ptp(skin.vertex_m, axis=0).max() < 0.30  # a hand, in metres
    corners = skin.vertex_m[skin.triangle]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.vecdot(across, skin.normal[skin.triangle].sum(axis=1)) > -1e-12).all()
    # Every piece is closed: each edge once in each direction.
    edges = np.concatenate([skin.triangle[:, [i, (i + 1) % 3]] for i in range(3)])
    assert {tuple(edge) for edge in edges.tolist()} == {tuple(edge[::-1]) for edge in edges.tolist()}


def test_over_a_gap_the_hand_stands_still(tmp_path: Path) -> None:
    motion = complete(stacked(poses_of(5, 4)), REST)
    motion.t_ns[3:] += 2_000_000_000
    write_gltf(tmp_path / "hand.glb", motion, REST, "y")
    model = Model(tmp_path / "hand.glb")
    times = model.values(model.json["animations"][0]["samplers"][0]["input"])[:, 0]
    assert len(times) == 5
    assert times[4] - times[3] == pytest.approx(0.001, abs=1e-5)
    before, after = model.world(2), model.world(3)
    np.testing.assert_array_equal(before["wrist"], after["wrist"])


def test_a_text_file_holds_the_same(tmp_path: Path) -> None:
    motion = complete(stacked(poses_of(5, 2)), REST)
    write_gltf(tmp_path / "hand.gltf", motion, REST, "y")
    found = json.loads((tmp_path / "hand.gltf").read_text())
    assert found["buffers"][0]["uri"].startswith("data:")
    assert found["asset"]["extras"]["hand"] == REST.hand


PAGE = """<script type="module">
import {THREE, GLTFLoader} from "/three.js";
new GLTFLoader().load("/hand.glb", model => {
  const mixer = new THREE.AnimationMixer(model.scene);
  const action = mixer.clipAction(model.animations[0]);
  action.setLoop(THREE.LoopOnce); action.clampWhenFinished = true; action.play();
  window.places = (time, names) => {
    mixer.setTime(time);
    model.scene.updateMatrixWorld(true);
    return names.map(name => model.scene.getObjectByName(name).getWorldPosition(new THREE.Vector3()).toArray());
  };
  window.bones = [];
  model.scene.traverse(one => { if (one.isSkinnedMesh) window.bones = one.skeleton.bones.map(bone => bone.name); });
}, undefined, error => { window.failed = String(error); });
</script>"""


def test_three_js_in_a_browser_sees_the_joints_where_they_were(tmp_path: Path) -> None:
    import nicegui

    poses = poses_of(21, 5)
    write_gltf(tmp_path / "hand.glb", complete(stacked(poses), REST), REST, "y")
    three = Path(nicegui.__file__).parent / "elements" / "scene" / "dist" / "index.js"
    with chromium() as browser:
        page = browser.new_page()
        page.set_default_timeout(WAIT_MS)
        page.route("**/", lambda route: route.fulfill(body=PAGE, content_type="text/html"))
        page.route("**/three.js", lambda route: route.fulfill(path=three, content_type="text/javascript"))
        page.route("**/hand.glb", lambda route: route.fulfill(path=tmp_path / "hand.glb"))
        page.goto("http://phalanx.test/")
        page.wait_for_function("Boolean(window.places || window.failed)")
        assert page.evaluate("window.failed") is None
        assert tuple(page.evaluate("window.bones")) == JOINTS
        for key, true in enumerate(positions(poses)):
            at = page.evaluate(
                "([t, names]) => window.places(t, names)", [key * STEP_NS * 1e-9, list(JOINTS)]
            )
            assert np.abs(np.array(at) - FLIP * true).max() < NEAR_M
