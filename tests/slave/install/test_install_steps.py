"""Installing on a machine that is a folder: twice, with other content, with what does not run, and gone again."""

import fcntl
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from slave.install import release, steps
from slave.install.arguments import STATE, InstallError
from slave.install.release import Source
from slave.install.steps import uninstall
from slave.install.transaction import LOCKED, NOTES, Transaction
from slave.install.wanted import CALIB
from tests.programs import needs
from tests.slave.install.conftest import ROOT, Board, site_of

UNIT = "phalanx-slave@left.service"


def test_a_clean_machine_gets_all_of_it(board: Board, site: Path) -> None:
    outcome = board.install(site)
    root = board.root
    assert outcome.restarted == [UNIT]
    assert (root / "opt/phalanx/current").readlink() == Path(f"releases/{outcome.release}")
    assert outcome.release.startswith("1.0-")
    lines = (root / "etc/phalanx/left.env").read_text().splitlines()
    assert (
        "PHALANX_OPTIONS=--name left --rig desk --calibration /var/lib/phalanx/calib_json --camera synthetic"
        in lines
    )
    modes = {p.name: p.stat().st_mode & 0o777 for p in (root / "etc/phalanx/keys").iterdir()}
    assert modes == dict.fromkeys(
        ("rig.key", "ca.pem", "device-left.pem", "device-left.key", "device-left.secret"), 0o600
    )
    assert (root / "etc/phalanx/keys").stat().st_mode & 0o777 == 0o700
    assert "server 10.0.0.2 " in (root / "etc/chrony/conf.d/phalanx.conf").read_text()
    assert (root / "var/lib/phalanx/calib_json/cameras/left.json").is_file()
    assert not list((root / "var/lib/phalanx/calib_json/hands").glob("*left*")), (
        "hands of others stay at home"
    )
    assert UNIT in board.systemd.enabled
    script = (root / "opt/phalanx/current/bin/phalanx-slave").read_text()
    assert script.startswith(f"#!/opt/phalanx/releases/{outcome.release}/bin/python\n")


def test_the_slave_and_it_alone_is_on_the_path_as_long_as_it_is_installed(board: Board, site: Path) -> None:
    bin_folder = board.root / "usr/local/bin"
    board.install(site)
    assert [path.name for path in bin_folder.iterdir()] == ["phalanx-slave"]
    link = bin_folder / "phalanx-slave"
    assert str(link.readlink()) == "/opt/phalanx/current/bin/phalanx-slave"
    link.unlink()
    assert board.install(site).changed == ["usr/local/bin/phalanx-slave"], (
        "an installation from before it was"
    )
    steps.roll_back(board.machine)
    assert not os.path.lexists(link)
    board.install(site)
    assert "usr/local/bin/phalanx-slave" in uninstall(board.machine)
    assert not list(bin_folder.iterdir())


@pytest.mark.parametrize("leads_to", [None, "/opt/pipx/venvs/phalanx-hand/bin/phalanx-slave"])
def test_a_foreign_command_of_that_name_is_refused_and_stays(
    board: Board, site: Path, leads_to: str | None
) -> None:
    link = board.root / "usr/local/bin/phalanx-slave"
    link.write_text("foreign") if leads_to is None else link.symlink_to(leads_to)
    before = board.files()
    with pytest.raises(
        InstallError, match=r"/usr/local/bin/phalanx-slave: is not of this installation; remove"
    ):
        board.install(site)
    assert board.files() == before
    link.unlink()
    board.install(site)
    link.unlink()
    link.write_text("foreign")
    uninstall(board.machine)
    assert link.read_text() == "foreign"


def test_a_second_time_nothing_is_changed_or_restarted(board: Board, site: Path) -> None:
    board.install(site)
    before, pids, asked = board.files(), dict(board.systemd.pids), len(board.systemd.asked)
    outcome = board.install(site)
    assert (outcome.changed, outcome.restarted) == ([], [])
    assert board.files() == before
    assert board.systemd.pids == pids
    assert all(line.startswith("systemctl show") for line in board.systemd.asked[asked:])


def test_a_dry_run_writes_nothing_and_says_what_it_would(board: Board, site: Path) -> None:
    before = board.files()
    outcome = board.install(site, dry_run=True)
    assert board.files() == before
    assert outcome.restarted == [UNIT]
    assert "would write /etc/phalanx/left.env" in board.output
    assert all(line.startswith("systemctl show") for line in board.systemd.asked)


