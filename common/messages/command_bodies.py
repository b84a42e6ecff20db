"""Bodies of commands state what "preview" and "raw" request of a camera's slave."""

import re
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from common.calibration import parse
from common.errors import CalibrationError
from common.messages import MAX_MARKERS, Name


class PreviewRequest(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """Body of the command "preview"; an empty one asks for the plain picture.

    Attributes:
        mask: Markers whose pixels are tinted: those inside the colour ranges in use, as the slave takes them.
        found: Whether crosses show what was found in that frame: markers, or laser points and fingertips.
    """

    mask: Annotated[tuple[Name, ...], Meta(max_length=MAX_MARKERS)] = ()
    found: bool = False

    @classmethod
    def of(cls, body: str) -> "PreviewRequest":
        """Read a body; raises CalibrationError, which names the key, if it is none."""
        return parse(body.encode(), cls, "preview") if body else cls()

    def body(self) -> str:
        """Return the command body that states this request."""
        return "" if self == PreviewRequest() else msgspec.json.encode(self).decode()


_PLAIN = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*")


class RawRequest(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """Body of the command "raw".

    Attributes:
        name: Of the recording, a new folder in the slave's own folder for raw frames.
        lease_s: It ends by itself unless it is asked for again within so many s; 0: it goes on until "raw_stop".
    """

    name: Name
    lease_s: Annotated[float, Meta(ge=0.0, le=3600.0)] = 0.0

    @classmethod
    def of(cls, body: str) -> "RawRequest":
        """Read a body with a folder's name; CalibrationError names the key."""
        request = parse(body.encode(), cls, "raw")
        refuse_strange(request.name, "raw: name")
        return request

    def body(self) -> str:
        """Return the command body that states this request."""
        return msgspec.json.encode(self).decode()


def raw_name(stem: str, camera: str, number: int = 1) -> str:
    """Name of raw frames of a camera beside STEM.mcap: STEM-CAMERA, STEM-CAMERA-2."""
    return f"{stem}-{camera}" if number == 1 else f"{stem}-{camera}-{number}"


def refuse_strange(name: str, where: str) -> None:
    """Refuse what is not the name of one folder, or hidden (CalibrationError)."""
    longest = 64  # of a `Name`
    if not _PLAIN.fullmatch(name) or len(name) > longest:
        raise CalibrationError(
            f"{where}: {name!r}: must be letters, digits, _ . -, not begin with a dot, and have at most {longest} "
            "characters"
        )
