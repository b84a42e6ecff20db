"""The viewer runs in processes of its own and reads the bus.

It never slows the tracking: a full subscription drops its oldest message, so a slow screen loses pictures,
not poses. It sends nothing but "preview" to the cameras. Native and web viewer are child processes, as the
SDK's `spawn` and `serve_*` listen on every interface: these listen on 127.0.0.1 only, with a memory limit,
and with usage statistics switched off in a private settings folder (docs/viewer.md).
"""

import logging
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from bisect import bisect_right
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Literal, TypeVar
from urllib.parse import quote

import rerun as rr
import rerun_cli

from common.arrays import Image
from common.bus.bus import Bus, Subscription
from common.clock import now_ns
from common.errors import PhalanxError, RecordingError
from common.messages import (
    Contact,
    Detections,
    Gesture,
    HandPose,
    Health,
    Message,
    ObjectPose,
    Preview,
    ResultMessage,
)
from common.messages.streams import MASTER
from common.supervisor import NEW_GROUP
from master.outputs.bus import PictureAsker
from master.outputs.poses import Poses, PosesTruth
from master.outputs.rerun_blueprint import blueprint
from master.outputs.rerun_scene import RerunScene
from master.rig.setup import RigSetup

LOOPBACK = "127.0.0.1"
VIEWER_MEMORY = "1GB"  # the viewer drops its oldest data beyond it
SERVER_MEMORY = "256MB"
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
_FIX = "without a display use --web or --save FILE.rrd; a busy port needs another one"


class ViewerProcess:
    """A running viewer: a window, or a web page when `web_port` is given."""

    def __init__(self, web_port: int | None) -> None:
        """Start it and wait until it listens.

        Raises:
            PhalanxError: It ended at once (no display, port taken) or does not listen; the text has its reason.
        """
        if (
            web_port is None
            and sys.platform == "linux"
            and not any(os.environ.get(name) for name in _DISPLAYS)
        ):
            # The viewer would listen before it finds that out.
            raise PhalanxError(
                f"the viewer cannot open a window: none of {', '.join(_DISPLAYS)} is set; {_FIX}"
            )
        self._port = _free_port()
        self._web_port = web_port
        self._folder = tempfile.TemporaryDirectory(prefix="phalanx-viewer-")
        self._errors = Path(self._folder.name) / "stderr"
        program = _program()
        environment = {**os.environ, "XDG_CONFIG_HOME": self._folder.name}
        try:
            subprocess.run(
                [program, "analytics", "disable"],
                env=environment,
                capture_output=True,
                check=True,
                timeout=30,
            )
            with self._errors.open("wb") as errors:
                self._child = subprocess.Popen(
                    [program, *viewer_arguments(self._port, web_port)],
                    env=environment,
                    stdin=subprocess.DEVNULL,
                    stdout=errors,
                    stderr=errors,
                    start_new_session=True,
                    creationflags=NEW_GROUP,
                )
        except (OSError, subprocess.SubprocessError) as error:
            self._folder.cleanup()
            raise PhalanxError(f"{program}: cannot start the viewer: {error}") from error
        try:
            for port in (self._port, *(() if web_port is None else (web_port,))):
                self._wait_for(port)
        except BaseException:
            self.close()
            raise

    @property
    def url(self) -> str:
        """Where the SDK sends its data."""
        return f"rerun+http://{LOOPBACK}:{self._port}/proxy"

    @property
    def address(self) -> str:
        """The address to show to the user."""
        if self._web_port is None:
            return "viewer window opened"
        return f"http://{LOOPBACK}:{self._web_port}?url={quote(self.url, safe='')}"

    def alive(self) -> bool:
        """Whether the viewer runs; False once its window was closed."""
        return self._child.poll() is None

    def close(self) -> None:
        """End the viewer. Safe to call twice."""
        if self.alive():
            self._child.terminate()
            try:
                end_timeout_s = 5.0
                self._child.wait(end_timeout_s)
            except subprocess.TimeoutExpired:
                self._child.kill()
                self._child.wait()
        self._folder.cleanup()

    def check(self) -> None:
        """Do nothing while it runs or its user closed it; else PhalanxError has why."""
        if not self.alive() and self._child.returncode != 0:
            last = self._errors.read_text(errors="replace").strip().splitlines()[-1:] or ["no reason given"]
            raise PhalanxError(f"the viewer ended (exit {self._child.returncode}): {last[0]}; {_FIX}")

    def _wait_for(self, port: int) -> None:
        start_timeout_ns = 15_000_000_000
        end_ns = now_ns() + start_timeout_ns
        while now_ns() < end_ns:
            self.check()
            try:
                socket.create_connection((LOOPBACK, port), timeout=1.0).close()
                return
            except OSError:
                time.sleep(0.05)
        raise PhalanxError(
            f"the viewer does not listen on {LOOPBACK}:{port} after {start_timeout_ns // 10**9} s"
        )


