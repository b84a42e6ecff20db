"""The payload is what goes to a machine: bundle, keys, files and wheels.

Hosts of a command line are assigned to the cameras of a rig's file.

The bundle, by the input of ssh, is installer, keys of that machine and files of the rig as one zip in memory. Nothing
of it touches a disk there before the installer writes it: a dry run writes nothing, no key is left in a file.

Wheels for another machine, for its Python and processor, are gathered on this one: downloaded once for each kind of
machine, and kept below ~/.cache/phalanx.
"""

import hashlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import zipfile
from base64 import urlsafe_b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from typing import cast

from deploy.remote import DeployError

_HOST = re.compile(r"(?:[A-Za-z0-9._-]+@)?[A-Za-z0-9.:-]+")


@dataclass(frozen=True, slots=True)
class Target:
    """A machine, and the cameras and IMUs of the rig that it serves."""

    host: str
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RigFile:
    """A rig's file, as far as it matters here."""

    name: str
    kind: str
    hand: str
    cameras: tuple[str, ...]
    imu: str | None
    imu_placed: bool  # whether its orientations on the palm and to the world are known
    objects: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """All that send."""
        return self.cameras + (() if self.imu is None else (self.imu,))

    @property
    def files(self) -> tuple[str, ...]:
        """Its files below calib_json."""
        cameras = [f"cameras/{one}.json" for one in self.cameras]
        objects = [f"objects/{one}.json" for one in self.objects]
        return (f"rigs/{self.name}.json", *cameras, f"hands/{self.hand}.json", *objects)


