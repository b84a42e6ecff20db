"""Run commands and copy files on the hosts of a fleet.

Commands go by ssh, files by rsync, and both come to an end, also when the network goes meanwhile. What ssh and sudo
ask is asked on the terminal, once for all hosts; the answers are in this process and in pipes alone: in no command
line, environment, file or log.
"""

import contextlib
import getpass
import json
import math
import os
import queue
import re
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO


class DeployError(Exception):
    """A demo or deployment that is not possible; one line why, and what to do."""


# A link that is gone shows after nine seconds. Secrets given for other hosts are tried, too: more than ssh's three.
_PROMPTS = "NumberOfPasswordPrompts=6"
_SETTINGS = ("ConnectTimeout=10", "ServerAliveInterval=3", "ServerAliveCountMax=3", _PROMPTS)
_HINTS = (  # the first that is found
    ("Could not resolve hostname", "HOST is not known here: is it on, in this network? Or give its address"),
    ("Connection refused", "no sshd answers on HOST: sudo systemctl enable --now ssh there, or give --port"),
    ("No route to host", "nobody has the address HOST: is it on, in this network, is its address new?"),
    ("Network is unreachable", "this machine has no way to HOST: is its own network up?"),
    ("Connection timed out", "HOST does not answer: is it on, in this network? A firewall at port 22?"),
    ("Permission denied", "no key or password is taken: ssh-copy-id HOST, or another user by USER@HOST"),
    ("Host key verification failed", "it is not known here, or was not accepted: ssh HOST shows it"),
)


class Deadline:
    """When all must be done; `end` makes it now."""

    def __init__(self, seconds: float) -> None:
        """So many seconds from now."""
        self._end, self._seconds, self._why = time.monotonic() + seconds, seconds, ""
        self.ended = threading.Event()

    def end(self, why: str = "interrupted") -> None:
        """End what runs, for this reason."""
        self._why = why
        self.ended.set()

    def left_s(self) -> float:
        """What is left [s]; DeployError: nothing."""
        if self.ended.is_set():
            raise DeployError(self._why)
        left = self._end - time.monotonic()
        if left <= 0.0:
            raise DeployError(f"not done within {self._seconds:.0f} s (--deadline)")
        return left


@dataclass(slots=True)
class Secret:
    """A secret that one machine asks for, until it takes one.

    Attributes:
        kind: One that was given is tried on all machines that ask for this kind; empty: it is used once.
        prompt: What a person sees.
        fix: What to do where nobody can be asked.
        answers: What the machine got so far.
        typed: Of them, what a person typed for this one.
    """

    kind: str
    host: str
    prompt: str
    fix: str
    answers: list[str] = field(default_factory=list[str], repr=False)
    typed: list[str] = field(default_factory=list[str], repr=False)


# In ssh's place it asks this process: which machine, which ssh, what.
_HELPER = """#!/bin/sh
exec {python} -IS -c '
import json, os, socket, sys
ask = socket.socket(socket.AF_UNIX)
ask.connect(sys.argv[1])
about = [os.environ[one] for one in ("PHALANX_HOST", "SSH_ASKPASS_PROMPT") if one in os.environ]
ask.sendall(json.dumps([os.getppid(), sys.argv[2], *about]).encode() + b"\\n")
answer = ask.makefile().read()
sys.exit(print(answer) if answer else 1)
' {socket} "$1"
"""


