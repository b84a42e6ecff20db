"""A live master in this process, the ends of those who send to it, and somebody on its bus."""

import threading
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import msgspec

from common.bus.keys import new_key
from common.bus.zenoh_bus import ZenohBus
from common.clock import SystemClock
from common.messages import (
    Command,
    Health,
    ImuSample,
    MarkerDetections,
    TagDetections,
    TrackerPose,
    WristDetections,
)
from common.messages.streams import sender_of
from master.rig.setup import RigFiles
from master.run.live import LiveSettings, run_live
from slave.uplink import Uplink
from tests.network_helpers import free_endpoint, free_udp_port

Sent = MarkerDetections | WristDetections | TagDetections | TrackerPose | ImuSample


class LiveMaster:
    """Runs until the stack is closed, and has heard all senders. Its results are in `out`, if there is one.

    Attributes:
        setups: What it tracks.
        ends: Of each sender its end of the link.
        bus: Somebody else's end of the bus.
        lines: What the master said.
        stop: Ends it.
    """

    def __init__(
        self, stack: ExitStack, files: RigFiles, senders: Sequence[str], out: Path | None = None
    ) -> None:
        key, beacon, endpoint = bytes.fromhex(new_key()), free_udp_port(), free_endpoint()
        poses, summary = (None, None) if out is None else (out / "poses.npz", out / "live.json")
        settings = LiveSettings(
            ("127.255.255.255", beacon), ("127.0.0.1", 0), endpoint, files, poses=poses, summary=summary
        )
        self.setups, self.lines, self.stop = files.load(), list[str](), threading.Event()
        args = (self.setups, key, settings, self.stop, self.lines.append)
        self._thread = threading.Thread(target=run_live, args=args)
        self._thread.start()
        stack.callback(self.end)
        self.bus = ZenohBus(None, endpoint)
        stack.callback(self.bus.close)
        self.ends = {name: Uplink(name, key, SystemClock(), beacon, "127.0.0.1") for name in senders}
        for end in self.ends.values():
            stack.callback(end.close)
        assert all(end.wait_for_start(60.0) for end in self.ends.values())

    def ask(self, verb: str) -> Health:
        return self.bus.ask(Command("master", verb), 10.0)

    def counts(self) -> dict[str, int]:
        return self.ask("report").counts

    def send(self, message: Sent, **changes: int) -> None:
        """Send as the message's own sender in its session."""
        end = self.ends[sender_of(message)]
        end.send(msgspec.structs.replace(message, session=end.session, **changes))

    def end(self) -> None:
        """Stop it, and wait until all is written."""
        self.stop.set()
        self.ended()

    def ended(self) -> None:
        """Wait for its end."""
        self._thread.join(60.0)
        assert not self._thread.is_alive()
