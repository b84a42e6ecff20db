"""Changes of files that can be taken back: what stood there before is kept until the next installation.

The notes are a folder below /opt/phalanx. While its manifest is open, a change is under way: whoever finds it so (the
power went) takes it back first.
"""

from __future__ import annotations

import json
import os
import shutil
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from slave.install.errors import InstallError
from slave.install.wanted import OPT, File

NOTES = f"{OPT}/before"
CURRENT = f"{OPT}/current"
_STATE = "var/lib/phalanx"
_FOLDER_MODES = {"etc/phalanx/keys": 0o700, NOTES: 0o700}


def changed(root: Path, files: Mapping[str, File | None]) -> list[str]:
    """Paths of those that are not as they are wanted."""
    return [path for path, file in files.items() if not _as_wanted(root / path, file, path)]


class Transaction:
    """One installation's changes. Holds nothing but the place of its notes."""

    def __init__(self, root: Path) -> None:
        """Of the machine whose files are below `root`."""
        self._root, self._notes = root, root / NOTES
        self._manifest = self._notes / "manifest.json"

    @property
    def is_open(self) -> bool:
        """Whether an installation began and neither ended nor was taken back."""
        return self._read().get("open", False) is True

    @property
    def is_there(self) -> bool:
        """Whether there is something that can be taken back."""
        return bool(self._read())

    def begin(self, paths: list[str], restarted: list[str]) -> None:
        """Keep what is at `paths`, and which release is current.

        Args:
            paths: Below the root; those that are not there yet are noted as such.
            restarted: Services that will be restarted, so that taking it back restarts them again.
        """
        shutil.rmtree(self._notes, ignore_errors=True)
        _make_folder(self._root, NOTES)
        kept: dict[str, str | None] = {}
        for number, path in enumerate(paths):
            file = self._root / path
            kept[path] = f"{number:04d}" if file.exists() else None
            if file.exists():
                shutil.copy2(file, self._notes / f"{number:04d}")
        link = self._root / CURRENT
        current = str(link.readlink()) if link.is_symlink() else None
        self._write({"open": True, "files": kept, "current": current, "restarted": restarted})

    def end(self) -> None:
        """All is well; the notes stay until the next installation."""
        self._write(self._read() | {"open": False})

    def take_back(self) -> list[str]:
        """Put everything back; the services that have to be restarted.

        Raises:
            InstallError: There is nothing to take back.
        """
        notes = self._read()
        if not notes:
            raise InstallError("there is no earlier installation to go back to")
        for path, kept in notes["files"].items():
            target = self._root / path
            if kept is None:
                target.unlink(missing_ok=True)
            else:
                before = self._notes / kept
                write(self._root, path, File(before.read_bytes(), stat.S_IMODE(before.stat().st_mode)))
        link = self._root / CURRENT
        if notes["current"] is None:
            link.unlink(missing_ok=True)
        else:
            point(link, notes["current"])
        shutil.rmtree(self._notes)
        return [str(unit) for unit in notes["restarted"]]

    def _read(self) -> dict[str, Any]:
        try:
            return cast(dict[str, Any], json.loads(self._manifest.read_text()))
        except FileNotFoundError:
            return {}

    def _write(self, notes: Mapping[str, object]) -> None:
        fresh = self._manifest.with_suffix(".new")
        fresh.write_text(json.dumps(notes, indent=1))
        fresh.replace(self._manifest)


def point(link: Path, target: str) -> None:
    """Let a link point elsewhere, at once."""
    fresh = link.with_name(f".{link.name}.new")
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(target)
    fresh.replace(link)


def write(root: Path, path: str, file: File) -> None:
    """Write a file whole or not at all; it belongs to whom its folder belongs.

    Raises:
        InstallError: A folder of the slave's is a link: whoever made it would have root write elsewhere.
        OSError: It cannot be written.
    """
    folder = _make_folder(root, str(Path(path).parent))
    fresh = folder / f".{Path(path).name}.new"
    fresh.unlink(missing_ok=True)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
    try:
        with open(os.open(fresh, flags, 0o600), "wb") as out:  # noqa: PTH123 - a descriptor
            out.write(file.content)
            owner = folder.stat()
            if os.geteuid() == 0:
                os.fchown(out.fileno(), owner.st_uid, owner.st_gid)
            os.fchmod(out.fileno(), file.mode)
            out.flush()
            os.fsync(out.fileno())
        fresh.replace(root / path)
    except OSError:
        fresh.unlink(missing_ok=True)
        raise


def _make_folder(root: Path, path: str) -> Path:
    """Make a folder and those above it, as they should be."""
    if path.startswith(f"{_STATE}/"):
        base = (root / _STATE).resolve()
        inner = [base / part for part in _prefixes(path.removeprefix(f"{_STATE}/"))]
        if any(one.is_symlink() for one in inner):
            raise InstallError(
                f"/{path}: is a link, which no slave makes; look at it before you install again"
            )
    folder = root / path
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    for one in reversed(missing):
        one.mkdir(mode=0o755)
        if os.geteuid() == 0:
            owner = one.parent.stat()
            os.chown(one, owner.st_uid, owner.st_gid)
    if path in _FOLDER_MODES:
        folder.chmod(_FOLDER_MODES[path])
    return folder


def _prefixes(path: str) -> list[str]:
    parts = Path(path).parts
    return ["/".join(parts[: n + 1]) for n in range(len(parts))]


def _as_wanted(path: Path, file: File | None, name: str) -> bool:
    if file is None:
        return not path.exists()
    try:
        if path.read_bytes() != file.content:
            return False
    except FileNotFoundError:
        return False
    # What the slave owns, and a FAT partition, have modes of their own.
    return not name.startswith("etc/") or stat.S_IMODE(path.stat().st_mode) == file.mode
