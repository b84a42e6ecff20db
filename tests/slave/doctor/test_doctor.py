"""The doctor on machines laid out in files: what it says is well, or wrong, and what it did not look at."""

import argparse
import json
import os
import socket
import threading
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from shutil import copytree

import pytest
from msgspec.structs import replace

from common.bus.keys import issue, new_authority, new_key
from common.calibration import CameraCalibration, load, save
from common.calibration.camera import sensor_files
from common.clock import SystemClock
from common.machine import ROOT, Program
from master.run.link import MasterLink
from slave.__main__ import main
from slave.cli.table import PROGRAM
from slave.doctor.command import examine
from slave.doctor.devices import check_camera, check_devices, check_groups
from slave.doctor.host import (
    Finding,
    Ran,
    System,
    Verdict,
    as_json,
    as_text,
    check_clock,
    check_host,
    check_programs,
    check_strobe,
    check_unit,
    exit_code,
    fail,
    ok,
    run,
    unseen,
    warn,
)
from slave.doctor.master import check_keys, check_master
from tests.slave.fake_picamera2 import Sensor, install
from tests.slave.fake_v4l2 import Camera, FakeDevice
from tests.slave.recorded_lists import PI_CAMERAS, USB_CAMERAS

CALIBRATION = Path(__file__).resolve().parents[3] / "calib_json"
NOW = datetime(2026, 11, 22, tzinfo=UTC)
GROUP_LINES = "root:x:0:\nvideo:x:44:\ndialout:x:20:\ni2c:x:994:\ngpio:x:993:\n"


class Answers:
    """Programs that answer as told; of others there are none."""

    def __init__(self, output: Mapping[str, Ran]) -> None:
        self._said = output
        self.asked: list[Sequence[str]] = []

    def __call__(self, command: Sequence[str], timeout_s: float) -> Ran:
        self.asked.append(command)
        return self._said.get(Path(command[0]).name, Ran(None, "", f"there is no {command[0]}"))


def machine(
    root: Path, output: Mapping[str, Ran] | None = None, files: Mapping[str, str] | None = None
) -> System:
    for place, text in (files or {}).items():
        path = root / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return System(root, {ROOT: str(root)}, Answers(output or {}))


def pi(root: Path, output: Mapping[str, Ran] | None = None) -> System:
    files = {
        "etc/os-release": 'PRETTY_NAME="Debian GNU/Linux 13 (trixie)"\nVERSION_CODENAME=trixie\n',
        "etc/group": GROUP_LINES,
        "sys/firmware/devicetree/base/model": "Raspberry Pi 5 Model B Rev 1.0\0",
        "sys/class/thermal/thermal_zone0/type": "cpu-thermal\n",
        "sys/class/thermal/thermal_zone0/temp": "51200\n",
        "disk_free_mb": "20000\n",
        "sys/fs/cgroup/cgroup.controllers": "cpuset cpu io memory pids\n",
    }
    return machine(root, output, files)


def by_check(findings: Sequence[Finding]) -> dict[str, Finding]:
    return {one.check: one for one in findings}


def test_a_pi_that_is_well(tmp_path: Path) -> None:
    output = by_check(list(check_host(pi(tmp_path, {"vcgencmd": Ran(0, "throttled=0x0\n", "")}))))
    assert {one.verdict for one in output.values()} == {Verdict.OK}
    assert output["board"].text == "Raspberry Pi 5 Model B Rev 1.0"
    assert output["temperature"].text == "51 °C, limit 80 °C"


@pytest.mark.parametrize(
    ("flags", "text", "fix"),
    [
        ("0x50005", "under-voltage now, throttled now", "power supply"),
        ("0x50000", "under-voltage since the start, throttled since the start", "power supply"),
        ("0x80008", "soft temperature limit now", "cooling"),
    ],
)
def test_what_the_firmware_says_of_supply_and_heat(tmp_path: Path, flags: str, text: str, fix: str) -> None:
    system = pi(tmp_path, {"vcgencmd": Ran(0, f"throttled={flags}\n", "")})
    found = by_check(list(check_host(system)))["throttling"]
    assert (found.verdict, found.text) == (Verdict.WARN, text)
    assert fix in found.fix


