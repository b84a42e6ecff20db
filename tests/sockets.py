"""What a process and its children really listen on, as the kernel tells, and what docs/security.md says they may."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path

from common.command_line import Family
from master.cli.table import TABLE

FAMILIES = {word for entry in TABLE if isinstance(entry, Family) for word in entry.name.split()}
PAGE = Path(__file__).resolve().parents[1] / "docs" / "security.md"
_LISTENS = {
    "tcp": "0A",
    "udp": "07",
}  # states of /proc/net: a TCP socket listens, a UDP socket is not connected
_WORD = 8


@dataclass(frozen=True, slots=True)
class Listener:
    """One socket that takes what comes: `program` as `master run`, `protocol` tcp or udp."""

    program: str
    protocol: str
    address: str
    port: int

    @property
    def here(self) -> bool:
        """Whether only this machine reaches it."""
        return ip_address(self.address).is_loopback


def family(pid: int) -> Iterator[int]:
    """A process and all that it started."""
    yield pid
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in children.read_text().split():
            yield from family(int(child))


def listeners(pid: int) -> set[Listener]:
    """Of a process and all that it started."""
    found: set[Listener] = set()
    for one in family(pid):
        try:
            inodes = {str(fd.readlink()) for fd in Path(f"/proc/{one}/fd").iterdir()}
            words = Path(f"/proc/{one}/cmdline").read_bytes().decode(errors="replace").split("\0")
            own = [socket for socket in _sockets(one) if f"socket:[{socket[3]}]" in inodes]
        except OSError:
            continue  # it has just ended
        found |= {Listener(_program(words), protocol, address, port) for protocol, address, port, _ in own}
    return found


def _sockets(pid: int) -> Iterator[tuple[str, str, int, str]]:
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == _LISTENS[table[:3]]:
                digits, _, port = fields[1].partition(":")
                words = (digits[k : k + _WORD] for k in range(0, len(digits), _WORD))
                packed = b"".join(int(word, 16).to_bytes(4, "little") for word in words)
                yield table[:3], str(ip_address(packed)), int(port, 16), fields[9]


def _program(words: list[str]) -> str:
    """`master run` of `python -m master run …` or of a script of ours; `master status` of `master fleet status`."""
    for k, word in enumerate(words):
        side = Path(word).name.removeprefix("phalanx-").replace("phalanx", "master")
        if side in ("master", "slave"):
            names = words[k + 1 :]
            while names[:1] and names[0] in FAMILIES:
                names = names[1:]
            return " ".join([side, *names[:1]])
    return Path(words[0]).name


@dataclass(frozen=True, slots=True)
class Row:
    """One row of the page's table of sockets."""

    program: str
    protocol: str
    address: str  # with its port

    @property
    def anywhere(self) -> bool:
        """Whether other machines may reach it."""
        return not ip_address(self.address.rpartition(":")[0].strip("[]")).is_loopback


def rows() -> list[Row]:
    """The table: `| program | protocol address:port | ...`."""
    found = re.findall(r"^\| `([a-z]+ [a-z*]+)` \| (tcp|udp) `([^`]+)` \|", PAGE.read_text(), re.MULTILINE)
    return [Row(*words) for words in found]


def undocumented(found: set[Listener], table: list[Row]) -> list[Listener]:
    """What listens without a row, or further than its row says."""
    return [
        one
        for one in found
        if not any(
            row.protocol == one.protocol
            and one.program in (row.program, row.program.replace("*", one.program.split()[-1]))
            and (one.here or row.anywhere)
            for row in table
        )
    ]
