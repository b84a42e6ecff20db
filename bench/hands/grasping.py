"""Real hands before ideal markers: grasping by motion capture that you bring, and a glove of six markers.

**Grasping** (`PHALANX_MOTION`, a folder of BVH files of one hand each, perhaps with the `joints.json` of `--joints`):
joints are read as by `calibrate hand --from`; tips and back are the markers, known to 1 mm and without noise. A file
without tips gets them, 0.75 of the bone before ahead. The profile is fitted to the first half of a motion and to all
of it; the second half is scored. Figures of this project are from ManipNet (He Zhang, Yuting Ye, Takaaki Shiratori,
Taku Komura, SIGGRAPH 2021; CC BY-NC; `cghezhang/ManipNet`), 16 of its files, with `{"thumb-metacarpal":
"THUMB_CMC_AA"}`.

**Glove** (`real_mocap`, `PHALANX_DATASETS`): six markers of an optical motion capture. Each tip in turn is hidden for
0.3 s and 0.5 s every 2 s. Its hand was never measured: a generated one of 210 mm with noise of 0.7 mm.
"""

import os
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from bench.hands.draws import EDGE_ON, MARKERS, PointHand
from bench.hands.motion import SIGMA_M, pip_deg
from bench.report import Row, chi_squares, datasets, inside, joined, rms
from common.arrays import Bool, Float, Int
from common.calibration import HandProfile, MarkerMount
from common.geometry.transforms import fit_rigid
from common.hand.fitting import profile_from_joints
from common.hand.model import CHAINS, TIPS, HandModel
from common.hand.profiles import generated_profile
from common.recording.recorded_files import read_npz
from master.calibrate.hand.motion import find_palm
from master.mocap.compare import joint_track
from master.mocap.read import Reading, read_motion

_MORE_BACKS_M = ((0.025, 0.0, 0.02), (-0.025, 0.0, 0.02))
BINS_DEG = (0.0, 6.0, 9.0, 12.0, 16.0, 25.0, 90.0)


@dataclass(frozen=True, slots=True, eq=False)
class Grasped:
    """One motion before ideal markers."""

    pip_deg: Float  # (T, 4) error of the PIPs of index ... little
    sigma_deg: Float  # (T, 4) its standard deviation as stated
    joint_m: Float  # (T, 20) error of the joints of the chains
    chi2: Float  # (T, 5, 4) of these joints
    tracked: Bool  # (T, 4) fingers whose tip is TRACKED


def rows() -> Iterator[Row]:
    """Measure both parts; a row names absent data."""
    if files := motion_files():
        for backs in (1, 3):
            for half in (True, False):
                yield from _grasp_rows([grasped(path, backs, half) for path in files], backs, half)
    else:
        yield Row("grasping: skipped", 0.0, "", "set PHALANX_MOTION to a folder of BVH files of hands")
    if (data := glove()) is not None:
        yield from _glove_rows(*data)
    else:
        yield Row("glove: skipped", 0.0, "", "no real_mocap: set PHALANX_DATASETS")


def motion_files() -> list[Path]:
    """The motions that are there; none where `PHALANX_MOTION` is not set."""
    folder = os.environ.get("PHALANX_MOTION")
    return sorted(Path(folder).glob("*.bvh")) if folder else []


def glove() -> tuple[Int, Float] | None:
    """Times (T,) [ns] and markers (T, 6, 3) [m] of the glove, of every other frame; None where the data are absent."""
    path = datasets() / "real_mocap" / "six_markers_20s.npz"
    if not path.is_file():
        return None
    arrays = read_npz(path)
    names = [str(name) for name in arrays["names"]]
    t_ns = np.round(1e9 * np.asarray(arrays["t"], np.float64)).astype(np.int64)
    points = np.asarray(arrays["markers_m"], np.float64)[:, [names.index(name) for name in MARKERS]]
    return t_ns[::2], points[::2]


