"""Body of the command "preview": what it requests beside the picture.

A console writes it and a slave reads it.
"""

from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from common.calibration import parse
from common.messages import MAX_MARKERS, Name


class PreviewWish(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """The body; an empty one asks for the plain picture.

    Attributes:
        mask: Markers whose pixels are tinted: those inside the colour ranges in use, as the slave takes them.
        found: Whether crosses show what was found in that frame: markers, or laser points and fingertips.
    """

    mask: Annotated[tuple[Name, ...], Meta(max_length=MAX_MARKERS)] = ()
    found: bool = False

    @classmethod
    def of(cls, body: str) -> "PreviewWish":
        """Read a body.

        Raises:
            CalibrationError: It is none; the text names the key.
        """
        return parse(body.encode(), cls, "preview") if body else cls()

    def body(self) -> str:
        """Return the command body that states this request."""
        return "" if self == PreviewWish() else msgspec.json.encode(self).decode()
