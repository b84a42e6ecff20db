"""What ssh and sudo ask, by stand-ins of both: asked once, tried on all machines, and seen in no process or line."""

import json
import os
import re
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from deploy import commands, remote
from deploy.remote import Deadline, DeployError, Remote, Terminal
from master.cli.table import program

FACTS = {"why_not": None, "user": "pi", "root": False, "start_s": None, "model": "m", "os": "o",
         "machine": "aarch64", "python": [3, 13], "memory_mb": 416.0, "available_mb": 300.0, "swap_mb": 0.0,
         "free_mb": 9000.0}  # fmt: skip
# Answers as a machine does, each with the password of its name; keeps each program's command line and environment.
SSH = """#!/bin/sh
tr '\\0' '\\n' < /proc/$$/environ >> {folder}/seen; tr '\\0' ' ' < /proc/$$/cmdline >> {folder}/seen
for word; do host=$command command=$word; done
case $host in *asks)
  test "$("$SSH_ASKPASS" "pi@$host's password: ")" = "pw-$host" ||
  test "$("$SSH_ASKPASS" "pi@$host's password: ")" = "pw-$host" ||
  test "$("$SSH_ASKPASS" "pi@$host's password: ")" = "pw-$host" || {{ echo 'Permission denied' >&2; exit 255; }}
esac
case $command in
python3*) cat > /dev/null; sed "s/BOOT/$host/" {folder}/facts;;
*) HOST=$host; export HOST; exec sh -c "$command";;
esac
"""
SUDO = """#!/bin/sh
tr '\\0' '\\n' < /proc/$$/environ >> {folder}/seen; tr '\\0' ' ' < /proc/$$/cmdline >> {folder}/seen
read -r line
case $HOST in unlisted*) echo 'pi is not in the sudoers file.' >&2; exit 1;; esac
test "$line" = "pw-$HOST" || test "$line" = pw-all || {{ echo 'sudo: 1 incorrect password attempt' >&2; exit 1; }}
case "$*" in *python3*) cat > {folder}/payload-$HOST; echo '{{"result": {{"text": "removed all"}}}}';; esac
"""

Typed = Callable[..., list[str]]


@pytest.fixture
def typed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Typed:
    """A person at a terminal: types these answers, then the right ones; what was asked is returned.

    Stand-ins take the places of ssh and sudo.
    """
    facts = json.dumps({"result": FACTS | {"boot_id": "BOOT", "t_unix_ns": time.time_ns()}})
    (tmp_path / "facts").write_text(facts + "\n")
    for name, text in (("ssh", SSH), ("sudo", SUDO)):
        (tmp_path / name).write_text(text.format(folder=tmp_path))
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")

    def answers(*given: str, there: bool = True) -> list[str]:
        asked: list[str] = []
        left = list(given)

        def read(prompt: str) -> str:
            asked.append(prompt)
            return left.pop(0) if left else f"pw-{prompt.partition(' (')[0].rpartition(' ')[2]}"

        monkeypatch.setattr(remote.getpass, "getpass", read)
        monkeypatch.setattr(commands, "_asks", lambda: there)
        return asked

    return answers


def uninstall(*hosts: str) -> int:
    return program().main(["fleet", "uninstall", *hosts])


