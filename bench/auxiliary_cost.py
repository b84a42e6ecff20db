"""What objects, contact and gestures cost a master beside the fit of the hand, pose by pose, in one run.

A hand that grasps and an object that wanders, as two cameras would tell of them: exact projections with honest noise.
Times are of the thread, and the parts take turns, so that what else the machine does slows all of them alike; the
figures to go by are the ratios. A pose costs what all messages cost that led to it.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from time import thread_time
from typing import TypeVar

import numpy as np

from bench.object_views import Where, detections, wander
from bench.row import Row
from common.arrays import Float
from common.calibration import HandProfile, load
from common.calibration.object_profile import ObjectProfile
from common.geometry.transforms import axis_rotation, rigid
from common.messages import MarkerDetections
from common.sim.scenes import scene_by_name
from master.gestures.recogniser import GestureRecogniser
from master.objects.contact import ContactMonitor
from master.objects.line import ObjectLine
from master.rig.files import load_setup
from master.rig.pipeline import build_pipeline
from master.rig.setup import RigSetup
from master.run.stages import StageTimes

CALIBRATION = Path(__file__).resolve().parents[1] / "calib_json"
# How they are turned, so that what is painted or printed on them faces the cameras.
OBJECTS = {"wand": axis_rotation(0, np.pi / 2), "cube": axis_rotation(1, np.radians(145.0))}
SECONDS, SEED, WARM = 8.0, 7, 30
_PX = 0.08
Found = TypeVar("Found")


def rows() -> Iterator[Row]:
    """Cost of each part for each object, by that of the hand's fit."""
    for name in OBJECTS:
        costs = costs_of(name, SECONDS)
        hand = float(np.median(costs["hand"]))
        yield Row(f"{name}: the hand's fit", 1e3 * hand, "ms", f"{_spread(costs['hand'])} ms")
        for part in ("object", "contact", "gestures"):
            yield _row(f"{name}: {part}", costs[part], hand)
        count = min(len(costs[part]) for part in costs)
        each = [costs[part][:count] for part in ("object", "contact", "gestures")]
        yield _row(f"{name}: all three", np.sum(each, axis=0), hand)


def costs_of(name: str, seconds: float) -> dict[str, Float]:
    """Thread times [s] of each part, pose by pose, without those of the beginning.

    Raises:
        ValueError: The object is lost on its way.
    """
    setup = load_setup(CALIBRATION, f"desk-{name}")
    profile = load(CALIBRATION / f"objects/{name}.json", ObjectProfile)
    pipeline, line = build_pipeline(setup, StageTimes()), ObjectLine(profile, setup.rig, setup.models)
    contact, gestures = ContactMonitor(setup.hand, [profile]), GestureRecogniser(setup.gestures, setup.hand)
    messages = list(detections(profile, setup.rig.markers, setup.models, _way(OBJECTS[name]), seconds, SEED))
    spent: dict[str, list[float]] = {part: [] for part in ("hand", "object", "contact", "gestures")}
    waits = dict.fromkeys(spent, 0.0)

    def timed(part: str, work: Callable[[], list[Found]], poses: int | None = None) -> list[Found]:
        """Do a part's work; what waited for a pose is paid by that which comes."""
        start_s = thread_time()
        found = work()
        waits[part] += thread_time() - start_s
        if count := len(found) if poses is None else poses:
            spent[part] += [waits[part] / count] * count
            waits[part] = 0.0
        return found

    for message in _hand(setup, name, profile, seconds):
        while messages and messages[0].t_ns <= message.t_ns:
            one = messages.pop(0)
            for solved in timed("object", lambda one=one: line.push(one)):
                if not solved.pose.tracked:
                    raise ValueError(
                        f"{name}: not tracked in all frames, so this would be the cost of another thing"
                    )
                contact.push_object(solved.pose)
        for solved in timed("hand", lambda message=message: pipeline.push(message)):
            timed("contact", lambda pose=solved.pose: contact.push(pose), 1)
            timed("gestures", lambda pose=solved.pose: gestures.push(pose), 1)
    return {part: np.array(each[WARM:]) for part, each in spent.items()}


def _way(first: Float) -> Where:
    """A way half a metre away on which what faces the cameras at first goes on facing them."""
    way = wander(SEED, np.zeros(3), 0.25, 0.5)
    back = way(0.0)[:3, :3].T

    def where(t_s: float) -> Float:
        T = way(t_s)
        return rigid(T[:3, :3] @ back @ first, np.array([0.0, 0.0, 0.5]) + 0.5 * T[:3, 3])

    return where


def _hand(setup: RigSetup, name: str, profile: ObjectProfile, seconds: float) -> Iterator[MarkerDetections]:
    """A hand that grasps, as its markers are projected into the cameras, 5 ms apart."""
    hand = load(CALIBRATION / f"hands/{setup.rig.hand}.json", HandProfile)
    scene = scene_by_name("grasp", setup.rig, setup.cameras, hand, SEED, {name: profile})
    rng, count = np.random.default_rng(SEED), len(setup.rig.markers)
    on_hand = [row for row, marker in enumerate(setup.rig.markers) if marker not in setup.rig.free_markers]
    for seq in range(round(60.0 * seconds)):
        for index, (camera, model) in enumerate(setup.models.items()):
            t_s = seq / 60.0 + 0.005 * index
            uv = np.full((count, 2), np.nan)
            uv[on_hand] = model.project(scene.truth(t_s).markers_m[on_hand]) + rng.normal(
                0.0, _PX, (len(on_hand), 2)
            )
            seen = np.isfinite(uv[:, 0])
            area, one, sigma = (np.where(seen, value, np.nan) for value in (150.0, 1.0, 0.1))
            t_ns, nowhere = round(t_s * 1e9), np.full((count, 2), np.nan)
            yield MarkerDetections(camera, 1, seq, t_ns, t_ns, uv, area, one, sigma, nowhere)


def _row(name: str, costs: Float, hand_s: float) -> Row:
    ratio = costs / hand_s
    note = f"of the hand's fit, {_spread(1e-3 * ratio)}; {1e3 * np.median(costs):.2f} ms"
    return Row(name, float(np.median(ratio)), "x", note)


def _spread(seconds: Float) -> str:
    low, high = np.percentile(1e3 * seconds, [25, 75])
    return f"quartiles {low:.2f} ... {high:.2f}"
