"""`phalanx-slave record --from`: recording from videos or pictures.

They were made by other programs.
"""

import argparse
from pathlib import Path

from common.terminal import echo


def import_foreign(options: argparse.Namespace) -> int:
    """Import them.

    Raises:
        PhalanxError: A file is missing, broken, of no camera or of another size than was calibrated.
    """
    from common.errors import RecordingError
    from slave.foreign.importing import Wish, import_pictures

    paths: list[Path] = []
    named: dict[str, Path] = {}
    for text in options.foreign:
        name, path = camera_path(text)
        if name is None:
            paths.append(path)
        elif name in named:
            raise RecordingError(f"--from {name}=: is given twice")
        else:
            named[name] = path
    wish = Wish(options.calibration or Path("calib_json"), paths, named, options.rig, options.times)
    import_pictures(wish, options.output, echo)
    echo(f"recording in {options.output}")
    return 0


def camera_path(text: str) -> tuple[str | None, Path]:
    """Split an argument into an optional camera and its video or folder.

    A path with `=` in it counts as a path if it exists.
    """
    name, equals, path = text.partition("=")
    if Path(text).exists() or not (name and equals and path):
        return None, Path(text)
    return name, Path(path)
