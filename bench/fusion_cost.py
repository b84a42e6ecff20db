"""What the fused line costs a small PC, message by message, beside each sensor alone in the same process.

Times are of the processor, on one thread: what else the machine does is not in them, though a shared core is slower.
Beside cameras a triple waits for the next instant, whose fit takes its rows: it is that instant which pays for it.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from time import process_time

from bench.fusion_scene import Observed
from bench.fusion_shown import shown
from bench.row import Row
from common.messages import ImuSample, WristDetections
from master.rig.pipeline import pipeline_of
from master.rig.setup import RigSetup
from master.run.stages import StageTimes

SCENE, SECONDS, SEED = "grasp", 6.0, 7


def rows() -> Iterator[Row]:
    """A hand that grasps, solved by markers, by the wrist device, and by both."""
    played = shown(SCENE, SECONDS, SEED)
    markers, wrist, fused = (
        costs(setup, played.messages) for setup in (played.both.markers, played.both.wrist, played.both.fused)
    )
    yield Row("an instant of two cameras, markers alone", 1e3 * markers["instant"], "ms", "")
    yield _row("  fused with the wrist device", fused["instant"], markers["instant"], "markers alone")
    yield Row("a triple, wrist device alone", 1e3 * wrist["cycle"], "ms", "")
    both_s = markers["second"] + wrist["second"]
    yield _row("a second, fused", fused["second"], both_s, "both apart")
    yield Row("a sample of the IMU, fused", 1e3 * fused["sample"], "ms", "")
    note = f"markers alone {100 * markers['second']:.0f}, wrist device alone {100 * wrist['second']:.0f}"
    yield Row("one core, fused hand", 100 * fused["second"], "%", note)


def costs(setup: RigSetup, messages: Iterable[Observed]) -> dict[str, float]:
    """Processor time [s] of an instant, a triple and an IMU sample, mean, and of a second of all.

    The message that completes an instant pays for it; the others of its cameras count to it, too.
    """
    pipeline = pipeline_of(setup, StageTimes())
    spent, count = defaultdict[str, float](float), defaultdict[str, int](int)
    for message in messages:
        start_s = process_time()
        if isinstance(message, ImuSample):
            if message.source not in setup.imus:
                continue
            pipeline.push_orientation(message.t_ns, message.orientation_wxyz, message.heading_sigma_rad)
            kind, news = "sample", 1
        elif message.camera in setup.cameras:
            poses = pipeline.push(message)
            kind = "cycle" if isinstance(message, WristDetections) else "instant"
            news = 1 if kind == "cycle" else len(poses)
        else:
            continue
        spent[kind] += process_time() - start_s
        count[kind] += news
    each = {kind: total / count[kind] for kind, total in spent.items()}
    return {**each, "second": sum(spent.values()) / SECONDS}


def _row(name: str, cost_s: float, baseline_s: float, what: str) -> Row:
    return Row(name, 1e3 * cost_s, "ms", f"{cost_s / baseline_s:.2f} x {what}, goal 2")