def test_a_pi_in_trouble(tmp_path: Path) -> None:
    system = pi(tmp_path)
    (tmp_path / "disk_free_mb").write_text("60\n")
    (tmp_path / "sys/class/thermal/thermal_zone0/temp").write_text("83000\n")
    (tmp_path / "etc/os-release").write_text("PRETTY_NAME=Elsewhere\n")
    (tmp_path / "sys/fs/cgroup/cgroup.controllers").write_text("cpuset cpu io pids\n")
    output = by_check(list(check_host(system)))
    assert output["memory limit"].verdict is Verdict.WARN
    assert "cgroup_enable=memory" in output["memory limit"].fix
    assert output["disk"].verdict is Verdict.FAIL
    assert output["temperature"].verdict is Verdict.WARN
    assert output["system"].verdict is Verdict.WARN
    assert output["throttling"].verdict is Verdict.UNSEEN  # neither the firmware's file nor vcgencmd


def test_a_missing_group_would_keep_systemd_from_starting_it(tmp_path: Path) -> None:
    assert check_groups(machine(tmp_path / "a", None, {"etc/group": GROUP_LINES})).verdict is Verdict.OK
    found = check_groups(machine(tmp_path / "b", None, {"etc/group": "video:x:44:\ndialout:x:20:\n"}))
    assert found.verdict is Verdict.FAIL
    assert "i2c, gpio" in found.text


def test_devices_must_be_there_and_open_to_a_group_of_the_service(tmp_path: Path) -> None:
    slave = argparse.Namespace(camera="picamera2", imu=None, lights="gpio:0:17,27")
    system = machine(tmp_path, None, {"etc/group": GROUP_LINES})
    missing = by_check(list(check_devices(system, slave)))
    assert missing["lights"].verdict is missing["dma_heap"].verdict is Verdict.FAIL
    assert "No such file" in missing["lights"].text
    for place, mode in (("dev/gpiochip0", 0o600), ("dev/dma_heap/linux,cma", 0o666)):
        path = tmp_path / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        path.chmod(mode)
    found = by_check(list(check_devices(system, slave)))
    assert found["lights"].verdict is Verdict.FAIL  # there, but root's alone
    assert "-rw-------" in found["lights"].text
    assert found["dma_heap"].verdict is Verdict.OK


TRACKING = "C0A80005,pc.local,9,1763800000.1,{},0.000002,0.000031,-3.1,0.0,0.05,0.0002,0.0001,16.1,{}\n"


@pytest.mark.parametrize(
    ("output", "verdict", "text"),
    [
        (Ran(0, TRACKING.format("0.000012", "Normal"), ""), Verdict.OK, "+12 µs off pc.local (stratum 9)"),
        (Ran(0, TRACKING.format("-0.004", "Normal"), ""), Verdict.WARN, "-4000 µs off"),
        (Ran(0, TRACKING.format("0", "Not synchronised"), ""), Verdict.WARN, "no time yet"),
        (Ran(0, TRACKING.format("junk", "Normal"), ""), Verdict.WARN, "junk"),
        (Ran(1, "506 Cannot talk to daemon\n", ""), Verdict.WARN, "506 Cannot talk to daemon"),
        (Ran(0, "", ""), Verdict.WARN, "no answer"),
    ],
)
def test_the_clock_as_chrony_reports_it(tmp_path: Path, output: Ran, verdict: Verdict, text: str) -> None:
    (found,) = check_clock(machine(tmp_path, {"chronyc": output}), None)
    assert found.verdict is verdict
    assert text in found.text


def test_another_source_than_the_master_and_no_chrony_at_all(tmp_path: Path) -> None:
    output = Ran(0, TRACKING.format("0.00001", "Normal"), "")
    (found,) = check_clock(machine(tmp_path, {"chronyc": output}), "other.local")
    assert found.verdict is Verdict.WARN
    assert "not by other.local" in found.text
    answers = {"timedatectl": Ran(0, "NTP=yes\nNTPSynchronized=yes\n", "")}
    (found,) = check_clock(machine(tmp_path, answers), None)
    assert found.verdict is Verdict.WARN
    (found,) = check_clock(machine(tmp_path), None)
    assert found.verdict is Verdict.UNSEEN


