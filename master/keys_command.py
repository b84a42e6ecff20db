"""`phalanx-master keys`: rig key, secrets and certificates of a rig, made and kept on the PC."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from common.errors import PhalanxError
from common.keys import DEVICES_KEY, RIG_KEY
from master.keys_folder import certificates_of, devices_of, lacks_secrets, make, renew, renew_device

Folder = Annotated[Path, typer.Argument(help="Keys folder; keep it private, and out of calib_json.")]
Devices = Annotated[
    list[str] | None,
    typer.Option("--device", help="Name of a camera, IMU or tracker as the rig has it; once for each."),
]


def keys_app() -> typer.Typer:
    """The command `keys`."""
    app = typer.Typer(no_args_is_help=True)

    @app.callback()
    def about() -> None:
        """The secrets of a rig: keys for its datagrams, certificates for its bus. docs/keys.md says who has which.

        `phalanx deploy` makes the folder and brings each device its part.
        """

    app.command(name="make")(make_command)
    app.command(name="show")(show_command)
    app.command(name="renew")(renew_command)
    app.command(name="revoke")(revoke_command)
    return app


def make_command(folder: Folder, device: Devices = None) -> None:
    """Make a keys folder, or add what is missing: what is there stays as it is.

    Examples:

      phalanx-master keys make ~/.config/phalanx/keys

      phalanx-master keys make ~/.config/phalanx/keys --device left --device right
    """
    made = make(folder, device or (), _now())
    typer.echo(f"{folder}: made {', '.join(made)}" if made else f"{folder}: everything is there")
    if DEVICES_KEY in made and RIG_KEY not in made and (names := devices_of(folder)):
        typer.echo(
            f"Each device has a secret of its own now: deploy again to {', '.join(names)}; restart the master"
        )


def show_command(folder: Folder) -> None:
    """Say who has a certificate, what for, until when, and which device has no secret for its datagrams.

    Examples:

      phalanx-master keys show ~/.config/phalanx/keys
    """
    certificates = certificates_of(folder)
    wide = max(len(one.name) for one in certificates)
    for one in certificates:
        use = "listens" if one.listens else "connects"
        late = "  ENDED: renew" if one.until < _now() else ""
        typer.echo(f"{one.name:<{wide}}  {use:<8}  until {one.until:%Y-%m-%d}  {one.fingerprint}{late}")
    if lacking := lacks_secrets(folder):
        typer.echo(
            f"No secret of its own has {', '.join(lacking)}: phalanx-master keys make {folder}, then deploy again"
        )


def renew_command(
    folder: Folder,
    device: Annotated[
        str | None,
        typer.Option(
            help="Only a new certificate for this device; its old one stays valid and its secret stays, so not for a"
            " lost one."
        ),
    ] = None,
) -> None:
    """Make all keys anew, for everybody; then deploy again and restart the programs of the PC.

    Examples:

      phalanx-master keys renew ~/.config/phalanx/keys

      phalanx-master keys renew ~/.config/phalanx/keys --device left
    """
    if device is not None:
        renew_device(folder, device, _now())
        typer.echo(f"{folder}: new certificate of {device}: deploy it again")
        return
    _report(folder, renew(folder, _now()))


def revoke_command(
    folder: Folder,
    device: Annotated[list[str], typer.Option(help="Device that was lost, sold or stolen; once for each.")],
) -> None:
    """Lock devices out: all keys are made anew, and these get none.

    A lost device reads and forges nothing of the others. But it has the rig key and a certificate, and is heard as
    itself: nothing less keeps it out.

    Examples:

      phalanx-master keys revoke ~/.config/phalanx/keys --device left
    """
    _report(folder, renew(folder, _now(), device))


def _report(folder: Path, left: list[str]) -> None:
    names = ", ".join(left) or "no device"
    typer.echo(f"{folder}: all keys are new. Deploy again to {names}; restart the master and what reads it")


def _now() -> datetime:
    return datetime.now(UTC)


def main() -> None:
    """`python -m master.keys_command`: the same without the rest of the master, which takes seconds to load."""
    try:
        keys_app()()
    except PhalanxError as error:
        raise SystemExit(f"keys: {error}") from error


if __name__ == "__main__":
    main()
