"""Bundle that goes to a machine by the input of ssh.

Installer, keys of that machine, files of the rig, as one zip in memory.

Nothing of it touches a disk there before the installer writes it: a dry run writes nothing, no key is left in a file.
"""

import io
import zipfile
from collections.abc import Sequence
from pathlib import Path

from deploy.targets import DeployError, RigFile

ROOT = Path(__file__).resolve().parents[1]
KEYS, CALIBRATION = "payload/keys/", "payload/calib_json/"
_OWN = ("pem", "key", "secret")
# Runs on the other machine: the zip is a file in memory, from which Python imports.
_BOOT = (
    "import os,sys;f=os.memfd_create('phalanx');"
    "o=open(f,'wb',closefd=False);o.write(sys.stdin.buffer.read());o.flush();"
    "p='/proc/self/fd/%d'%f;sys.path.insert(0,p);"
    "sys.argv=['slave.install']+[a.replace('@BUNDLE@',p) for a in sys.argv[1:]];"
    "import runpy;runpy.run_module('slave.install',run_name='__main__')"
)
BUNDLE = "@BUNDLE@"  # in arguments: where the zip is there


def command(arguments: Sequence[str], sudo: bool) -> list[str]:
    """The command line there, which takes the zip as its input."""
    return [*(["sudo", "-n"] if sudo else []), "python3", "-c", _BOOT, *arguments]


def bundle(keys: Path | None, names: Sequence[str], calibration: Path | None, rig: RigFile | None) -> bytes:
    """The zip.

    Args:
        keys: Keys folder, of which only what the machine may have is taken; None: none.
        names: Cameras and IMUs that it serves.
        calibration: calib_json tree, of which only what the rig needs is taken; None: none.
        rig: That rig.

    Raises:
        DeployError: A file is missing.
    """
    files = {path.relative_to(ROOT).as_posix(): path for path in _installer()}
    if keys is not None:
        own = ["rig.key", "ca.pem", *(f"devices/{name}.{kind}" for name in names for kind in _OWN)]
        files |= {KEYS + name: keys / name for name in own}
    if calibration is not None and rig is not None:
        files |= {CALIBRATION + name: calibration / name for name in rig.files}
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, path in files.items():
            try:
                archive.writestr(name, path.read_bytes())
            except OSError as error:
                raise DeployError(f"{path}: {error.strerror}; it has to go to the machine") from error
    return packed.getvalue()


def _installer() -> list[Path]:
    package = ROOT / "slave" / "install"
    return [ROOT / "slave" / "__init__.py", *package.glob("*.py"), *(package / "files").glob("*")]
