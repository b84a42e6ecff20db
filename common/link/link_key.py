"""Keys that seal the datagrams of a rig.

The rig key, which all share, and a secret of each device, which no other has.

Whoever has the rig key can make and read handshakes. What a device sends in a session needs its secret as well, which
only it and the master know: a device that was stolen reads and forges no datagram of another.

The secret of a device follows from `devices.key`, 32 random bytes that never leave the PC. Where there is the rig key
alone (a simulation, a closed laboratory), secrets follow from that: who has it has them all.
"""

from dataclasses import dataclass, field

from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from common.link.datagram import KEY_BYTES


def derive(key: bytes, length: int, salt: bytes, info: bytes) -> bytes:
    """Return `length` bytes that follow from `key`, by HKDF-SHA256 (RFC 5869)."""
    return HKDF(algorithm=SHA256(), length=length, salt=salt, info=info).derive(key)


def device_secret(root: bytes, name: str) -> bytes:
    """Return the secret of the device `name` (32 bytes).

    Derived from `devices.key` or the rig key.
    """
    return derive(root, KEY_BYTES, b"", b"phalanx device " + name.encode())


@dataclass(frozen=True, slots=True)
class LinkKey:
    """What one process has of the secrets of a rig, 32 bytes each.

    Attributes:
        rig: Rig key.
        root: `devices.key`, of a PC; None: the secrets follow from the rig key, or there is `own`.
        own: Secret of the one device that this process is; None: secrets follow from the root.
    """

    rig: bytes = field(repr=False)
    root: bytes | None = field(default=None, repr=False)
    own: bytes | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Refuse a key of wrong length.

        Raises:
            ValueError: One is not 32 bytes.
        """
        for what, key in (
            ("rig key", self.rig),
            ("devices.key", self.root),
            ("secret of a device", self.own),
        ):
            if key is not None and len(key) != KEY_BYTES:
                raise ValueError(f"{what} of {len(key)} bytes, must be {KEY_BYTES}")

    @property
    def has_secrets(self) -> bool:
        """Return whether device secrets are independent of the rig key alone.

        If so, one device cannot make the secrets of others.
        """
        return self.root is not None or self.own is not None

    def secret(self, name: str) -> bytes:
        """Return the secret of the device `name` (32 bytes)."""
        return self.own if self.own is not None else device_secret(self.root or self.rig, name)
