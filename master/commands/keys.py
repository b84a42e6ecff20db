"""Make, show and revoke keys, and relay masters of several sites.

`phalanx fleet keys`: keys folder of a rig on its PC; `common.bus.keys` states what is in it. A certificate
cannot be called back one by one, and a device that is lost also has the rig key, which every device has. So
whoever is taken out costs everybody else new keys; that is a second of work here, and a `phalanx fleet
deploy` for the rest. `phalanx fleet relay`: repeats a master's messages to a router under the name of its
site; nothing comes down. Each stream has a thread and a bounded queue of its own, so that a slow link holds
up neither the master nor another stream; what did not fit is counted. Of the two ends of a relay only the
lower one is asked anything.
"""

import os
import re
import secrets
import tempfile
import threading
from argparse import Namespace
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, closing
from datetime import UTC, datetime
from pathlib import Path

from common.bus.bus import Bus, Subscription
from common.bus.keys import (
    AUTHORITY,
    DEVICES,
    DEVICES_KEY,
    MASTER,
    OPERATOR,
    OTHERS,
    RIG_KEY,
    KeyPair,
    Shown,
    access_of,
    issue,
    new_authority,
    new_key,
    shown,
)
from common.clock import Clock, SystemClock
from common.command_line import UsageError, echo
from common.errors import PhalanxError
from common.link.datagram import KEY_BYTES, device_secret
from common.machine import program
from common.messages import Command, Health
from common.messages.streams import sender_of
from master.run.process import bus_of_master, stop_on_signals

AUTHORITY_KEY = "ca.key"
_ENDINGS = ("pem", "key", "secret")
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")


def make(folder: Path, devices: Iterable[str], now: datetime) -> list[str]:
    """Make what is missing, and nothing else; return the files made, below `folder`.

    Nobody but its owner may enter the folder. `devices` are to have a certificate, whose ten years begin
    `now`, and a secret; a folder of before there were secrets gets them for all of its devices.

    Raises:
        PhalanxError: A name that no device can have; a folder or file that cannot be written.
    """
    names = list(dict.fromkeys(devices))
    for name in names:
        _check_name(name)
    made: list[str] = []

    def add(path: Path, content: bytes, mode: int) -> None:
        _write(path, content, mode)
        made.append(str(path.relative_to(folder)))

    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if folder.stat().st_mode & OTHERS:
            raise PhalanxError(
                f"{folder}: others can enter it; give a folder of its own, or run: chmod 700 {folder}"
            )
        signs = (folder / AUTHORITY_KEY).exists()
        if not signs and (folder / AUTHORITY).exists():  # before anything is made: other keys than the rig's
            raise PhalanxError(
                f"{folder}: has {AUTHORITY} but not {AUTHORITY_KEY}: it is the folder of a device, or a copy for"
                " one; make certificates where the key is"
            )
        (folder / DEVICES).mkdir(mode=0o700, exist_ok=True)
        for shared in (RIG_KEY, DEVICES_KEY):
            if not (folder / shared).exists():
                add(folder / shared, f"{new_key()}\n".encode(), 0o600)
        if not signs:
            authority = new_authority(now)
            add(folder / AUTHORITY, authority.certificate, 0o644)
            add(folder / AUTHORITY_KEY, authority.key, 0o600)
        authority = _authority(folder)
        for place in [folder / MASTER, folder / OPERATOR, *(folder / DEVICES / name for name in names)]:
            certificate, key = (place.with_name(f"{place.name}.{ending}") for ending in ("pem", "key"))
            if certificate.exists() and key.exists():
                continue
            pair = issue(authority, place.name, now)
            add(key, pair.key, 0o600)
            add(certificate, pair.certificate, 0o644)
        for name in lacks_secrets(folder):
            add(folder / DEVICES / f"{name}.secret", _secret(folder, name), 0o600)
    except OSError as error:
        raise PhalanxError(f"{folder}: cannot make keys: {error}") from error
    return made


def renew(folder: Path, now: datetime, without: Iterable[str] = ()) -> list[str]:
    """Make all keys anew, which ends the old; return the devices to deploy to.

    All is made first, then takes the place of the old; other files in the folder stay. Devices `without` get
    nothing; the ten years of the certificates begin `now`.

    Raises:
        PhalanxError: No such folder or device; it cannot be written.
    """
    gone = list(without)
    for name in gone:
        _check_device(folder, name)
    left = [name for name in devices_of(folder) if name not in gone]
    try:
        with tempfile.TemporaryDirectory(
            prefix=".new.", dir=folder
        ) as temporary:  # one file system: each file is replaced
            fresh = Path(temporary)
            made = make(fresh, left, now)
            for name in gone:
                for ending in _ENDINGS:
                    (folder / DEVICES / f"{name}.{ending}").unlink(missing_ok=True)
            for file in made:
                (fresh / file).replace(folder / file)
    except OSError as error:
        raise PhalanxError(f"{folder}: cannot renew it: {error}") from error
    return left


