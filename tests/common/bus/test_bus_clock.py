"""A clock that is wrong, before an encrypted bus: it is named with its time, and not another rig's keys."""

import logging
from contextlib import ExitStack
from datetime import UTC, datetime, tzinfo
from pathlib import Path

import pytest

from common.bus.endpoints import why_refused
from common.bus.keys import FIRST_DAY, MASTER, OPERATOR, KeyPair, issue
from common.bus.zenoh_bus import ZenohBus
from common.errors import BusError
from master.commands.keys import make
from tests.common.bus.test_encrypted_bus import NOW, access, tls_endpoint
from tests.network_helpers import until

EARLIER, LATER = (
    datetime(2000, 1, 1, tzinfo=UTC),
    datetime(2200, 1, 1, tzinfo=UTC),
)  # certificates end ten years later


@pytest.mark.parametrize(("first_day", "which"), [(FIRST_DAY, "no longer"), (LATER, "not yet")])
def test_a_wrong_clock_is_named_and_not_another_rig(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    first_day: datetime,
    which: str,
) -> None:
    """Certificates of another time are the same as a clock of another time."""
    monkeypatch.setattr("common.bus.keys.FIRST_DAY", first_day)
    folder, endpoint = tmp_path / "keys", tls_endpoint()
    make(folder, ["left"], EARLIER if which == "no longer" else LATER)
    with ExitStack() as stack:
        stack.callback(ZenohBus(endpoint, None, access(MASTER, folder)).close)
        with pytest.raises(
            BusError, match=f"{which} valid: the clock of this machine says 20.*timedatectl"
        ) as refused:
            ZenohBus(None, endpoint, access(OPERATOR, folder), beyond=True)
        assert "another rig" not in str(refused.value)
        with caplog.at_level(logging.WARNING):
            left = ZenohBus(None, endpoint, access("left", folder))
            stack.callback(left.close)
            assert until(lambda: "the clock of this machine says" in caplog.text)
    assert "another rig" not in caplog.text


def _with_certificate_of(folder: Path, name: str, now: datetime) -> None:
    """Give one process a certificate of the rig that was made at another time."""
    pair = issue(KeyPair((folder / "ca.pem").read_bytes(), (folder / "ca.key").read_bytes()), name, now)
    (folder / f"{name}.pem").write_bytes(pair.certificate)
    (folder / f"{name}.key").write_bytes(pair.key)


def test_a_certificate_of_the_master_that_ended_is_named_with_its_validity(tmp_path: Path) -> None:
    folder, endpoint = tmp_path / "keys", tls_endpoint()
    make(folder, [], NOW)
    _with_certificate_of(folder, MASTER, EARLIER)
    with ExitStack() as stack:
        stack.callback(ZenohBus(endpoint, None, access(MASTER, folder)).close)
        with pytest.raises(
            BusError,
            match=r"who listens there \('master'\) is no longer valid.*from 1970-01-01 to 2009-12-31",
        ):
            ZenohBus(None, endpoint, access(OPERATOR, folder), beyond=True)


def test_an_own_certificate_that_the_master_refuses_by_its_time_is_named(tmp_path: Path) -> None:
    folder, endpoint = tmp_path / "keys", tls_endpoint()
    make(folder, [], NOW)
    _with_certificate_of(folder, OPERATOR, EARLIER)
    with ExitStack() as stack:
        stack.callback(ZenohBus(endpoint, None, access(MASTER, folder)).close)
        with pytest.raises(
            BusError, match=r"refused it, and the certificate of 'operator' is no longer valid"
        ):
            ZenohBus(None, endpoint, access(OPERATOR, folder), beyond=True)


class _InTime(datetime):
    """A clock by which certificates that ended are valid."""

    @classmethod
    def now(cls, tz: tzinfo | None = None) -> "_InTime":
        return cls(2005, 1, 1, tzinfo=tz)


def test_a_clock_that_is_wrong_where_the_master_is_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """By the clock here the certificate is valid, and the master's answer is that it is not."""
    folder, endpoint = tmp_path / "keys", tls_endpoint()
    make(folder, [], NOW)
    _with_certificate_of(folder, OPERATOR, EARLIER)
    monkeypatch.setattr("common.bus.endpoints.datetime", _InTime)
    with ExitStack() as stack:
        stack.callback(ZenohBus(endpoint, None, access(MASTER, folder)).close)
        why = why_refused(endpoint, access(OPERATOR, folder).identity())
    assert "the clock of this machine says 2005-01-01 00:00 UTC. Is the clock of the machine there" in why
