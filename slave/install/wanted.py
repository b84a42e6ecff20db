"""List the files that a plan installs, with their places and content.

In a Raspberry Pi's config.txt a marked block has only what the file does not state already. Keys are checked before
anything is written. Keys that are none raise `InstallError`.
"""

from __future__ import annotations

import hashlib
import json
import os
import pkgutil
import re
import ssl
import stat
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from slave.install.arguments import InstallError, Plan, wanted_keys

BEGIN, END = "# --- Phalanx: begin ---", "# --- Phalanx: end ---"
_ALL = "[all]"  # lines before may be for one model only


def with_block(text: str, lines: Sequence[str]) -> str:
    """`text` with a block of those `lines` that it lacks, if any."""
    plain = without_block(text)
    own = _shown_to_all(plain)
    missing = [line for line in lines if line not in own]
    if not missing:
        return plain
    if plain and not plain.endswith("\n"):
        plain += "\n"
    return plain + "\n".join([BEGIN, _ALL, *missing, END]) + "\n"


def without_block(text: str) -> str:
    """`text` as it was before we came."""
    kept: list[str] = []
    ours = False
    for line in text.splitlines(keepends=True):
        if line.strip() == BEGIN:
            ours = True
        elif line.strip() == END and ours:
            ours = False
        elif not ours:
            kept.append(line)
    return "".join(kept)


def _shown_to_all(text: str) -> set[str]:
    """The lines that hold on every model; the last of a setting counts."""
    stated: dict[str, str] = {}
    everyone = True
    for line in (line.strip() for line in text.splitlines()):
        if line.startswith("["):
            everyone = line == _ALL
        elif everyone and line and not line.startswith("#"):
            key = line if line.startswith(("dtoverlay=", "dtparam=")) else line.partition("=")[0]
            stated[key] = line
    return set(stated.values())


OPT, ETC, KEYS, CALIB = "opt/phalanx", "etc/phalanx", "etc/phalanx/keys", "var/lib/phalanx/calib_json"
UNIT, SYSUSERS = "etc/systemd/system/phalanx-slave@.service", "etc/sysusers.d/phalanx.conf"
LINK, COMMAND = "usr/local/bin/phalanx-slave", f"/{OPT}/current/bin/phalanx-slave"  # on everybody's PATH
DROP_IN = "etc/systemd/system/{}.d/strobe.conf"  # of the service that switches lights
CHRONY, BOOT, RECORD = "etc/chrony/conf.d/phalanx.conf", "boot/firmware/config.txt", f"{OPT}/installed.json"
_CHRONY = """\
# Written by the installer of Phalanx: the clock of the master's machine first, so that cameras agree with each other.
# That machine answers with `local stratum 8` and `allow` in its own chrony.conf.
server {master} iburst minpoll 0 maxpoll 4 prefer
makestep 0.1 3
"""


@dataclass(frozen=True, slots=True)
class File:
    """Content and mode of a file, or where a link leads."""

    content: bytes
    mode: int = 0o644


@dataclass(frozen=True, slots=True)
class Record:
    """What the last installation left behind for the next one."""

    calibration: Mapping[str, str]  # path below calib_json -> SHA-256 of what the PC had then
    groups: tuple[str, ...] = ()  # groups of the system that we made

    @staticmethod
    def of(plan: Plan, groups: tuple[str, ...]) -> Record:
        """What is to be remembered of the installation of a plan."""
        return Record({path: _hash(content) for path, content in plan.calibration.items()}, groups)

    @staticmethod
    def read(root: Path) -> Record:
        """That of this machine; empty before the first installation."""
        try:
            found = json.loads((root / RECORD).read_text())
            return Record(dict(found["calibration"]), tuple(found["groups"]))
        except FileNotFoundError:
            return Record({})
        except (OSError, ValueError, RecursionError, KeyError, TypeError) as error:
            raise InstallError(
                f"{root / RECORD}: cannot read it ({error}); remove it, and install again"
            ) from error

    def file(self) -> File:
        """As it is kept."""
        found = {"calibration": dict(sorted(self.calibration.items())), "groups": sorted(self.groups)}
        return File((json.dumps(found, indent=1) + "\n").encode())