def test_only_what_changed_is_restarted(board: Board, site: Path) -> None:
    two = ("--name", "right")
    board.install(site, *two)
    pids = dict(board.systemd.pids)
    outcome = board.install(site, *two, "--options", "right=--seed 8")
    assert outcome.changed == ["etc/phalanx/right.env"]
    assert outcome.restarted == ["phalanx-slave@right.service"]
    assert board.systemd.pids[UNIT] == pids[UNIT]


def test_a_machine_from_before_there_were_secrets_gets_its_own_by_one_installation(
    board: Board, site: Path
) -> None:
    board.install(site)
    secret, unit = (
        board.root / "etc/phalanx/keys/device-left.secret",
        board.root / "etc/systemd/system" / "phalanx-slave@.service",
    )
    after = board.files()
    secret.unlink()
    unit.write_text("".join(line for line in unit.read_text().splitlines(True) if ".secret:" not in line))
    before = board.files()
    with pytest.raises(InstallError, match=r"/etc/phalanx/keys/device-left.secret: missing; give --keys DIR"):
        board.install(site, keys=False)
    assert board.files() == before
    outcome = board.install(site)
    assert sorted(outcome.changed) == sorted(str(one.relative_to(board.root)) for one in (secret, unit))
    assert outcome.restarted == [UNIT]
    assert secret.read_bytes() == (board.keys / "devices/left.secret").read_bytes()
    now = board.files()
    assert {p: v for p, v in now.items() if not p.startswith(NOTES)} == {
        p: v for p, v in after.items() if not p.startswith(NOTES)
    }
    assert (board.install(site).changed, board.install(site).restarted) == ([], [])


def test_a_sender_that_is_served_no_more_is_removed_with_its_keys(board: Board, site: Path) -> None:
    board.install(site, "--name", "right")
    outcome = board.install(site)
    assert "etc/phalanx/right.env" in outcome.changed
    assert not list((board.root / "etc/phalanx/keys").glob("device-right.*"))
    assert set(board.systemd.pids) == {UNIT}


def test_real_time_is_allowed_to_a_slave_that_switches_lights_and_to_no_other(
    board: Board, site: Path
) -> None:
    drop_in = board.root / "etc/systemd/system/phalanx-slave@wrist.service.d/strobe.conf"
    wrist, lights = ("--rig", "wrist"), ("--lights", "gpio:0:17,27")
    outcome = board.install(site, *wrist, *lights, name="wrist")
    assert outcome.restarted == ["phalanx-slave@wrist.service"]
    assert drop_in.read_text() == (ROOT / "slave/install/files/strobe.conf").read_text()
    asked = len(board.systemd.asked)
    drop_in.unlink()  # as a release before this one left it: no other file of ours is different
    outcome = board.install(site, *wrist, *lights, name="wrist")
    assert outcome.changed == [str(drop_in.relative_to(board.root))]
    assert outcome.restarted == ["phalanx-slave@wrist.service"]
    assert "systemctl daemon-reload" in board.systemd.asked[asked:]
    board.install(site, *wrist, "--lights", "camera", name="wrist")  # others switch them
    assert not drop_in.exists()
    board.install(site, *wrist, *lights, name="wrist")
    board.install(site)
    assert not drop_in.exists()
    board.install(site, *wrist, *lights, name="wrist")
    uninstall(board.machine)
    assert not drop_in.parent.exists()


def test_an_upgrade_keeps_the_release_before_and_no_other(board: Board, tmp_path: Path) -> None:
    names = [board.install(site_of(tmp_path / f"site{n}", f"1.{n}")).release for n in range(3)]
    assert sorted(p.name for p in (board.root / "opt/phalanx/releases").iterdir()) == sorted(names[1:])


def test_going_back_restores_release_options_and_calibration_once(
    board: Board, site: Path, tmp_path: Path
) -> None:
    old = board.install(site).release
    before = board.files()
    board.install(site_of(tmp_path / "site2", "2.0"), "--options", "--seed 8")
    after, asked = board.files(), len(board.systemd.asked)
    assert steps.roll_back(board.machine, dry_run=True) == f"would go back to release {old}"
    assert board.files() == after
    assert len(board.systemd.asked) == asked
    assert steps.roll_back(board.machine) == f"back at release {old}"
    assert {p: v for p, v in board.files().items() if not p.startswith(NOTES)} == {
        p: v for p, v in before.items() if not p.startswith(NOTES)
    }
    assert UNIT in board.systemd.pids
    with pytest.raises(InstallError, match="there is no earlier installation to go back to"):
        steps.roll_back(board.machine)


