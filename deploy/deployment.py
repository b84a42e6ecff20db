"""Deploy the slave to a host, and wait until it sends.

All machines of a rig at once, step by step on each: look at it, bring packages, wheels and files, install; or take
back, or remove. A new version that runs and sends nothing costs the stream for as long as it is listened for. So
where a master runs and took all senders before, it waits twice as long as that took, or as the slave's own start did;
else `WAIT_SENDERS_S`.
"""

import json
import re
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

from deploy.payload import BUNDLE, Kind, RigFile, Target, bundle, command, wheelhouse
from deploy.remote import Deadline, DeployError, Remote, Secret, Terminal, run_bounded

# from READY=1 to the first datagram is a second; each one of waiting is a second without pictures
WAIT_SENDERS_S = 12.0
LEAST_S = 4.0  # a master reports its counts once a second, a beacon comes as often


Notify = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class ListenOptions:
    """How datagrams are received, for how long; options of `fleet status --wait`."""

    options: tuple[str, ...]
    keys: Path
    seconds: float = WAIT_SENDERS_S


@dataclass(frozen=True, slots=True)
class Received:
    """Datagrams that were received.

    Attributes:
        rates: Name -> datagrams a second, of those that were received.
        cause: Why nobody could listen; None: somebody did.
        master: Whether it was a master that runs, which others may ask meanwhile.
    """

    rates: Mapping[str, float] = field(default_factory=dict[str, float])
    cause: str | None = None
    master: bool = False


def received_of(
    names: Sequence[str], listening: ListenOptions, ended: threading.Event | None = None
) -> Received:
    """Return which senders `fleet status --wait` receives, until `ended` is set."""
    words = [sys.executable, "-m", "master", "fleet", "status", "--json"]
    words += ["--seconds", str(listening.seconds), *listening.options]
    words += [word for name in names for word in ("--wait", name)]
    lines: list[str] = []
    environment = {"PHALANX_KEYS": str(listening.keys)}
    limit_s = listening.seconds + 60.0  # the program that listens has to start and end, too
    code, errors = run_bounded(words, b"", lines.append, limit_s, environment, ended)
    results = [line for line in lines if line.startswith('{"heard"')]
    if not results:
        lines = [*lines, *errors] or [f"phalanx fleet status --wait ended with {code}"]
        return Received(cause=f"cannot listen for it: {lines[-1]}")
    answer = cast(dict[str, object], json.loads(results[-1]))
    rates = cast(dict[str, float], answer["heard"])
    return Received({name: float(rate) for name, rate in rates.items()}, None, answer.get("master") is True)


class Before:
    """Senders received before anything is changed; holds the thread that listens."""

    def __init__(self, names: Sequence[str], listening: ListenOptions) -> None:
        """Begin to listen, until `ended` is set."""
        self._names, self._listening = tuple(names), listening
        self._received, self._took_s = Received(), 0.0
        self.ended = threading.Event()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    @property
    def at_master(self) -> bool:
        """Whether a master runs, so that each machine can be checked by itself; blocks."""
        self._thread.join()
        return self._received.master

    def listening(self, start_s: float | None) -> ListenOptions:
        """How to listen for one machine afterwards.

        `start_s` is how long its slaves took to start before [s]; None: they did not run.
        """
        self._thread.join()
        if start_s is None or not self._received.master or set(self._received.rates) < set(self._names):
            return self._listening
        seconds = max(LEAST_S, 2.0 * self._took_s, 2.0 * start_s)
        return replace(self._listening, seconds=min(self._listening.seconds, seconds))

    def _listen(self) -> None:
        began = time.monotonic()
        listening = replace(self._listening, seconds=min(5.0, self._listening.seconds))
        self._received = received_of(self._names, listening, self.ended)
        self._took_s = time.monotonic() - began


STAGE = "/opt/phalanx/wheels"  # of the user who sends; the installer removes it
_PICAMERA2 = "picamera2"  # the default of cameras