class Terminal:
    """Lines to a person and questions, one at a time; holds the secrets given.

    Threads ask; `serve` on the main thread reads the answers, so that Ctrl-C ends a question, and what was given for
    one machine answers the next before it is asked.
    """

    def __init__(self, write: Callable[[str], None] = lambda _line: None, there: bool = False) -> None:
        """`write` takes lines; `there`: whether a person can be asked."""
        self._write, self._there, self._several = write, there, False
        self._lock, self._folder = threading.Lock(), ""
        self._questions: queue.SimpleQueue[tuple[Callable[[], str], Future[str]] | None] = queue.SimpleQueue()
        self._given: dict[str, list[str]] = {}
        self._last: dict[tuple[str, str], str] = {}
        self._secrets: dict[tuple[str, int, str], Secret] = {}
        self._deadlines: dict[str, Deadline] = {}

    @contextlib.contextmanager
    def listening(self) -> Generator["Terminal"]:
        """Answer what ssh asks, on a socket of this user alone."""
        with (
            tempfile.TemporaryDirectory(prefix="phalanx-") as self._folder,
            socket.socket(socket.AF_UNIX) as asks,
        ):
            asks.bind(f"{self._folder}/ask")
            asks.listen()
            words = {"python": shlex.quote(sys.executable), "socket": shlex.quote(f"{self._folder}/ask")}
            (helper := Path(self._folder, "askpass")).write_text(_HELPER.format(**words))
            helper.chmod(0o700)
            threading.Thread(target=self._listen, args=(asks,), daemon=True).start()
            try:
                yield self
            finally:
                with contextlib.suppress(OSError):
                    asks.shutdown(socket.SHUT_RDWR)

    def notify(self, line: str) -> None:
        """Write a line, printable, when no question is open."""
        with self._lock:
            self._write(printable(line))

    def environment(self, host: str, deadline: Deadline) -> dict[str, str]:
        """With which ssh asks here; what has no answer ends `deadline`."""
        self._deadlines[host] = deadline
        helper = f"{self._folder}/askpass" if self._folder else "/bin/false"
        return {"SSH_ASKPASS": helper, "SSH_ASKPASS_REQUIRE": "force", "PHALANX_HOST": host}

    def secret(self, secret: Secret, deadline: Deadline) -> str:
        """The next one to try; DeployError: nobody is there, or none is taken."""
        return self._ask(lambda: self._next(secret), deadline)

    def serve(self, waiting: Sequence[Future[str | None]]) -> None:
        """Ask what threads ask until all of `waiting` are done."""
        self._several = len(waiting) > 1
        for one in waiting:
            one.add_done_callback(lambda _one: self._questions.put(None))
        left = len(waiting)
        while left:
            if (question := self._questions.get()) is None:
                left -= 1
                continue
            read, answer = question
            if answer.set_running_or_notify_cancel():
                try:
                    answer.set_result(read())
                except (DeployError, OSError, EOFError) as error:
                    answer.set_exception(DeployError(str(error) or "no answer was given"))

    def _ask(self, read: Callable[[], str], deadline: Deadline) -> str:
        answer: Future[str] = Future()
        self._questions.put((read, answer))
        try:
            while not wait([answer], 0.2).done:
                deadline.left_s()
        finally:
            answer.cancel()
        return answer.result()

    def _next(self, secret: Secret) -> str:
        given, place = self._given.setdefault(secret.kind, []), (secret.kind, secret.host)
        known = [self._last.get(place), *given] if secret.kind else []
        answer = next((one for one in known if one is not None and one not in secret.answers), None)
        if answer is None:
            if not self._there:
                raise DeployError(f"{secret.prompt}: here is no terminal to ask for it; {secret.fix}")
            if len(secret.typed) == 2:
                raise DeployError(f"{secret.prompt}: refused there, twice; is it another user?")
            for wrong in [one for one in secret.typed if one in given]:
                given.remove(wrong)
            again = "refused; once more: " if secret.typed else ""
            others = " (tried on the others, too)" if self._several and secret.kind else ""
            with self._lock:
                try:
                    answer = getpass.getpass(printable(f"{again}{secret.prompt}{others}: "))
                except (EOFError, KeyboardInterrupt):
                    self._write("")  # behind the question
                    raise
            secret.typed.append(answer)
            given.append(answer)
        secret.answers.append(answer)
        self._last[place] = answer
        return answer

    def _listen(self, asks: socket.socket) -> None:
        with contextlib.suppress(OSError):  # closed
            while True:
                peer = asks.accept()[0]
                with peer, contextlib.suppress(OSError, ValueError, KeyError):  # not our helper
                    ssh, prompt, host, *hint = json.loads(peer.makefile().readline())
                    peer.sendall(self._answer(host, ssh, prompt.strip(), "none" in hint).encode())

    def _answer(self, host: str, ssh: int, prompt: str, only_shown: bool) -> str:
        """What the ssh of this number gets; empty: nothing, and it is ended."""
        if only_shown:  # as: touch your key
            self.notify(f"{host}: {prompt}")
            return ""
        deadline, about = self._deadlines[host], prompt.rstrip(": ")
        try:
            if "(yes/no" in prompt:
                return self._ask(lambda: self._confirm(host, prompt), deadline)
            kind = next((one for one in ("passphrase", "password") if one in prompt.lower()), "")
            kind = about if kind == "passphrase" else kind  # of that key, on all machines
            fix = f"ssh-copy-id {host} puts your key there, ssh-agent holds it here"
            secret = Secret(kind, host, about, fix)
            return self.secret(self._secrets.setdefault((host, ssh, prompt), secret), deadline)
        except DeployError as error:
            deadline.end(str(error))
            return ""

    def _confirm(self, host: str, prompt: str) -> str:
        key = re.search(r"(\S+) key fingerprint is:? (\S+?)\.?$", prompt, re.MULTILINE)
        there = f"{host} itself shows its own by: ssh-keygen -lf /etc/ssh/ssh_host_ed25519_key.pub"
        if not self._there:
            which = f": {' '.join(key.groups())}" if key else ""
            raise DeployError(f"its host key is not known here{which}; {there}; to accept it: ssh {host}")
        lines = "\n".join(printable(line) for line in prompt.splitlines())
        with self._lock, Path("/dev/tty").open("w") as shown, Path("/dev/tty").open() as typed:
            shown.write(f"{there}\n{lines} ")
            shown.flush()
            return typed.readline().strip()


