"""`phalanx-master info`."""

import typer

from common.recording import open_messages
from master.options import MessageFile
from master.recording.lines import events_of, table


def info(file: MessageFile) -> None:
    """Show what is in a recording of messages: streams, rates, length, files, and what happened.

    Examples:

      phalanx-master info out/wave.mcap
    """
    recording = open_messages(file)
    events = events_of(recording)
    typer.echo("\n".join(table(recording, events)))
