"""Options, keys, calibration and config.txt: what is refused before anything is written, and what is kept."""

import argparse
import json
import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slave.install import arguments
from slave.install.arguments import InstallError, NotReadyError, Plan, plan_of
from slave.install.command import calibration_of, keys_of
from slave.install.probe import judge, probe
from slave.install.systemd import Systemd
from slave.install.wanted import BEGIN, END, with_block, without_block
from tests.slave.install.conftest import ROOT, Board

FILES = calibration_of(ROOT / "calib_json")
WRIST = ("--rig", "wrist", "--imu", "lsm6dsox:1:0x6a", "--lights", "gpio:0:17,27")
FACTS = {
    "machine": "aarch64",
    "bits": 64,
    "python": [3, 13],
    "venv": True,
    "systemd": True,
    "root": False,
    "sudo": True,
    "user": "pi",
    "os": "Raspbian GNU/Linux 13 (trixie)",
    "free_mb": 9000.0,
    "memory_mb": 416.0,
    "available_mb": 300.0,
    "swap_mb": 416.0,
    "releases": [],
    "cameras": ["imx708"],
    "video": ["unicam"],
}


def plan(*words: str) -> Plan:
    parser = argparse.ArgumentParser()
    arguments.add_install(parser)
    return plan_of(parser.parse_args(["--master", "10.0.0.2", *words]), FILES, {})


def test_a_wrist_device_is_two_services_and_its_lights_go_dark() -> None:
    camera, imu = plan(*WRIST).senders
    assert (camera.name, imu.name) == ("wrist", "imu")
    assert ("--camera" in camera.options, "--imu" in imu.options) == (True, True)
    assert "PHALANX_STOP_POST=doctor --rig wrist --calibration" in camera.environment
    assert camera.environment.endswith("--lights gpio:0:17,27 --off\n")
    assert imu.environment.endswith("PHALANX_STOP_POST=\n")
    assert plan(*WRIST).boot == ("camera_auto_detect=1", "dtparam=i2c_arm=on")


def test_drivers_and_options_are_of_one_camera_or_of_all() -> None:
    made = plan("--name", "left", "--name", "right", "--camera", "right=v4l2", "--options", "--seed 1",
                "--options", "left=--sync server")  # fmt: skip
    left, right = (" ".join(sender.options) for sender in made.senders)
    assert left.endswith("--camera picamera2 --seed 1 --sync server")
    assert right.endswith("--camera v4l2 --seed 1")
    assert made.picamera2
    (alone,) = plan("--name", "left", "--camera", "left=v4l2", "--camera", "right=picamera2:1",
                    "--options", "left=--sync server", "--options", "right=--sync client").senders  # fmt: skip
    assert " ".join(alone.options).endswith("--camera v4l2 --sync server"), "right is on another machine"


