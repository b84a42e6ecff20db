"""`phalanx fleet deploy` where it needs no other machine: names of hosts, wheels, what is sent, deadlines, rollback."""

import json
import os
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest

from deploy import deployment
from deploy import payload as wheels_module
from deploy.commands import prepared_keys
from deploy.deployment import DeployRequest, Host, ListenOptions, Received, make_keys
from deploy.payload import (
    BUNDLE,
    RigFile,
    Target,
    bundle,
    command,
    own_wheel,
    read_rig,
    targets_of,
    wheelhouse,
)
from deploy.remote import Deadline, DeployError, Remote
from master.cli.table import program
from master.commands.fleet import Device, table
from master.commands.keys import make

ROOT = Path(__file__).resolve().parents[2]


def main(words: list[str]) -> int:
    return program().main(words)


DESK, WRIST = (read_rig(ROOT / "calib_json", name) for name in ("desk", "wrist"))


@pytest.mark.parametrize(
    ("hosts", "rig", "expected"),
    [
        (["a", "b"], DESK, [("a", "left"), ("b", "right")]),
        (["right=pi@b", "a"], DESK, [("pi@b", "right"), ("a", "left")]),
        (["left+right=a"], DESK, [("a", "left", "right")]),
        (["b"], WRIST, [("b", "wrist", "imu")]),
        (["wrist=a", "imu=b"], WRIST, [("a", "wrist"), ("b", "imu")]),
    ],
)
def test_hosts_take_cameras_in_the_order_of_the_rig_or_by_name(
    hosts: list[str], rig: RigFile, expected: list[tuple[str, ...]]
) -> None:
    assert [(t.host, *t.names) for t in targets_of(hosts, rig)] == expected


@pytest.mark.parametrize(
    ("hosts", "output"),
    [
        (["a", "b", "c"], "c: rig 'desk' has no camera left for it; it has left, right"),
        (["up=a"], "rig 'desk' has no camera or IMU 'up'"),
        (["left=a", "left=b"], "left: stands twice"),
        (["left=a", "right=a"], "a host stands twice"),
        (["left=-oProxyCommand"], "not a host"),
        (["a b"], "not a host"),
    ],
)
def test_hosts_that_do_not_fit_are_refused(hosts: list[str], output: str) -> None:
    with pytest.raises(DeployError) as refused:
        targets_of(hosts, DESK)
    assert output in str(refused.value)


def test_our_own_wheel_is_whole_and_always_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "a"))
    wheel = own_wheel()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "b"))
    assert own_wheel().read_bytes() == wheel.read_bytes()
    target = tmp_path / "site"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-compile"]
    subprocess.run([*pip, "--target", str(target), str(wheel)], check=True)
    assert (target / "slave/install/files/phalanx-slave@.service").is_file()
    assert (target / "bin/phalanx-slave").is_file()
    names = zipfile.ZipFile(wheel).namelist()
    assert not [name for name in names if "__pycache__" in name]
    assert {name.split("/")[0] for name in names if "." not in name.split("/")[0]} == set(
        wheels_module.PACKAGES
    )


def test_a_given_wheelhouse_gets_ours_and_a_release_is_named_by_all_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = _file(tmp_path / "phalanx_hand-1.0-py3-none-any.whl", b"0")
    monkeypatch.setattr(wheels_module, "own_wheel", lambda: ours)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    given, kind = tmp_path / "given", wheels_module.Kind("aarch64", "3.13")
    given.mkdir()
    with pytest.raises(DeployError, match="no wheels in it"):
        wheelhouse(kind, given, print)
    (given / "numpy-2.0-py3-none-any.whl").write_bytes(b"1")
    one = wheelhouse(kind, given, print)
    (given / "numpy-2.0-py3-none-any.whl").write_bytes(b"2")
    two = wheelhouse(kind, given, print)
    assert one.release != two.release
    assert [file.name.split("-")[0] for file in one.files] == ["numpy", "phalanx_hand"]
    assert list(given.iterdir()) == [given / "numpy-2.0-py3-none-any.whl"], "the user's folder stays as it is"