@dataclass(frozen=True, slots=True)
class DeployRequest:
    """What the user wants on all machines.

    Attributes:
        master: Host name or address of the PC.
        calibration: calib_json tree of the PC.
        keys: Keys folder of the PC.
        options: Of the installer, handed on.
        cameras: Their drivers as given: DRIVER or NAME=DRIVER.
        wheels: Folder of wheels; None: they are downloaded.
        apt: Whether packages of the system are installed.
        ready_s: How long slaves may take until they are ready.
    """

    master: str
    rig: RigFile
    calibration: Path
    keys: Path | None
    options: tuple[str, ...]
    cameras: tuple[str, ...]
    wheels: Path | None
    apt: bool
    dry_run: bool
    ready_s: float

    def driver(self, names: Sequence[str]) -> str:
        """Return the driver of the cameras among `names`; empty: none is a camera.

        It decides what their machine has to have. Of several, picamera2 asks for the most.
        """
        drivers: list[str] = []
        for name in [one for one in names if one in self.rig.cameras]:
            given = [(one.partition("="), one) for one in self.cameras]
            own = [driver if whose == name else text for (whose, _, driver), text in given
                   if whose == name or whose not in self.rig.names]  # fmt: skip
            drivers.append(own[-1] if own else _PICAMERA2)
        return next((one for one in drivers if one.startswith(_PICAMERA2)), (drivers or [""])[0])


