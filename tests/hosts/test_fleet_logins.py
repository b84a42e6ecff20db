"""Hosts as Raspberry Pi OS makes them today: sudo asks, logins ask, host keys are unknown or changed.

Each host has a password of its own, which no process, journal or file may show.
"""

import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.hosts.debian import BOOKWORM, why_not
from tests.hosts.fleet import Fleet
from tests.hosts.host import Account, Host
from tests.hosts.measured import Measured
from tests.hosts.person import Reader, at_terminal
from tests.hosts.rig import Ran, Rig

BY_KEY, BY_PASSWORD = "horse-battery 7", "correct&staple 9"  # of the user who logs in so
KEYBOARD = (
    "PubkeyAuthentication no\nKbdInteractiveAuthentication yes\nAuthenticationMethods keyboard-interactive"
)
PASSWORD = "PubkeyAuthentication no\nPasswordAuthentication yes\nAuthenticationMethods password"


@pytest.fixture(scope="module")
def fleet() -> Iterator[Fleet]:
    """Two hosts of users that are not `pi`, of the two systems there are."""
    if (reason := why_not()) is not None:
        pytest.skip(reason)
    users = {"left": Account("maker", BY_KEY), "right": Account("ana", BY_PASSWORD, KEYBOARD, BOOKWORM)}
    with Fleet(users, (os.getpid() + 1) % 250 + 1) as hosts:
        yield hosts


@pytest.fixture(scope="module")
def rig(fleet: Fleet) -> Rig:
    return Rig(fleet, fleet.folder)


def deploy(rig: Rig, *answers: tuple[str, str], more: tuple[str, ...] = (), name: str = "") -> Ran:
    """Deploy to both hosts, or to that one, by a person at a terminal."""
    targets = (f"{name}={rig.fleet.hosts[name].login}",) if name else rig.targets
    words = rig.deploy_words("--no-wait", *more, targets=targets)
    return at_terminal([sys.executable, "-m", *words], answers, rig.source, rig.environment)


def hosts_known(rig: Rig, content: str) -> tuple[Path, tuple[str, ...]]:
    """A file of known hosts, and the options with which ssh asks about others."""
    known = rig.folder / "known"
    known.write_text(content)
    options = (f"UserKnownHostsFile={known}", "StrictHostKeyChecking=ask", "IdentitiesOnly=yes")
    words = [word for option in options for word in ("--ssh-option", option)]
    return known, ("--identity", str(rig.folder / "id"), *words)


def known_words(rig: Rig, options: tuple[str, ...]) -> tuple[str, ...]:
    """Words of a dry run to `left` that knows hosts by those options."""
    words = rig.deploy_words("--no-wait", "--dry-run", targets=(f"left={rig.fleet.hosts['left'].login}",))
    return tuple(word for word in words if word not in rig.fleet.ssh_options) + options


def fingerprint(host: Host) -> str:
    shown = host.run("ssh-keygen -lf /etc/ssh/ssh_host_ed25519_key.pub")
    return shown.split()[1]


def at_home(rig: Rig, words: tuple[str, ...], *answers: tuple[str, str]) -> Ran:
    return at_terminal([sys.executable, "-m", *words], answers, rig.source, rig.environment)


def test_an_unknown_host_key_is_shown_and_refused_where_nobody_is_asked(rig: Rig) -> None:
    known, options = hosts_known(rig, "")
    ran = rig.program(*known_words(rig, options))
    assert ran.code == 1
    assert f"its host key is not known here: ED25519 {fingerprint(rig.fleet.hosts['left'])}; " in ran.err, (
        str(ran)
    )
    assert "to accept it: ssh maker@" in ran.err
    assert known.read_text() == ""


