"""The player turns a recording into the same results on a replay clock.

What the master received goes through the very same `Dispatcher` again, at any speed, from any time. What
comes out depends on nothing but the messages and their order, so that every pass over the same stretch yields
the same, bit for bit; a `Backlog` among them gives what the live master dropped, and the player drops it too.
To begin anywhere but at the start, a new world is shown the two seconds before, silently: filters and tracks
have settled by then, but the result is near to that of a whole pass, not equal to it.
"""

import hashlib
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import cast

import msgspec

from common.bus.bus import Bus
from common.clock import now_ns
from common.errors import PhalanxError
from common.messages import Backlog, Contact, Gesture, HandPose, ObjectPose, ResultMessage, encode
from common.recording.messages import MessageRecording, Recorded
from master.outputs.bus import Sink
from master.recording.lines import EventMonitor
from master.recording.probe import Probe
from master.rig.setup import RigSetup
from master.run.app import Solved, StageTimes
from master.run.dispatcher import Dispatcher
from master.run.link_senders import SensorMessage
from master.run.solver_supervisor import LoadShedding, Shedding
from master.run.tuning import LivePipeline


class ReplayClock:
    """Map from local time to time in the recording, with speed and pause.

    It reads no clock itself. At speed 0 there is no such map: everything is due at once.
    """

    def __init__(self, begin_t_ns: int, speed: float, now_ns: int) -> None:
        """Stand at `begin_t_ns` at `now_ns` here; ValueError: the speed is none."""
        self.paused = False
        self._at_ns, self._since_ns = begin_t_ns, now_ns
        self.speed = _checked(speed)

    def position_ns(self, now_ns: int) -> int:
        """Where it is [ns], recording's time."""
        if self.paused or self.speed == 0.0:
            return self._at_ns
        return self._at_ns + round((now_ns - self._since_ns) * self.speed)

    def wait_s(self, t_ns: int, now_ns: int) -> float | None:
        """How long until what came at `t_ns` is due [s]; None: not before `resume`."""
        if self.paused:
            return None
        if self.speed == 0.0:
            self._at_ns = max(self._at_ns, t_ns)
            return 0.0
        return max((t_ns - self.position_ns(now_ns)) * 1e-9 / self.speed, 0.0)

    def pause(self, now_ns: int) -> None:
        """Stand still."""
        self.seek(self.position_ns(now_ns), now_ns)
        self.paused = True

    def resume(self, now_ns: int) -> None:
        """Go on."""
        self._since_ns = now_ns
        self.paused = False

    def set_speed(self, factor: float, now_ns: int) -> None:
        """Go on at another speed; 0: as fast as it goes; ValueError: the speed is none."""
        factor = _checked(factor)
        self.seek(self.position_ns(now_ns), now_ns)
        self.speed = factor

    def seek(self, t_ns: int, now_ns: int) -> None:
        """Stand at `t_ns` now."""
        self._at_ns, self._since_ns = t_ns, now_ns


def _checked(speed: float) -> float:
    if not 0.0 <= speed <= 1000.0:
        raise ValueError(f"speed {speed:g}: must be 0 (as fast as it goes) to 1000")
    return speed


KINDS = {HandPose: "poses", ObjectPose: "objects", Contact: "contacts", Gesture: "gestures"}


class ResultDigest:
    """SHA-256 over the messages of each kind in their order, and their number.

    Each counts as it is encoded for the wire, with `latency_ns` 0: the machine's speed is no part of the
    result.
    """

    def __init__(self, results: Iterable[ResultMessage] = ()) -> None:
        """Begin with `results`."""
        self._sums = {name: hashlib.sha256() for name in KINDS.values()}
        self.counts = dict.fromkeys(KINDS.values(), 0)
        for message in results:
            self.take(message)

    def take(self, message: ResultMessage) -> None:
        """Count one message."""
        name = KINDS[type(message)]
        if isinstance(message, HandPose | ObjectPose) and message.latency_ns:
            message = msgspec.structs.replace(message, latency_ns=0)
        self._sums[name].update(encode(message))
        self.counts[name] += 1

    def hex(self, name: str = "poses") -> str:
        """The sum of one kind, as 64 characters."""
        return self._sums[name].hexdigest()

    def lines(self) -> list[str]:
        """A line for each kind that there was, poses always."""
        return [
            f"sha256 of {count} {name}: {self.hex(name)}"
            for name, count in self.counts.items()
            if count or name == "poses"
        ]