def wanted_files(plan: Plan, root: Path, record: Record) -> dict[str, File | None]:
    """Path below `root` -> what it is to be; None: gone."""
    files: dict[str, File | None] = {
        UNIT: File(_own("phalanx-slave@.service")),
        SYSUSERS: File(_own("phalanx.sysusers.conf")),
        LINK: File(COMMAND.encode(), stat.S_IFLNK | 0o777),
    }
    if not has_link(root) and os.path.lexists(root / LINK):
        raise InstallError(
            f"/{LINK}: is not of this installation; remove it (pipx uninstall?), and install again"
        )
    for sender in plan.senders:
        files[f"{ETC}/{sender.name}.env"] = File(sender.environment.encode())
        files[DROP_IN.format(sender.unit)] = File(_own("strobe.conf")) if sender.stop_post else None
    if (root / CHRONY).parent.is_dir():
        files[CHRONY] = File(_CHRONY.format(master=plan.master).encode())
    if (root / BOOT).is_file():
        text = (root / BOOT).read_text(errors="surrogateescape")
        files[BOOT] = File(with_block(text, plan.boot).encode(errors="surrogateescape"), 0o755)
    files |= _keys(plan, root)
    files |= _gone(plan, root)
    return files | _calibration(plan, root, record)


def has_link(root: Path) -> bool:
    """Whether the command on the PATH is ours."""
    return (root / LINK).is_symlink() and str((root / LINK).readlink()) == COMMAND


def missing_groups(root: Path) -> list[str]:
    """The groups that our sysusers file asks for and the system has not."""
    file = root / "etc/group"
    groups = file.read_text().splitlines() if file.is_file() else []
    there = {line.partition(":")[0] for line in groups}
    lines = _own("phalanx.sysusers.conf").decode().splitlines()
    return [line.split()[1] for line in lines if line.startswith("g ") and line.split()[1] not in there]


def check_keys(keys: Mapping[str, bytes], names: tuple[str, ...]) -> None:
    """Refuse what is no rig key, secret or certificate, or another one's key."""
    for file in ("rig.key", *(f"device-{name}.secret" for name in names)):
        if not re.fullmatch(rb"[0-9a-fA-F]{64}\s*", keys[file]):
            raise InstallError(
                f"keys: {file} is not 64 hexadecimal digits; phalanx fleet keys DIR --make makes one"
            )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(cadata=keys["ca.pem"].decode("ascii"))
    except (ssl.SSLError, ValueError) as error:
        raise InstallError(f"keys: ca.pem is not a certificate ({error})") from error
    for name in names:
        with _in_memory(keys[f"device-{name}.pem"]) as pem, _in_memory(keys[f"device-{name}.key"]) as key:
            try:
                context.load_cert_chain(pem, key, password=lambda: b"")
            except (ssl.SSLError, OSError, ValueError) as error:
                raise InstallError(
                    f"keys: device-{name}.pem and device-{name}.key are no certificate and its key ({error})"
                ) from error


@contextmanager
def _in_memory(content: bytes) -> Generator[str]:
    """Path of a file that is on no disk, for libraries that only open paths."""
    with open(os.memfd_create("phalanx"), "wb") as file:  # noqa: PTH123 - a descriptor
        file.write(content)
        file.flush()
        yield f"/proc/self/fd/{file.fileno()}"


def _keys(plan: Plan, root: Path) -> dict[str, File | None]:
    names = tuple(sender.name for sender in plan.senders)
    if plan.keys:
        check_keys(plan.keys, names)
        return {f"{KEYS}/{name}": File(content, 0o600) for name, content in plan.keys.items()}
    if missing := [one for one in wanted_keys(names) if not (root / KEYS / one).is_file()]:
        raise InstallError(
            f"/{KEYS}/{missing[0]}: missing; give --keys DIR, made by: phalanx fleet keys DIR --make"
        )
    return {}


def _gone(plan: Plan, root: Path) -> dict[str, File | None]:
    """What belongs to senders that this machine served before and does not now."""
    names = {sender.name for sender in plan.senders}
    gone = [path for path in (root / ETC).glob("*.env") if path.stem not in names]
    gone += [p for p in (root / KEYS).glob("device-*") if p.stem.removeprefix("device-") not in names]
    units = {DROP_IN.format(sender.unit) for sender in plan.senders}
    drop_ins = root.glob(DROP_IN.format("phalanx-slave@*.service"))
    gone += [path for path in drop_ins if str(path.relative_to(root)) not in units]
    return {str(path.relative_to(root)): None for path in sorted(gone)}


def _calibration(plan: Plan, root: Path, record: Record) -> dict[str, File | None]:
    """Files that the PC changed since the last time; what a slave saved stays."""
    return {
        f"{CALIB}/{path}": File(content)
        for path, content in plan.calibration.items()
        if not (root / CALIB / path).exists() or _hash(content) != record.calibration.get(path)
    }


def _own(name: str) -> bytes:
    content = pkgutil.get_data("slave.install", f"files/{name}")  # out of a zip, too
    assert content is not None
    return content


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