def viewer_arguments(port: int, web_port: int | None) -> list[str]:
    """Command line of the viewer: bound to 127.0.0.1, memory limited."""
    common = ["--bind", LOOPBACK, "--port", str(port), "--server-memory-limit", SERVER_MEMORY]
    if web_port is None:
        return [*common, "--memory-limit", VIEWER_MEMORY, "--hide-welcome-screen", "--expect-data-soon"]
    return [*common, "--serve-web", "--web-viewer-port", str(web_port)]


def _program() -> str:
    folder = Path(next(iter(rerun_cli.__path__)))
    for name in ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun"):
        if (folder / name).is_file():
            return str(folder / name)
    raise PhalanxError(f"{folder}: the viewer is missing; reinstall rerun-sdk")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


Mode = Literal["spawn", "web", "save"]

_APPLICATION = "phalanx"
_RESULTS = {"object": ObjectPose, "contact": Contact, "gesture": Gesture}

_log = logging.getLogger(__name__)
_Kind = TypeVar("_Kind", bound=Message)


def run_viewer(
    bus: Bus,
    setups: Sequence[RigSetup],
    *,
    mode: Mode,
    path: Path | None,
    stop: threading.Event,
    web_port: int = 9090,
    on_ready: Callable[[str], None] = _log.info,
) -> int:
    """Show what is on the bus, which stays open, until `stop` or the viewer's end.

    Args:
        mode: "spawn" a window, serve the "web" viewer on 127.0.0.1, or "save" an .rrd.
        path: The .rrd of mode "save"; None otherwise.
        on_ready: Called once with where the result is to be seen (an address or a file).

    Returns:
        Number of poses shown.

    Raises:
        RecordingError: The .rrd cannot be written.
        PhalanxError: The viewer did not start (no display?) or takes no data any more.
        ValueError: Mode and `path` do not fit.
    """
    if (mode == "save") != (path is not None):
        raise ValueError(f"mode {mode!r} with path {path}: a path belongs to mode 'save' and only to it")
    with ExitStack() as stack:
        inboxes = {
            stream: stack.enter_context(
                closing(bus.subscribe(stream, depth=16 if stream == "preview" else 256))
            )
            for stream in ("hand", *_RESULTS, "health", "preview")
        }
        recording, alive = stack.enter_context(_opened(mode, path, web_port, on_ready))
        recording.send_blueprint(blueprint(setups, live=mode != "save", with_truth=False))
        scene = RerunScene(recording, setups)
        asker = PictureAsker(bus, tuple(dict.fromkeys(name for one in setups for name in one.camera_names)))
        stack.callback(asker.close)
        return _pump(scene, recording, inboxes, lambda: alive() and not stop.is_set())