def _grasp_rows(motions: list[Grasped], backs: int, half: bool) -> Iterator[Row]:
    every = joined(motions)
    pip, sigma, tracked = every.pip_deg, every.sigma_deg, every.tracked
    who = f"grasping, {backs} on the back, hand of {'the first half' if half else 'the same motion'}"
    off = np.abs(pip)
    wrong = 100.0 * (off > 20.0)[tracked].mean()
    yield Row(
        f"{who}: PIP", float(off.mean()), "deg", f"goal 8.5; joints {1e3 * every.joint_m.mean():.1f} mm"
    )
    yield Row(f"{who}: PIP joint in its 95 % region", inside(every.chi2[:, 1:, 1]), "%", "goal 90")
    note = f"goal 2; {100 * tracked.mean():.0f} % TRACKED"
    yield Row(f"{who}: TRACKED fingers 20 degrees off", float(wrong), "%", note)
    bins = [(sigma >= low) & (sigma < high) for low, high in pairwise(BINS_DEG)]
    pairs = [f"{sigma[of].mean():.0f} -> {rms(pip[of]):.0f}" for of in bins if of.mean() > 0.01]
    yield Row(f"{who}: PIP, stated -> found", rms(pip), "deg RMS", ", ".join(pairs))


def grasped(path: Path, backs: int, half: bool) -> Grasped:
    """Score the second half of a motion by a hand of its first half or of all; FitError: no palm is found."""
    t_ns, joints, side, local = _joints(path)
    count = len(joints)
    profile = profile_from_joints("grasping", side, local[: count // 2] if half else local)
    names = MARKERS
    if backs > 1:
        profile, names = _more_backs(profile)
    model = HandModel.of(profile)
    T = fit_rigid(joints[:, CHAINS[:, 0]], local[:, :, 0])
    truth = np.einsum("tij,tfkj->tfki", T[:, :3, :3], local) + T[:, None, None, :3, 3]
    dorsal = T[:, :3, 1]
    towards = dorsal.mean(axis=0) / np.linalg.norm(dorsal.mean(axis=0))
    on_back = [T[:, :3, :3] @ model.mount(name).offset_m + T[:, :3, 3] for name in names[5:]]
    points = np.concatenate([truth[:, :, 3], np.stack(on_back, axis=1)], axis=1)
    points[dorsal @ towards < EDGE_ON, 5:] = np.nan
    solver = PointHand(model, names)
    cov = np.tile(SIGMA_M**2 * np.eye(3), (len(names), 1, 1))
    second = range(count // 2, count)
    pip, sigma, joint, chi2 = (list[Float]() for _ in range(4))
    tracked: list[Bool] = []
    for k in second:
        now = np.where(np.isfinite(points[k, :, :1, None]), cov, np.nan)
        hand = solver.push(int(t_ns[k]), points[k], now, towards)
        assert hand.solution is not None
        at = hand.solution.joints.position_m[CHAINS]
        off = at - truth[k]
        pip.append(pip_deg(at.reshape(1, 20, 3))[0] - pip_deg(truth[k].reshape(1, 20, 3))[0])
        column = 6 + np.searchsorted(solver.estimator.parameters.free, 4 * np.arange(1, 5) + 2)
        variance: Float = hand.solution.measurement_cov.diagonal()[column]
        sigma.append(np.degrees(np.sqrt(variance)))
        joint.append(np.linalg.norm(off, axis=2).ravel())
        chi2.append(chi_squares(off, hand.solution.cov_m2[CHAINS] + 1e-12 * np.eye(3)))
        tracked.append(np.asarray(hand.tracked[TIPS[1:]], np.bool_))
    return Grasped(np.array(pip), np.array(sigma), np.array(joint), np.array(chi2), np.array(tracked))


def _joints(path: Path) -> tuple[Int, Float, str, Float]:
    """Times (T,), joints (T, 26, 3) [m], side and chains (T, 5, 4, 3) [m] in the palm, at about 60 Hz."""
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / path.name
        whole.write_text(_with_tips(path.read_text(encoding="utf-8-sig")), encoding="utf-8")
        names = path.parent / "joints.json"
        motion = read_motion(whole, Reading(joints=names if names.is_file() else None))
    joints = joint_track(motion).position_m
    palm = find_palm(joints, None, str(path))
    rate_hz = 60.0
    step = max(1, round(1e9 / rate_hz / float(np.median(np.diff(motion.t_ns)))))
    good = np.flatnonzero(~palm.outlier & np.isfinite(palm.chains_m).all(axis=(1, 2, 3)))[::step]
    return motion.t_ns[good], joints[good], palm.side, palm.chains_m[good]


def _with_tips(text: str) -> str:
    """A BVH whose chains end a share of the bone before ahead, where it has them end in their last joint."""
    last = ["0", "0", "0"]

    def ended(found: re.Match[str]) -> str:
        nonlocal last
        lead, numbers = found.group(1), found.group(2).split()
        if "End" in lead and not any(float(number) for number in numbers):
            numbers = [f"{0.75 * float(number):.6f}" for number in last]
        last = numbers
        return f"{lead}{' '.join(numbers)}"

    return re.sub(r"((?:JOINT|ROOT|End)\s+\S+\s*\{\s*OFFSET\s+)(\S+\s+\S+\s+\S+)", ended, text)


def _more_backs(profile: HandProfile) -> tuple[HandProfile, tuple[str, ...]]:
    """The profile with three markers on its back, and all names."""
    back = np.array(profile.markers["back"].offset_m)
    more: dict[str, MarkerMount] = {}
    for k, aside in enumerate(_MORE_BACKS_M):
        x, y, z = (float(value) for value in back + aside)
        more[f"back_{k + 2}"] = MarkerMount(joint="palm_frame", offset_m=(x, y, z))
    return replace(profile, markers=profile.markers | more), (*MARKERS, *more)


def _glove_rows(t_ns: Int, points_m: Float) -> Iterator[Row]:
    for hidden_s in (0.3, 0.5):
        for f in (0, 3):
            off, chi2, seen = hidden_tip(t_ns, points_m, f, hidden_s)
            note = (
                f"{'goal 12; ' if f == 0 else ''}95 % {1e3 * np.percentile(off, 95):.0f}; in its 95 % region"
                f" {inside(chi2):.0f} %, seen tips {inside(seen):.0f} % (goal 93)"
            )
            name = f"glove: {MARKERS[f]} tip while it is hidden for {hidden_s:g} s"
            yield Row(name, 1e3 * float(off.mean()), "mm", note)


def hidden_tip(t_ns: Int, points_m: Float, finger: int, hidden_s: float) -> tuple[Float, Float, Float]:
    """Errors [m] of a tip that is hidden for `hidden_s` every 2 s, its chi squares, and those of all seen tips.

    Of times (T,) [ns] and markers (T, 6, 3) [m]; NaN: not seen.
    """
    glove_m, glove_ahead_m, glove_noise_m = 0.21, 0.005, 7e-4
    profile = generated_profile("glove", "right", glove_m)
    x, y, z = profile.markers["back"].offset_m
    mount = replace(profile.markers["back"], offset_m=(x, y, z + glove_ahead_m))
    model = HandModel.of(replace(profile, markers=profile.markers | {"back": mount}))
    noise = np.random.default_rng(7).normal(0.0, glove_noise_m, points_m.shape)
    truth = points_m - np.nanmean(points_m[:, 5], axis=0)
    shown = truth + noise
    towards = _dorsal(points_m)
    every_s = 2.0
    hidden = (1e-9 * (t_ns - t_ns[0])) % every_s > every_s - hidden_s
    solver = PointHand(model, MARKERS)
    off: list[float] = []
    chi2: list[float] = []
    seen: list[Float] = []
    for k in range(len(t_ns)):
        now = shown[k].copy()
        if hidden[k]:
            now[finger] = np.nan
        cov = np.where(np.isfinite(now[:, :1, None]), glove_noise_m**2 * np.eye(3), np.nan)
        hand = solver.push(int(t_ns[k]), now, cov, towards).solution
        if hand is None:
            continue
        error: Float = model.marker_points(hand.joints, MARKERS)[:5] - truth[k, :5]
        each = chi_squares(error, hand.cov_m2[TIPS] + 1e-12 * np.eye(3))
        seen.append(each[np.isfinite(now[:5, 0])])
        if hidden[k] and np.isfinite(each[finger]):
            off.append(float(np.linalg.norm(error[finger])))
            chi2.append(float(each[finger]))
    return np.array(off), np.array(chi2), np.concatenate(seen)


def _dorsal(points_m: Float) -> Float:
    """Unit vector (3,) out of the back of a right hand, from markers (T, 6, 3): across its fingers, and along them."""
    tips = points_m[:, 1:5]
    along = tips.mean(axis=1) - points_m[:, 5]
    across = tips[:, 0] - tips[:, 3]
    back: Float = np.nanmean(np.cross(along, across), axis=0)
    return back / np.sqrt(back @ back)
