"""`phalanx info`."""

from argparse import Namespace

from common.recording import open_messages
from common.terminal import echo
from master.recording.lines import events_of, table


def info(options: Namespace) -> None:
    """Show what is in a recording of messages: streams, rates, length, files, and what happened."""
    recording = open_messages(options.file)
    events = events_of(recording)
    echo("\n".join(table(recording, events)))