@pytest.mark.parametrize(
    ("words", "output"),
    [
        (("--rig", "attic"), "calib_json/rigs/attic.json: no such rig; there are desk"),
        ((), "rig 'desk' has left, right: say which of them this is, --name NAME"),
        (("--name", "up"), "rig 'desk' has no camera or IMU 'up'; it has left, right"),
        (("--name", "left", "--name", "left"), "one stands twice"),
        (("--name", "left", "--role", "wrist"), "--role wrist: rig 'desk' is one of kind 'markers'"),
        (("--rig", "wrist", "--imu", "ximu3:/dev/ttyACM0"), "say who switches its lights, --lights DRIVER"),
        (("--rig", "wrist", "--lights", "camera"), "say which one it is, --imu DRIVER"),
        (("--name", "left", "--options", "--note 'a b'"), "'a b': blanks and quotes cannot be in an option"),
        (("--name", "left", "--options", "--note 'a"), '--options "--note \'a": No closing quotation'),
        (("--name", "left", "--options", "--seed $(id)"), "blanks and quotes"),
        (("--name", "left", "--master", "a b"), "--master a b: give the host name or the address"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_fix(words: tuple[str, ...], output: str) -> None:
    with pytest.raises(InstallError) as refused:
        plan(*words)
    assert output in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("file", "content", "output"),
    [
        ("rig.key", b"0123", "rig.key is not 64 hexadecimal digits"),
        ("devices/left.secret", b"0123", "device-left.secret is not 64 hexadecimal digits"),
        (
            "ca.pem",
            b"-----BEGIN CERTIFICATE-----\nnone\n-----END CERTIFICATE-----\n",
            "ca.pem is not a certificate",
        ),
        ("devices/left.pem", None, "device-left.pem and device-left.key are no certificate and its key"),
    ],
)
def test_keys_that_are_none_are_refused_and_nothing_is_written(
    board: Board, site: Path, file: str, content: bytes | None, output: str
) -> None:
    other = (board.keys / "devices/right.pem").read_bytes()
    (board.keys / file).write_bytes(other if content is None else content)
    before = board.files()
    with pytest.raises(InstallError, match=output):
        board.install(site)
    assert {p: v for p, v in board.files().items() if p != "run"} == before


def test_keys_that_others_can_read_and_keys_that_are_missing_are_refused(board: Board, site: Path) -> None:
    (board.keys / "rig.key").chmod(0o644)
    with pytest.raises(InstallError, match="others can read this key; run: chmod 600"):
        board.install(site)
    (board.keys / "rig.key").chmod(0o600)
    (board.keys / "devices/left.secret").chmod(0o640)
    with pytest.raises(InstallError, match=r"left.secret: others can read this key; run: chmod 600"):
        board.install(site)
    (board.keys / "devices/left.secret").chmod(0o600)
    (board.keys / "devices/left.key").unlink()
    with pytest.raises(
        InstallError, match=r"no device-left.key; make them on the PC: phalanx fleet keys DIR --make"
    ):
        board.install(site)
    with pytest.raises(InstallError, match=r"/etc/phalanx/keys/rig.key: missing; give --keys DIR"):
        board.install(site, keys=False)


def test_keys_stay_where_none_are_given_and_the_private_ones_of_the_pc_never_come(
    board: Board, site: Path
) -> None:
    assert not {
        name
        for name in keys_of(board.keys)
        if name.startswith(("ca.key", "devices.key", "master", "operator"))
    }
    board.install(site)
    assert board.install(site, keys=False).changed == []


def test_what_the_slave_saved_stays_until_the_pc_changes_its_own(
    board: Board, site: Path, tmp_path: Path
) -> None:
    pc = tmp_path / "calib_json"
    shutil.copytree(ROOT / "calib_json", pc)
    board.install(site, calibration=pc)
    there = board.root / "var/lib/phalanx/calib_json/cameras/left.json"
    there.write_text("saved by the slave")
    assert board.install(site, calibration=pc).changed == []
    mine = pc / "cameras/left.json"
    mine.write_text(json.dumps(json.loads(mine.read_text()) | {"exposure_us": 1234.0}))
    outcome = board.install(site, calibration=pc)
    assert "var/lib/phalanx/calib_json/cameras/left.json" in outcome.changed
    assert outcome.restarted == [], "a slave follows its files"
    assert there.read_bytes() == mine.read_bytes()


def test_a_link_that_a_slave_made_leads_root_nowhere(board: Board, site: Path, tmp_path: Path) -> None:
    board.install(site)
    folder = board.root / "var/lib/phalanx/calib_json/cameras"
    shutil.rmtree(folder)
    folder.symlink_to(tmp_path)
    with pytest.raises(InstallError, match="is a link or a special file, which no slave makes"):
        board.install(site)
    assert not (tmp_path / "left.json").exists()


@given(st.lists(st.sampled_from(["[all]", "[pi4]", "dtparam=audio=on", "camera_auto_detect=0", "# note", ""])),
       st.lists(st.sampled_from(["camera_auto_detect=1", "dtoverlay=imx296", "dtparam=i2c_arm=on"]), unique=True),
       st.booleans())  # fmt: skip
def test_our_lines_of_config_txt_come_once_and_go_without_a_trace(
    before: list[str], lines: list[str], ended: bool
) -> None:
    text = "\n".join(before) + ("\n" if ended and before else "")
    once = with_block(text, lines)
    assert with_block(once, lines) == once
    assert without_block(once) in (text, text + "\n")
    assert (
        once.count(BEGIN) == once.count(END) == (1 if lines and once.rstrip("\n") != text.rstrip("\n") else 0)
    )


def test_what_config_txt_says_already_is_not_said_again() -> None:
    assert with_block("camera_auto_detect=1\n", ["camera_auto_detect=1"]) == "camera_auto_detect=1\n"
    assert BEGIN in with_block("[pi4]\ncamera_auto_detect=1\n", ["camera_auto_detect=1"]), (
        "that is for one model only"
    )
    assert BEGIN in with_block("camera_auto_detect=1\ncamera_auto_detect=0\n", ["camera_auto_detect=1"])


@pytest.mark.parametrize(
    ("facts", "camera", "output"),
    [
        (
            {"bits": 32},
            "",
            "Raspbian GNU/Linux 13 (trixie) is a 32-bit system on aarch64: needs a 64-bit system; write",
        ),
        (
            {"machine": "armv7l", "bits": 32},
            "",
            "needs a 64-bit system; write Raspberry Pi OS (64-bit) to its card",
        ),
        (
            {"machine": "armv6l", "bits": 32},
            "",
            "its processor has none; a Raspberry Pi Zero 2 W, 3, 4 or 5 has",
        ),
        (
            {"available_mb": 90.0, "swap_mb": 0.0},
            "",
            "90 MB of memory and swap free, needs 150 MB: switch swap on, or",
        ),
        ({"python": [3, 9]}, "", "its Python is 3.9, needs 3.11 or newer"),
        ({"python": [3, 15]}, "", "needs 3.11 to 3.14"),
        ({"venv": False}, "", "apt install python3-venv"),
        ({"systemd": False}, "", "systemd does not run there"),
        ({"root": False, "sudo": False}, "", "user pi is not root, and there is no sudo: log in as root"),
        ({"free_mb": 100.0}, "", "100 MB free below /opt, needs 700 MB"),
        ({"cameras": []}, "picamera2", "libcamera finds no camera"),
        ({"video": []}, "v4l2:/dev/video2", "no V4L2 camera is there (/dev/video2)"),
    ],
)
def test_a_machine_that_cannot_is_refused_with_the_reason(
    facts: dict[str, object], camera: str, output: str
) -> None:
    assert judge(FACTS, camera) is None
    assert output in (judge(FACTS | facts, camera) or "")


def test_picamera2_has_to_be_there_only_where_apt_may_not_bring_it() -> None:
    without = FACTS | {"cameras": None}
    assert judge(without, "picamera2") is None
    assert "sudo apt install python3-picamera2" in (judge(without, "picamera2:1", apt=False) or "")
    assert judge(without, "v4l2", apt=False) is None


def test_this_machine_is_described() -> None:
    facts = probe()
    assert set(facts) >= set(FACTS)
    assert facts["bits"] == 64
    assert facts["free_mb"] > 0
    assert facts["memory_mb"] > facts["available_mb"] > 100


def test_a_service_that_restarts_or_says_nothing_is_not_ready() -> None:
    clock = [0.0]

    def services(states: list[str]) -> Systemd:
        def run(words: object) -> str:
            assert isinstance(words, list)
            if words[0] == "journalctl":
                return "phalanx-slave: no camera\n"
            return states.pop(0) if len(states) > 1 else states[0]

        return Systemd(run, lambda: clock[0], lambda seconds: clock.__setitem__(0, clock[0] + seconds))

    def state(active: str, pid: int = 0, restarts: int = 0, status: int = 1) -> str:
        sub = "running" if active == "active" else "start"
        return f"ActiveState={active}\nSubState={sub}\nMainPID={pid}\nNRestarts={restarts}\nExecMainStatus={status}\n"

    services([state("activating")] * 3 + [state("active", 7)]).wait_ready({"a": 30.0}, 2.0)
    with pytest.raises(NotReadyError, match="a ends again and again: phalanx-slave: no camera"):
        services([state("active", n, n) for n in range(9)]).wait_ready({"a": 30.0}, 2.0)
    old = state("deactivating", 3, 9)  # a count of before, until systemd has begun again
    with pytest.raises(NotReadyError, match="again and again"):
        services([old, old, *(state("activating", n, n // 4) for n in range(12))]).wait_ready(
            {"a": 30.0}, 2.0
        )
    with pytest.raises(NotReadyError, match="not ready after 5 s: status 243/CREDENTIALS"):
        services([state("activating", status=243)]).wait_ready({"a": 5.0}, 2.0)
    with pytest.raises(NotReadyError, match="a does not stay ready for 2 s"):
        services([state("active", pid) for pid in range(30)]).wait_ready({"a": 2.2}, 2.0)


def test_a_service_that_asks_for_time_to_start_has_it_once() -> None:
    clock = [0.0]

    def services(expected: str, ready_s: float) -> Systemd:
        def run(words: object) -> str:
            assert isinstance(words, list)
            if words[0] == "journalctl":
                return ""
            active = clock[0] >= ready_s
            state = ("active", "running") if active else ("activating", "start")
            return f"ActiveState={state[0]}\nSubState={state[1]}\nMainPID=7\nStatusText={expected}\n"

        return Systemd(run, lambda: clock[0], lambda seconds: clock.__setitem__(0, clock[0] + seconds))

    services("compiles: may take 180 s", 100.0).wait_ready({"a": 10.0}, 2.0)
    clock[0] = 0.0
    with pytest.raises(NotReadyError, match="a is not ready after 180 s: compiles"):
        services("compiles: may take 180 s", 1e9).wait_ready({"a": 10.0}, 2.0)
    clock[0] = 0.0
    with pytest.raises(NotReadyError, match="a is not ready after 10 s: it reports nothing"):
        services("", 1e9).wait_ready({"a": 10.0}, 2.0)


def test_how_long_a_service_took_to_start_is_known_while_it_runs() -> None:
    def started(active: str, began_us: int, ready_us: int) -> float | None:
        sub = "running" if active == "active" else "start"
        text = (
            f"ActiveState={active}\nSubState={sub}\nExecMainStartTimestampMonotonic={began_us}\n"
            f"ActiveEnterTimestampMonotonic={ready_us}\n"
        )
        return Systemd(lambda _words: text).state("a").start_s

    assert started("active", 7_000_000, 9_500_000) == pytest.approx(2.5)
    assert started("activating", 7_000_000, 9_500_000) is None
    assert started("activating", 12_000_000, 9_500_000) is None
    assert started("active", 0, 0) is None