@dataclass(slots=True)
class Host:
    """One machine while it is deployed to.

    Attributes:
        sudo: How root is reached: sudo and its options; empty: we are root.
        password: Sudo's, a line; empty: it asks for none.
        changed: Whether something was changed, which can be taken back.
        reboot: Whether it runs only after it was restarted.
        start_s: How long its slaves took to start before [s]; None: none runs.
        known: Machines that were looked at, and by which name; the same of all of a command.
    """

    target: Target
    remote: Remote
    notify: Callable[[str], None]
    sudo: tuple[str, ...] = ()
    password: bytes = field(default=b"", repr=False)
    changed: bool = False
    reboot: bool = False
    start_s: float | None = None
    known: dict[str, str] = field(default_factory=dict[str, str])

    def deploy(self, request: DeployRequest) -> None:
        """Bring it to what is requested, or `DeployError`: it is as before."""
        camera = request.driver(self.target.names)
        picamera2 = camera.startswith(_PICAMERA2)
        facts = self.look(camera, request.apt)
        self._packages(facts, request, picamera2)
        old = facts["codename"] == "bookworm"  # whose simplejpeg was built for numpy 1
        kind = Kind(
            str(facts["machine"]),
            ".".join(str(part) for part in cast(list[int], facts["python"])),
            ("simplejpeg",) if picamera2 and old else (),
            ("wrist",) if request.rig.kind == "wrist" else (),
        )
        wheels = wheelhouse(kind, request.wheels, self.notify)
        stage = f"{STAGE}/{wheels.release}"
        if wheels.release not in cast(list[str], facts["releases"]):
            self.notify(f"{'would send' if request.dry_run else 'sending'} {wheels.size_mb:.0f} MB of wheels")
            if not request.dry_run:
                if self.sudo:  # a folder of the user's, so that rsync needs no root
                    made = [*self.sudo, "install", "-d", "-o", str(facts["user"]), STAGE, stage]
                    if self.remote.run(made, self.password, self.notify) != 0:
                        raise DeployError(f"cannot make {stage}")
                self.remote.send(wheels.files, stage)
        words = ["install", "--json", "--bundle", BUNDLE, "--master", request.master]
        words += ["--rig", request.rig.name, "--release", wheels.release, "--wheelhouse", stage]
        words += ["--ready-s", str(request.ready_s), *request.options]
        words += [word for name in self.target.names for word in ("--name", name)]
        words += ["--dry-run"] if request.dry_run else []
        packed = bundle(request.keys, self.target.names, request.calibration, request.rig)
        done = self._act(words, packed)
        self.changed = bool(done.get("changed")) or bool(done.get("restarted"))
        self.reboot = bool(done.get("reboot"))
        self.notify(str(done["text"]))

    def look(self, camera: str = "", apt: bool = True) -> dict[str, object]:
        """What it is like; DeployError: not reached, or nothing can be installed there."""
        lines: list[tuple[float, str]] = []
        code = self.remote.run(
            command(["probe", camera, *([] if apt else ["--no-apt"])]),
            bundle(),
            lambda line: lines.append((time.time(), line)),
            180.0,  # a person may be asked meanwhile
        )
        results = [(at, found) for at, line in lines if (found := _result(line)) is not None]
        if code != 0 or not results:
            raise DeployError(f"cannot look at it: {lines[-1][1] if lines else f'python3 ended with {code}'}")
        arrived, facts = results[-1]
        if facts["why_not"] is not None:
            raise DeployError(str(facts["why_not"]))
        first = self.known.setdefault(str(facts["boot_id"]), self.target.host)
        if first != self.target.host:
            raise DeployError(f"is the same machine as {first}: write NAME+NAME=HOST for two cameras of one")
        if facts["user"] != "root":
            self._become_root(str(facts["user"]), facts["root"] is True)
        self.start_s = cast("float | None", facts["start_s"])
        python = ".".join(str(part) for part in cast(list[int], facts["python"]))
        free = "free: {available_mb:.0f} of {memory_mb:.0f} MB memory, {swap_mb:.0f} MB swap, {free_mb:.0f} MB disk"
        self.notify(
            f"{facts['model']}, {facts['os']}, {facts['machine']}, Python {python}; {free.format(**facts)}"
        )
        ahead_s = cast(int, facts["t_unix_ns"]) * 1e-9 - arrived
        if abs(ahead_s) > 0.5:
            self.notify(
                f"its clock is {ahead_s:+.1f} s from this one; chrony brings it here, if this machine answers"
            )
        return facts

    def roll_back(self, dry_run: bool = False) -> str:
        """Go back to what was before; what is there now, or DeployError: it does not run."""
        return self._end("--rollback", dry_run)

    def uninstall(self, dry_run: bool) -> str:
        """Take everything of ours away; what that was, or DeployError."""
        return self._end("--uninstall", dry_run)

    def _end(self, option: str, dry_run: bool) -> str:
        words = ["install", "--json", option, *(["--dry-run"] if dry_run else [])]
        return str(self._act(words, bundle())["text"])

    def _packages(self, facts: dict[str, object], request: DeployRequest, picamera2: bool) -> None:
        """Install the packages that the system lacks, or report what it lacks."""
        there = cast(list[str], facts["packages"])
        wanted = ["rsync", "chrony", *(["python3-picamera2"] if picamera2 else [])]
        missing = [name for name in wanted if name not in there]
        if not missing:
            return
        if request.apt and not request.dry_run:
            self._act(["packages", *missing], bundle())
        else:
            self.notify(f"{'would install' if request.apt else 'not installed'}: {' '.join(missing)}")

    def _become_root(self, user: str, without_password: bool) -> None:
        """Find out how; DeployError: sudo does not take the password, or the user."""
        self.sudo = ("sudo", "-n", "--")
        if without_password:
            return
        fix = (
            "run it in one, or let sudo ask for none there: sudo raspi-config nonint do_sudo_pass 1 (Raspberry Pi OS), "
            "or a NOPASSWD rule in /etc/sudoers.d"
        )
        prompt = f"sudo password of {user} on {self.target.host.rpartition('@')[2]}"
        secret = Secret("password", self.target.host, prompt, fix)
        lines: list[str] = []
        while not self.password:
            given = self.remote.terminal.secret(secret, self.remote.deadline).encode() + b"\n"
            lines.clear()  # -k: it asks in any case, so that it never takes what is sent behind the password for one
            tried = ["sh", "-c", "LC_ALL=C exec sudo -k -S -p '' true 2>&1"]
            if self.remote.run(tried, given, lines.append, 60.0) == 0:
                self.sudo, self.password = ("sudo", "-k", "-S", "-p", "", "--"), given
            elif not re.search("incorrect|try again", "".join(lines)):
                raise DeployError(f"sudo: {' '.join(lines[-2:]) or 'failed'}")

    def _act(self, words: Sequence[str], packed: bytes) -> dict[str, object]:
        """Run the installer there and return its result; DeployError: why it failed."""
        result: dict[str, object] = {}
        last = ""

        def on_line(line: str) -> None:
            nonlocal last
            if (found := _result(line)) is not None:
                result.update(found)
            else:
                last = line
                self.notify(line)

        code = self.remote.run([*self.sudo, *command(words)], self.password + packed, on_line)
        if "error" in result:
            raise DeployError(str(result["error"]))
        if code != 0 or not result:
            raise DeployError(last.removeprefix("! ") or f"the installer ended with {code}")
        return result


def _result(line: str) -> dict[str, object] | None:
    """What the installer found or did; None: another line, or the link broke in it."""
    if not line.startswith('{"result"'):
        return None
    try:
        return cast(dict[str, object], json.loads(line)["result"])
    except ValueError:
        return None


@dataclass(frozen=True, slots=True)
class SshOptions:
    """How machines are reached, and by when all of one machine is done."""

    words: tuple[str, ...]
    deadline_s: float


