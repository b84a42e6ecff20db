"""Credentials of a process, and where they come from.

The rig key of the datagrams, and a certificate on the bus.

The rig key is 32 random bytes that all processes of a rig share, written as 64 hexadecimal digits. It is in a file that
only its owner can read, or in the environment variable PHALANX_RIG_KEY; never on a command line, where every user of
the machine could see it.

A *keys folder* has all that processes need; `--keys DIR` or the variable PHALANX_KEYS names it. `phalanx fleet keys
make` makes it (docs/keys.md):

| file | what |
|---|---|
| `rig.key` | the rig key |
| `devices.key` | what the secrets of devices follow from (`common.link.link_key`); stays on the PC |
| `ca.pem` | who signed the certificates of this rig; `ca.key`, which signs, stays on the PC |
| `master.pem`, `.key`; `operator.pem`, `.key` | of the master, and of every other program of the PC |
| `devices/NAME.pem`, `.key` | of each device; on the device itself `device-NAME.pem`, or `device.pem` if it is alone |
| `devices/NAME.secret` | of each device, for its datagrams; on the device `device-NAME.secret` or `device.secret` |

Who is given the rig key alone has the secrets that follow from it. Who is given a folder needs what is in it: an older
one, without secrets, is refused with the command that adds them, and does not make the rig weaker in silence.
"""

import secrets
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from common.bus.certificates import MASTER, OPERATOR, shown
from common.errors import BusError, PhalanxError
from common.link.datagram import KEY_BYTES
from common.link.link_key import LinkKey

ENVIRONMENT = "PHALANX_RIG_KEY"
FOLDER = "PHALANX_KEYS"
OPEN = "PHALANX_OPEN"
RIG_KEY, AUTHORITY, DEVICES, DEVICES_KEY = "rig.key", "ca.pem", "devices", "devices.key"
_CREDENTIALS = "CREDENTIALS_DIRECTORY"
_ADVICE = f"write 64 hexadecimal digits, for example from: openssl rand -hex {KEY_BYTES}"


def rig_key(environment: Mapping[str, str], key_file: Path | None = None, keys: Path | None = None) -> bytes:
    """Return the 32 bytes of the rig key.

    Args:
        environment: Of the process: PHALANX_RIG_KEY, else PHALANX_KEYS, where neither of the next two is given.
        key_file: File that has it.
        keys: Keys folder that has it.

    Raises:
        PhalanxError: No key, not 64 hexadecimal digits, or a file that others can read.
    """
    if key_file is None and keys is None and ENVIRONMENT in environment:
        return _parse(environment[ENVIRONMENT], ENVIRONMENT)
    folder = keys or keys_folder(environment)
    path = key_file or (folder / RIG_KEY if folder else None)
    if path is None:
        raise PhalanxError(
            f"no rig key: set {ENVIRONMENT} or give --key-file FILE; {_ADVICE}. Or make a keys folder,"
            f" phalanx fleet keys DIR --make, and give --keys DIR (or set {FOLDER})"
        )
    return _read(path, "the rig key", environment)


def link_key(
    environment: Mapping[str, str],
    key_file: Path | None = None,
    keys: Path | None = None,
    device: str | None = None,
) -> LinkKey:
    """Return what a process seals its datagrams with.

    The rig key as `rig_key` finds it, and its secrets.

    Args:
        environment: As of `rig_key`.
        key_file: File that has the rig key alone.
        keys: Keys folder.
        device: Name of the device that the process is; None: the master, who knows the secrets of all.

    Raises:
        PhalanxError: As `rig_key`; a keys folder without the secret, which is then named with its fix.
    """
    rig = rig_key(environment, key_file, keys)
    folder = keys or (None if ENVIRONMENT in environment else keys_folder(environment))
    if key_file is not None or folder is None:
        return LinkKey(rig)
    if device is None:
        if not (path := folder / DEVICES_KEY).exists():
            raise PhalanxError(
                f"{path}: missing, the folder is older than the secrets of devices: phalanx fleet keys {folder} --make"
                " makes them, phalanx fleet deploy brings each device its own"
            )
        return LinkKey(rig, root=_read(path, "the root of the secrets of devices", environment))
    path = secret_of(folder, device)
    return LinkKey(rig, own=_read(path, f"the secret of {device!r}", environment))


def secret_of(folder: Path, device: str) -> Path:
    """Where a keys folder has the secret of a device.

    Raises:
        PhalanxError: Nowhere.
    """
    places = [place.with_name(f"{place.name}.secret") for place in _places(folder, device)]
    if (found := next((path for path in places if path.exists()), None)) is not None:
        return found
    where = ", ".join(str(path.relative_to(folder)) for path in places)
    raise PhalanxError(
        f"{folder}: no secret of {device!r} ({where}); on the PC: phalanx fleet keys DIR --make --device {device}, then"
        " phalanx fleet deploy, which brings it"
    )


