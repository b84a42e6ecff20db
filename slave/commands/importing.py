"""`phalanx-slave import`: a recording of videos or pictures that other programs made."""

import argparse
from collections.abc import Callable
from pathlib import Path

PURPOSE = "a recording of your own videos or pictures"
EXAMPLES = """\
  phalanx-slave import left.mp4 right.mp4 --calibration calib_json -o recordings/wave
        videos named as the cameras of the rig; `phalanx replay left.mp4 right.mp4 ...` does this by itself
  phalanx-slave import takes/7 --calibration calib_json --times takes/7/times.csv -o recordings/take7
        a folder with a video, or a folder of pictures, for each camera; times.csv: camera,frame,time (seconds)
  phalanx-slave import --camera left=GOPR0012.MP4 --camera right=GOPR0944.MP4 --calibration calib_json -o recordings/go
        whose each one is, where its name does not say so
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """The options of `import`."""
    command.add_argument(
        "paths",
        type=Path,
        nargs="*",
        metavar="PATH",
        help="a video or a folder of pictures for each camera, or a folder of these",
    )
    command.add_argument(
        "--camera",
        action="append",
        type=camera_path,
        default=[],
        metavar="NAME=PATH",
        help="whose a video or folder is (default: that of its name, else in the order of the rig)",
    )
    command.add_argument(
        "--calibration", type=Path, required=True, metavar="DIR", help="calib_json tree: cameras and rig"
    )
    command.add_argument(
        "--rig", metavar="NAME", help="rig in DIR/rigs (default: the one with these cameras)"
    )
    command.add_argument(
        "--times",
        type=Path,
        metavar="FILE.csv",
        help="when each frame was taken: camera,frame,time; frames from 0, time in seconds, or t_ns (default: "
        "NAME.csv beside NAME.mp4, without the camera; else the video's time stamps, else the frame rate)",
    )
    command.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FOLDER", help="new, empty, or a former import"
    )


def run(options: argparse.Namespace, notify: Callable[[str], None]) -> int:
    """Import them.

    Raises:
        PhalanxError: A file is missing, broken, of no camera or of another size than was calibrated.
    """
    from common.errors import RecordingError
    from slave.foreign.importing import Wish, import_pictures

    named: dict[str, Path] = {}
    for name, path in options.camera:
        if name in named:
            raise RecordingError(f"--camera {name}: is given twice")
        named[name] = path
    if not options.paths and not named:
        raise RecordingError("import: name a video or a folder of pictures for each camera")
    wish = Wish(options.calibration, options.paths, named, options.rig, options.times)
    import_pictures(wish, options.output, notify)
    notify(f"recording in {options.output}")
    return 0


def camera_path(text: str) -> tuple[str, Path]:
    """A camera and its video or folder.

    Raises:
        argparse.ArgumentTypeError: The text is not NAME=PATH.
    """
    name, equals, path = text.partition("=")
    if not (name and equals and path):
        raise argparse.ArgumentTypeError(f"{text!r}: expected NAME=PATH, such as left=GOPR0012.MP4")
    return name, Path(path)