def make_keys(folder: Path, names: Sequence[str], notify: Notify) -> None:
    """Make missing keys of a folder, by `phalanx fleet keys --make`; or DeployError."""
    wanted = [folder / one for one in ("rig.key", "devices.key", "ca.pem")]
    wanted += [folder / f"devices/{name}.{kind}" for name in names for kind in ("pem", "secret")]
    if all(path.is_file() for path in wanted):
        return
    notify(f"making keys in {folder}")
    devices = [word for name in names for word in ("--device", name)]
    words = [sys.executable, "-m", "master", "fleet", "keys", str(folder), "--make", *devices]
    lines: list[str] = []
    code, errors = run_bounded(words, b"", lines.append, 60.0)
    if code != 0:
        raise DeployError(f"keys: {([*lines, *errors] or ['phalanx fleet keys --make has no end'])[-1]}")


def deploy(
    targets: Sequence[Target],
    request: DeployRequest,
    ssh: SshOptions,
    listening: ListenOptions | None,
    terminal: Terminal,
) -> dict[str, str | None]:
    """Deploy to all at once; host -> None, or one line why it failed there.

    `listening` is how first datagrams are received; None: nobody listens.
    """
    hosts = _hosts(targets, ssh, terminal)
    if listening is None or request.dry_run:
        return _each(hosts, lambda host: host.deploy(request))
    before = Before([name for target in targets for name in target.names], listening)

    def one(host: Host) -> None:
        host.deploy(request)
        if not host.reboot and before.at_master:  # at once: others may take longer, and it may be silent
            own = before.listening(host.start_s)
            _judge(host, _received([host], own, host.remote.deadline.ended), own)

    try:
        failed = _each(hosts, one)
    finally:
        before.ended.set()
    there = [host for host in hosts if failed[host.target.host] is None and not host.reboot]
    if there and not before.at_master:  # then all are listened for together: one port, one start
        failed |= _wait_for_senders(there, listening)
    return failed


def end_all(
    targets: Sequence[Target], ssh: SshOptions, act: Callable[[Host], str], terminal: Terminal
) -> dict[str, str | None]:
    """Roll back or remove (`act`) on all machines; host -> None, or why it failed."""

    def one(host: Host) -> None:
        host.look()
        host.notify(act(host))

    return _each(_hosts(targets, ssh, terminal), one)


def _hosts(targets: Sequence[Target], ssh: SshOptions, terminal: Terminal) -> list[Host]:
    known: dict[str, str] = {}

    def host(target: Target) -> Host:
        remote = Remote(target.host, ssh.words, Deadline(ssh.deadline_s), terminal)
        return Host(target, remote, lambda line: terminal.notify(f"{target.host}: {line}"), known=known)

    return [host(target) for target in targets]


def _each(hosts: Sequence[Host], act: Callable[[Host], None]) -> dict[str, str | None]:
    def one(host: Host) -> str | None:
        try:
            act(host)
        except DeployError as error:
            if len(hosts) > 1:  # the others go on, which takes a while
                host.notify(f"failed: {error}")
            return str(error)
        return None

    with ThreadPoolExecutor(len(hosts)) as workers:
        waiting = [workers.submit(one, host) for host in hosts]
        try:
            hosts[0].remote.terminal.serve(waiting)
        except KeyboardInterrupt:  # each ends its ssh; what runs on a machine goes on to its end there
            for host in hosts:
                host.remote.deadline.end()
            raise
    return {host.target.host: one.result() for host, one in zip(hosts, waiting, strict=True)}


def _wait_for_senders(hosts: Sequence[Host], listening: ListenOptions) -> dict[str, str | None]:
    """Wait until each sender was received, and roll back machines that are silent."""
    received = _received(hosts, listening)
    return _each(hosts, lambda host: _judge(host, received, listening))


def _received(
    hosts: Sequence[Host], listening: ListenOptions, ended: threading.Event | None = None
) -> Received:
    for host in hosts:
        host.notify("waiting for its first datagram")
    return received_of([name for host in hosts for name in host.target.names], listening, ended)


def _judge(host: Host, received: Received, listening: ListenOptions) -> None:
    """Roll back a machine one of whose senders is silent, and raise DeployError."""
    missing = [name for name in host.target.names if name not in received.rates]
    if not missing:
        host.notify(f"streams: {', '.join(f'{n} {received.rates[n]:.0f}/s' for n in host.target.names)}")
        return
    why = received.cause or f"no datagram of {', '.join(missing)} in {listening.seconds:.0f} s at the master"
    if received.cause is not None or not host.changed:
        raise DeployError(why)
    try:
        back = host.roll_back()
    except DeployError as error:
        raise DeployError(f"{why}; going back failed, too: {error}") from error
    raise DeployError(f"{why}; {back}")
