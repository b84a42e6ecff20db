"""Keys and certificates are the credentials by which a process joins a rig.

The rig key of the datagrams is 32 random bytes that all processes of a rig share, written as 64 hexadecimal digits. It
is in a file that only its owner can read, or in the environment variable PHALANX_RIG_KEY; never on a command line,
where every user of the machine could see it.

On the bus each process proves who it is by a certificate whose common name is its role (`master`, `operator`) or, of a
device, its name. The rig is its own certificate authority. Only the master's may be shown by the side that listens
(extended key usage serverAuth): whoever steals a camera's key cannot play the master before the other cameras.
Certificates are valid from 1970 on, because a Raspberry Pi has no clock battery: without network time it starts at the
time of its last shutdown or of its system image, and would refuse each certificate that is younger. They end after ten
years: `phalanx fleet keys --renew` makes new ones.

A *keys folder* has all that processes need; `--keys DIR` or the variable PHALANX_KEYS names it (docs/keys.md):

| file | what |
|---|---|
| `rig.key` | the rig key |
| `devices.key` | what the secrets of devices follow from (`common.link.datagram`); stays on the PC |
| `ca.pem` | who signed the certificates of this rig; `ca.key`, which signs, stays on the PC |
| `master.pem`, `.key`; `operator.pem`, `.key` | of the master, and of every other program of the PC |
| `devices/NAME.pem`, `.key` | of each device; on the device itself `device-NAME.pem`, or `device.pem` if it is alone |
| `devices/NAME.secret` | of each device, for its datagrams; on the device `device-NAME.secret` or `device.secret` |

Who is given the rig key alone has the secrets that follow from it. A folder without secrets is refused with the
command that adds them, and does not make the rig weaker in silence.
"""

import os
import secrets
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from common.errors import BusError, PhalanxError
from common.link.datagram import KEY_BYTES, LinkKey

MASTER, OPERATOR = "master", "operator"
# Bits of a private file's mode that must not be set; Windows has other rules and shows them all.
OTHERS = 0 if os.name == "nt" else stat.S_IRWXG | stat.S_IRWXO
LIFE = timedelta(days=3652)
FIRST_DAY = datetime(1970, 1, 1, tzinfo=UTC)
CLOCK_FIX = (
    "set the clock (timedatectl shows it; timedatectl set-ntp true, chrony, or a clock battery keep it); if it is "
    "right, make new certificates: phalanx fleet keys DIR --renew, then phalanx fleet deploy"
)


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A certificate, for everybody, and its private key, for its owner; both as PEM."""

    certificate: bytes
    key: bytes


def new_authority(now: datetime) -> KeyPair:
    """Return a new certificate authority (ECDSA P-256) that signs processes only."""
    private = ec.generate_private_key(ec.SECP256R1())
    name = _named("Phalanx rig")
    draft = _draft(name, name, private.public_key(), now).add_extension(
        x509.BasicConstraints(ca=True, path_length=0), critical=True
    )
    usage = _usage(key_cert_sign=True, crl_sign=True)
    return _signed(draft.add_extension(usage, critical=True), private, private)


def issue(authority: KeyPair, name: str, now: datetime) -> KeyPair:
    """Return a new certificate for a process or device; only `MASTER`'s may listen.

    Raises:
        PhalanxError: The authority's PEM is broken.
    """
    try:
        issuer = x509.load_pem_x509_certificate(authority.certificate)
        signer = serialization.load_pem_private_key(authority.key, None)
    except ValueError as error:
        raise PhalanxError(
            f"ca.pem or ca.key: broken ({error}); make a new keys folder: phalanx fleet keys --make"
        ) from error
    assert isinstance(signer, ec.EllipticCurvePrivateKey)  # we made it
    private = ec.generate_private_key(ec.SECP256R1())
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if name == MASTER:
        uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
    draft = (
        _draft(_named(name), issuer.subject, private.public_key(), now)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(digital_signature=True), critical=True)
        .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False
        )
    )
    return _signed(draft, signer, private)


@dataclass(frozen=True, slots=True)
class Shown:
    """Contents of a certificate.

    Attributes:
        name: Role or device.
        listens: Whether it may be shown by the side that listens.
        since, until: Validity.
        fingerprint: First 16 hexadecimal digits of its SHA-256, to distinguish two of one name.
    """

    name: str
    listens: bool
    since: datetime
    until: datetime
    fingerprint: str

    def invalid_at(self, now: datetime, whose: str) -> str:
        """Why the certificate is not valid at `now` (with its zone); empty: it is valid.

        `whose`: subject of the sentence, for example `the certificate of 'left'`.
        """
        if self.since <= now <= self.until:
            return ""
        which = "no longer" if now > self.until else "not yet"
        return (
            f"{whose} is {which} valid: the clock of this machine says {now:%Y-%m-%d %H:%M} UTC, the certificate is "
            f"valid from {self.since:%Y-%m-%d} to {self.until:%Y-%m-%d}"
        )


def shown(pem: bytes) -> Shown:
    """Read a certificate; raises ValueError if it is none."""
    certificate = x509.load_pem_x509_certificate(pem)
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    try:
        uses = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        listens = ExtendedKeyUsageOID.SERVER_AUTH in uses
    except x509.ExtensionNotFound:
        listens = False
    return Shown(
        str(names[0].value) if names else "",
        listens,
        certificate.not_valid_before_utc,
        certificate.not_valid_after_utc,
        certificate.fingerprint(hashes.SHA256()).hex()[:16],
    )


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _draft(
    subject: x509.Name, issuer: x509.Name, public: ec.EllipticCurvePublicKey, now: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(FIRST_DAY)
        .not_valid_after(now + LIFE)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
    )


def _usage(
    *, digital_signature: bool = False, key_cert_sign: bool = False, crl_sign: bool = False
) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=digital_signature,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=key_cert_sign,
        crl_sign=crl_sign,
        encipher_only=False,
        decipher_only=False,
    )


def _signed(
    draft: x509.CertificateBuilder, signer: ec.EllipticCurvePrivateKey, private: ec.EllipticCurvePrivateKey
) -> KeyPair:
    certificate = draft.sign(signer, hashes.SHA256())
    return KeyPair(
        certificate.public_bytes(serialization.Encoding.PEM),
        private.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        ),
    )


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
    """Return what a process seals its datagrams with: the rig key, and its secrets.

    Args:
        environment, key_file, keys: As of `rig_key`; the file has the rig key alone.
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
    """Where a keys folder has the secret of a device; raises PhalanxError if nowhere."""
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
    """Why others than the owner can read a private file, which has `what`, or None.

    In the folder of a service's credentials the mask of an access-control list stands where the group's bits are.
    """
    folder = environment.get(_CREDENTIALS)
    handed = folder is not None and path.parent == Path(folder)
    if path.stat().st_mode & (OTHERS & stat.S_IRWXO if handed else OTHERS):
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
        if self.folder.is_dir() and not os.access(self.folder, os.R_OK | os.X_OK):
            raise BusError(
                f"{self.folder}: these keys are of root or of another user: sudo, or give other --keys"
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
    """How a process of `role` accesses the bus, by its options or environment."""
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