def test_libraries_are_asked_of_the_services_python(tmp_path: Path) -> None:
    python = tmp_path / "opt/phalanx/current/bin/python"
    python.parent.mkdir(parents=True)
    python.touch()
    lines = "libstdc++ yes\nnumpy yes 2.4.6\ncv2 yes 5.0\nzenoh no ImportError: GLIBC_2.38 not found\n"
    output = Answers({"python": Ran(-11, lines, "")})
    findings = list(check_programs(System(tmp_path, {}, output), ["picamera2"]))
    assert str(output.asked[0][0]) == str(python)
    found = by_check(findings)
    assert found["numpy"] == ok("numpy", "2.4.6")
    assert found["zenoh"].verdict is Verdict.FAIL
    assert "GLIBC_2.38" in found["zenoh"].text
    assert "crashed" in findings[-1].text  # and what comes behind is not claimed
    assert [one.check for one in findings][-1] == "cryptography"


def test_libraries_of_this_environment_are_really_imported(tmp_path: Path) -> None:
    findings = list(check_programs(System(tmp_path, {}, run), ["no_such_library"]))
    found = by_check(findings)
    assert found["installed"].verdict is Verdict.WARN
    assert found["numpy"].verdict is found["cv2"].verdict is found["zenoh"].verdict is Verdict.OK
    assert found["no_such_library"].verdict is Verdict.FAIL


def keys_of(folder: Path, name: str, now: datetime = NOW) -> Path:
    folder.mkdir(mode=0o700)
    authority = new_authority(now)
    pair = issue(authority, name, now)
    content = {"ca.pem": authority.certificate, "device.pem": pair.certificate, "device.key": pair.key}
    secrets = {file: new_key().encode() for file in ("rig.key", "device.secret")}
    for file, text in (content | secrets).items():
        (folder / file).write_bytes(text)
        (folder / file).chmod(0o600)
    return folder


def verdicts(folder: Path, name: str | None, now: datetime = NOW) -> dict[str, Finding]:
    return by_check(list(check_keys(System(Path("/"), {}), folder, name, now)))


def test_keys_that_are_well(tmp_path: Path) -> None:
    found = verdicts(keys_of(tmp_path / "keys", "left"), "left")
    assert {one.verdict for one in found.values()} == {Verdict.OK}
    assert found["certificate"].text.startswith("of left, signed by the rig's authority, until 2036-")
    assert found["secret"].text.endswith("device.secret")


def test_keys_that_are_not(tmp_path: Path) -> None:
    keys = keys_of(tmp_path / "keys", "left")
    assert "certificate of 'left', not of 'right'" in verdicts(keys, "right")["certificate"].text
    assert "ends in 38 days" in verdicts(keys, "left", NOW + timedelta(days=3614))["certificate"].text
    late = verdicts(keys, "left", NOW + timedelta(days=3700))["certificate"]
    assert late.verdict is Verdict.FAIL
    assert "no longer valid: the clock of this machine says 2037-01-08" in late.text
    assert "timedatectl" in late.fix
    assert verdicts(keys, None)["certificate"].verdict is Verdict.UNSEEN
    other = keys_of(tmp_path / "other", "left")
    (keys / "ca.pem").write_bytes((other / "ca.pem").read_bytes())
    assert "not signed by" in verdicts(keys, "left")["certificate"].text
    (keys / "device.key").write_bytes((other / "device.key").read_bytes())
    assert "key of another certificate" in verdicts(keys, "left")["certificate"].text
    (keys / "device.secret").unlink()
    assert "no secret of 'left'" in verdicts(keys, "left")["secret"].text
    (keys / "rig.key").chmod(0o644)
    assert "others can read" in verdicts(keys, "left")["rig key"].text
    keys.chmod(0o755)
    assert verdicts(keys, "left")["keys"].verdict is Verdict.WARN
    assert verdicts(tmp_path / "nowhere", "left")["keys"].verdict is Verdict.FAIL


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        asked.bind(("127.0.0.1", 0))
        return int(asked.getsockname()[1])


