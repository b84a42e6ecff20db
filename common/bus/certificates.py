"""Certificates of a rig: which processes may join its bus.

The rig is its own certificate authority, which signs nothing outside the rig.

Each process proves who it is by a certificate whose common name is its role (`master`, `operator`) or, of a device, its
name on the bus. Only the master's may be shown by the side that listens (extended key usage serverAuth): whoever steals
a camera's key cannot play the master before the other cameras.

They are valid from 1970 on, because a Raspberry Pi has no clock battery: where the network does not provide the time,
it starts at the time of its last shutdown or of its system image, and would refuse each certificate that is younger.
They end ten years after they were made: `phalanx fleet keys --renew` makes new ones.
"""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from common.errors import PhalanxError

MASTER, OPERATOR = "master", "operator"
LIFE = timedelta(days=3652)
FIRST_DAY = datetime(1970, 1, 1, tzinfo=UTC)
CLOCK_FIX = (
    "set the clock (timedatectl shows it; timedatectl set-ntp true, chrony, or a clock battery keep it); if it is "
    "right, make new certificates: phalanx fleet keys DIR --renew, then phalanx fleet deploy"
)


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A certificate and its private key, both as PEM.

    Attributes:
        certificate: May be shown to everybody.
        key: Must not.
    """

    certificate: bytes
    key: bytes


def new_authority(now: datetime) -> KeyPair:
    """Return a new certificate authority (ECDSA P-256).

    It may sign certificates of processes, but no other authority.
    """
    private = ec.generate_private_key(ec.SECP256R1())
    name = _named("Phalanx rig")
    draft = _draft(name, name, private.public_key(), now).add_extension(
        x509.BasicConstraints(ca=True, path_length=0), critical=True
    )
    usage = _usage(key_cert_sign=True, crl_sign=True)
    return _signed(draft.add_extension(usage, critical=True), private, private)


def issue(authority: KeyPair, name: str, now: datetime) -> KeyPair:
    """Return a new certificate for the process or device `name`.

    Only the certificate of `MASTER` may listen.

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
        since: Beginning of its validity.
        until: End of its validity.
        fingerprint: First 16 hexadecimal digits of its SHA-256, to distinguish two of one name.
    """

    name: str
    listens: bool
    since: datetime
    until: datetime
    fingerprint: str

    def invalid_at(self, now: datetime, whose: str) -> str:
        """Return why the certificate is not valid at `now`, with its validity period.

        Empty: it is valid.

        Args:
            now: Time of the clock of this machine, with its zone.
            whose: Subject of the sentence, for example `the certificate of 'left'`.
        """
        if self.since <= now <= self.until:
            return ""
        which = "no longer" if now > self.until else "not yet"
        return (
            f"{whose} is {which} valid: the clock of this machine says {now:%Y-%m-%d %H:%M} UTC, the certificate is "
            f"valid from {self.since:%Y-%m-%d} to {self.until:%Y-%m-%d}"
        )


def shown(pem: bytes) -> Shown:
    """Read a certificate.

    Raises:
        ValueError: It is none.
    """
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
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        ),
    )
