"""Keys for a dry run.

As if the keys folder had what it lacks, while nothing is written into it.
"""

import contextlib
import tempfile
from collections.abc import Callable, Generator, Sequence
from pathlib import Path

from deploy.deployment import make_keys

Notify = Callable[[str], None]


@contextlib.contextmanager
def prepared_keys(folder: Path, names: Sequence[str], dry_run: bool, notify: Notify) -> Generator[Path]:
    """A keys folder that has all that these senders need.

    Args:
        folder: That of the user; what it lacks is made.
        names: Senders.
        dry_run: Nothing is made there. A private folder takes its place for as long as this lasts, so that the rest of
            the way can be looked at: links to what is there, and what is lacking, made for nobody.
        notify: Called with what is made.

    Raises:
        DeployError: They cannot be made.
    """
    if not dry_run:
        make_keys(folder, names, notify)
        yield folder
        return
    with tempfile.TemporaryDirectory(prefix="phalanx-keys-") as private:
        keys = Path(private) / "keys"
        make_keys(keys, names, lambda _line: None)
        lacking = 0
        for file in [path for path in keys.rglob("*") if path.is_file()]:
            there = folder / file.relative_to(keys)
            if there.is_file():
                file.unlink()
                file.symlink_to(there.resolve())
            else:
                lacking += 1
        if lacking:
            notify(f"would make keys in {folder}")
        yield keys
