"""Password of the console, made or read at the start.

It is kept as its scrypt hash and compared in constant time.

It is needed wherever the page can be reached from another machine (docs/security.md). scrypt is slow and takes memory
on purpose: who steals the file of the hash tries a dozen passwords a second, not millions.
"""

import hashlib
import hmac
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from common.errors import PhalanxError
from master.outputs.web.listening import read_private, write_private

HASH_FILE = "console.password"
MOST_BYTES = 1024
_ALPHABET = "abcdefghijkmnpqrstuvwxyz23456789"  # 32 that are not taken for one another: 5 bits each
_BYTES = 32  # 32 MiB and about 0.1 s


@dataclass(frozen=True, slots=True)
class PasswordHash:
    """What is kept of a password: `scrypt`, its cost n, r, p, salt and hash."""

    n: int
    r: int
    p: int
    salt: bytes
    digest: bytes

    # 32 MiB and about 0.1 s
    @classmethod
    def of(cls, password: str, n: int = 2**15) -> "PasswordHash":
        """Hash a password with a salt of its own; n is the cost, a power of two."""
        salt = secrets.token_bytes(16)
        r, p = 8, 1
        return cls(n, r, p, salt, _scrypt(password, salt, n, r, p))

    @classmethod
    def parse(cls, text: str, where: str) -> "PasswordHash":
        """Read what `text` wrote.

        Raises:
            PhalanxError: It is something else.
        """
        try:
            kind, n, r, p, salt, digest = text.strip().split("$")
            found = cls(int(n), int(r), int(p), bytes.fromhex(salt), bytes.fromhex(digest))
        except ValueError as error:
            raise PhalanxError(
                f"{where}: not the hash of a password; delete it, and a new one is made"
            ) from error
        most_n = 2**20
        if kind != "scrypt" or not 2 <= found.n <= most_n or len(found.digest) != _BYTES:
            raise PhalanxError(f"{where}: not the hash of a password; delete it, and a new one is made")
        return found

    def text(self) -> str:
        """One line for a file."""
        return f"scrypt${self.n}${self.r}${self.p}${self.salt.hex()}${self.digest.hex()}\n"

    def fits(self, password: str) -> bool:
        """Whether this is the password; takes as long for a wrong one."""
        return hmac.compare_digest(_scrypt(password, self.salt, self.n, self.r, self.p), self.digest)


def new_password() -> str:
    """A password of 100 random bits, in groups that can be read aloud."""
    groups, group = 4, 5  # 100 bits
    return "-".join("".join(secrets.choice(_ALPHABET) for _ in range(group)) for _ in range(groups))


def password_from(file: Path) -> PasswordHash:
    """Of the password that stands in the first line of a file.

    Raises:
        PhalanxError: It cannot be read, others can read it, or the password is too short.
    """
    text = _text(file)
    password = text.splitlines()[0].strip() if text.strip() else ""
    least_characters = 12
    if len(password) < least_characters:
        raise PhalanxError(
            f"{file}: the password needs at least {least_characters} characters in the first line"
        )
    return PasswordHash.of(password)


def kept_password(folder: Path, notify: Callable[[str], None]) -> PasswordHash:
    """Return the hash of the password kept in a folder.

    At the first start the password is made, and printed this once.

    Raises:
        PhalanxError: The file is there and cannot be used, or it cannot be written.
    """
    path = folder / HASH_FILE
    if path.exists():
        notify(
            f"console: the password is the one that was printed when {path} was made; forgotten: delete that file"
        )
        return PasswordHash.parse(_text(path), str(path))
    password = new_password()
    kept = PasswordHash.of(password)
    write_private(path, kept.text().encode())
    notify(f"console: the password is {password}   (shown only now; its hash is kept in {path})")
    return kept


def _text(path: Path) -> str:
    try:
        return read_private(path).decode()
    except UnicodeDecodeError as error:
        raise PhalanxError(f"{path}: not a text") from error


def _scrypt(password: str, salt: bytes, n: int, r: int, p: int) -> bytes:
    memory = 2 * 128 * n * r  # what it needs, twice: OpenSSL counts a little more than that
    return hashlib.scrypt(password.encode(), salt=salt, n=n, r=r, p=p, dklen=_BYTES, maxmem=memory)