def new_key() -> str:
    """Return a fresh rig key as text, for the environment or a file."""
    return secrets.token_hex(KEY_BYTES)


def keys_folder(environment: Mapping[str, str]) -> Path | None:
    """The keys folder that the environment names, if it does."""
    return Path(environment[FOLDER]) if environment.get(FOLDER) else None


def _others_read(path: Path, what: str, environment: Mapping[str, str]) -> str | None:
    """Return why a private file, which has `what`, is not private.

    Others than its owner can read it; None: all is well.

    In the folder of a service's credentials the mask of an access-control list stands where the group's bits are.
    """
    folder = environment.get(_CREDENTIALS)
    handed = folder is not None and path.parent == Path(folder)
    forbidden = stat.S_IRWXO if handed else stat.S_IRWXG | stat.S_IRWXO
    if path.stat().st_mode & forbidden:
        return f"{path}: others can read {what}; run: chmod 600 {path}"
    return None


@dataclass(frozen=True, slots=True)
class Identity:
    """Who a process is on an encrypted bus.

    Attributes:
        name: Common name of its certificate: `master`, `operator`, or a device.
        authority: Certificate that signed those of the rig (PEM file).
        certificate: Own certificate (PEM file).
        key: Its private key (PEM file).
        devices: Names of devices that the keys folder has certificates of.
    """

    name: str
    authority: Path
    certificate: Path
    key: Path
    devices: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Access:
    """How a process comes to the bus.

    Attributes:
        role: `MASTER`, `OPERATOR`, or the name of a device.
        folder: Keys folder; None: it has none, and can only use a bus that is not encrypted.
        open: Whether a bus that is neither encrypted nor authenticated may leave this machine.
        environment: Of the process.
    """

    role: str
    folder: Path | None
    open: bool
    environment: Mapping[str, str]

    def identity(self) -> Identity:
        """Find the certificate of this role.

        Raises:
            BusError: There is no keys folder, a file is missing, of somebody else, or others can read it.
        """
        if self.folder is None:
            raise BusError(
                f"no keys: give --keys DIR or set {FOLDER}; phalanx fleet keys DIR --make makes them"
            )
        own = self._stem(self.folder)
        found = tuple(sorted(path.stem for path in (self.folder / DEVICES).glob("*.pem")))
        pem, key = (own.with_name(f"{own.name}.{ending}") for ending in ("pem", "key"))
        identity = Identity(self.role, self.folder / AUTHORITY, pem, key, found)
        try:
            name = shown(identity.certificate.read_bytes()).name
            shown(identity.authority.read_bytes())
            fault = _others_read(identity.key, f"the key of {self.role!r}", self.environment)
        except (OSError, ValueError) as error:
            raise BusError(f"{self.folder}: keys of {self.role!r}: {error}") from error
        if fault is not None:
            raise BusError(fault)
        if name != self.role:
            raise BusError(f"{identity.certificate}: is the certificate of {name!r}, not of {self.role!r}")
        return identity

    def _stem(self, folder: Path) -> Path:
        """Where its certificate and key are, without their endings."""
        places = [folder / self.role] if self.role in (MASTER, OPERATOR) else _places(folder, self.role)
        for place in places:
            if place.with_name(f"{place.name}.pem").exists():
                return place
        where = ", ".join(f"{place.relative_to(folder)}.pem" for place in places)
        make = "" if self.role in (MASTER, OPERATOR) else f" --device {self.role}"
        raise BusError(
            f"{folder}: no certificate of {self.role!r} ({where}); make it on the PC that has ca.key:"
            f" phalanx fleet keys {folder} --make{make}"
        )


def access_of(
    environment: Mapping[str, str], role: str, keys: Path | None = None, open_bus: bool = False
) -> Access:
    """Return how a process of `role` accesses the bus.

    From its options `--keys` and `--open` or its environment.
    """
    return Access(
        role, keys or keys_folder(environment), open_bus or environment.get(OPEN) == "1", environment
    )


def _places(folder: Path, device: str) -> list[Path]:
    """Where a folder may have the files of a device, without their endings."""
    return [folder / DEVICES / device, folder / f"device-{device}", folder / "device"]


def _read(path: Path, what: str, environment: Mapping[str, str]) -> bytes:
    try:
        text = path.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise PhalanxError(f"{path}: cannot read {what} ({error}); {_ADVICE}") from error
    if (fault := _others_read(path, what, environment)) is not None:
        raise PhalanxError(fault)
    return _parse(text, str(path))


def _parse(text: str, where: str) -> bytes:
    try:
        key = bytes.fromhex(text.strip())
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise PhalanxError(f"{where}: not a key; {_ADVICE}")
    return key
