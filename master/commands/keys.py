"""`phalanx fleet keys`: rig key, secrets and certificates of a rig.

They are made and kept on the PC.
"""

from argparse import Namespace
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from common.bus.keys import DEVICES_KEY, RIG_KEY
from common.command_line import UsageError
from common.terminal import echo
from master.commands.keys_folder import certificates_of, devices_of, lacks_secrets, make, renew, renew_device


def keys(options: Namespace) -> None:
    """Show who has a certificate; or make the folder, renew it, or lock a device out.

    Raises:
        UsageError: `--device` is missing or has no meaning.
    """
    folder: Path = options.folder
    devices: list[str] = options.devices
    if options.make:
        _make(folder, devices)
    elif options.revoke:
        if not devices:
            raise UsageError("--revoke: name the lost device, --device NAME")
        _new(folder, renew(folder, _now(), devices))
    elif options.renew and devices:
        for device in devices:
            renew_device(folder, device, _now())
            echo(f"{folder}: new certificate of {device}: deploy it again")
    elif options.renew:
        _new(folder, renew(folder, _now()))
    elif devices:
        raise UsageError("--device is for --make, --renew and --revoke")
    else:
        _show(folder)


def _make(folder: Path, devices: Sequence[str]) -> None:
    made = make(folder, devices, _now())
    echo(f"{folder}: made {', '.join(made)}" if made else f"{folder}: everything is there")
    if DEVICES_KEY in made and RIG_KEY not in made and (names := devices_of(folder)):
        echo(
            f"Each device has a secret of its own now: deploy again to {', '.join(names)}; restart the master"
        )


def _show(folder: Path) -> None:
    """Print the certificates and the devices without a secret.

    For each certificate: who has it, what for, and until when.
    """
    certificates = certificates_of(folder)
    wide = max(len(one.name) for one in certificates)
    for one in certificates:
        use = "listens" if one.listens else "connects"
        late = "  ENDED: renew" if one.until < _now() else ""
        echo(f"{one.name:<{wide}}  {use:<8}  until {one.until:%Y-%m-%d}  {one.fingerprint}{late}")
    if lacking := lacks_secrets(folder):
        echo(
            f"No secret of its own has {', '.join(lacking)}: phalanx fleet keys {folder} --make, then deploy again"
        )


def _new(folder: Path, left: Sequence[str]) -> None:
    names = ", ".join(left) or "no device"
    echo(f"{folder}: all keys are new. Deploy again to {names}; restart the master and what reads it")


def _now() -> datetime:
    return datetime.now(UTC)
