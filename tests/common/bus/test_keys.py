"""Which keys a process finds, and which it refuses: of others, readable by others, missing."""

import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509

from common.bus.keys import (
    FIRST_DAY,
    LIFE,
    MASTER,
    OPERATOR,
    access_of,
    issue,
    link_key,
    new_authority,
    new_key,
    rig_key,
    shown,
)
from common.errors import BusError, PhalanxError
from common.link.datagram import LinkKey
from master.commands.keys import make

NOW = datetime(2026, 1, 1, tzinfo=UTC)


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """A keys folder of one device."""
    make(tmp_path / "keys", ["left"], NOW)
    return tmp_path / "keys"


def test_a_certificate_is_valid_for_a_machine_without_a_clock_and_for_ten_years() -> None:
    authority = new_authority(NOW)
    left = x509.load_pem_x509_certificate(issue(authority, "left", NOW).certificate)
    ca = x509.load_pem_x509_certificate(authority.certificate)
    for one in (left, ca):
        assert one.not_valid_before_utc == FIRST_DAY == datetime(1970, 1, 1, tzinfo=UTC)
        assert one.not_valid_after_utc == NOW + LIFE
    assert timedelta(days=3650) < LIFE
    left.verify_directly_issued_by(ca)


def test_only_the_master_may_listen() -> None:
    authority = new_authority(NOW)
    printed = {name: shown(issue(authority, name, NOW).certificate) for name in (MASTER, OPERATOR, "left")}
    assert {name: one.listens for name, one in printed.items()} == {
        MASTER: True,
        OPERATOR: False,
        "left": False,
    }
    assert {one.name for one in printed.values()} == set(printed)
    assert not shown(authority.certificate).listens


def test_a_certificate_signs_no_others() -> None:
    ca = x509.load_pem_x509_certificate(new_authority(NOW).certificate)
    assert ca.extensions.get_extension_for_class(x509.BasicConstraints).value.path_length == 0
    left = x509.load_pem_x509_certificate(issue(new_authority(NOW), "left", NOW).certificate)
    assert not left.extensions.get_extension_for_class(x509.BasicConstraints).value.ca


def test_the_rig_key_is_that_of_the_file_then_the_folder_then_the_environment(keys: Path) -> None:
    inside = bytes.fromhex((keys / "rig.key").read_text())
    other, text = keys.parent / "other.key", new_key()
    other.write_text(new_key())
    other.chmod(0o600)
    of_file = bytes.fromhex(other.read_text())
    environment = {"PHALANX_RIG_KEY": text, "PHALANX_KEYS": str(keys)}
    assert rig_key(environment, other, keys) == of_file
    assert rig_key(environment, None, keys) == inside
    assert rig_key(environment) == bytes.fromhex(text)
    assert rig_key({"PHALANX_KEYS": str(keys)}) == inside
    with pytest.raises(PhalanxError, match="keys DIR --make"):
        rig_key({})


def test_the_secrets_are_those_of_the_folder_and_of_the_rig_key_where_that_is_alone(keys: Path) -> None:
    rig, root, own = (
        bytes.fromhex((keys / file).read_text()) for file in ("rig.key", "devices.key", "devices/left.secret")
    )
    other, text = keys.parent / "other.key", new_key()
    other.write_text(new_key())
    other.chmod(0o600)
    folder = {"PHALANX_KEYS": str(keys)}
    assert link_key(folder) == link_key({}, None, keys) == LinkKey(rig, root)
    assert link_key(folder, device="left") == link_key({}, None, keys, "left") == LinkKey(rig, own=own)
    assert LinkKey(rig, root).secret("left") == own
    for device in (None, "left"):  # and whoever is told the rig key alone has no more than that
        both = folder | {"PHALANX_RIG_KEY": text}
        assert link_key(both, device=device) == LinkKey(bytes.fromhex(text))
        assert link_key(both, other, keys, device) == LinkKey(bytes.fromhex(other.read_text()))
    assert link_key(both, None, keys) == LinkKey(rig, root)


def test_a_folder_without_secrets_makes_no_weaker_rig(keys: Path) -> None:
    (keys / "devices.key").unlink()
    (keys / "devices/left.secret").unlink()
    with pytest.raises(
        PhalanxError, match=rf"devices\.key: missing.* fleet keys {keys} --make.*phalanx fleet deploy"
    ):
        link_key({}, None, keys)
    with pytest.raises(
        PhalanxError, match=r"no secret of 'left' \(devices/left\.secret, device-left\.secret.*--device left"
    ):
        link_key({}, None, keys, "left")


@pytest.mark.parametrize("place", ["devices/left", "device-left", "device"])
def test_a_device_finds_its_certificate_in_every_layout(keys: Path, place: str) -> None:
    there = keys.parent / "device"
    (there / "devices").mkdir(mode=0o700, parents=True)
    shutil.copy(keys / "ca.pem", there)
    shutil.copy(keys / "rig.key", there)
    for ending in ("pem", "key", "secret"):
        shutil.copy(keys / "devices" / f"left.{ending}", there / f"{place}.{ending}")
    assert link_key({}, None, there, "left") == link_key({}, None, keys, "left")
    found = access_of({"PHALANX_KEYS": str(there)}, "left").identity()
    assert found.certificate == there / f"{place}.pem"
    if place == "device":  # and there it may be of somebody else
        with pytest.raises(BusError, match="is the certificate of 'left', not of 'right'"):
            access_of({}, "right", there).identity()


def test_the_names_of_devices_are_known_to_the_master(keys: Path) -> None:
    assert access_of({}, MASTER, keys).identity().devices == ("left",)


@pytest.mark.parametrize("secret", ["rig.key", "devices/left.key", "devices/left.secret", "devices.key"])
@pytest.mark.parametrize("mode", [0o640, 0o604])
def test_a_secret_that_others_can_read_is_refused_but_for_the_mask_of_a_service(
    keys: Path, secret: str, mode: int
) -> None:
    (keys / secret).chmod(mode)

    def use(environment: dict[str, str]) -> object:
        if secret == "rig.key":
            return rig_key(environment, None, keys)
        if secret == "devices.key":
            return link_key(environment, None, keys)
        if secret == "devices/left.secret":
            return link_key(environment, None, keys, "left")
        return access_of(environment, "left", keys).identity()

    with pytest.raises(PhalanxError, match=r"others can read .*chmod 600"):
        use({})
    handed = {"CREDENTIALS_DIRECTORY": str((keys / secret).parent)}
    if mode & 0o007:
        with pytest.raises(PhalanxError, match="others can read"):
            use(handed)
    else:
        assert use(handed)


def test_what_is_missing_or_broken_is_named_with_the_fix(keys: Path) -> None:
    with pytest.raises(BusError, match=r"no certificate of 'right' .*fleet keys .* --make --device right"):
        access_of({}, "right", keys).identity()
    with pytest.raises(BusError, match="give --keys DIR or set PHALANX_KEYS"):
        access_of({}, OPERATOR).identity()
    (keys / "ca.pem").write_text("nonsense")
    with pytest.raises(BusError, match="keys of 'operator'"):
        access_of({}, OPERATOR, keys).identity()


def test_an_open_bus_must_be_wished() -> None:
    assert not access_of({}, OPERATOR).open
    assert not access_of({"PHALANX_OPEN": "0"}, OPERATOR).open
    assert access_of({"PHALANX_OPEN": "1"}, OPERATOR).open
    assert access_of({}, OPERATOR, open_bus=True).open
