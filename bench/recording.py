"""Recording raw frames: what it costs the camera loop, and how many frames per second reach the disk."""

import statistics
import tempfile
import time
from pathlib import Path
from time import perf_counter_ns

import cv2
import msgspec

from bench.row import Row
from common.arrays import Image
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.recording.frame_recording import Illumination, Manifest
from common.recording.frame_writing import RecordingWriter, encode_png
from common.sim.render import Renderer
from common.sim.scene import Scene
from slave.progress import Length
from slave.recorder import Recorder
from slave.sources import Frame

CALIBRATION = Path(__file__).resolve().parents[1] / "calib_json"
SIZES = ((640, 480), (1456, 1088))
DRAWN = 6
ROUNDS = 3
ROUND_BYTES = 150_000_000  # raw, per round
_LEVEL_1 = (cv2.IMWRITE_PNG_COMPRESSION, 1)


def rows() -> list[Row]:
    """Rows of both sizes; writes to the folder for temporary files."""
    cv2.setNumThreads(1)
    found: list[Row] = []
    for width, height in SIZES:
        manifest, images = _scene(width, height)
        size = f"{width}x{height}"
        ours, level_1, share = _encoding(images)
        found.append(Row(f"{size}: PNG, level 1", level_1, "ms", "baseline, same run, taken in turn"))
        found.append(
            Row(f"{size}: PNG, Huffman codes only", ours, "ms", f"{100 * share:.0f} % of the raw bytes")
        )
        rates: list[tuple[float, float, float, float]] = []
        for _ in range(ROUNDS):
            with tempfile.TemporaryDirectory() as folder:
                in_loop = _in_the_loop(Path(folder) / "loop", manifest, images)
                rates.append((in_loop, *_recorded(Path(folder) / "recorder", manifest, images)))
        loop, recorder, cpu_ms, offer_us = (statistics.median(column) for column in zip(*rates, strict=True))
        found.append(
            Row(f"{size}: written in the camera loop", loop, "fps", "baseline, same run, taken in turn")
        )
        found.append(
            Row(f"{size}: recorder, sustained", recorder, "fps", f"{recorder / loop:.2f} x the baseline")
        )
        fps = f"{1e3 / cpu_ms:.0f} fps per free core"
        found.append(Row(f"{size}: recorder, CPU time per frame", cpu_ms, "ms", fps))
        found.append(
            Row(f"{size}: recorder, in the camera loop", offer_us, "us", "per frame, beside its threads")
        )
    return found


def _scene(width: int, height: int) -> tuple[Manifest, list[Image]]:
    """The standard scene seen by the rig's first camera with another sensor of the same field of view."""
    rig = load(CALIBRATION / "rigs/desk.json", RigCalibration)
    cameras = {n: load(CALIBRATION / f"cameras/{n}.json", CameraCalibration) for n in rig.cameras}
    name = rig.cameras[0]
    lens = cameras[name].intrinsics
    assert lens is not None
    scale = height / cameras[name].height_px
    lens = msgspec.structs.replace(
        lens,
        fx_px=lens.fx_px * scale,
        fy_px=lens.fy_px * scale,
        cx_px=0.5 * (width - 1),
        cy_px=0.5 * (height - 1),
    )
    cameras[name] = msgspec.structs.replace(cameras[name], width_px=width, height_px=height, intrinsics=lens)
    hand = load(CALIBRATION / f"hands/{rig.hand}.json", HandProfile)
    renderer = Renderer(Scene.standard(rig, cameras, hand), name)
    manifest = Manifest(version=1, kind="markers", cameras=cameras, rig=rig)
    return manifest, [renderer.render(20.0 + 0.1 * k) for k in range(DRAWN)]


def _encoding(images: list[Image]) -> tuple[float, float, float]:
    """Median time [ms] of our encoding and of level 1, and our share of the raw bytes."""
    ours: list[float] = []
    level_1: list[float] = []
    for k in range(8 * len(images)):
        image = images[k % len(images)]
        start_ns = perf_counter_ns()
        encode_png(image)
        middle_ns = perf_counter_ns()
        cv2.imencode(".png", image, _LEVEL_1)
        ours.append((middle_ns - start_ns) * 1e-6)
        level_1.append((perf_counter_ns() - middle_ns) * 1e-6)
    share = sum(len(encode_png(image)) for image in images) / sum(image.nbytes for image in images)
    return statistics.median(ours), statistics.median(level_1), share


def _in_the_loop(folder: Path, manifest: Manifest, images: list[Image]) -> float:
    """Frames per second of a loop that encodes and writes by itself."""
    writer = RecordingWriter(folder, manifest)
    camera = next(iter(manifest.cameras))
    count = max(ROUND_BYTES // images[0].nbytes, 1)
    start_ns = perf_counter_ns()
    for k in range(count):
        writer.add(camera, k, k, Illumination.NONE, encode_png(images[k % len(images)]))
    rate = count * 1e9 / (perf_counter_ns() - start_ns)
    writer.close()
    return rate


def _recorded(folder: Path, manifest: Manifest, images: list[Image]) -> tuple[float, float, float]:
    """Frames per second through the recorder without a drop; CPU time [ms] and the loop's time [us] per frame."""
    count = max(ROUND_BYTES // images[0].nbytes, 1)
    recorder = Recorder(folder, manifest, next(iter(manifest.cameras)), Length(), reserve_bytes=0)
    offers_us: list[float] = []
    start_ns, cpu_ns = perf_counter_ns(), time.process_time_ns()
    for k in range(count):
        while (progress := recorder.progress()).waiting >= progress.capacity:
            time.sleep(0.001)
        frame = Frame(k, k, k, images[k % len(images)])
        before_ns = perf_counter_ns()
        recorder.offer(frame)
        offers_us.append((perf_counter_ns() - before_ns) * 1e-3)
    recorder.close()
    elapsed_ns, cpu_ns = perf_counter_ns() - start_ns, time.process_time_ns() - cpu_ns
    done = recorder.progress()
    if recorder.failure is not None:
        raise recorder.failure
    assert (done.frames, done.dropped) == (count, 0)
    return count * 1e9 / elapsed_ns, cpu_ns * 1e-6 / count, statistics.median(offers_us)
