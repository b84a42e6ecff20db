"""Phalanx's lines in a Raspberry Pi's config.txt.

They are a marked block that has only what the file does not state already.
"""

from collections.abc import Sequence

BEGIN, END = "# --- Phalanx: begin ---", "# --- Phalanx: end ---"
_ALL = "[all]"  # lines before may be for one model only


def with_block(text: str, lines: Sequence[str]) -> str:
    """Return `text` with a block of those `lines` that it lacks.

    Without a block if it has all of them.
    """
    plain = without_block(text)
    own = _shown_to_all(plain)
    missing = [line for line in lines if line not in own]
    if not missing:
        return plain
    if plain and not plain.endswith("\n"):
        plain += "\n"
    return plain + "\n".join([BEGIN, _ALL, *missing, END]) + "\n"


def without_block(text: str) -> str:
    """`text` as it was before we came."""
    kept: list[str] = []
    ours = False
    for line in text.splitlines(keepends=True):
        if line.strip() == BEGIN:
            ours = True
        elif line.strip() == END and ours:
            ours = False
        elif not ours:
            kept.append(line)
    return "".join(kept)


def _shown_to_all(text: str) -> set[str]:
    """Return the lines that hold on every model.

    Of a setting that is stated twice, the last one counts.
    """
    stated: dict[str, str] = {}
    everyone = True
    for line in (line.strip() for line in text.splitlines()):
        if line.startswith("["):
            everyone = line == _ALL
        elif everyone and line and not line.startswith("#"):
            key = line if line.startswith(("dtoverlay=", "dtparam=")) else line.partition("=")[0]
            stated[key] = line
    return set(stated.values())