def test_no_beacon_and_no_key(tmp_path: Path) -> None:
    system, port = System(tmp_path, {}), free_port()
    keys = keys_of(tmp_path / "keys", "left")
    (found,) = check_master(system, keys, None, port, "127.0.0.1")
    assert found.verdict is Verdict.FAIL
    assert f"UDP port {port}" in found.text
    (found,) = check_master(system, tmp_path / "nowhere", None, port, "127.0.0.1")
    assert found.verdict is Verdict.UNSEEN


def beacon(key: bytes, port: int) -> bytes:
    """The first word of a master."""
    link = MasterLink(
        ("left",), key, SystemClock(), ("127.0.0.1", port), "tcp/127.0.0.1:1", 10**9, os.urandom
    )
    return link.due()[0][0]


@pytest.mark.parametrize(
    ("own", "master", "verdict", "text"),
    [
        (True, None, Verdict.OK, "from 127.0.0.1, of this rig"),
        (True, "127.0.0.2", Verdict.WARN, "which is not the master named"),
        (False, None, Verdict.FAIL, "not of this rig: foreign"),
    ],
)
def test_a_beacon_is_heard(
    tmp_path: Path, own: bool, master: str | None, verdict: Verdict, text: str
) -> None:
    keys, port = keys_of(tmp_path / "keys", "left"), free_port()
    key = bytes.fromhex((keys / "rig.key").read_text()) if own else bytes(32)
    output, over = beacon(key, port), threading.Event()

    def speak() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as to:
            while not over.wait(0.05):
                to.sendto(output, ("127.0.0.1", port))

    speaker = threading.Thread(target=speak)
    speaker.start()
    try:
        *_, found = check_master(System(tmp_path, {}), keys, master, port, "127.0.0.1")
    finally:
        over.set()
        speaker.join()
    assert found.verdict is verdict
    assert text in found.text


UNIT = (
    "LoadState=loaded\nActiveState={}\nSubState={}\nUnitFileState=enabled\nNRestarts={}\nExecMainStatus={}\n"
    "StatusText={}\n"
)


@pytest.mark.parametrize(
    ("output", "verdict", "runs", "text"),
    [
        (UNIT.format("active", "running", 0, 0, "90 frames/s"), Verdict.OK, True, "90 frames/s"),
        (UNIT.format("active", "running", 3, 0, "90 frames/s"), Verdict.WARN, True, "restarted 3 times"),
        (
            UNIT.format("activating", "auto-restart", 9, 1, "failed: no such camera"),
            Verdict.FAIL,
            False,
            "no such camera",
        ),
        (
            UNIT.format("activating", "auto-restart", 9, 216, ""),
            Verdict.FAIL,
            False,
            "a group of the unit is missing",
        ),
        (UNIT.format("inactive", "dead", 0, 0, ""), Verdict.FAIL, False, "stopped"),
        ("LoadState=not-found\nActiveState=inactive\n", Verdict.WARN, False, "not installed"),
    ],
)
def test_the_service_as_systemd_reports_it(
    tmp_path: Path, output: str, verdict: Verdict, runs: bool, text: str
) -> None:
    finding, has_device = check_unit(machine(tmp_path, {"systemctl": Ran(0, output, "")}), "left")
    assert (finding.verdict, has_device) == (verdict, runs)
    assert text in finding.text


STAT = "{0} (a (thread) of it) S " + "0 " * 36 + "{1} {2} 0 0\n"  # proc_pid_stat(5): 40 priority, 41 policy


