"""The bus between processes, over zenoh: the only file that knows zenoh.

The master listens, everybody else connects to it; there is no router and no discovery, so a process sees only the one
it is connected to (and, on the master, everybody). What zenoh does by default and must not do here: listen on every
interface, join any peer of the network by multicast or gossip, notice a pulled cable after 10 s, come back to a
restarted master after 4 s, take messages of 1 GiB. Links are reliable (tcp, tls, quic): on bare udp its handshake can
stay silent. zenoh's fifos are read by one thread each, never in a callback on zenoh's own threads.
"""

import atexit
import json
import logging
import os
import re
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Protocol

import zenoh

from common.bus.bus import ANY, Handler, Inbox, Subscription, decoded, payload_of, stream_key
from common.bus.endpoints import check, encrypted, log_why_alone, loopback, why_refused
from common.bus.keys import MASTER, OPERATOR, Access, access_of
from common.bus.settings import settings
from common.errors import BusError, PhalanxError
from common.messages import Command, Health, Message, encode
from common.messages.parts import printable
from common.messages.streams import ALIVE_KEY, key_of
from common.supervisor import until

FIFO_DEPTH = 64  # between zenoh and the thread that empties it at once
# Nothing of these is dropped: who publishes them does so on a thread of its own.
WAITING = frozenset({"taken"})

_LOG = logging.getLogger(__name__)