def test_a_person_compares_an_unknown_host_key_and_accepts_it_or_not(rig: Rig) -> None:
    known, options = hosts_known(rig, "")
    refused = at_home(rig, known_words(rig, options), (r"\(yes/no", "no"))
    assert refused.code == 1
    assert "Host key verification failed: it is not known here, or was not accepted" in refused.out
    assert known.read_text() == ""
    taken = at_home(rig, known_words(rig, options), (r"\(yes/no", "yes"), ("sudo password of maker", BY_KEY))
    assert taken.code == 0, str(taken)
    assert fingerprint(rig.fleet.hosts["left"]) in taken.out
    assert taken.out.count("(yes/no") == 1, "it is known then"
    assert "ssh-ed25519" in known.read_text()


def test_a_changed_host_key_is_refused_with_the_fix_and_the_fix_helps(rig: Rig) -> None:
    host, other = rig.fleet.hosts["left"], rig.folder / "other"
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(other)], check=True)
    known, options = hosts_known(rig, f"{host.address} {other.with_suffix('.pub').read_text()}")
    ran = at_home(rig, known_words(rig, options))
    fix = ["ssh-keygen", "-f", str(known), "-R", host.address]
    assert ran.code == 1
    assert f"its host key (ED25519 {fingerprint(host)}) is not the one known here" in ran.out, str(ran)
    assert f"forget the old key: {shlex.join(fix)}\n" in ran.out
    subprocess.run(fix, check=True, capture_output=True)
    again = at_home(rig, known_words(rig, options), (r"\(yes/no", "yes"), ("sudo password of maker", BY_KEY))
    assert again.code == 0, str(again)


def test_where_nobody_can_be_asked_each_host_is_named_with_what_to_do(rig: Rig) -> None:
    ran = rig.deploy("--no-wait")
    assert ran.code == 1
    left, right = ran.err.splitlines()
    assert left.startswith(f"{rig.fleet.hosts['left'].login}: FAILED: sudo password of maker on ")
    assert "sudo raspi-config nonint do_sudo_pass 1" in left
    assert right.startswith(f"{rig.fleet.hosts['right'].login}: FAILED: (ana@")
    assert f"ssh-copy-id {rig.fleet.hosts['right'].login} puts your key there" in right


def test_a_wrong_password_is_asked_for_once_more_and_then_the_host_is_named(rig: Rig) -> None:
    question = "sudo password of maker"
    ran = deploy(rig, (question, "wrong"), (f"refused; once more: {question}", "wrong, too"), name="left")
    assert ran.code == 1
    login = rig.fleet.hosts["left"].login
    assert f"{login}: FAILED: {question} on {login[6:]}: refused there, twice" in ran.out, str(ran)
    assert "wrong" not in ran.out, "what was typed is not shown"
    ended = deploy(rig, (question, "\x04"), name="left")
    assert "FAILED: no answer was given" in ended.out


def test_two_hosts_with_different_passwords_are_asked_for_once_each_and_nobody_sees_them(
    rig: Rig, measured: Measured
) -> None:
    with Reader(BY_KEY, BY_PASSWORD) as reader:
        ran = deploy(rig, ("assword", BY_KEY), ("once more.*assword", BY_PASSWORD))
    assert ran.code == 0, str(ran)
    measured("deploy to two hosts that ask, at a terminal", ran.seconds)
    assert ran.out.count("assword") == 2, str(ran)
    assert f"Debian GNU/Linux 13 (trixie), {platform.machine()}, Python 3.13; free: " in ran.out
    assert f"Debian GNU/Linux 12 (bookworm), {platform.machine()}, Python 3.11; free: " in ran.out
    assert reader.rounds > 100
    assert reader.found == set()
    assert_nowhere(rig, ran)
    for host in rig.fleet.hosts.values():
        assert host.main_pid() > 0
        user = f"runuser -u {host.account.user} --"
        assert host.run(f"{user} sh -lc 'command -v phalanx-slave'") == "/usr/local/bin/phalanx-slave"
        assert host.try_run(f"{user} sh -c 'command -v phalanx || command -v phalanx-master'").returncode != 0
        found = host.try_run(f"cd /; {user} phalanx-slave doctor --json")
        assert found.returncode in (0, 1), found.stderr
        assert "only root may look: sudo phalanx-slave doctor" in found.stdout
        assert "Traceback" not in found.stderr
        words = f"phalanx-slave run --name {host.name} --camera synthetic --keys /etc/phalanx/keys"
        host.run("cp -r /var/lib/phalanx/calib_json /tmp && chmod -R a+rX /tmp/calib_json")
        refused = host.try_run(f"cd /tmp; {user} {words}")
        assert refused.returncode == 1
        assert "/etc/phalanx/keys: these keys are of root or of another user: sudo, or" in refused.stderr
        assert host.try_run("ls /opt/phalanx/wheels").returncode != 0, "what was sent is gone"


