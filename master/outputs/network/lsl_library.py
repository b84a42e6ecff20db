"""Parts of pylsl that Phalanx uses.

Its interface as types, and the one place that imports it.

It needs liblsl, a C++ library that its wheels bring for the usual machines only, so it is imported when the output is
switched on. Names and meanings were read in pylsl 1.18 (info.py, outlet.py, util.py, lib/__init__.py).
"""

import importlib
from collections.abc import Sequence
from typing import Protocol, cast

from common.errors import PhalanxError

INSTALL = (
    "pip install 'phalanx-hand[lsl]'; where that brings no liblsl, install it"
    " (https://github.com/sccn/liblsl/releases) and name it in the variable PYLSL_LIB"
)
PORTS = range(16572, 16604)  # where liblsl listens for who reads a stream, and for who compares clocks
# Discovery by a datagram on the loopback interface, nothing joined and nothing sent on any other.
_MACHINE = """[log]
level = -2
[ports]
IPv6 = disable
AllowRandomPorts = 0
[multicast]
ResolveScope = machine
ListenAddress = 127.0.0.1
"""


class XmlElement(Protocol):
    """`pylsl.XMLElement`: the description of a stream."""

    def append_child(self, name: str) -> "XmlElement":
        """A new element below this one."""
        ...

    def append_child_value(self, name: str, value: str) -> "XmlElement":
        """A new element with a text below this one; returns this one."""
        ...


class Info(Protocol):
    """`pylsl.StreamInfo`: what a stream is."""

    def desc(self) -> XmlElement:
        """Its description."""
        ...


class Outlet(Protocol):
    """`pylsl.StreamOutlet`: a stream that this process offers.

    It is offered until nothing holds it any more.
    """

    def push_sample(self, x: Sequence[float], timestamp: float) -> None:
        """Offer one sample of all channels; `timestamp` [s] on `local_clock`."""
        ...


class Library(Protocol):
    """The module `pylsl`."""

    IRREGULAR_RATE: float
    cf_float32: int

    def StreamInfo(  # noqa: D102
        self,
        name: str,
        type: str,  # noqa: A002
        channel_count: int,
        nominal_srate: float,
        channel_format: int,
        source_id: str,
    ) -> Info: ...

    def StreamOutlet(self, info: Info, chunk_size: int, max_buffered: int) -> Outlet:
        """Offer a stream.

        For a slow inlet it keeps `max_buffered` * 100 samples. Raises `RuntimeError`.
        """
        ...

    def local_clock(self) -> float:
        """LSL's clock on this machine [s]."""
        ...

    def set_config_content(self, content: str) -> None:
        """Configure liblsl, once, before anything else.

        Raises `NotImplementedError` before liblsl 1.17.7.
        """
        ...


def load_library(scope: str, bound_scope: str | None) -> Library:
    """Import the module and set who can find its streams.

    Args:
        scope: "machine" or "network".
        told: What liblsl was configured with before in this process, which is for ever; None: nothing yet.

    Raises:
        PhalanxError: It is not installed, has no liblsl, or one that is too old or was configured otherwise.
    """
    try:
        library = cast(Library, importlib.import_module("pylsl"))
    except ImportError as error:
        raise PhalanxError(f"pylsl is not installed: {INSTALL}") from error
    except (OSError, RuntimeError) as error:  # liblsl is loaded at once
        raise PhalanxError(f"pylsl finds no liblsl that runs here: {INSTALL}") from error
    if bound_scope is not None:
        if bound_scope != scope:
            raise PhalanxError(
                f"lsl.scope is {scope!r}, but liblsl began with {bound_scope!r} in this process: start"
                " `phalanx send` anew"
            )
        return library
    if scope == "machine":
        try:
            library.set_config_content(_MACHINE)
        except NotImplementedError as error:
            raise PhalanxError(
                f"liblsl is older than 1.17.7 and cannot be kept to this machine: {INSTALL};"
                " or set lsl.scope network"
            ) from error
    return library