def test_going_back_from_the_first_installation_leaves_no_service(board: Board, site: Path) -> None:
    board.install(site)
    assert steps.roll_back(board.machine) == "back at no release, as before the first installation"
    assert not board.systemd.pids
    assert not list((board.root / "opt/phalanx/releases").iterdir())


def test_a_version_that_hangs_is_taken_back_by_what_the_one_before_needed(
    board: Board, site: Path, tmp_path: Path
) -> None:
    board.install(site)
    board.systemd.start_s = 1.0
    began = board.systemd.now_s
    with pytest.raises(InstallError, match=r"is not ready after 10 s: .*; everything is as before"):
        board.install(site_of(tmp_path / "bad", "2.0", hangs=True))
    assert board.systemd.now_s - began < 13.0
    board.systemd.start_s, began = 5.0, board.systemd.now_s
    with pytest.raises(InstallError, match="is not ready after 20 s"):
        board.install(site_of(tmp_path / "slower", "3.0", hangs=True))
    with pytest.raises(InstallError, match="is not ready after 30 s"):  # with other options nobody knows
        board.install(site_of(tmp_path / "other", "4.0", hangs=True), "--options", "--seed 8")
    assert UNIT in board.systemd.pids


def test_the_release_that_the_installer_runs_from_is_not_made_again(board: Board, site: Path) -> None:
    name = board.install(site).release
    inside = Path("/") / release.RELEASES / name / "lib/python3.13/site-packages"
    assert Source(inside, wheels=False).name() == name


def test_what_does_not_run_is_taken_back_and_says_why(board: Board, site: Path, tmp_path: Path) -> None:
    good = board.install(site)
    before = board.files()
    with pytest.raises(InstallError, match=r"it is broken, as it was meant to be; everything is as before"):
        board.install(site_of(tmp_path / "bad", "2.0", broken=True), "--options", "--seed 8")
    after = board.files()
    assert {p: v for p, v in after.items() if not p.startswith(NOTES)} == {
        p: v for p, v in before.items() if not p.startswith(NOTES)
    }
    assert (board.root / "opt/phalanx/current").readlink().name == good.release
    assert UNIT in board.systemd.pids
    board.install(site)  # and the next installation finds nothing to do


def test_a_first_installation_that_does_not_run_leaves_no_service(board: Board, tmp_path: Path) -> None:
    with pytest.raises(InstallError, match="everything is as before"):
        board.install(site_of(tmp_path / "bad", "2.0", broken=True))
    assert not list((board.root / "etc/phalanx").glob("*.env"))
    assert not list((board.root / "etc/phalanx/keys").iterdir())
    assert not (board.root / "opt/phalanx/current").is_symlink()
    assert not board.systemd.pids
    assert not board.systemd.enabled


def test_a_release_that_does_not_load_stops_nothing(board: Board, site: Path, tmp_path: Path) -> None:
    board.install(site)
    asked = len(board.systemd.asked)
    bad = site_of(tmp_path / "bad", "2.0")
    (bad / "slave/live.py").write_text("import no_such_thing\n")
    with pytest.raises(
        InstallError, match="does not load: ModuleNotFoundError: No module named 'no_such_thing'"
    ):
        board.install(bad)
    assert not [line for line in board.systemd.asked[asked:] if "restart" in line]
    assert len(list((board.root / "opt/phalanx/releases").iterdir())) == 1


