"""Report how the slave is: `Health` twice a second, and on command.

The sender loop never waits for the bus: this thread opens it when the uplink has learned where the master's
bus is, opens it anew when another master takes over, and lives on without it when there is none.
"""

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from common.bus.bus import Bus
from common.clock import Clock
from common.errors import BusError
from common.machine import Machine, program
from common.messages import Command, Health
from slave.failures import Failures
from slave.sources import Reporting
from slave.uplink import Uplink

if TYPE_CHECKING:  # of cameras alone
    from slave.preview import Previews
    from slave.raw import RawFrames
    from slave.tuning import CameraTuning

ALONE_AT = 6  # the report after which a slave without a master logs what it receives
_LOG = logging.getLogger(__name__)


class Reporter:
    """Publishes `Health`, and answers commands.

    These are "report", "stop", where there is a picture "preview" and "still", and those of the parts, which also look
    after their files once a period. Holds the bus while a master is there, and the metrics of the last period.
    """

    def __init__(
        self,
        name: str,
        uplink: Uplink,
        counters: Reporting,
        clock: Clock,
        connect: Callable[[str], Bus],
        stop: Callable[[], None],
        period_s: float = 0.5,
        *,
        previews: "Previews | None" = None,
        parts: "Sequence[CameraTuning | RawFrames]" = (),
    ) -> None:
        """Start the thread.

        Args:
            name: Name of this slave on the bus.
            uplink: Learns the endpoint of the bus.
            counters: Counts of the loop.
            clock: Clock of the reports' times.
            connect: Opens a bus to an endpoint.
            stop: Called on the command "stop".
            period_s: Time between reports [s]: two of them make a judgement in the checklist of the master, which is to
                be out within two seconds.
            previews: Shows the camera's picture on the command "preview".
            parts: Change the settings of the camera; keep raw frames.
        """
        self._name, self._uplink, self._counters, self._clock = name, uplink, counters, clock
        self._connect, self._stop, self._period_s = connect, stop, period_s
        self._previews, self._parts = previews, tuple(parts)
        self._commands = {verb: act for part in self._parts for verb, act in part.commands().items()}
        self._machine = Machine(Path.cwd())
        self._metrics: dict[str, float] = {}
        self._bus: Bus | None = None
        self._endpoint: str | None = None
        self._failures = Failures(f"{name} health")
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name=f"{name} health", daemon=True)
        self._thread.start()

    def health(self, now: Mapping[str, float] | None = None) -> Health:
        """The report of this moment, with the metrics of the last period, or `now`."""
        counts = {**self._counters.counts(), **self._uplink.counts}
        for part in self._parts:
            counts |= part.counts()
        metrics = self._metrics | dict(now or {})
        return Health(self._name, self._uplink.session, self._clock.now_ns(), counts, metrics, *program())

    def answer(self, command: Command) -> Health:
        """Obey a command.

        "report" sends a report, "preview" shows the picture for 3 s, "still" sends the next frame whole, "stop" ends
        the slave; the others are those of the camera and of raw frames.

        Raises:
            PhalanxError: It could not be done.
            ValueError: Another verb; the asker reads which ones there are.
        """
        plain: dict[str, Callable[[], None]] = {"report": lambda: None, "stop": self._stop}
        if (previews := self._previews) is not None:
            plain |= {"preview": lambda: previews.ask(command.body), "still": previews.ask_still}
        if command.verb in plain:
            plain[command.verb]()
            return self.health()
        if command.verb in self._commands:
            return self.health(self._commands[command.verb](command.body))
        verbs = ", ".join([*plain, *self._commands])
        raise ValueError(f"{self._name}: no command {command.verb!r}; there are {verbs}")

    def close(self) -> None:
        """End the thread and leave the bus. Safe to call twice."""
        self._closing.set()
        self._thread.join()

    def _work(self) -> None:
        count = 0
        while not self._closing.wait(self._period_s):
            log_every = 20  # reports
            if count % log_every == ALONE_AT and self._uplink.zenoh_endpoint is None:
                _LOG.warning("%s", _why_alone(self._uplink.counts))
            try:
                for part in self._parts:
                    part.look()
                self._metrics = self._measured()
                self._follow(self._uplink.zenoh_endpoint)
                if self._bus is not None:
                    self._bus.publish("health", self._name, self.health())
            except BusError as error:
                self._leave()
                if count % log_every == 0:
                    _LOG.warning("no bus: %s", error)
            except Exception as error:  # noqa: BLE001 - whatever it is of, the next report is tried
                self._failures.log("no report", error)
            if count % log_every == 0 and self._counters.counts().get("frames", 0):
                _LOG.info("%s", "  ".join(f"{k} {_short(v)}" for k, v in self._metrics.items()))
            count += 1
        self._leave()

    def _measured(self) -> dict[str, float]:
        metrics = dict(self._counters.metrics())
        for part in self._parts:
            metrics |= part.metrics()
        return metrics | self._machine.metrics()

    def _follow(self, endpoint: str | None) -> None:
        if endpoint is None or endpoint == self._endpoint:
            return
        self._leave()
        bus = self._connect(endpoint)
        bus.announce(self._name)
        bus.serve(self._name, self.answer)
        self._bus, self._endpoint = bus, endpoint
        if self._previews is not None:
            self._previews.use(bus)

    def _leave(self) -> None:
        if self._previews is not None:
            self._previews.use(None)
        if self._bus is not None:
            self._bus.close()
        self._bus, self._endpoint = None, None


def _short(value: float) -> str:
    """Three digits at least, and no exponent: a gain of 0.83 is not 1."""
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _why_alone(counts: Mapping[str, int]) -> str:
    """What to look at when no master has answered, by what was refused."""
    if counts.get("refused.foreign", 0):
        return "a master is received, but of another rig key (or another program): compare the key files of both sides"
    if counts.get("refused.version", 0):
        return (
            "a master is received, but of another version of the wire: install the same version on both sides"
        )
    if counts.get("refused.secret", 0):
        return "a master is received, but not with the secret of this device: phalanx fleet deploy brings what fits"
    if counts.get("refused.duplicate_sender", 0):
        return "a master is received, but it has somebody of this name already: two slaves of one name?"
    return "no master received yet: is it running, and does its --beacon reach this network and port?"
