"""Run commands and copy files on the hosts of a fleet.

Hosts of a command line are assigned to the cameras of a rig's file. Commands go by ssh, files by rsync, and both come
to an end, also when the network goes meanwhile.
"""

import contextlib
import json
import math
import os
import re
import shlex
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, cast

_HOST = re.compile(r"(?:[A-Za-z0-9._-]+@)?[A-Za-z0-9.:-]+")


class DeployError(Exception):
    """A demo or deployment that is not possible; one line why, and what to do."""


@dataclass(frozen=True, slots=True)
class Target:
    """A machine, and the cameras and IMUs of the rig that it serves."""

    host: str
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RigFile:
    """A rig's file, as far as it matters here."""

    name: str
    kind: str
    hand: str
    cameras: tuple[str, ...]
    imu: str | None
    imu_placed: bool  # whether its orientations on the palm and to the world are known
    objects: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """All that send."""
        return self.cameras + (() if self.imu is None else (self.imu,))

    @property
    def files(self) -> tuple[str, ...]:
        """Its files below calib_json."""
        cameras = [f"cameras/{one}.json" for one in self.cameras]
        objects = [f"objects/{one}.json" for one in self.objects]
        return (f"rigs/{self.name}.json", *cameras, f"hands/{self.hand}.json", *objects)