def test_an_installation_that_was_cut_off_is_taken_back_first(
    board: Board, site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = board.install(site)
    with monkeypatch.context() as patch:
        patch.setattr(Transaction, "end", _power_goes)
        with pytest.raises(KeyboardInterrupt):  # as if the power went
            board.install(site_of(tmp_path / "new", "2.0"), "--options", "--seed 8")
    assert Transaction(board.root).is_open
    outcome = board.install(site)
    assert board.output.count("an installation before was cut off: taking it back") == 1
    assert outcome.changed == []
    assert outcome.release == good.release


def _power_goes(_self: Transaction) -> None:
    raise KeyboardInterrupt


def test_uninstalling_leaves_nothing_of_ours(board: Board, site: Path) -> None:
    before = board.files()
    board.install(site, "--overlay", "imx296")
    assert board.files() != before
    uninstall(board.machine)
    left = {
        path: value
        for path, value in board.files().items()
        if path not in ("run", "boot/firmware/config.txt")
    }
    assert left == {path: value for path, value in before.items() if path != "boot/firmware/config.txt"}
    assert (board.root / "boot/firmware/config.txt").read_text() == "# of the system\ndtparam=audio=on\n"
    assert not board.systemd.pids
    assert not board.systemd.enabled
    assert uninstall(board.machine) == [], "a second time there is nothing"


def test_a_full_disk_is_reported_and_leaves_what_runs(
    board: Board, site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs("mount")
    disk = board.root / "opt"
    mount = ["mount", "-t", "tmpfs", "-o", "size=60m", "none", str(disk)]
    if os.geteuid() != 0 or subprocess.run(mount, check=False).returncode != 0:
        pytest.skip("needs root, to mount a small disk")
    try:
        good = board.install(site)
        big = site_of(tmp_path / "big", "2.0")
        (big / "ballast").write_bytes(bytes(30_000_000))
        with pytest.raises(InstallError, match=r"MB free, a release needs 92 MB; make room there"):
            board.install(big)
        monkeypatch.setattr(release, "_check_space", _enough)  # as if somebody else filled it meanwhile
        (disk / "filler").write_bytes(bytes(40_000_000))
        with pytest.raises(InstallError, match="No space left on device"):
            board.install(big)
        assert (board.root / "opt/phalanx/current").readlink().name == good.release
        assert [p.name for p in (disk / "phalanx/releases").iterdir()] == [good.release]
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def _enough(_releases: Path, _source: Source) -> None:
    """There is room."""


def test_an_installation_waits_for_another_and_not_for_ever(board: Board, site: Path) -> None:
    board.install(site)
    other = os.open(board.root / LOCKED, os.O_RDONLY)
    fcntl.flock(other, fcntl.LOCK_EX)
    try:
        for act in (lambda: board.install(site), lambda: uninstall(board.machine)):
            board.output.clear()
            with pytest.raises(InstallError, match="still runs on this machine after 600 s"):
                act()
            assert board.output == [
                "another installation runs on this machine: waiting for its end, at most 600 s"
            ]
    finally:
        os.close(other)
    assert uninstall(board.machine)


@pytest.mark.parametrize("place", ["rigs/desk.json", "rigs"])
def test_what_a_slave_put_there_as_a_link_is_neither_read_nor_written(
    board: Board, site: Path, tmp_path: Path, place: str
) -> None:
    board.install(site)
    secret = tmp_path / "secret"
    (secret / "rigs").mkdir(parents=True)
    (secret / "rigs/desk.json").write_text("of root alone")
    mine = board.root / CALIB / place
    mine.rename(tmp_path / "away")
    mine.symlink_to(secret / place)
    other = tmp_path / "other"
    shutil.copytree(ROOT / "calib_json", other)
    (other / "rigs/desk.json").write_text((other / "rigs/desk.json").read_text() + "\n")
    with pytest.raises(InstallError, match=rf"/{CALIB}/{place}: is a link or a special file"):
        board.install(site, calibration=other)
    assert (secret / "rigs/desk.json").read_text() == "of root alone"
    kept = [file.read_bytes() for file in (board.root / NOTES).iterdir()]
    assert b"of root alone" not in kept, "what is kept goes back to the slave's folder"


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to give files away")
def test_new_files_of_the_slave_belong_to_the_slave(board: Board, site: Path, tmp_path: Path) -> None:
    board.install(site)
    for path in [board.root / STATE.lstrip("/"), *(board.root / STATE.lstrip("/")).rglob("*")]:
        os.chown(path, 64000, 64000)  # as systemd does when the service starts
    other = tmp_path / "other"
    shutil.copytree(ROOT / "calib_json", other)
    shutil.copy(other / "rigs/desk.json", other / "rigs/second.json")
    board.install(site, "--rig", "second", calibration=other)
    fresh = board.root / CALIB / "rigs/second.json"
    assert (fresh.stat().st_uid, fresh.stat().st_gid) == (64000, 64000)


def test_a_release_that_was_half_removed_is_made_again(
    board: Board, site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = board.install(site).release
    with monkeypatch.context() as patch:
        patch.setattr(release.shutil, "rmtree", _nothing)  # the power goes
        release.remove(board.root, name)
    assert not (board.root / release.RELEASES / name).exists()
    assert release.make(board.root, name, Source(site, wheels=False), board.output.append)


def _nothing(_path: Path, ignore_errors: bool = False) -> None:
    """Remove nothing."""