def read_rig(calibration: Path, name: str) -> RigFile:
    """Read `rigs/NAME.json`.

    Raises:
        DeployError: It is missing or broken.
    """
    path = calibration / "rigs" / f"{name}.json"
    try:
        rig = cast(dict[str, object], json.loads(path.read_text()))
        cameras = tuple(str(one) for one in cast(list[object], rig["cameras"]))
        objects = tuple(str(one) for one in cast(list[object], rig.get("objects") or []))
        imu = cast(dict[str, object], rig.get("imu") or {})
        imu_name = str(imu.get("name", "imu")) if imu else None
        placed = imu.get("q_palm_imu") is not None and imu.get("q_rig_world") is not None
        return RigFile(name, str(rig["kind"]), str(rig["hand"]), cameras, imu_name, placed, objects)
    except (OSError, ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
        raise DeployError(
            f"{path}: cannot read the rig ({error}); give --calibration DIR and --rig NAME"
        ) from error


def targets_of(hosts: Sequence[str], rig: RigFile) -> list[Target]:
    """Parse `HOST` or `NAME[+NAME...]=HOST` of each host.

    Hosts without a name take the rig's cameras in their order. The IMU of a rig goes to the host of its first
    camera, unless it is named.

    Raises:
        DeployError: A name is none of the rig's, stands twice, or there are more hosts than cameras.
    """
    split = [host.rpartition("=") for host in hosts]
    named = [name for names, _, _ in split for name in names.split("+") if names]
    free = [camera for camera in rig.cameras if camera not in named]
    targets: list[Target] = []
    for names, _, host in split:
        if not _HOST.fullmatch(host) or host.startswith("-"):
            raise DeployError(f"{host!r}: not a host; write HOST, USER@HOST or NAME=HOST")
        if not names and not free:
            raise DeployError(
                f"{host}: rig {rig.name!r} has no camera left for it; it has {', '.join(rig.cameras)}"
            )
        own = tuple(names.split("+")) if names else (free.pop(0),)
        if rig.imu is not None and rig.imu not in named and own[0] == rig.cameras[0]:
            own += (rig.imu,)
        targets.append(Target(host, own))
    given = [name for target in targets for name in target.names]
    for name in given:
        if name not in rig.names:
            raise DeployError(
                f"rig {rig.name!r} has no camera or IMU {name!r}; it has {', '.join(rig.names)}"
            )
        if given.count(name) > 1:
            raise DeployError(f"{name}: stands twice; each camera has one host")
    if len({target.host for target in targets}) < len(targets):
        raise DeployError("a host stands twice: write NAME+NAME=HOST for two cameras of one machine")
    return targets


ROOT = Path(__file__).resolve().parents[1]
KEYS, CALIBRATION = "payload/keys/", "payload/calib_json/"
SENSOR_FILES = "*-*x*.json"  # cameras of any rig: the doctor there names those that fit
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


def command(arguments: Sequence[str]) -> list[str]:
    """The command line there, which takes the zip as its input."""
    return ["python3", "-c", _BOOT, *arguments]


def bundle(
    keys: Path | None = None,
    names: Sequence[str] = (),
    calibration: Path | None = None,
    rig: RigFile | None = None,
) -> bytes:
    """The zip: installer, keys and files that the machine needs; or DeployError."""
    package = ROOT / "slave" / "install"
    installer = [ROOT / "slave" / "__init__.py", *package.glob("*.py"), *(package / "files").glob("*")]
    files = {path.relative_to(ROOT).as_posix(): path for path in installer}
    if keys is not None:
        own = ["rig.key", "ca.pem", *(f"devices/{name}.{kind}" for name in names for kind in _OWN)]
        files |= {KEYS + name: keys / name for name in own}
    if calibration is not None and rig is not None:
        sensors = [f"cameras/{path.name}" for path in (calibration / "cameras").glob(SENSOR_FILES)]
        files |= {CALIBRATION + name: calibration / name for name in (*rig.files, *sensors)}
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, path in files.items():
            try:
                archive.writestr(name, path.read_bytes())
            except OSError as error:
                raise DeployError(f"{path}: {error.strerror}; it has to go to the machine") from error
    return packed.getvalue()


NAME = "phalanx-hand"
PACKAGES = ("slave", "common", "master", "deploy")
_GLIBC = ("2_17", "2_24", "2_26", "2_27", "2_28", "2_31", "2_34", "2_35")  # Bookworm has 2.36
_WHEN = (1980, 1, 1, 0, 0, 0)  # a wheel of the same content is the same file
_LOCK = threading.Lock()


@dataclass(frozen=True, slots=True)
class Kind:
    """What wheels have to fit to.

    Attributes:
        machine: aarch64 or x86_64.
        python: Version, as 3.13.
        more: Requirements besides ours.
        extras: Of ours.
    """

    machine: str
    python: str
    more: tuple[str, ...] = ()
    extras: tuple[str, ...] = ()


def cache() -> Path:
    """Where wheels are kept."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "phalanx"


@dataclass(frozen=True, slots=True)
class Wheels:
    """Wheels, ours among them, and their release: our version and a hash of them all."""

    files: tuple[Path, ...]
    release: str

    @property
    def size_mb(self) -> float:
        """How much has to be sent."""
        return sum(file.stat().st_size for file in self.files) * 1e-6


def wheelhouse(kind: Kind, given: Path | None, notify: Callable[[str], None]) -> Wheels:
    """The wheels for machines of this kind, or DeployError.

    `given` is a folder that the user made; ours is added if it is missing there. None: they are downloaded.
    """
    try:
        with _LOCK:  # the second machine of a kind waits for the first
            folder = _downloaded(kind, notify) if given is None else given
            files = sorted(folder.glob("*.whl"))
            if not files:
                raise DeployError(f"--wheelhouse {given}: no wheels in it")
            if given is not None and (wrong := [one.name for one in files if not fits(one.name, kind)]):
                raise DeployError(
                    f"--wheelhouse {given}: {wrong[0]} is not for {kind.machine} with Python {kind.python}; "
                    f"those that are: phalanx fleet wheels DIR --machine {kind.machine} --python {kind.python}"
                )
            if not any(file.name.startswith("phalanx_hand-") for file in files):
                files.append(own_wheel())
            files.sort(key=lambda file: file.name)  # as the installer there names it, too
            digest = hashlib.sha256()
            for file in files:
                digest.update(file.name.encode() + hashlib.sha256(file.read_bytes()).digest())
    except OSError as error:
        raise DeployError(f"wheels: {error.filename or cache()}: {error.strerror or error}") from error
    versions = [file.name.split("-")[1] for file in files if file.name.startswith("phalanx_hand-")]
    return Wheels(tuple(files), f"{versions[-1]}-{digest.hexdigest()[:8]}")


def fits(wheel: str, kind: Kind) -> bool:
    """Whether a wheel fits such a machine, by the tags of its name (PEP 427)."""
    parts = wheel.removesuffix(".whl").split("-")
    if len(parts) < 5:
        return False
    pythons, abis, platforms = parts[-3:]
    if platforms != "any" and not any(one.endswith(kind.machine) for one in platforms.split(".")):
        return False
    own = int(kind.python.replace(".", "", 1))
    for python in pythons.split("."):
        number = int(re.sub(r"\D", "", python) or 0)
        if python.startswith("py") and number in (3, own):
            return True
        if python.startswith("cp") and (number == own or ("abi3" in abis and number <= own)):
            return True
    return False


def export(kind: Kind, folder: Path, notify: Callable[[str], None]) -> Wheels:
    """Put the wheels for machines without network into a new folder, or DeployError."""
    if folder.exists() and any(folder.iterdir()):
        raise DeployError(f"{folder}: is not empty")
    wheels = wheelhouse(kind, None, notify)
    folder.mkdir(parents=True, exist_ok=True)
    for file in wheels.files:
        shutil.copy2(file, folder)
    return wheels


def own_wheel() -> Path:
    """Make the wheel of this program as it is, without a network or a build."""
    ours = _ours()
    stem = f"{NAME.replace('-', '_')}-{ours.version}"
    info = f"{stem}.dist-info"
    sources = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*"))]
    files = {
        path.relative_to(ROOT).as_posix(): path.read_bytes()
        for path in sources
        if path.is_file() and "__pycache__" not in path.parts
    }
    for name in ("METADATA", "entry_points.txt"):
        files[f"{info}/{name}"] = (ours.read_text(name) or "").encode()
    files[f"{info}/WHEEL"] = (
        b"Wheel-Version: 1.0\nGenerator: phalanx\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    )
    rows: list[str] = []
    for name, content in files.items():
        digest = urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
        rows.append(f"{name},sha256={digest},{len(content)}")
    files[f"{info}/RECORD"] = "\n".join([*rows, f"{info}/RECORD,,", ""]).encode()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, _WHEN), content, zipfile.ZIP_DEFLATED)
    # In a folder of its hash: another program of another state does not change it while it is sent.
    wheel = cache() / "own" / hashlib.sha256(packed.getvalue()).hexdigest()[:12] / f"{stem}-py3-none-any.whl"
    if not wheel.is_file():
        wheel.parent.mkdir(parents=True, exist_ok=True)
        fresh = wheel.with_name(f".{os.getpid()}.new")
        fresh.write_bytes(packed.getvalue())
        fresh.replace(wheel)
    return wheel


def _ours() -> Distribution:
    try:
        return distribution(NAME)
    except PackageNotFoundError as error:
        raise DeployError(
            f"{NAME} is not installed here (pip install .), so what it needs is not known"
        ) from error


def _downloaded(kind: Kind, notify: Callable[[str], None]) -> Path:
    requirements = [*_requirements(kind.extras), *kind.more, "pip"]
    places = (ROOT / "deploy" / "constraints.txt", ROOT / "constraints.txt")
    limits = next((path for path in places if path.is_file()), None)  # tested versions, where they are known
    key = "\n".join([*requirements, *([] if limits is None else [limits.read_text()])])
    digest = hashlib.sha256(key.encode()).hexdigest()[:12]
    folder = cache() / f"{kind.machine}-{kind.python}-{digest}"
    if not folder.is_dir():
        notify(f"downloading wheels for {kind.machine}, Python {kind.python}")
        fresh = folder.with_name(f".{folder.name}.{os.getpid()}")
        shutil.rmtree(fresh, ignore_errors=True)
        fresh.mkdir(parents=True)
        try:
            _download(kind, requirements, limits, fresh)
            fresh.rename(folder)
        except OSError:
            if not folder.is_dir():  # else another program was quicker
                raise
        finally:
            shutil.rmtree(fresh, ignore_errors=True)
    return folder


def _download(kind: Kind, requirements: list[str], limits: Path | None, folder: Path) -> None:
    platforms = [f"manylinux_{glibc}_{kind.machine}" for glibc in reversed(_GLIBC)]
    platforms += [f"manylinux2014_{kind.machine}"]
    words = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check"]
    words += [f"--dest={folder}", "--only-binary=:all:", "--implementation=cp"]
    words += [f"--python-version={kind.python}"]
    words += [word for platform in platforms for word in ("--platform", platform)]
    words += ["-c", str(limits)] if limits is not None else []
    download_s = 600.0
    try:
        done = subprocess.run(
            [*words, *requirements], capture_output=True, text=True, timeout=download_s, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise DeployError(f"pip download: no end after {download_s:.0f} s; is there a network?") from error
    if done.returncode != 0:
        errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR:")]
        why = errors[-1].removeprefix("ERROR: ") if errors else done.stderr[-300:].strip()
        raise DeployError(f"pip download: {why}; --wheelhouse DIR takes wheels you have")


def _requirements(extras: tuple[str, ...]) -> list[str]:
    """What a slave needs, by our own metadata, and by those extras."""
    found: list[str] = []
    for line in _ours().requires or []:
        requirement, _, marker = (part.strip() for part in line.partition(";"))
        extra = re.search(r"extra == ['\"]([^'\"]+)", marker)
        if extra is None or extra[1] in extras:
            found.append(requirement)
    return found