def renew_device(folder: Path, name: str, now: datetime) -> None:
    """Make a new certificate for one device.

    Its old one stays valid, its secret stays: for one that was lost or stolen use `renew`.

    Raises:
        PhalanxError: No such folder or device; it cannot be written. The old one is still there then.
    """
    _check_device(folder, name)
    place = folder / DEVICES / name
    try:
        pair = issue(_authority(folder), name, now)
        _write(place.with_name(f"{name}.key"), pair.key, 0o600)
        _write(place.with_name(f"{name}.pem"), pair.certificate, 0o644)
    except OSError as error:
        raise PhalanxError(f"{folder}: cannot renew {name!r}: {error}") from error


def devices_of(folder: Path) -> list[str]:
    """Names of the devices that have certificates.

    Raises:
        PhalanxError: It is not the keys folder of a PC.
    """
    if not (folder / AUTHORITY_KEY).exists():
        raise PhalanxError(
            f"{folder}: no keys folder (no {AUTHORITY_KEY}): phalanx fleet keys {folder} --make"
        )
    return sorted(path.stem for path in (folder / DEVICES).glob("*.pem"))


def _check_device(folder: Path, name: str) -> None:
    if name not in (names := devices_of(folder)):
        raise PhalanxError(f"{folder}: no device {name!r}; there are: {', '.join(names) or 'none'}")


def files_of_device(name: str) -> tuple[str, ...]:
    """What of the folder belongs on a device, by their places in it."""
    return RIG_KEY, AUTHORITY, *(f"{DEVICES}/{name}.{ending}" for ending in _ENDINGS)


def lacks_secrets(folder: Path) -> list[str]:
    """Return the devices without a secret of `devices.key`; without that key, all.

    Raises:
        PhalanxError: It is not the keys folder of a PC; a file is broken, or cannot be read.
    """
    names = devices_of(folder)
    if not (folder / DEVICES_KEY).exists():
        return names
    try:
        return [
            name
            for name in names
            if not (path := folder / DEVICES / f"{name}.secret").exists()
            or path.read_bytes() != _secret(folder, name)
        ]
    except OSError as error:
        raise PhalanxError(f"{folder}: cannot read the secrets of devices: {error}") from error


def certificates_of(folder: Path) -> list[Shown]:
    """Return the contents of the certificates of master, operator and devices.

    Raises:
        PhalanxError: It is not the keys folder of a PC; a certificate is broken.
    """
    listed: list[Shown] = []
    for path in [folder / f"{MASTER}.pem", folder / f"{OPERATOR}.pem",
                 *(folder / DEVICES / f"{name}.pem" for name in devices_of(folder))]:  # fmt: skip
        try:
            listed.append(shown(path.read_bytes()))
        except (OSError, ValueError) as error:
            raise PhalanxError(f"{path}: cannot read the certificate ({error})") from error
    return listed


def _authority(folder: Path) -> KeyPair:
    return KeyPair((folder / AUTHORITY).read_bytes(), (folder / AUTHORITY_KEY).read_bytes())


def _secret(folder: Path, name: str) -> bytes:
    """What `devices/NAME.secret` is to be."""
    try:
        root = bytes.fromhex((folder / DEVICES_KEY).read_text(encoding="ascii"))
        if len(root) != KEY_BYTES:
            raise ValueError(f"{len(root)} bytes, must be {KEY_BYTES}")
    except ValueError as error:
        raise PhalanxError(
            f"{folder / DEVICES_KEY}: broken ({error}); phalanx fleet keys {folder} --renew makes all keys anew"
        ) from error
    return f"{device_secret(root, name).hex()}\n".encode()


def _check_name(name: str) -> None:
    if not _NAME.fullmatch(name) or name in (MASTER, OPERATOR, ".", ".."):
        raise PhalanxError(
            f"--device {name!r}: must be the name of a camera, IMU or tracker: up to 64 of A-Z a-z 0-9 _ . -, and"
            f" neither {MASTER} nor {OPERATOR}"
        )