def assert_nowhere(rig: Rig, ran: Ran) -> None:
    """Fail where a password stands in a file of PC or host, a journal, or what the person saw."""
    for password in (BY_KEY, BY_PASSWORD):
        assert password not in ran.out + ran.err
        for host in rig.fleet.hosts.values():
            assert password not in host.run("journalctl --no-pager -o json", 60.0), host.name
        files = [
            path for path in rig.folder.rglob("*") if "root" not in path.relative_to(rig.folder).parts[1:2]
        ]
        assert len(files) > 1000
        for path in files:
            if path.is_file() and not path.is_symlink():
                assert password.encode() not in path.read_bytes(), path


def test_one_password_of_all_hosts_is_asked_for_once_by_password_login_too(rig: Rig) -> None:
    right = rig.fleet.hosts["right"]
    (right.tree / "etc/ssh/sshd_config.d/user.conf").write_text(f"Match User ana\n{PASSWORD}\n")
    right.run("systemctl reload ssh")
    subprocess.run(["chroot", str(right.tree), "chpasswd"], input=f"ana:{BY_KEY}".encode(), check=True)
    logins = [host.login for host in rig.fleet.hosts.values()]
    words = ("master", "fleet", "rollback", *logins, *rig.fleet.ssh_options)
    ran = at_home(rig, words, ("assword", BY_KEY))
    assert ran.code == 0, str(ran)
    assert ran.out.count("assword") == 1
    words = ("master", "fleet", "uninstall", *logins, *rig.fleet.ssh_options)
    ran = at_home(rig, words, ("assword", BY_KEY))
    assert ran.code == 0, str(ran)
    assert ran.out.count("assword") == 1
    assert right.run("ls /usr/local/bin") == ""
    assert_nowhere(rig, ran)


def test_a_passphrase_of_a_key_is_asked_for_once(rig: Rig) -> None:
    right, key = rig.fleet.hosts["right"], rig.folder / "locked"
    (right.tree / "etc/ssh/sshd_config.d/user.conf").write_text("")
    right.run("systemctl reload ssh")
    key.write_bytes((rig.folder / "id").read_bytes())
    key.chmod(0o600)
    subprocess.run(["ssh-keygen", "-q", "-p", "-P", "", "-N", "open sesame", "-f", str(key)], check=True)
    options = [str(key) if word == str(rig.folder / "id") else word for word in rig.fleet.ssh_options]
    logins = [host.login for host in rig.fleet.hosts.values()]
    words = ("master", "fleet", "uninstall", "--dry-run", *logins, *options)
    with Reader("open sesame") as reader:
        ran = at_home(rig, words, ("passphrase for key", "open sesame"), ("sudo password of", BY_KEY))
    assert ran.code == 0, str(ran)
    assert (ran.out.count("passphrase"), ran.out.count("sudo password")) == (1, 1), str(ran)
    assert {one for one in reader.found if "ssh-keygen" not in one} == set()


def test_the_reader_finds_what_is_planted() -> None:
    with Reader("planted-1", "planted-2") as reader:
        subprocess.run(["sh", "-c", "sleep 1; : planted-1"], check=True)
        subprocess.run(["sleep", "1"], env={"GIVEN": "planted-2"}, check=True)
    assert {one.split()[1] for one in reader.found} == {"cmdline:", "environ:"}