def write_rrd(
    path: Path,
    poses: Poses,
    setup: RigSetup,
    detections: Mapping[str, Iterable[Detections]] | None = None,
    truth: PosesTruth | None = None,
    images: Iterable[tuple[str, int, Image | bytes]] = (),
    results: Sequence[ResultMessage] = (),
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> None:
    """Write a finished run as an .rrd, which `rerun FILE` opens with its layout.

    Args:
        path: Replaced only by a complete file.
        detections: Camera -> its frames in the order of time, on the clock of the poses.
        truth: Row by row with `poses`.
        images: (camera, t_ns, BGR image or JPEG); at most 10 Hz of each camera are kept.
        results: Objects, contact and gestures of the run, each in the order of time.
        progress: Called with how many poses of how many are written.

    Raises:
        RecordingError: The file cannot be written; nothing half written is left.
    """
    with _saved(path) as recording:
        recording.send_blueprint(blueprint([setup], live=False, with_truth=truth is not None))
        scene = RerunScene(recording, [setup])
        rest = sorted(results, key=lambda one: one.t_ns)
        rows_a_chunk = 512
        for start in range(0, len(poses), rows_a_chunk):
            stop = min(start + rows_a_chunk, len(poses))
            scene.log_poses(poses.rows(start, stop), truth.rows(start, stop) if truth is not None else None)
            count = bisect_right(rest, int(poses.t_ns[stop - 1]), key=lambda one: one.t_ns)
            scene.log_results(rest[:count])
            rest = rest[count:]
            progress(stop, len(poses))
        scene.log_results(rest)
        for frames in (detections or {}).values():
            scene.log_detections(frames)
        for camera, t_ns, image in images:
            scene.log_image(camera, image, t_ns)


def _pump(
    scene: RerunScene,
    recording: rr.RecordingStream,
    inboxes: Mapping[str, Subscription],
    go_on: Callable[[], bool],
) -> int:
    """Move messages from the bus to the scene while `go_on`, and the last after it."""
    shown, flush_ns, going = 0, now_ns(), True
    at_ns: int | None = None  # newest time of the master, on whose clock the timeline is
    while going:
        going = go_on()
        # Before the poses: a report or picture never overtakes a pose sent before it.
        reports, pictures = _waiting(inboxes["health"], Health), _waiting(inboxes["preview"], Preview)
        for health in reports:
            at_ns = health.t_ns if health.source == MASTER else at_ns
        for poses in _by_hand(_drain(inboxes["hand"])):
            scene.log_poses(poses)
            shown += len(poses)
            at_ns = scene.last_t_ns
        scene.log_results(
            [one for stream, kind in _RESULTS.items() for one in _waiting(inboxes[stream], kind)]
        )
        if at_ns is not None:  # the slaves' clocks are their own: what they send stands at the master's time
            for health in reports:
                scene.log_health(health, at_ns)
            for picture in pictures:
                scene.log_image(picture.camera, picture.jpeg, picture.t_ns, at_ns)
        flush_period_ns = 1_000_000_000
        if now_ns() - flush_ns > flush_period_ns:
            # The SDK queues without bound towards a viewer that hangs; one second's data is the bound here.
            _flush(recording)
            flush_ns = now_ns()
    return shown


def _waiting(inbox: Subscription, kind: type[_Kind]) -> list[_Kind]:
    """The messages that have arrived."""
    return [message for message in iter(lambda: inbox.get(0.0), None) if isinstance(message, kind)]


def _drain(hands: Subscription) -> list[HandPose]:
    """Wait for a pose, then take what arrives until the next redraw."""
    batch: list[HandPose] = []
    idle_s = 0.1
    end_ns = now_ns() + round(idle_s * 1e9)
    while (left_ns := end_ns - now_ns()) > 0:
        message = hands.get(left_ns * 1e-9)
        if message is None:
            break
        if isinstance(message, HandPose):
            if not batch:
                batch_s = 0.033  # poses shown together: one redraw of a 30 Hz screen
                end_ns = now_ns() + round(batch_s * 1e9)
            batch.append(message)
    return batch


def _by_hand(batch: list[HandPose]) -> Iterator[Poses]:
    """One `Poses` for each hand (and marker count) in the batch."""
    groups: dict[tuple[str, int], list[HandPose]] = {}
    for pose in batch:
        groups.setdefault((pose.hand, len(pose.markers_m)), []).append(pose)
    return map(Poses.of, groups.values())


@contextmanager
def _opened(
    mode: Mode, path: Path | None, web_port: int, on_ready: Callable[[str], None]
) -> Generator[tuple[rr.RecordingStream, Callable[[], bool]], None, None]:
    """The recording of one mode, and whether somebody still looks at it."""
    if path is not None:
        with _saved(path) as recording:
            on_ready(f"recording to {path}")
            yield recording, lambda: True
        return
    with closing(ViewerProcess(web_port if mode == "web" else None)) as viewer:
        recording = rr.RecordingStream(_APPLICATION)
        # The port was seen open: connecting to a dead viewer would block for seconds.
        recording.connect_grpc(viewer.url)
        on_ready(viewer.address)
        try:
            yield recording, viewer.alive
            viewer.check()
            if viewer.alive():
                _flush(recording)
        except PhalanxError:
            viewer.check()
            if viewer.alive():
                raise
            _log.info("the viewer was closed")
        finally:
            recording.disconnect()


@contextmanager
def _saved(path: Path) -> Generator[rr.RecordingStream, None, None]:
    """A recording into `path`, which appears under its name only when it is complete."""
    temporary = None
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".rrd")
        os.close(handle)
        temporary = Path(name)
        recording = rr.RecordingStream(_APPLICATION)
        recording.save(temporary)
        try:
            yield recording
            _flush(recording)
        finally:
            recording.disconnect()
        if not rr.chunk.RrdReader(temporary).recordings():
            raise RecordingError(f"{path}: the file came out empty; free the disk or choose another folder")
        temporary.chmod(0o644)
        temporary.replace(path)
    except (OSError, RuntimeError) as error:
        raise RecordingError(f"{path}: cannot write: {error}") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def _flush(recording: rr.RecordingStream) -> None:
    """Wait until all is written or received; PhalanxError: disk full, viewer hangs."""
    try:
        flush_timeout_s = 5.0
        recording.flush(timeout_sec=flush_timeout_s)
    except (RuntimeError, TimeoutError) as error:
        raise PhalanxError(
            f"Rerun does not take the data (disk full, or the viewer hangs): {error}"
        ) from error