class ZenohBus:
    """One process on the bus (see `common.bus.bus.Bus`).

    An unreachable peer does not delay the constructor by more than half a second; zenoh goes on trying, and everything
    declared here holds again once the peer is back. `open` states whether it leaves this machine as plain text.
    """

    def __init__(
        self,
        listen: str | None,
        connect: str | Sequence[str] | None,
        access: Access | None = None,
        *,
        beyond: bool = False,
        devices: Iterable[str] = (),
        router: bool = False,
        namespace: str | None = None,
    ) -> None:
        """Listen on an endpoint, connect to one (`tls/127.0.0.1:47802`), or both.

        Args:
            listen: Endpoint where others connect to; needs the master's certificate if it is encrypted.
            connect: Endpoint of who listens; of several only for a router.
            access: Certificates, and whether plain text may leave the machine; None: as the variables PHALANX_KEYS and
                PHALANX_OPEN define them, for a master if it listens, else for an operator.
            beyond: See and ask also those that are connected to the one it connects to: a viewer at the master reaches
                the slaves. It is a client then, listens nowhere, and that one must be there.
            devices: Names that may connect, beside those whose certificates are in the keys folder.
            router: Pass everything on between all that are connected, in place of being one of them.
            namespace: Site whose keys these are, at a router of several.

        Raises:
            BusError: An endpoint is malformed, or not tcp, tls or quic; it would leave the machine as plain text; keys
                are missing; the address is taken; with `beyond`, nobody listens there yet, or refused us.
        """
        targets = [connect] if isinstance(connect, str) else list(connect or ())
        ends = [("listening on", listen), *(("connecting to", target) for target in targets)]
        self._where = ", ".join(f"{what} {endpoint}" for what, endpoint in ends if endpoint)
        endpoints = [endpoint for _, endpoint in ends if endpoint]
        if access is None:
            access = access_of(os.environ, MASTER if listen else OPERATOR)
        self.open = False
        for endpoint in endpoints:
            check(endpoint, access.open)
            if not encrypted(endpoint) and not loopback(endpoint):
                self.open = True
                _LOG.warning(
                    "OPEN BUS: %s is plain text: whoever reaches it can watch, tune and stop this rig",
                    endpoint,
                )
        sealed = any(encrypted(endpoint) for endpoint in endpoints)
        self._identity = access.identity() if sealed else None
        self._sealed = [target for target in targets if encrypted(target)]
        mode = "client" if beyond else "router" if router else "peer"
        made = settings(listen, targets, mode, self._identity, devices, namespace)
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(made)))
        except zenoh.ZError as error:
            why = self._refusal() or (
                f"{_plain(error)}. "
                + ("Is the master running?" if beyond else "Is the address taken or mistyped?")
            )
            raise BusError(f"cannot open the bus ({self._where or 'no endpoint'}): {why}") from error
        self._inboxes: list[Inbox] = []
        self._undeclare: list[Callable[[], None]] = []
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        self._closed = False
        # A thread that is still inside zenoh when the interpreter ends aborts the process, and with
        # it the report of whatever error ended the program before it could close this.
        atexit.register(self.close)
        self._closing = threading.Event()
        if self._sealed and not beyond:
            self._threads.append(log_why_alone(lambda: self.peers, self._refusal, self._where, self._closing))

    @property
    def peers(self) -> int:
        """Number of processes this one is connected to now."""
        if self._closed:
            return 0
        return len(self._session.info.peers_zid()) + len(self._session.info.routers_zid())

    @property
    def counts(self) -> dict[str, int]:
        """What came on open subscriptions and was of no use.

        `bus.refused`: no message of its stream, or in another's name; `bus.dropped`: too much of one sender.
        """
        with self._lock:
            inboxes = list(self._inboxes)
        return {
            "bus.refused": sum(inbox.refused for inbox in inboxes),
            "bus.dropped": sum(inbox.dropped for inbox in inboxes),
        }

    def publish(self, stream: str, name: str, message: Message) -> None:
        """Send to every matching subscription; dropped when the link is congested.

        A stream of `WAITING` waits instead; it goes behind all others and in larger packets.
        """
        self._check_open()
        waits = stream in WAITING
        self._session.put(
            stream_key(stream, name),
            payload_of(stream, message),
            congestion_control=zenoh.CongestionControl.BLOCK if waits else zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_LOW if waits else zenoh.Priority.DATA,
            express=not waits,
        )

    def subscribe(self, stream: str, name: str = ANY, depth: int = 16) -> Subscription:
        """Receive a stream (see `Bus.subscribe`)."""
        self._check_open()
        key = stream_key(stream, name)
        undeclare: list[Callable[[], None]] = []

        def forget(inbox: Inbox) -> None:
            undeclare[0]()
            with self._lock:
                if inbox in self._inboxes:
                    self._inboxes.remove(inbox)

        inbox = Inbox(stream, depth, forget)
        subscriber = self._session.declare_subscriber(key, zenoh.handlers.FifoChannel(FIFO_DEPTH))
        undeclare.append(_quietly(subscriber))
        # The handler by itself: a thread that waits in `subscriber.recv` would block `undeclare`.
        handler = subscriber.handler

        def take_next() -> None:
            sample = handler.recv()
            inbox.put(str(sample.key_expr).rpartition("/")[2], sample.payload.to_bytes())

        thread = _start(f"bus {key}", take_next, lambda: self._closed or inbox.closed)
        with self._lock:
            self._threads = [alive for alive in self._threads if alive.is_alive()] + [thread]
            self._inboxes.append(inbox)
        return inbox

    def serve(self, name: str, handler: Handler) -> None:
        """Answer every command for `name`, one after the other, on a thread of the bus."""
        self._check_open()
        queryable = self._session.declare_queryable(
            key_of("command", name), zenoh.handlers.FifoChannel(FIFO_DEPTH)
        )
        queries = queryable.handler

        def answer_next() -> None:
            # A query is finished, and its sender notified, when it is left: never keep one while waiting.
            with queries.recv() as query, suppress(zenoh.ZError):  # who asked may be gone
                _answer(query, name, handler)

        thread = _start(f"bus command {name}", answer_next, lambda: self._closed)
        with self._lock:
            self._threads.append(thread)
            self._undeclare.append(_quietly(queryable))

    def ask(self, command: Command, timeout_s: float) -> Health:
        """Ask, waiting for the target to appear until `timeout_s` is over. See `Bus.ask`."""
        self._check_open()
        deadline = time.monotonic() + timeout_s
        key = key_of("command", command.target)
        payload = encode(command)
        while (left_s := deadline - time.monotonic()) > 0:
            try:
                replies = self._session.get(
                    key, zenoh.handlers.FifoChannel(FIFO_DEPTH), timeout=left_s, payload=payload
                )
            except zenoh.ZError as error:  # closed by another thread meanwhile
                raise BusError(f"no answer from {command.target!r} to {command.verb!r}: {error}") from error
            for reply in replies:
                if reply.ok is not None:
                    if str(reply.ok.key_expr) != key:
                        raise BusError(f"somebody else answered for {command.target!r}")
                    return _health(command, reply.ok.payload.to_bytes())
                text = reply.err.payload.to_bytes().decode(errors="replace") if reply.err is not None else ""
                if text == "Timeout":  # zenoh's own word for a target that took the query and kept silent
                    break
                max_refusal = 2000  # characters of why a device refused a command
                raise BusError(
                    f"{command.target!r} refused {command.verb!r}: {printable(text[:max_refusal])}"
                )
            ask_again_s = 0.05  # a target that has just connected is not known everywhere yet
            # Nobody there yet looks the same as no answer: ask again, it costs nothing.
            time.sleep(max(0.0, min(ask_again_s, deadline - time.monotonic())))
        raise BusError(self._silence(command, timeout_s))

    def announce(self, name: str) -> None:
        """Declare the liveliness token of `name`; it dies with this process."""
        self._check_open()
        token = self._session.liveliness().declare_token(ALIVE_KEY.format(name=name))
        with self._lock:
            self._undeclare.append(_quietly(token))

    def alive(self) -> frozenset[str]:
        """Return the announced names of the connected processes and of this one."""
        if self._closed:
            return frozenset()
        try:
            liveliness_timeout_s = 0.5
            replies = self._session.liveliness().get(
                ALIVE_KEY.format(name=ANY),
                zenoh.handlers.FifoChannel(FIFO_DEPTH),
                timeout=liveliness_timeout_s,
            )
        except zenoh.ZError:  # closed by another thread meanwhile
            return frozenset()
        keys = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        return frozenset(printable(key.rsplit("/", 1)[-1]) for key in keys)

    def close(self) -> None:
        """Leave the bus: every thread ends, every declaration goes. Safe to call twice."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._closing.set()
            atexit.unregister(self.close)
            inboxes, undeclare, threads = list(self._inboxes), list(self._undeclare), list(self._threads)
        for inbox in inboxes:
            inbox.close()
        for forget in undeclare:
            forget()
        try:
            self._session.close()
        except zenoh.ZError as error:
            _LOG.warning("bus: closing: %s", error)
        for thread in threads:
            if thread is not threading.current_thread():
                join_s = 1.0  # a thread that zenoh does not release is left to the end of the process
                thread.join(join_s)

    def _check_open(self) -> None:
        if self._closed:
            raise BusError("the bus is closed")

    def _refusal(self) -> str:
        """Why no encrypted endpoint takes us; empty: there is none, or nothing is wrong."""
        if self._identity is None:
            return ""
        reasons = [why_refused(target, self._identity) for target in self._sealed]
        return "; ".join(dict.fromkeys(reason for reason in reasons if reason))

    def _silence(self, command: Command, timeout_s: float) -> str:
        """Return the likely reason why nobody answered."""
        text = (
            f"no answer from {command.target!r} to {command.verb!r} within {timeout_s:g} s ({self._where}): "
        )
        if self.peers == 0:
            if reason := self._refusal():
                return text + reason
            return text + "no process is connected. Is the master running, and is this its bus endpoint?"
        names = ", ".join(sorted(self.alive())) or "none announced"
        return text + f"{self.peers} connected, alive: {names}. Is the target running and named so?"


def _plain(error: zenoh.ZError) -> str:
    """What went wrong, without the places in zenoh's source that it names."""
    text = re.sub(r" at /\S+:\d+\.?", "", str(error)).rstrip(".")
    return re.sub(r"Unable to connect to any of .*Timeout!", "nobody answers there", text)