def _write(path: Path, content: bytes, mode: int) -> None:
    """Write a file that is private from its first moment on, whole or not at all."""
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
        temporary = Path(file.name)
        try:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
            temporary.chmod(mode)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


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
    """Print each certificate's holder, use and end, and the devices without a secret."""
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


STREAMS = ("hand", "object", "contact", "gesture", "health", "checklist")
NAME = "relay"


class Relay:
    """Relay that repeats messages from a master's bus `below` to a router's `above`.

    Both belong to the caller.
    """

    def __init__(self, below: Bus, above: Bus, clock: Clock) -> None:
        self.session = secrets.randbits(63)
        self._below, self._above, self._clock = below, above, clock
        self._repeated: Counter[str] = Counter(dict.fromkeys(STREAMS, 0))
        self._stop = threading.Event()
        depth = 256  # messages of a stream that may wait: 1.4 s of a hand at 90 Hz with its contact
        self._from = {stream: below.subscribe(stream, depth=depth) for stream in STREAMS}
        self._threads = [
            threading.Thread(target=self._repeat, args=(stream, source), name=f"relay {stream}", daemon=True)
            for stream, source in self._from.items()
        ]
        for thread in self._threads:
            thread.start()
        below.announce(NAME)
        above.announce(NAME)
        below.serve(NAME, self._answer)

    def health(self) -> Health:
        """Return repeated.STREAM, and dropped. and refused.STREAM where there are any."""
        counts = {f"repeated.{stream}": number for stream, number in dict(self._repeated).items()}
        for stream, source in self._from.items():
            lost = {f"dropped.{stream}": source.dropped, f"refused.{stream}": source.refused}
            counts |= {name: number for name, number in lost.items() if number}
        return Health(NAME, self.session, self._clock.now_ns(), counts, {}, *program())

    def report(self, notify: Callable[[str], None], stop: threading.Event) -> None:
        """Report health once a second until `stop`, and a line each minute.

        Health is published below, from where it is repeated above as all health is.
        """
        minute = 0
        while not stop.wait(1.0):
            health = self.health()
            self._below.publish("health", NAME, health)
            minute += 1
            if minute % 60 == 1:
                notify(", ".join(f"{name} {number}" for name, number in health.counts.items() if number))

    def close(self) -> None:
        """End. Safe to call twice."""
        self._stop.set()
        for source in self._from.values():
            source.close()
        for thread in self._threads:
            thread.join(2.0)

    def _answer(self, command: Command) -> Health:
        """Return the health; another verb than "report" is a ValueError for the asker."""
        if command.verb != "report":
            raise ValueError(f"{NAME}: no command {command.verb!r}; there is report")
        return self.health()

    def _repeat(self, stream: str, source: Subscription) -> None:
        while not self._stop.is_set():
            message = source.get(0.2)
            if message is not None:
                self._above.publish(stream, sender_of(message), message)
                self._repeated[stream] += 1


def relay(options: Namespace) -> None:
    """Run a router, to which relays and readers connect, or a relay beside a master.

    Raises:
        UsageError: An option is of the other one.
    """
    if options.listen is not None:
        if options.router is not None:
            raise UsageError("--router is for --site; two routers are joined by --connect")
        _route(options.listen, options.connect)
        return
    if options.router is None:
        raise UsageError("--site: give the address of the router, --router ENDPOINT")
    if options.connect:
        raise UsageError("--connect is for --listen")
    stop = stop_on_signals()
    with ExitStack() as stack:
        below = bus_of_master(
            options.bus, stop, lambda error: echo(f"relay: waiting for the master: {error}")
        )
        if below is None:
            return
        stack.callback(below.close)
        above = bus_of_master(
            options.router, stop, lambda error: echo(f"relay: waiting for the router: {error}"), options.site
        )
        if above is None:
            return
        stack.callback(above.close)
        repeats = Relay(below, above, SystemClock())
        stack.callback(repeats.close)
        echo(f"relay: repeating as {options.site}")
        repeats.report(lambda line: echo(f"relay: {line}"), stop)


def _route(listen: str, connect: Sequence[str]) -> None:
    stop = stop_on_signals()
    from common.bus.zenoh_bus import ZenohBus  # the other commands on keys need no bus

    with closing(ZenohBus(listen, connect, access_of(os.environ, MASTER), router=True)) as bus:
        echo(f"router: listening on {listen}" + "".join(f", joined with {one}" for one in connect))
        joined = 0
        while not stop.wait(0.5):
            if bus.peers != joined:
                joined = bus.peers
                echo(f"router: joined with {joined} of other routers")