def read_rig(calibration: Path, name: str) -> RigFile:
    """Read `rigs/NAME.json`.

    Raises:
        DeployError: It is missing or broken.
    """
    path = calibration / "rigs" / f"{name}.json"
    try:
        rig = cast(dict[str, object], json.loads(path.read_text()))
        cameras = tuple(str(one) for one in cast(list[object], rig["cameras"]))
        objects = tuple(str(one) for one in cast(list[object], rig.get("objects") or []))
        imu = cast(dict[str, object], rig.get("imu") or {})
        imu_name = str(imu.get("name", "imu")) if imu else None
        placed = imu.get("q_palm_imu") is not None and imu.get("q_rig_world") is not None
        return RigFile(name, str(rig["kind"]), str(rig["hand"]), cameras, imu_name, placed, objects)
    except (OSError, ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
        raise DeployError(
            f"{path}: cannot read the rig ({error}); give --calibration DIR and --rig NAME"
        ) from error


def targets_of(hosts: Sequence[str], rig: RigFile) -> list[Target]:
    """Parse `HOST` or `NAME[+NAME...]=HOST` of each host.

    Hosts without a name take the rig's cameras in their order. The IMU of a rig goes to the host of its first
    camera, unless it is named.

    Raises:
        DeployError: A name is none of the rig's, stands twice, or there are more hosts than cameras.
    """
    split = [host.rpartition("=") for host in hosts]
    named = [name for names, _, _ in split for name in names.split("+") if names]
    free = [camera for camera in rig.cameras if camera not in named]
    targets: list[Target] = []
    for names, _, host in split:
        if not _HOST.fullmatch(host) or host.startswith("-"):
            raise DeployError(f"{host!r}: not a host; write HOST, USER@HOST or NAME=HOST")
        if not names and not free:
            raise DeployError(
                f"{host}: rig {rig.name!r} has no camera left for it; it has {', '.join(rig.cameras)}"
            )
        own = tuple(names.split("+")) if names else (free.pop(0),)
        if rig.imu is not None and rig.imu not in named and own[0] == rig.cameras[0]:
            own += (rig.imu,)
        targets.append(Target(host, own))
    given = [name for target in targets for name in target.names]
    for name in given:
        if name not in rig.names:
            raise DeployError(
                f"rig {rig.name!r} has no camera or IMU {name!r}; it has {', '.join(rig.names)}"
            )
        if given.count(name) > 1:
            raise DeployError(f"{name}: stands twice; each camera has one host")
    if len({target.host for target in targets}) < len(targets):
        raise DeployError("a host stands twice: write NAME+NAME=HOST for two cameras of one machine")
    return targets


# A link that is gone shows after nine seconds
_SETTINGS = ("BatchMode=yes", "ConnectTimeout=10", "ServerAliveInterval=3", "ServerAliveCountMax=3")
_HINTS = (  # the first that is found: a changed host key is reported with two of them
    (
        "Could not resolve hostname",
        "no machine of that name is known here; switched on, in this network? Or give its address in place of HOST",
    ),
    ("Connection refused", "no sshd answers on HOST: sudo systemctl enable --now ssh there, or give --port"),
    (
        "No route to host",
        "nobody has the address HOST: switched on, in this network, is its address another now?",
    ),
    ("Network is unreachable", "this machine has no way to HOST: is its own network up?"),
    (
        "Connection timed out",
        "HOST does not answer: switched on, in this network? A firewall that drops port 22?",
    ),
    ("Permission denied", "your key is not known there: ssh-copy-id HOST"),
    (
        "REMOTE HOST IDENTIFICATION",
        "another machine answers than before: ssh-keygen -R ADDRESS, if that is meant",
    ),
    ("Host key verification failed", "its host key is not known here: ssh HOST once, and look at it"),
)


class Deadline:
    """When all must be done; `ended` is set where somebody wants an end before."""

    def __init__(self, seconds: float) -> None:
        """So many seconds from now."""
        self._end, self._seconds = time.monotonic() + seconds, seconds
        self.ended = threading.Event()

    def left_s(self) -> float:
        """What is left [s]; DeployError: nothing."""
        if self.ended.is_set():
            raise DeployError("interrupted")
        left = self._end - time.monotonic()
        if left <= 0.0:
            raise DeployError(f"not done within {self._seconds:.0f} s (--deadline)")
        return left


@dataclass(frozen=True, slots=True)
class Remote:
    """How one machine, HOST or USER@HOST, is reached, with options of ssh."""

    host: str
    options: tuple[str, ...]
    deadline: Deadline

    def run(
        self, command: Sequence[str], send: bytes, on_line: Callable[[str], None], limit_s: float = math.inf
    ) -> int:
        """Run a command there, with input `send`, and return its exit code.

        Raises:
            DeployError: The machine is not reached, the link broke, or the time is over.
        """
        words = [*self._ssh(), "--", self.host, shlex.join(command)]
        code, errors = self._bounded(words, send, on_line, limit_s)
        if code is None:
            raise DeployError(f"no answer within {limit_s:.0f} s")
        if code == 255:  # ssh's own: not reached
            raise DeployError(_plain(errors, self.host))
        if code != 0 and errors:
            on_line(f"! {errors[-1]}")
        return code

    def send(self, files: Sequence[Path], to: str, sudo: bool) -> None:
        """Send files to the folder `to` there, but for what is there, whole or in part.

        Raises:
            DeployError: The machine is not reached, its disk is full, the link broke, or the time is over.
        """
        words = ["rsync", "--partial", "--times", "--mkpath", "--timeout=15"]
        if sudo:
            words += ["--rsync-path", "sudo -n rsync"]
        user, at, address = self.host.rpartition("@")
        host = f"{user}{at}[{address}]" if ":" in address else self.host  # as rsync wants an IPv6 address
        words += ["-e", shlex.join(self._ssh()), "--", *map(str, files), f"{host}:{to}/"]
        code, errors = self._bounded(words, b"", lambda _line: None)
        if code != 0:
            raise DeployError(f"rsync: {_plain(errors, self.host)}")

    def _bounded(
        self, words: Sequence[str], send: bytes, on_line: Callable[[str], None], limit_s: float = math.inf
    ) -> tuple[int | None, list[str]]:
        """As `run_bounded`; None: after `limit_s`, and DeployError after the deadline."""
        limit_s = min(limit_s, self.deadline.left_s())
        found = run_bounded(words, send, on_line, limit_s, ended=self.deadline.ended)
        if found[0] is None:
            self.deadline.left_s()
        return found

    def _ssh(self) -> list[str]:
        return ["ssh", *(word for setting in _SETTINGS for word in ("-o", setting)), *self.options]


def run_bounded(
    words: Sequence[str],
    send: bytes,
    on_line: Callable[[str], None],
    limit_s: float,
    environment: Mapping[str, str] | None = None,
    ended: threading.Event | None = None,
) -> tuple[int | None, list[str]]:
    """Run a command of this machine; return exit code and lines of its errors.

    After `limit_s` [s], or when `ended` is set, it is ended with all that it started: None.

    Raises:
        DeployError: There is no such command.
    """
    try:
        child = subprocess.Popen(
            list(words),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=None if environment is None else {**os.environ, **environment},
            start_new_session=True,  # so that what it starts ends with it
        )
    except FileNotFoundError as error:
        raise DeployError(
            f"{words[0]}: not found on this machine; install it (Debian: apt install {words[0]})"
        ) from error
    assert child.stdin is not None
    assert child.stdout is not None
    assert child.stderr is not None
    errors: list[str] = []
    threads = [
        threading.Thread(target=_write_input, args=(child.stdin, send), daemon=True),
        threading.Thread(target=_lines, args=(child.stdout, on_line), daemon=True),
        threading.Thread(target=_lines, args=(child.stderr, errors.append), daemon=True),
    ]
    for thread in threads:
        thread.start()
    end = time.monotonic() + limit_s
    code: int | None = None
    try:
        while code is None and time.monotonic() < end and not (ended is not None and ended.is_set()):
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = child.wait(min(0.5, max(0.0, end - time.monotonic())))
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
        child.wait()
    for thread in threads[1:]:
        thread.join(2.0)
    return code, [line for line in errors if line.strip()]


def _write_input(pipe: IO[bytes], content: bytes) -> None:
    with contextlib.suppress(BrokenPipeError), pipe:
        pipe.write(content)


def _lines(pipe: IO[bytes], on_line: Callable[[str], None]) -> None:
    with pipe:
        for line in pipe:
            on_line(printable(line.decode(errors="replace").rstrip("\r\n")))


def printable(text: str) -> str:
    """The text with ? for control characters: a device writes to the user's terminal."""
    return "".join(c if c.isprintable() or c == "\t" else "?" for c in text)


def _plain(errors: Sequence[str], host: str) -> str:
    """The line that gives the reason, with what to do about it."""
    text = "\n".join(errors)
    for sign, hint in _HINTS:
        if sign in text:
            return f"{sign}: {hint.replace('HOST', host).replace('ADDRESS', host.rpartition('@')[2])}"
    noise = ("Warning:", "** ", "rsync error: error in rsync protocol")
    own = [line for line in errors if not line.startswith(noise)]
    return (own or ["the connection broke"])[0].removeprefix("ssh: ")