def test_one_password_is_asked_for_once_and_reaches_sudo_before_the_payload_alone(
    typed: Typed, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = typed("pw-all")
    assert uninstall("left", "right") == 0
    assert len(asked) == 1
    assert re.fullmatch(r"sudo password of pi on (left|right) \(tried on the others, too\): ", asked[0])
    printed = capsys.readouterr()
    assert printed.out.count("removed all") == 2
    seen = (tmp_path / "seen").read_text()
    assert "SSH_ASKPASS_REQUIRE=force" in seen
    assert "sudo -k -S -p  -- python3" in seen.replace("/bin/sh ", "").replace(f"{tmp_path}/", "")
    assert "pw-all" not in seen + printed.out + printed.err
    for host in ("left", "right"):  # a zip, from its first byte on
        assert (tmp_path / f"payload-{host}").read_bytes().startswith(b"PK")


def test_a_machine_with_another_password_is_asked_for_by_its_name(typed: Typed) -> None:
    asked = typed()
    assert uninstall("left", "right") == 0
    assert sorted(asked) == [
        f"sudo password of pi on {one} (tried on the others, too): " for one in ("left", "right")
    ]


def test_a_wrong_password_has_one_more_try_and_the_machine_is_named(
    typed: Typed, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = typed("secret-1", "pw-left")
    assert uninstall("left") == 0
    assert asked == ["sudo password of pi on left: ", "refused; once more: sudo password of pi on left: "]
    asked = typed("secret-1", "secret-2")
    assert uninstall("pi@left") == 1
    printed = capsys.readouterr()
    assert printed.err.startswith("pi@left: FAILED: sudo password of pi on left: refused there, twice; is it")
    assert "secret" not in printed.out + printed.err


def test_without_a_terminal_nobody_is_asked_and_the_way_out_is_said(
    typed: Typed, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = typed(there=False)
    assert uninstall("left", "asks") == 1
    left, other = capsys.readouterr().err.splitlines()
    assert left.startswith(
        "left: FAILED: sudo password of pi on left: here is no terminal to ask for it; run it in one"
    )
    assert "raspi-config nonint do_sudo_pass 1" in left
    assert "NOPASSWD" in left
    assert other.startswith(
        "asks: FAILED: pi@asks's password: here is no terminal to ask for it; ssh-copy-id asks "
    )
    assert asked == []


def test_who_may_not_use_sudo_is_not_asked_again(typed: Typed, capsys: pytest.CaptureFixture[str]) -> None:
    asked = typed("pw-all")
    assert uninstall("unlisted") == 1
    assert "unlisted: FAILED: sudo: pi is not in the sudoers file." in capsys.readouterr().err
    assert len(asked) == 1


def test_the_password_of_a_login_is_that_of_sudo_too_and_of_each_connection(
    typed: Typed, tmp_path: Path
) -> None:
    asked = typed("pw-asks")
    assert uninstall("asks") == 0
    assert asked == ["pi@asks's password: "], "three connections and sudo"
    assert "pw-asks" not in (tmp_path / "seen").read_text()


def test_a_refused_login_ends_at_the_second_wrong_answer(
    typed: Typed, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = typed("a", "b")
    assert uninstall("asks") == 1
    assert len(asked) == 2
    assert "asks: FAILED: pi@asks's password: refused there, twice" in capsys.readouterr().err


def test_an_interruption_at_a_question_ends_all_at_once(
    typed: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    typed()
    monkeypatch.setattr(remote.getpass, "getpass", _interrupted)
    began, threads = time.monotonic(), threading.active_count()
    assert uninstall("left", "right") == 130
    assert time.monotonic() - began < 60.0
    assert threading.active_count() <= threads + 1, "but for the one that listens, which ends with its socket"


def _interrupted(_prompt: str) -> str:
    raise KeyboardInterrupt


def test_lines_wait_while_a_question_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    output: list[str] = []
    terminal = Terminal(output.append, there=True)

    def read(prompt: str) -> str:
        threading.Thread(target=terminal.notify, args=("a line",)).start()
        time.sleep(0.2)
        output.append(prompt)
        return "x"

    monkeypatch.setattr(remote.getpass, "getpass", read)
    assert terminal._next(remote.Secret("", "left", "code", "")) == "x"
    end = time.monotonic() + 60.0
    while len(output) < 2 and time.monotonic() < end:
        time.sleep(0.01)
    assert output == ["code: ", "a line"]


def test_a_code_that_holds_once_is_asked_for_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    codes = ["123", "456"]

    def read(_prompt: str) -> str:
        return codes.pop(0)

    monkeypatch.setattr(remote.getpass, "getpass", read)
    terminal = Terminal(there=True)
    assert [terminal._next(remote.Secret("", "left", "code", "")) for _ in "ab"] == ["123", "456"]


def test_what_only_has_to_be_looked_at_is_shown_and_answered_by_nobody(tmp_path: Path) -> None:
    output: list[str] = []
    with Terminal(output.append).listening() as terminal:
        (tmp_path / "ssh").write_text(
            '#!/bin/sh\nSSH_ASKPASS_PROMPT=none "$SSH_ASKPASS" "Touch \x1b[2Jyour key"\n'
        )
        (tmp_path / "ssh").chmod(0o755)
        environment = terminal.environment("left", Deadline(60.0))
        code, _ = remote.run_bounded([str(tmp_path / "ssh")], b"", print, 60.0, environment)
    assert code == 1
    assert output == ["left: Touch ?[2Jyour key"]


def test_the_socket_is_of_this_user_alone_and_goes(tmp_path: Path) -> None:
    with Terminal().listening() as terminal:
        folder = Path(terminal.environment("left", Deadline(1.0))["SSH_ASKPASS"]).parent
        assert folder.stat().st_mode & 0o777 == 0o700
    assert not folder.exists()


def test_an_unknown_host_key_is_refused_with_its_fingerprint_where_nobody_is_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    question = (
        "The authenticity of host 'left (10.0.0.5)' can't be established.\nED25519 key fingerprint is SHA256:abc/+1.\n"
        "This key is not known by any other names.\nAre you sure you want to continue (yes/no/[fingerprint])? "
    )
    (tmp_path / "question").write_text(question)
    (tmp_path / "ssh").write_text(f'#!/bin/sh\n"$SSH_ASKPASS" "$(cat {tmp_path}/question)"; sleep 60\n')
    (tmp_path / "ssh").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    with Terminal().listening() as terminal, ThreadPoolExecutor(1) as pool:
        login = pool.submit(_login, Remote("pi@left", (), Deadline(60.0), terminal))
        terminal.serve([login])
    with pytest.raises(DeployError) as refused:
        login.result()
    assert "its host key is not known here: ED25519 SHA256:abc/+1; " in str(refused.value)
    assert str(refused.value).endswith("to accept it: ssh pi@left")


def _login(machine: Remote) -> str | None:
    machine.run(["true"], b"", print)
    return None
