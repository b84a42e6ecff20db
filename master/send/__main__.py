"""`python -m master.send`: as `phalanx-master send`, without the rest of the master's commands, for a start in a
quarter of their time."""

import typer

from common.errors import PhalanxError
from master.send.command import send


def main() -> None:
    """Run it; an error is a line, as from any command of the master."""
    try:
        typer.run(send)
    except PhalanxError as error:
        typer.echo(f"outputs: {error}", err=True)
        raise SystemExit(1) from error


if __name__ == "__main__":
    main()