@pytest.mark.parametrize(
    ("pid", "priorities", "verdict", "text"),
    [
        (812, (0, 10, 0), Verdict.OK, "real-time priority 10"),
        (812, (0, 0), Verdict.WARN, "no real-time priority"),
        (0, (), Verdict.UNSEEN, "does not run"),
    ],
)
def test_the_strobes_priority_is_read_from_the_running_service(
    tmp_path: Path, pid: int, priorities: tuple[int, ...], verdict: Verdict, text: str
) -> None:
    group = "system.slice/system-phalanx.slice/phalanx-slave@wrist.service"
    files = {
        f"proc/{pid + k}/stat": STAT.format(pid + k, priority, int(priority > 0))
        for k, priority in enumerate(priorities)
    }
    if pid:
        gone = pid + 99  # it ended meanwhile
        files[f"sys/fs/cgroup/{group}/cgroup.procs"] = f"{pid}\n{pid + 1}\n{gone}\n{pid + 2}\n"
    system = machine(tmp_path, {"systemctl": Ran(0, f"ControlGroup=/{group}\n", "")}, files)
    finding = check_strobe(system, "wrist")
    assert (finding.verdict, text in finding.text) == (verdict, True)
    assert ("strobe.conf" in finding.fix) == (verdict is Verdict.WARN)


def test_the_fields_of_a_thread_are_those_of_the_kernel() -> None:
    own = Path("/proc/thread-self/stat").read_text().rpartition(")")[2].split()
    assert own[37:39] == ["0", str(os.sched_getscheduler(0))]


def test_what_is_installed_is_looked_at_by_itself(tmp_path: Path) -> None:
    system = pi(tmp_path, {"systemctl": Ran(0, UNIT.format("active", "running", 0, 0, "60 frames/s"), "")})
    etc = tmp_path / "etc/phalanx"
    etc.mkdir()
    (etc / "left.env").write_text(
        "# Written by the installer\n"
        f"PHALANX_OPTIONS=--name left --rig desk --camera picamera2 --calibration {CALIBRATION}\n"
    )
    (etc / "imu.env").write_text("PHALANX_OPTIONS=--name imu --imu lsm6dsox:1\n")
    found = by_check(list(examine(PROGRAM.parse(["doctor"])[1], system)))
    assert found["left: service"].text == "60 frames/s"
    assert found["left: camera file"].verdict is Verdict.OK
    assert found["left: camera"].verdict is Verdict.UNSEEN  # the running service has it
    assert found["imu: IMU bus"].verdict is Verdict.FAIL  # /dev/i2c-1 is not there
    assert "picamera2" not in found  # for the Python before it crashed: nothing answers here
    assert found["libstdc++"].verdict is Verdict.FAIL


def test_the_report(capsys: pytest.CaptureFixture[str]) -> None:
    findings = [ok("disk", "9 GB free"), warn("clock", "far", "wait"), unseen("board", "no device tree")]
    assert exit_code(findings) == 0
    assert exit_code([*findings, fail("keys", "none", "make them")]) == 1
    text = as_text(findings)
    assert text.splitlines()[-1] == "1 ok, 1 to look at, 0 wrong"
    assert "not looked at:\n     board" in text
    answers = json.loads(as_json(findings, Program("pi-left", "1.2")))
    assert (answers["host"], answers["ok"]) == ("pi-left", True)
    assert answers["findings"][1] == {"check": "clock", "verdict": "warn", "text": "far", "fix": "wait"}


def test_it_runs_without_any_hardware(capsys: pytest.CaptureFixture[str]) -> None:
    files = ["--rig", "desk", "--calibration", str(CALIBRATION)]
    code = main(
        ["doctor", "--name", "left", "--camera", "v4l2:/dev/none", *files, "--beacon-port", str(free_port())]
    )
    output = capsys.readouterr().out
    assert code == 1  # there is no such camera
    assert "/dev/none" in output
    assert "not looked at:" in output


def camera_findings(
    monkeypatch: pytest.MonkeyPatch, tree: Path, driver: str, file: CameraCalibration
) -> dict[str, Finding]:
    """What the doctor says of a camera, where the camera file of `left` is this one."""
    save(tree / "cameras/left.json", replace(file, name="left"))
    words = ["run", "--name", "left", "--rig", "desk", "--camera", driver, "--calibration", str(tree)]
    codes = ["--control", "gain=32", "--control", "white_balance_temperature=4600"]
    slave = PROGRAM.parse([*words, *(codes if driver == "v4l2" else [])])[1]
    return by_check(list(check_camera(slave, taken=False)))


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    return Path(copytree(CALIBRATION, tmp_path / "calib"))


