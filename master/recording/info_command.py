"""`phalanx info`."""

from argparse import Namespace

from common.recording.messages import open_messages
from common.terminal import echo
from master.recording.lines import events_of, table


def info(options: Namespace) -> None:
    """Show the contents of a recording of messages.

    Streams, rates, length, files, and what happened.
    """
    recording = open_messages(options.file)
    events = events_of(recording)
    echo("\n".join(table(recording, events)))