def test_what_is_sent_has_the_keys_of_that_machine_alone_and_runs_from_memory(tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    make(keys, ("left", "right"), datetime.now(UTC))
    sent = bundle(keys, ["left"], ROOT / "calib_json", DESK)
    names = zipfile.ZipFile(_file(tmp_path / "sent.zip", sent)).namelist()
    assert sorted(name for name in names if "keys" in name) == [
        f"payload/keys/{name}"
        for name in ("ca.pem", "devices/left.key", "devices/left.pem", "devices/left.secret", "rig.key")
    ]
    for other in ("devices.key", "devices/right.secret", "devices/right.key", "ca.key"):
        kept = (keys / other).read_bytes()
        assert not [name for name in names if kept in zipfile.ZipFile(tmp_path / "sent.zip").read(name)], (
            other
        )
    words = ["install", "--json", "--dry-run", "--bundle", BUNDLE, "--master", "10.0.0.2", "--name", "left"]
    words += [
        "--release",
        "1.0-0",
        "--camera",
        "synthetic",
        "--root",
        str(tmp_path / "root"),
        "--wheelhouse",
        "/none/x",
    ]
    (tmp_path / "root").mkdir()
    systemctl = tmp_path / "bin/systemctl"
    systemctl.parent.mkdir()
    systemctl.write_text("#!/bin/sh\necho ActiveState=inactive\n")
    systemctl.chmod(0o755)
    environment = {"PATH": f"{systemctl.parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        command(words), input=sent, capture_output=True, cwd="/", env=environment, check=False
    )
    result = json.loads(done.stdout.splitlines()[-1])["result"]
    assert done.returncode == 0, done.stderr.decode()
    assert {f"etc/phalanx/keys/device-left.{kind}" for kind in ("pem", "key", "secret")} < {
        *result["changed"]
    }
    assert not list((tmp_path / "root").iterdir()), "a dry run writes nothing"


@pytest.fixture
def fake_ssh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Puts a script in the place of ssh, and one that only starts it in that of rsync."""

    def put(text: str) -> None:
        for name, script in (("ssh", text), ("rsync", "ssh & wait")):
            (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
            (tmp_path / name).chmod(0o755)
        monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")

    return put


def test_a_link_that_hangs_ends_by_the_deadline_with_all_that_it_started(
    fake_ssh: Callable[[str], None], tmp_path: Path
) -> None:
    fake_ssh(f"sleep 300 & echo $! > {tmp_path}/child; wait")
    began = time.monotonic()
    with pytest.raises(DeployError, match=r"not done within 1 s \(--deadline\)"):
        Remote("host", (), Deadline(1.0)).run(["true"], b"", print)
    with pytest.raises(DeployError, match="--deadline"):
        Remote("host", (), Deadline(0.5)).send((tmp_path / "ssh",), "/tmp")
    assert time.monotonic() - began < 60.0
    child = Path(f"/proc/{(tmp_path / 'child').read_text().strip()}/stat")
    assert not child.exists() or " Z " in child.read_text()


@pytest.mark.parametrize(
    ("output", "expected"),
    [
        (
            "ssh: Could not resolve hostname pi: Name or service not known",
            "Could not resolve hostname: pi is not known here: is it on, in this network? Or give its address",
        ),
        (
            "pi@pi: Permission denied (publickey,password).",
            "Permission denied: no key or password is taken: ssh-copy-id pi, or another user by USER@pi",
        ),
        (
            "ssh: connect to host pi port 22: Connection refused",
            "Connection refused: no sshd answers on pi: sudo",
        ),
        (
            "Host key verification failed.",
            "Host key verification failed: it is not known here, or was not accepted: ssh pi shows it",
        ),
        (
            "@ WARNING: REMOTE HOST IDENTIFICATION HAS CHANGED! @\nHost key verification failed.",
            "if that is meant, forget the old key: ssh-keygen -R pi",
        ),
        ("ssh: connect to host pi port 22: No route to host", "nobody has the address pi: is it on"),
        ("ssh: connect to host pi port 22: Connection timed out", "pi does not answer: is it on"),
    ],
)
def test_a_host_that_is_not_reached_is_reported_in_one_line_with_what_to_do(
    fake_ssh: Callable[[str], None],
    output: str,
    expected: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    fake_ssh(f"echo '{output}' >&2; exit 255")
    assert main(["fleet", "uninstall", "pi"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("pi: FAILED: ")
    assert expected in error
    assert error.count("\n") == 1


class Remembered(Host):
    """A machine that only remembers that it was sent back."""

    back = 0

    def roll_back(self, dry_run: bool = False) -> str:
        self.back += 1
        return "back at release 1.0-0"


def _hosts(output: list[str]) -> list[Remembered]:
    remote = Remote("none", (), Deadline(9.0))
    hosts = [
        Remembered(Target(name, (name,)), remote, output.append, changed=True) for name in ("left", "right")
    ]
    hosts[1].changed = False
    return hosts


def _receive_only(
    monkeypatch: pytest.MonkeyPatch, received: dict[str, float], cause: str | None = None
) -> None:
    def answer(*_arguments: object) -> Received:
        return Received(received, cause)

    monkeypatch.setattr(deployment, "received_of", answer)


def test_a_machine_that_is_not_heard_goes_back_and_others_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    output: list[str] = []
    hosts = _hosts(output)
    _receive_only(monkeypatch, {"right": 30.0})
    failed = deployment._wait_for_senders(hosts, ListenOptions((), Path("keys"), 3.0))
    assert failed == {
        "left": "no datagram of left in 3 s at the master; back at release 1.0-0",
        "right": None,
    }
    assert [host.back for host in hosts] == [1, 0]
    assert "streams: right 30/s" in output


def _before(monkeypatch: pytest.MonkeyPatch, received: Received) -> deployment.Before:
    def answer(*_arguments: object) -> Received:
        return received

    monkeypatch.setattr(deployment, "received_of", answer)
    return deployment.Before(["left", "right"], ListenOptions((), Path("keys"), 12.0))


def test_what_streamed_at_a_master_is_listened_for_as_long_as_it_needs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    streamed = _before(monkeypatch, Received({"left": 30.0, "right": 30.0}, None, True))
    assert streamed.at_master
    assert streamed.listening(1.0).seconds == deployment.LEAST_S
    assert streamed.listening(3.5).seconds == pytest.approx(7.0)
    assert streamed.listening(60.0).seconds == pytest.approx(12.0)
    assert streamed.listening(None).seconds == pytest.approx(12.0), "it did not run: nobody knows"
    one_silent = _before(monkeypatch, Received({"left": 30.0}, None, True))
    assert one_silent.listening(1.0).seconds == pytest.approx(12.0)
    no_master = _before(monkeypatch, Received({"left": 30.0, "right": 30.0}, None, False))
    assert not no_master.at_master
    assert no_master.listening(1.0).seconds == pytest.approx(12.0)


def test_one_machine_by_two_names_is_refused(fake_ssh: Callable[[str], None]) -> None:
    facts = {"why_not": None, "user": "root", "boot_id": "7", "start_s": None, "model": "m", "os": "o",
             "machine": "aarch64", "python": [3, 13], "t_unix_ns": time.time_ns(),
             "memory_mb": 416.0, "available_mb": 300.0, "swap_mb": 0.0, "free_mb": 9000.0}  # fmt: skip
    fake_ssh(f"cat > /dev/null; echo '{json.dumps({'result': facts})}'")
    known: dict[str, str] = {}
    for name in ("pi.local", "10.0.0.5"):
        host = Host(Target(name, ("left",)), Remote(name, (), Deadline(60.0)), print, known=known)
        if name == "pi.local":
            host.look()
            continue
        with pytest.raises(DeployError, match=r"is the same machine as pi.local: write NAME\+NAME=HOST"):
            host.look()


def test_a_dry_run_without_keys_says_so_and_makes_none(tmp_path: Path) -> None:
    keys, output = tmp_path / "keys", list[str]()
    with prepared_keys(keys, ["left"], True, output.append) as lent:
        assert (lent / "devices/left.key").is_file()
    assert output == [f"would make keys in {keys}"]
    assert not keys.exists()
    assert not lent.exists()
    with prepared_keys(keys, ["left"], False, output.append) as own:
        assert own == keys
    del output[:]
    with prepared_keys(keys, ["left", "right"], True, output.append) as lent:
        assert (lent / "rig.key").resolve() == (keys / "rig.key").resolve()
        assert (lent / "devices/right.key").is_file()
    assert output == [f"would make keys in {keys}"]
    assert not (keys / "devices/right.key").exists()


def test_wheels_of_another_machine_are_refused_here(tmp_path: Path) -> None:
    kind = wheels_module.Kind("aarch64", "3.13")
    for name, expected in (
        ("numpy-2.4-cp313-cp313-manylinux_2_27_aarch64.manylinux_2_28_aarch64.whl", True),
        ("zenoh-1.1-cp39-abi3-manylinux_2_28_aarch64.whl", True),
        ("smbus2-0.6-py2.py3-none-any.whl", True),
        ("numpy-2.4-cp312-cp312-manylinux_2_27_aarch64.whl", False),
        ("numpy-2.4-cp313-cp313-manylinux_2_27_x86_64.whl", False),
        ("new-1.0-cp314-abi3-manylinux_2_28_aarch64.whl", False),
        ("none.whl", False),
    ):
        assert wheels_module.fits(name, kind) is expected, name
    wrong = tmp_path / "numpy-2.4-cp312-cp312-manylinux_2_27_aarch64.whl"
    wrong.write_bytes(b"")
    with pytest.raises(DeployError, match=r"phalanx fleet wheels DIR --machine aarch64 --python 3\.13"):
        wheelhouse(kind, tmp_path, print)


def test_what_was_not_changed_stays_and_so_does_all_if_nobody_can_listen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    hosts = _hosts([])
    _receive_only(monkeypatch, {"left": 30.0})
    assert (
        deployment._wait_for_senders(hosts, ListenOptions((), Path("keys"), 3.0))["right"]
        == "no datagram of right in 3 s at the master"
    )
    _receive_only(monkeypatch, {}, "cannot listen for it: port taken")
    assert set(deployment._wait_for_senders(hosts, ListenOptions((), Path("keys"), 3.0)).values()) == {
        "cannot listen for it: port taken"
    }
    assert [host.back for host in hosts] == [0, 0]


def test_missing_keys_are_made_and_what_is_there_stays(tmp_path: Path) -> None:
    keys, output = tmp_path / "keys", list[str]()
    make_keys(keys, ["left"], output.append)
    rig_key = (keys / "rig.key").read_text()
    make_keys(keys, ["left"], output.append)
    assert output == [f"making keys in {keys}"]
    assert (keys / "rig.key").read_text() == rig_key
    assert (keys / "devices/left.key").stat().st_mode & 0o777 == 0o600
    (keys / "devices.key").unlink()  # a folder from before there were secrets
    (keys / "devices/left.secret").unlink()
    make_keys(keys, ["left"], output.append)
    assert output == [f"making keys in {keys}"] * 2
    assert (keys / "devices/left.secret").stat().st_mode & 0o777 == 0o600
    assert (keys / "rig.key").read_text() == rig_key


def test_a_table_has_a_dash_where_nothing_is_known() -> None:
    lines = table(
        [
            Device("left", "streaming", host="pi-left", version="0.1.0", temperature_c=51.2,
                   throttled=False, rate_hz=89.96, offset_us=-12.4, sigma_us=8.0),
            Device("right", "unknown"),
        ]
    )  # fmt: skip
    assert lines[1].split("  ")[0] == "left"
    assert "51 °C" in lines[1]
    assert "90.0/s" in lines[1]
    assert "-12 ± 8 µs" in lines[1]
    assert lines[2].split() == ["right", *["-"] * 6, "unknown"]


def _file(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("words", "output"),
    [
        (["--options", "rihgt=--sync client"], "--options 'rihgt=--sync client': rig 'desk' has no 'rihgt'"),
        (["--camera", "up=v4l2"], "--camera 'up=v4l2': rig 'desk' has no 'up'; it has left, right"),
        (["--wheelhouse", "nowhere"], "--wheelhouse nowhere: no wheels in it; phalanx fleet wheels DIR"),
        (["--identity", "nokey"], "--identity nokey: no such file"),
    ],
)
def test_what_is_mistyped_is_reported_before_a_machine_is_asked(
    words: list[str], output: str, capsys: pytest.CaptureFixture[str]
) -> None:
    tree = str(ROOT / "calib_json")
    line = [
        "fleet",
        "deploy",
        "left=a.invalid",
        "--master",
        "127.0.0.1",
        "--dry-run",
        "--calibration",
        tree,
        *words,
    ]
    assert main(line) == 1
    assert output in capsys.readouterr().err


def test_a_fleet_with_a_missing_keys_folder_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fleet", "status", "--keys", "nokeys"]) == 1
    assert "--keys nokeys: no such folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("output", "names", "driver"),
    [
        ((), ("left",), "picamera2"),
        (("v4l2:0",), ("left",), "v4l2:0"),
        (("left=v4l2", "right=picamera2:1"), ("left",), "v4l2"),
        (("left=v4l2", "right=picamera2:1"), ("right",), "picamera2:1"),
        (("left=v4l2",), ("left", "right"), "picamera2"),
        (("picamera2",), (), ""),
    ],
)
def test_each_machine_gets_what_its_own_cameras_need(
    output: tuple[str, ...], names: tuple[str, ...], driver: str
) -> None:
    request = DeployRequest(
        "10.0.0.2", DESK, ROOT, None, (), output, None, apt=True, dry_run=True, ready_s=9.0
    )
    assert request.driver(names) == driver


def test_an_interruption_ends_what_waits_for_a_machine(fake_ssh: Callable[[str], None]) -> None:
    fake_ssh("sleep 300")
    deadline = Deadline(200.0)
    threading.Timer(0.3, deadline.end).start()
    began = time.monotonic()
    with pytest.raises(DeployError, match="interrupted"):
        Remote("host", (), deadline).run(["true"], b"", print)
    assert time.monotonic() - began < 60.0


def test_a_link_that_breaks_within_the_last_line_is_reported(fake_ssh: Callable[[str], None]) -> None:
    fake_ssh(
        """cat > /dev/null; printf '{"result": {"mach'; echo 'client_loop: send disconnect' >&2; exit 255"""
    )
    host = Host(Target("pi", ("left",)), Remote("pi", (), Deadline(60.0)), print)
    with pytest.raises(DeployError, match="send disconnect"):
        host.look()


def test_wheels_that_cannot_be_kept_are_reported_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cache").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with pytest.raises(DeployError, match=r"wheels: .*cache.*: Not a directory"):
        wheelhouse(wheels_module.Kind("aarch64", "3.13"), None, print)
