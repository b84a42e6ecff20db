"""What of a command line can be refused before a machine is asked."""

import argparse
import os
import re
from pathlib import Path

from deploy.targets import DeployError, RigFile

_PREFIXED = re.compile(r"[A-Za-z0-9_.]+=")  # NAME= before a driver or before options


def check_wish(options: argparse.Namespace, rig: RigFile) -> None:
    """Look at the options of `phalanx fleet deploy`.

    Raises:
        DeployError: One is for a name that the rig does not have, or `--wheelhouse` has no wheels.
    """
    for option in ("camera", "options"):
        for text in getattr(options, option):
            name = text.partition("=")[0] if _PREFIXED.match(text) else None
            if name is not None and name not in rig.names:
                raise DeployError(
                    f"--{option} {text!r}: rig {rig.name!r} has no {name!r}; it has {', '.join(rig.names)}"
                )
    if options.wheelhouse is not None and not any(options.wheelhouse.glob("*.whl")):
        raise DeployError(
            f"--wheelhouse {options.wheelhouse}: no wheels in it; phalanx fleet wheels DIR gathers them"
        )


def check_reach(options: argparse.Namespace) -> None:
    """Look at how machines are to be reached.

    Raises:
        DeployError: The private key is not there.
    """
    if options.identity is not None and not options.identity.is_file():
        raise DeployError(f"--identity {options.identity}: no such file; ssh-keygen makes one")


def default_keys() -> Path:
    """Return the default keys folder."""
    return Path(os.environ.get("PHALANX_KEYS") or Path.home() / ".config/phalanx/keys")