SOLVED = ("hand", "object", "contact", "gesture")
AUXILIARY = ("health", "checklist", "preview", "still")  # published again as they were
_OWN = frozenset({"master", "recorder"})  # whose reports are not: the player is the master now


@dataclass(frozen=True, slots=True)
class Passed:
    """One pass over a recording."""

    digest: ResultDigest  # over all that was published
    seconds: float
    whole: bool  # from the beginning to the end that was asked for, without a jump

    @property
    def poses_per_s(self) -> float:
        """Poses of hands over the time of the pass."""
        return self.digest.counts["poses"] / max(self.seconds, 1e-9)


def world_of(setups: Sequence[RigSetup], load_shedding: LoadShedding) -> Dispatcher:
    """Build the dispatcher as a live master; `load_shedding` drops epochs."""
    stages = StageTimes()
    return Dispatcher(
        setups, [LivePipeline(setup, stages, Shedding(load_shedding)) for setup in setups], stages
    )


class Player:
    """Player of one recording; `run` belongs to one thread, all else to any."""

    def __init__(
        self,
        recording: MessageRecording,
        setups: Sequence[RigSetup],
        sinks: Sequence[Sink],
        *,
        speed: float = 0.0,
        from_ns: int | None = None,
        to_ns: int | None = None,
        solved: bool = False,
        bus: Bus | None = None,
        probe: Probe | None = None,
        notify: Callable[[str], None] = lambda _line: None,
    ) -> None:
        """Stand at the beginning.

        Args:
            speed: 1: as it was; 0: as fast as it goes.
            from_ns, to_ns: The stretch that is played, log times [ns]; None: all.
            solved: Publish what was published live instead of solving.
            bus: Where reports, lists and pictures that were recorded beside are published again.
            probe: Shown each message that was taken, once all that it yields is out.
            notify: Called with a line where something happened that a replay cannot repeat.

        Raises:
            ValueError: The speed is none, or the stretch is empty.
        """
        self._recording, self._setups, self._sinks, self._solved = recording, setups, sinks, solved
        self._bus, self._probe, self._notify = bus, probe, notify
        self.first_ns = recording.begin_t_ns if from_ns is None else max(from_ns, recording.begin_t_ns)
        self.last_ns = recording.end_t_ns if to_ns is None else min(to_ns, recording.end_t_ns)
        if self.first_ns > self.last_ns:
            raise ValueError("nothing of the recording lies between the times asked for")
        self._clock = ReplayClock(self.first_ns, speed, now_ns())
        self._changed = threading.Condition()
        self._jump: int | None = None
        self._stopped = False
        self._notified: set[str] = set()
        self._unsolved: set[tuple[str, str]] = set()
        self.poses = 0
        self.at_ns = self.first_ns

    @property
    def speed(self) -> float:
        """As which factor of live; 0: as fast as it goes."""
        return self._clock.speed

    @property
    def paused(self) -> bool:
        """Whether it stands still."""
        return self._clock.paused

    def pause(self) -> None:
        """Stand still."""
        with self._changed:
            self._clock.pause(now_ns())

    def resume(self) -> None:
        """Go on."""
        with self._changed:
            self._clock.resume(now_ns())
            self._changed.notify()

    def set_speed(self, factor: float) -> None:
        """Go on at another speed; ValueError: below 0, or no number."""
        with self._changed:
            self._clock.set_speed(factor, now_ns())
            self._changed.notify()

    def seek(self, t_ns: int) -> None:
        """Go on from `t_ns`; ValueError: outside of what is played."""
        if not self.first_ns <= t_ns <= self.last_ns:
            begin = self._recording.begin_t_ns
            first, last = ((one - begin) * 1e-9 for one in (self.first_ns, self.last_ns))
            raise ValueError(f"t_s {(t_ns - begin) * 1e-9:g}: must be {first:.3f} to {last:.3f}")
        with self._changed:
            self._jump = t_ns
            self._changed.notify()

    def stop(self) -> None:
        """End `run` soon."""
        with self._changed:
            self._stopped = True
            self._changed.notify()

    def run(self) -> Passed:
        """Play until the end, with all jumps; RecordingError, or PhalanxError of a sink."""
        start_ns, whole = self.first_ns, self.first_ns == self._recording.begin_t_ns
        digest, began_ns = ResultDigest(), now_ns()
        while True:
            with self._changed:
                self._clock.seek(start_ns, now_ns())
            self.at_ns = start_ns  # also while it stands still there
            ended = self._pass(start_ns, digest)
            with self._changed:
                jump, self._jump = self._jump, None
                if jump is None or self._stopped:
                    return Passed(digest, (now_ns() - began_ns) * 1e-9, whole and ended)
            start_ns, whole = jump, False

    def _pass(self, start_ns: int, digest: ResultDigest) -> bool:
        """Play from `start_ns`; False: not to the end."""
        load_shedding = LoadShedding()
        dispatcher = None if self._solved else world_of(self._setups, load_shedding)
        events = EventMonitor(self._recording.begin_t_ns)
        with self._changed:
            self._clock.seek(start_ns, now_ns())  # to build a world took its time
        streams = (*AUXILIARY, *(SOLVED if self._solved else ("taken",)))
        settle_ns = 2_000_000_000
        for one in self._recording.read(streams, start_ns - settle_ns, self.last_ns):
            silent = one.t_ns < start_ns
            if not silent and not self._due(one.t_ns):
                return False
            if one.stream == "health":
                self._print_events(events.push(one.t_ns, one.message))
                if events.restarted and dispatcher is not None:
                    load_shedding = LoadShedding()
                    dispatcher = world_of(self._setups, load_shedding)
            if isinstance(one.message, Backlog):
                load_shedding.skip = one.message.skip
            results = self._results_of(dispatcher, one)
            if not silent:
                self._write(results, digest)
                self._auxiliary(one)
                self.at_ns = one.t_ns
            else:
                for _ in results:
                    pass
        return True

    def _due(self, t_ns: int) -> bool:
        """Wait until it is time; False: stopped, or a jump is to be made."""
        with self._changed:
            while not self._stopped and self._jump is None:
                wait_s = self._clock.wait_s(t_ns, now_ns())
                if wait_s == 0.0:
                    return True
                # longer than that nobody waits for the next message
                if (
                    wait_s is not None
                    and (gap_ns := t_ns - self._clock.position_ns(now_ns())) > 600_000_000_000
                ):
                    at_s = (self.at_ns - self._recording.begin_t_ns) * 1e-9
                    self._print_events([f"at {at_s:.1f} s nothing comes for {gap_ns * 1e-9:.0f} s: skipped"])
                    self._clock.seek(t_ns, now_ns())
                    return True
                step_s = 60.0  # of a wait, whatever the speed; a change ends it
                self._changed.wait(None if wait_s is None else min(wait_s, step_s))
            return False

    def _results_of(self, dispatcher: Dispatcher | None, one: Recorded) -> Iterable[ResultMessage]:
        """The results of a recorded message: solved now, or published live."""
        if one.stream in SOLVED:
            return (cast(ResultMessage, one.message),)
        if one.stream != "taken" or dispatcher is None or isinstance(one.message, Backlog):
            return ()
        return self._solve(dispatcher, cast(SensorMessage, one.message), one.name)

    def _solve(self, dispatcher: Dispatcher, message: SensorMessage, name: str) -> Iterable[ResultMessage]:
        """What the world makes of a message; nothing of one that it cannot solve."""
        try:
            return [_plain(solved) for solved in dispatcher.push(message)]
        except PhalanxError:
            raise
        except Exception as error:  # noqa: BLE001 -- a file may hold whatever makes the solver raise
            kind = type(error).__name__
            if (name, kind) not in self._unsolved:
                self._notify(f"messages of {name} cannot be solved and are left out: {kind}: {error}")
            self._unsolved.add((name, kind))
            return ()

    def _write(self, results: Iterable[ResultMessage], digest: ResultDigest) -> None:
        for message in results:
            digest.take(message)
            for sink in self._sinks:
                sink.write(message)
            self.poses += isinstance(message, HandPose)

    def _auxiliary(self, one: Recorded) -> None:
        if one.stream == "taken" and self._probe is not None:
            self._probe.show(one.message)
        elif self._bus is not None and one.stream in AUXILIARY and one.name not in _OWN:
            self._bus.publish(one.stream, one.name, one.message)

    def _print_events(self, lines: Sequence[str]) -> None:
        for line in lines:
            if line not in self._notified:  # not again with every jump
                self._notified.add(line)
                self._notify(line)


def _plain(solved: Solved) -> ResultMessage:
    """As it is published; how long it took to be solved here is nobody's latency."""
    return solved if isinstance(solved, Contact | Gesture) else solved.pose