@dataclass(frozen=True, slots=True)
class Remote:
    """How one machine, HOST or USER@HOST, is reached, with options of ssh."""

    host: str
    options: tuple[str, ...]
    deadline: Deadline
    terminal: Terminal = field(default_factory=Terminal)

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

    def send(self, files: Sequence[Path], to: str) -> None:
        """Send files to the folder `to` there, but for what is there, whole or in part.

        Raises:
            DeployError: The machine is not reached, its disk is full, the link broke, or the time is over.
        """
        words = ["rsync", "--partial", "--times", "--mkpath", "--timeout=30"]
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
        asking = self.terminal.environment(self.host, self.deadline)
        found = run_bounded(words, send, on_line, limit_s, asking, self.deadline.ended)
        if found[0] is None or self.deadline.ended.is_set():
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
    if "REMOTE HOST IDENTIFICATION" in text:
        return _changed_key(text, host)
    for sign, hint in _HINTS:
        if sign in text:
            return f"{sign}: {hint.replace('HOST', host)}"
    noise = ("Warning:", "** ", "rsync error: error in rsync protocol")
    own = [line for line in errors if not line.startswith(noise)]
    return (own or ["the connection broke"])[0].removeprefix("ssh: ")


def _changed_key(text: str, host: str) -> str:
    """What to do about a host key that is not the one known."""
    now = re.search(r"for the (\S+) key sent by the remote host is\s+(\S+?)\.?$", text, re.MULTILINE)
    name = re.search(r"Host key for (\S+) has changed", text)
    file = re.search(r"Offending .* in (.+):\d+", text)
    words = [
        "ssh-keygen",
        *(["-f", file[1]] if file else []),
        "-R",
        name[1] if name else host.rpartition("@")[2],
    ]
    shown = f" ({' '.join(now.groups())})" if now else ""
    return (
        f"its host key{shown} is not the one known here: another machine has its name or address, or its system was "
        f"written anew; if that is meant, forget the old key: {shlex.join(words)}"
    )
