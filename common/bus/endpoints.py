"""Bus endpoints: which may leave the machine, and which one a program uses.

Also where a listener can be reached.

`tls/HOST:PORT` (or `quic/`) is encrypted, and both sides prove who they are. `tcp/` is neither: it stays on a loopback
address, which other machines cannot reach, unless `--open` is given.
"""

from collections.abc import Mapping
from ipaddress import AddressValueError, IPv4Address, ip_address

from common.bus.keys import OPEN, keys_folder
from common.errors import BusError

SCHEMES = ("tcp", "tls", "quic")
ANYWHERE = "0.0.0.0"


def encrypted(endpoint: str) -> bool:
    """Whether both sides of the endpoint need a certificate of the rig."""
    return endpoint.split("/", 1)[0] in ("tls", "quic")


def check(endpoint: str, open_bus: bool) -> None:
    """Refuse an invalid endpoint, or one that sends plain text off this machine.

    Args:
        endpoint: As `tls/192.168.1.2:47802`.
        open_bus: Whether plain text may leave it.

    Raises:
        BusError: It must not; the message states what to do.
    """
    if endpoint.split("/", 1)[0] not in SCHEMES:
        raise BusError(f"bus endpoint {endpoint!r}: must begin with {', '.join(s + '/' for s in SCHEMES)}")
    if "#" in endpoint:  # zenoh would take other certificates from there, or do without
        raise BusError(f"bus endpoint {endpoint!r}: must have no settings of its own behind #")
    if encrypted(endpoint) or open_bus or loopback(endpoint):
        return
    raise BusError(
        f"bus endpoint {endpoint!r}: is neither encrypted nor authenticated, and leaves this machine. Write"
        f" tls/{endpoint.split('/', 1)[1]} and give keys (phalanx fleet keys DIR --make, then --keys DIR); or, in a"
        f" closed laboratory where everybody is trusted, --open (or {OPEN}=1) on both sides"
    )


def loopback(endpoint: str) -> bool:
    """Return whether the endpoint's address is reachable from this machine only."""
    host = host_of(endpoint)
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def host_of(endpoint: str) -> str:
    """The host of an endpoint: `tls/[::1]:47802` -> `::1`."""
    return endpoint.split("/", 1)[-1].split("?")[0].split("#")[0].rpartition(":")[0].strip("[]")


def port_of(endpoint: str) -> int:
    """The port of an endpoint; 0: it has none."""
    text = endpoint.split("?")[0].split("#")[0].rpartition(":")[2]
    return int(text) if text.isdecimal() else 0


def default_bus(environment: Mapping[str, str]) -> str:
    """Return the bus of a program that was given none.

    Encrypted where there are keys, on this machine in any case.
    """
    port = 47802
    return f"{'tcp' if keys_folder(environment) is None else 'tls'}/127.0.0.1:{port}"


def reached_at(endpoint: str, address: str) -> str:
    """Return the address of a listener that listens on all addresses of a machine.

    `address` is the machine's address from which it was received.
    """
    if host_of(endpoint) != ANYWHERE:
        return endpoint
    try:
        IPv4Address(address)
    except AddressValueError:
        return endpoint
    return endpoint.replace(ANYWHERE, address, 1)
