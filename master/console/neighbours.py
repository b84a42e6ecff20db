"""Local user at the other end of a connection that never left this machine.

Linux reports it in /proc/net.
"""

import os
import sys
from ipaddress import IPv6Address, ip_address
from pathlib import Path

_TABLES = ("tcp", "tcp6")
_WORD = 8  # hexadecimal digits of 32 bits, which the kernel writes in the machine's own byte order
Peer = tuple[str, int]


def same_user(client: Peer, server: Peer, net: Path = Path("/proc/net")) -> bool:
    """Return whether the client belongs to this process's user, or to root.

    True where the system does not report it.

    Args:
        client, server: Address and port of both ends, as the server sees them.
        net: Folder with the kernel's tables of sockets.
    """
    tables = [path for name in _TABLES if (path := net / name).exists()]
    if not tables:
        return True  # no Linux
    wanted = (_plain(client), _plain(server))
    ports = f":{client[1]:04X} ", f":{server[1]:04X} "  # thousands of lines are looked at quickly by these
    for path in tables:
        for line in path.read_text(encoding="ascii").splitlines()[1:]:
            if ports[0] not in line or ports[1] not in line:
                continue
            fields = line.split()
            if (_socket(fields[1]), _socket(fields[2])) == wanted:
                root = 0
                return int(fields[7]) in (os.getuid(), root)
    return False


def _plain(peer: Peer) -> Peer:
    address = ip_address(peer[0].split("%", 1)[0])
    if isinstance(address, IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped
    return str(address), peer[1]


def _socket(text: str) -> Peer:
    """ADDRESS:PORT as the kernel writes it."""
    digits, _, port = text.partition(":")
    words = (digits[k : k + _WORD] for k in range(0, len(digits), _WORD))
    packed = b"".join(int(word, 16).to_bytes(4, sys.byteorder) for word in words)
    return _plain((str(ip_address(packed)), int(port, 16)))
