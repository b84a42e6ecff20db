"""The keys folder: made once, added to, renewed, a device taken out; private from the first moment on."""

import os
from datetime import UTC, datetime
from pathlib import Path

import pytest

from common.bus.keys import link_key, new_key, shown
from common.errors import PhalanxError
from common.link.datagram import device_secret
from master.commands.keys import certificates_of, devices_of, lacks_secrets, make, renew, renew_device
from tests.cli import invoke

NOW = datetime(2026, 1, 1, tzinfo=UTC)
ALL = {
    "rig.key",
    "devices.key",
    "ca.pem",
    "ca.key",
    "master.pem",
    "master.key",
    "operator.pem",
    "operator.key",
}


def files(folder: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """A keys folder of two devices."""
    before = os.umask(0)  # who cares least about his files
    try:
        make(tmp_path / "of" / "rig", ["left", "pi.right-2_x"], NOW)
    finally:
        os.umask(before)
    return tmp_path / "of" / "rig"


def test_it_has_everything_and_nobody_else_can_read_a_secret(keys: Path) -> None:
    devices = {
        f"devices/{name}.{ending}" for name in ("left", "pi.right-2_x") for ending in ("pem", "key", "secret")
    }
    assert set(files(keys)) == ALL | devices
    for path in [keys, keys / "devices"]:
        assert path.stat().st_mode & 0o777 == 0o700
    for path in [*keys.rglob("*.key"), *keys.rglob("*.secret")]:
        assert path.stat().st_mode & 0o777 == 0o600
    assert {one.name: one.listens for one in certificates_of(keys)} == {
        "master": True,
        "operator": False,
        "left": False,
        "pi.right-2_x": False,
    }


def test_made_again_it_stays_as_it_is_and_only_what_is_missing_is_added(keys: Path) -> None:
    before = files(keys)
    assert make(keys, ["left"], NOW) == []
    assert files(keys) == before
    assert make(keys, ["left", "imu"], NOW) == [
        "devices/imu.key",
        "devices/imu.pem",
        "devices/imu.secret",
    ]
    assert {name: content for name, content in files(keys).items() if "imu" not in name} == before
    (keys / "devices" / "left.key").unlink()
    assert make(keys, ["left"], NOW) == ["devices/left.key", "devices/left.pem"]


def test_the_secret_of_a_device_follows_from_the_root_alone(keys: Path) -> None:
    root = bytes.fromhex((keys / "devices.key").read_text())
    for name in devices_of(keys):
        assert bytes.fromhex((keys / "devices" / f"{name}.secret").read_text()) == device_secret(root, name)
        assert link_key({}, None, keys).secret(name) == link_key({}, None, keys, name).secret(name)
    (keys / "devices" / "left.secret").write_text(new_key())  # of somewhere else
    assert lacks_secrets(keys) == ["left"]
    assert make(keys, [], NOW) == ["devices/left.secret"]
    assert not lacks_secrets(keys)


def test_a_folder_from_before_there_were_secrets_gets_them_for_all_its_devices(keys: Path) -> None:
    old = {
        name: content
        for name, content in files(keys).items()
        if not name.endswith((".secret", "devices.key"))
    }
    for name in files(keys).keys() - old.keys():
        (keys / name).unlink()
    output = invoke("fleet", "keys", keys)
    assert f"No secret of its own has left, pi.right-2_x: phalanx fleet keys {keys} --make" in output.output
    output = invoke("fleet", "keys", keys, "--make")
    assert output.exit_code == 0
    assert "made devices.key, devices/left.secret, devices/pi.right-2_x.secret" in output.output
    assert "deploy again to left, pi.right-2_x; restart the master" in output.output
    assert {name: content for name, content in files(keys).items() if name in old} == old
    assert not lacks_secrets(keys)
    for more in (("--make",), ()):
        assert "again" not in invoke("fleet", "keys", keys, *more).output


@pytest.mark.parametrize("content", ["", "00", "z" * 64])
def test_a_broken_root_of_the_secrets_is_named(keys: Path, content: str) -> None:
    (keys / "devices.key").write_text(content)
    with pytest.raises(PhalanxError, match=r"devices\.key: broken .*fleet keys .* --renew"):
        make(keys, [], NOW)


def test_a_rig_key_that_is_there_stays(tmp_path: Path) -> None:
    tmp_path.chmod(0o700)
    (tmp_path / "rig.key").write_text("ab" * 32)
    make(tmp_path, [], NOW)
    assert (tmp_path / "rig.key").read_text() == "ab" * 32


def test_renewed_everything_is_another_and_other_files_stay(keys: Path) -> None:
    before = files(keys)
    (keys / "note.txt").write_text("mine")
    assert renew(keys, NOW) == ["left", "pi.right-2_x"]
    after = files(keys)
    assert after.pop("note.txt") == b"mine"
    assert set(after) == set(before)
    assert not [name for name in after if after[name] == before[name]]


def test_a_removed_device_keeps_no_valid_secret(keys: Path) -> None:
    before = files(keys)
    assert renew(keys, NOW, ["left"]) == ["pi.right-2_x"]
    assert devices_of(keys) == ["pi.right-2_x"]
    after = files(keys)
    assert after["rig.key"] != before["rig.key"]
    assert after["devices.key"] != before["devices.key"]
    assert not [name for name in after if name.startswith("devices/left")]
    assert after["ca.pem"] != before["ca.pem"]
    with pytest.raises(PhalanxError, match=r"no device 'left'; there are: pi\.right-2_x"):
        renew(keys, NOW, ["left"])


def test_one_device_is_renewed_without_the_others(keys: Path) -> None:
    before = files(keys)
    renew_device(keys, "left", NOW)
    changed = {name for name, content in files(keys).items() if content != before[name]}
    assert changed == {"devices/left.pem", "devices/left.key"}
    assert shown((keys / "devices" / "left.pem").read_bytes()).name == "left"


@pytest.mark.parametrize(
    "name", ["master", "operator", "", ".", "..", "a/b", "../left", "a b", "x" * 65, "naïve", "a\n"]
)
def test_a_name_that_no_device_can_have_is_refused_before_anything_is_made(tmp_path: Path, name: str) -> None:
    with pytest.raises(PhalanxError, match="--device"):
        make(tmp_path / "keys", [name], NOW)
    assert not (tmp_path / "keys").exists()


def test_folders_that_are_not_ours_are_left_alone(tmp_path: Path, keys: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o755)
    with pytest.raises(PhalanxError, match="others can enter it"):
        make(shared, [], NOW)
    assert not list(shared.iterdir())
    for use in (devices_of, certificates_of):
        with pytest.raises(PhalanxError, match="no keys folder"):
            use(shared)
    with pytest.raises(PhalanxError, match="no keys folder"):
        renew(shared, NOW)
    for file in ("ca.key", "devices.key"):  # as on a device
        (keys / file).unlink()
    before = files(keys)
    with pytest.raises(PhalanxError, match=r"has ca\.pem but not ca\.key"):
        make(keys, ["late"], NOW)
    assert files(keys) == before


def test_a_device_keeps_its_certificate_where_none_can_be_made(keys: Path) -> None:
    before = files(keys)
    (keys / "ca.key").write_text("broken")
    with pytest.raises(PhalanxError, match=r"ca\.pem or ca\.key: broken"):
        renew_device(keys, "left", NOW)
    assert files(keys) == before | {"ca.key": b"broken"}
