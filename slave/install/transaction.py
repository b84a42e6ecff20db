"""Change files so that they can be rolled back, one installation at a time.

The former content is kept below /opt/phalanx until the next installation. While its manifest is open, a change is
under way: whoever finds it so (the power went) takes it back first. An installation whose PC went away goes on to its
end, and the next waits for it: the lock is on a folder that is always there, and ends with whoever has it. Each
command that an installer runs has a time limit, so that has an end, too. Nothing to take back, and links in the
slave's folder, raise `InstallError`, other files `OSError`.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import shutil
import stat
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any, cast

from slave.install.arguments import InstallError
from slave.install.wanted import LINK, OPT, File

NOTES = f"{OPT}/before"
CURRENT = f"{OPT}/current"
_MANIFEST = "manifest.json"
_STATE = "var/lib/phalanx"
_NO_SLAVES = "/{}: is a link or a special file, which no slave makes; look at it before you install again"
_LINKS = (errno.ELOOP, errno.ENOTDIR, errno.ENXIO, errno.EISDIR)
_FOLDER_MODES = {"etc/phalanx/keys": 0o700, NOTES: 0o700}


def changed(root: Path, files: Mapping[str, File | None]) -> list[str]:
    """Paths of those that are not as they are wanted."""
    return [path for path, file in files.items() if not _as_wanted(root, path, file)]


class Transaction:
    """One installation's changes on the machine whose files are below `root`."""

    def __init__(self, root: Path) -> None:
        self._root, self._notes = root, root / NOTES
        self._manifest = self._notes / _MANIFEST

    @property
    def is_open(self) -> bool:
        """Whether an installation began and neither ended nor was taken back."""
        return self._read().get("open", False) is True

    @property
    def release_before(self) -> str | None:
        """The release that was current before; None: there was none."""
        current = self._there()["current"]
        return None if current is None else Path(current).name

    def begin(self, paths: list[str], restarted: list[str]) -> None:
        """Keep what is at `paths`, the current release, and what will be `restarted`."""
        self._forget()
        kept: dict[str, str | None] = {}
        for number, path in enumerate(paths):
            file = read(self._root, path)
            kept[path] = None if file is None else f"{number:04d}"
            if file is not None:
                write(self._root, f"{NOTES}/{number:04d}", file)
        link = self._root / CURRENT
        current = str(link.readlink()) if link.is_symlink() else None
        self._write({"open": True, "files": kept, "current": current, "restarted": restarted})

    def end(self) -> None:
        """All is well; the notes stay until the next installation."""
        self._write(self._read() | {"open": False})

    def take_back(self) -> list[str]:
        """Put everything back; the services that have to be restarted."""
        notes = self._there()
        for path, kept in notes["files"].items():
            before = None if kept is None else read(self._root, f"{NOTES}/{kept}")
            if before is None:
                remove(self._root, path)
            else:
                write(self._root, path, before)
        link = self._root / CURRENT
        if notes["current"] is None:
            link.unlink(missing_ok=True)
        else:
            point(link, notes["current"])
        self._forget()
        return [str(unit) for unit in notes["restarted"]]

    def _there(self) -> dict[str, Any]:
        if not (notes := self._read()):
            raise InstallError("there is no earlier installation to go back to")
        return notes

    def _read(self) -> dict[str, Any]:
        try:
            return cast(dict[str, Any], json.loads(self._manifest.read_text()))
        except FileNotFoundError:
            return {}

    def _write(self, notes: Mapping[str, object]) -> None:
        write(self._root, f"{NOTES}/{_MANIFEST}", File(json.dumps(notes, indent=1).encode(), 0o600))

    def _forget(self) -> None:
        """Remove the notes, the manifest first: without it what is left means nothing."""
        self._manifest.unlink(missing_ok=True)
        shutil.rmtree(self._notes, ignore_errors=True)


def point(link: Path, target: str) -> None:
    """Let a link point elsewhere, at once."""
    fresh = link.with_name(f".{link.name}.new")
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(target)
    fresh.replace(link)


def read(root: Path, path: str) -> File | None:
    """A file as it is; None: it is not there.

    Raises:
        InstallError: It is in the slave's folder, and no plain file: root follows no link that a slave may have made.
    """
    own = _is_slaves(path)
    try:
        with _folder(root, path, make=False) as folder:
            if path == LINK:
                return File(os.readlink(Path(path).name, dir_fd=folder).encode(), stat.S_IFLNK | 0o777)
            flags = os.O_RDONLY | (os.O_NOFOLLOW | os.O_NONBLOCK if own else 0)
            with open(os.open(Path(path).name, flags, dir_fd=folder), "rb") as file:  # noqa: PTH123 - a descriptor
                mode = os.fstat(file.fileno()).st_mode
                if own and not stat.S_ISREG(mode):
                    raise InstallError(_NO_SLAVES.format(path))
                return File(file.read(), stat.S_IMODE(mode))
    except FileNotFoundError:
        return None
    except OSError as error:
        if own and error.errno in _LINKS:
            raise InstallError(_NO_SLAVES.format(path)) from error
        raise


