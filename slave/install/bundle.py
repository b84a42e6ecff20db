"""Sources of keys and calibration.

Folders of this machine, or the archive that the PC sent with the installer.
"""

from __future__ import annotations

import stat
import zipfile
from pathlib import Path

from slave.install.arguments import InstallError

KEYS, CALIBRATION = "payload/keys/", "payload/calib_json/"
_SHARED = stat.S_IRWXG | stat.S_IRWXO


def from_archive(archive: Path) -> tuple[dict[str, bytes], dict[str, bytes]]:
    """Keys and calibration of an archive: path -> content each.

    Raises:
        InstallError: It is none.
    """
    try:
        with zipfile.ZipFile(archive) as opened:
            names = [name for name in opened.namelist() if not name.endswith("/")]
            keys = {n.removeprefix(KEYS): opened.read(n) for n in names if n.startswith(KEYS)}
            calibration = {
                n.removeprefix(CALIBRATION): opened.read(n) for n in names if n.startswith(CALIBRATION)
            }
    except (OSError, zipfile.BadZipFile) as error:
        raise InstallError(f"{archive}: not what the PC sends ({error})") from error
    return keys, calibration


def calibration_of(folder: Path) -> dict[str, bytes]:
    """All JSON files of a calib_json tree.

    Raises:
        InstallError: There is none.
    """
    if not (folder / "rigs").is_dir():
        raise InstallError(f"{folder}: no calib_json tree (no rigs/ in it); give --calibration DIR")
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.glob("*/*.json"))
    }


def keys_of(folder: Path | None) -> dict[str, bytes]:
    """The files of a keys folder that a device may have; empty without a folder.

    Raises:
        InstallError: It is not there, or others can read it.
    """
    if folder is None:
        return {}
    if not folder.is_dir():
        raise InstallError(
            f"{folder}: no such folder of keys; make one on the PC: phalanx fleet keys {folder} --make"
        )
    found: dict[str, bytes] = {}
    for path in sorted([*folder.glob("*"), *folder.glob("devices/*")]):
        name = path.relative_to(folder).as_posix()
        if name in ("rig.key", "ca.pem") or name.startswith(("devices/", "device-", "device.")):
            if not path.is_file():
                continue
            if path.suffix in (".key", ".secret") and stat.S_IMODE(path.stat().st_mode) & _SHARED:
                raise InstallError(f"{path}: others can read this key; run: chmod 600 {path}")
            found[name] = path.read_bytes()
    return found
