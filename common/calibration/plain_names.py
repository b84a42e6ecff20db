"""Plain names: those that can stand as a part of a path.

So a name out of a file leads nowhere else.
"""

import re

PLAIN = "letters, digits, _ . -, at most 64, not dots alone"
_PLAIN = re.compile(r"[A-Za-z0-9_.-]{1,64}")


def is_plain(name: str) -> bool:
    """Whether it is a `Name` that can stand as a part of a path."""
    return _PLAIN.fullmatch(name) is not None and name.strip(".") != ""
