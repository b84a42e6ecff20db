"""The rig key: the one secret that the processes of a rig share, and where it comes from.

It is 32 random bytes, written as 64 hexadecimal digits, in the environment variable
PHALANX_RIG_KEY or in a file that only its owner can read. It is never on a command line, where
every user of the machine could see it.
"""

import secrets
import stat
from collections.abc import Mapping
from pathlib import Path

from common.datagram import KEY_BYTES
from common.errors import PhalanxError

ENVIRONMENT = "PHALANX_RIG_KEY"
_ADVICE = f"write 64 hexadecimal digits, for example from: openssl rand -hex {KEY_BYTES}"


def rig_key(environment: Mapping[str, str], key_file: Path | None = None) -> bytes:
    """Return the 32 bytes of the rig key: from `key_file` if given, else from the environment.

    Raises:
        PhalanxError: No key, not 64 hexadecimal digits, or a file that others can read.
    """
    if key_file is not None:
        try:
            mode = key_file.stat().st_mode
            text = key_file.read_text(encoding="ascii")
        except (OSError, UnicodeDecodeError) as error:
            raise PhalanxError(f"{key_file}: cannot read the rig key ({error}); {_ADVICE}") from error
        if mode & (stat.S_IRWXG | stat.S_IRWXO):
            raise PhalanxError(f"{key_file}: others can read the rig key; run: chmod 600 {key_file}")
        return _parse(text, str(key_file))
    if ENVIRONMENT not in environment:
        raise PhalanxError(f"no rig key: set {ENVIRONMENT} or give --key-file FILE; {_ADVICE}")
    return _parse(environment[ENVIRONMENT], ENVIRONMENT)


def new_key() -> str:
    """Return a fresh rig key as text, for the environment or a file."""
    return secrets.token_hex(KEY_BYTES)


def _parse(text: str, where: str) -> bytes:
    try:
        key = bytes.fromhex(text.strip())
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise PhalanxError(f"{where}: not a rig key; {_ADVICE}")
    return key