def write(root: Path, path: str, file: File) -> None:
    """Write a file whole or not at all; it belongs to the owner of its folder.

    Raises:
        InstallError: A folder of the slave's is a link: whoever made it would have root write elsewhere.
    """
    name, fresh = Path(path).name, f".{Path(path).name}.new"
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
    with _folder(root, path, make=True) as folder:
        try:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(fresh, dir_fd=folder)
            if stat.S_ISLNK(file.mode):
                os.symlink(file.content.decode(), fresh, dir_fd=folder)
            else:
                with open(os.open(fresh, flags, 0o600, dir_fd=folder), "wb") as out:  # noqa: PTH123 - a descriptor
                    out.write(file.content)
                    _give_to_owner(out.fileno(), folder)
                    os.fchmod(out.fileno(), file.mode)
                    out.flush()
                    os.fsync(out.fileno())
            os.replace(fresh, name, src_dir_fd=folder, dst_dir_fd=folder)
        except OSError:
            with contextlib.suppress(OSError):
                os.unlink(fresh, dir_fd=folder)
            raise


def remove(root: Path, path: str) -> None:
    """Remove a file, if it is there."""
    with contextlib.suppress(FileNotFoundError), _folder(root, path, make=False) as folder:
        os.unlink(Path(path).name, dir_fd=folder)


@contextlib.contextmanager
def _folder(root: Path, path: str, *, make: bool) -> Generator[int]:
    """Descriptor of the folder of a file, made with the right mode if `make`."""
    below = os.open(root, os.O_RDONLY | os.O_DIRECTORY)
    so_far = Path()
    try:
        for part in Path(path).parent.parts:
            so_far /= part
            inner = _inner(part, below, str(so_far), make)
            os.close(below)
            below = inner
        if make and str(so_far) in _FOLDER_MODES:
            os.fchmod(below, _FOLDER_MODES[str(so_far)])
        yield below
    finally:
        os.close(below)


def _inner(name: str, folder: int, path: str, make: bool) -> int:
    """Descriptor of the folder `name` in `folder`; `path` states where that is."""
    own, fresh = _is_slaves(path), False
    if make:
        with contextlib.suppress(FileExistsError):
            os.mkdir(name, 0o755, dir_fd=folder)
            fresh = True
    flags = os.O_RDONLY | os.O_DIRECTORY | (os.O_NOFOLLOW if own else 0)
    try:
        inner = os.open(name, flags, dir_fd=folder)
    except OSError as error:
        if own and error.errno in _LINKS:
            raise InstallError(_NO_SLAVES.format(path)) from error
        raise
    if fresh:
        _give_to_owner(inner, folder)
    return inner


def _give_to_owner(descriptor: int, folder: int) -> None:
    """Let what is open belong to whom `folder` belongs."""
    if os.geteuid() == 0:
        owner = os.fstat(folder)
        os.fchown(descriptor, owner.st_uid, owner.st_gid)


def _is_slaves(path: str) -> bool:
    """Whether a slave can have put something else there."""
    return path.startswith(f"{_STATE}/")


def _as_wanted(root: Path, path: str, file: File | None) -> bool:
    there = read(root, path)
    if file is None or there is None:
        return file is there
    # What the slave owns, and a FAT partition, have modes of their own.
    return there.content == file.content and (not path.startswith("etc/") or there.mode == file.mode)


LOCKED = "opt"


@contextlib.contextmanager
def alone(root: Path, notify: Callable[[str], None], sleep: Callable[[float], None]) -> Generator[None]:
    """Hold the machine below `root` for oneself."""
    (root / LOCKED).mkdir(parents=True, exist_ok=True)
    folder = os.open(root / LOCKED, os.O_RDONLY | os.O_DIRECTORY)
    try:
        wait_s = 600
        for look in range(wait_s):
            try:
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if look == 0:
                    notify(
                        f"another installation runs on this machine: waiting for its end, at most {wait_s} s"
                    )
                sleep(1.0)
        else:
            raise InstallError(
                f"another installation still runs on this machine after {wait_s} s; to see it there: "
                "pgrep -af 'slave.*install'"
            )
        yield
    finally:
        os.close(folder)