@pytest.mark.parametrize(
    ("camera", "shown", "fitting"),
    [
        ("ov5647", "640x480 10 bit, up to 58.9 Hz, 98 % of the full view, 53 x 41 deg",
         "ov5647-1296x972, ov5647-640x480"),
        ("imx219", "640x480 10 bit, up to 206.7 Hz, 15 % of the full view, 27 x 20 deg",
         "imx219-640x480, imx219-820x616"),
        ("imx219 since 6.6", "1640x1232 8 bit, up to 83.7 Hz", "imx219-640x480, imx219-820x616-8bit, imx219-820x616"),
        ("imx708", "1536x864 10 bit, up to 120.1 Hz, 44 % of the full view, 47 x 27 deg",
         "imx708-1152x648, imx708-768x432, imx708-864x648"),
        ("imx708_wide", "2304x1296 10 bit, up to 56.0 Hz, 100 % of the full view, 99 x 67 deg",
         "imx708_wide-1152x648, imx708_wide-864x648"),
        ("imx296", "1456x1088 10 bit, up to 60.4 Hz, 100 % of the full view, 45 x 35 deg", "imx296-728x544"),
        ("ov9281", "640x400 8 bit, up to 309.8 Hz", "ov9281-1280x720, ov9281-1280x800, ov9281-640x400"),
    ],
)  # fmt: skip
def test_what_a_pi_camera_can_do_and_the_shipped_files_that_fit(
    monkeypatch: pytest.MonkeyPatch, tree: Path, camera: str, shown: str, fitting: str
) -> None:
    install(monkeypatch, Sensor.of(PI_CAMERAS[camera]))
    found = camera_findings(
        monkeypatch, tree, "picamera2", load(tree / "cameras/right.json", CameraCalibration)
    )
    assert shown in found["camera modes"].text
    assert found["camera files"].text == f"shipped ones that fit: {fitting}"


def test_a_rigs_file_of_a_mode_that_the_sensor_lacks_is_wrong_with_the_nearest_and_a_fitting_one_is_well(
    monkeypatch: pytest.MonkeyPatch, tree: Path
) -> None:
    install(monkeypatch, Sensor.of(PI_CAMERAS["ov5647"]))
    desk = replace(load(tree / "cameras/right.json", CameraCalibration), frame_rate_hz=60.0)
    found = camera_findings(monkeypatch, tree, "picamera2", desk)
    assert found["camera"].verdict is Verdict.FAIL
    assert "640x480 at 60 Hz. Nearest: 640x480 10 bit, up to 58.9 Hz" in found["camera"].text
    fits = sensor_files(tree)["ov5647-640x480"]
    assert camera_findings(monkeypatch, tree, "picamera2", fits)["camera"].verdict is Verdict.OK
    for path in (tree / "cameras").glob("ov5647-*.json"):
        path.unlink()
    assert camera_findings(monkeypatch, tree, "picamera2", fits)["camera files"].verdict is Verdict.WARN
    (tree / "cameras/imx219-640x480.json").write_text("{")
    found = camera_findings(monkeypatch, tree, "picamera2", fits)
    assert found["camera"].verdict is Verdict.OK
    assert "640x480 10 bit, up to 58.9 Hz" in found["camera modes"].text
    assert "imx219-640x480.json" in found["camera files"].text


def test_what_a_usb_camera_offers_is_listed_as_its_driver_has_it(
    monkeypatch: pytest.MonkeyPatch, tree: Path
) -> None:
    def device(_path: Path) -> FakeDevice:
        return FakeDevice(Camera(formats=USB_CAMERAS["USB Camera"]))

    monkeypatch.setattr("slave.doctor.devices.KernelDevice", device)
    desk = load(tree / "cameras/right.json", CameraCalibration)
    found = camera_findings(monkeypatch, tree, "v4l2", desk)
    assert "MJPG 1280x720 at 5, 10, 15, 20, 25, 30 Hz" in found["camera modes"].text
    assert found["camera files"].text == "shipped ones that fit: usb-1280x720, usb-640x480"