def _start(name: str, step: Callable[[], None], ended: Callable[[], bool]) -> threading.Thread:
    """Repeat `step` on a thread until zenoh ends its source: a fault unless `ended`."""

    def run() -> None:
        try:
            while True:
                step()
        except zenoh.ZError:
            return

    thread = threading.Thread(target=until(ended, run), name=name, daemon=True)
    thread.start()
    return thread


def _answer(query: zenoh.Query, name: str, handler: Handler) -> None:
    payload = query.payload
    command = decoded(payload.to_bytes(), Command) if payload is not None else None
    if not isinstance(command, Command):
        query.reply_err(b"not a command")
        return
    if command.target != name:  # who may ask whom is decided by the key, which must be the target's
        query.reply_err(f"a command for {command.target!r}, asked of {name!r}".encode())
        return
    try:
        query.reply(query.key_expr, encode(handler(command)))
    except (PhalanxError, ValueError) as error:
        query.reply_err(str(error).encode(errors="replace"))
    except Exception as error:  # noqa: BLE001
        # A fault in one handler must not make the process deaf to every later command.
        _LOG.exception("command %s of %s failed", command.verb, command.target)
        query.reply_err(f"internal fault: {error!r}".encode(errors="replace"))


def _health(command: Command, payload: bytes) -> Health:
    health = decoded(payload, Health)
    if not isinstance(health, Health) or health.source != command.target:
        raise BusError(
            f"{command.target!r} answered {command.verb!r} with something that is not its health report"
        )
    return health


class _Declared(Protocol):
    def undeclare(self) -> object: ...


def _quietly(declared: _Declared) -> Callable[[], None]:
    """Return an undeclaration that is safe to call when the session is gone already."""

    def run() -> None:
        try:
            declared.undeclare()
        except zenoh.ZError:
            return

    return run
