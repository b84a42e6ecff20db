"""Which endpoints may leave the machine, which one is the default, and where a listener is reached."""

import pytest

from common.bus.endpoints import check, default_bus, encrypted, host_of, port_of, reached_at
from common.errors import BusError


@pytest.mark.parametrize(
    "endpoint",
    ["tcp/127.0.0.1:47802", "tcp/127.3.2.1:1", "tcp/[::1]:47802", "tcp/localhost:47802", "tls/0.0.0.0:47802",
     "tls/pc.local:47802", "quic/192.168.1.2:47802"],
)  # fmt: skip
def test_what_is_encrypted_or_stays_on_this_machine_is_allowed(endpoint: str) -> None:
    check(endpoint, open_bus=False)


@pytest.mark.parametrize(
    "endpoint", ["tcp/0.0.0.0:47802", "tcp/192.168.1.2:47802", "tcp/[fe80::1]:47802", "tcp/pc.local:47802",
                 "tcp/127.0.0.1.evil.example:47802", "tcp/127.0.0.1@evil.example:1", "tcp/nonsense"]
)  # fmt: skip
def test_plain_text_leaves_the_machine_only_when_somebody_says_so(endpoint: str) -> None:
    with pytest.raises(BusError, match="neither encrypted nor authenticated") as refused:
        check(endpoint, open_bus=False)
    for word in (endpoint, "tls/", "phalanx fleet keys DIR --make", "--open", "PHALANX_OPEN=1"):
        assert word in str(refused.value)
    check(endpoint, open_bus=True)


@pytest.mark.parametrize("endpoint", ["udp/127.0.0.1:1", "127.0.0.1:47802", "TCP/127.0.0.1:1", ""])
def test_anything_else_is_no_endpoint_open_or_not(endpoint: str) -> None:
    for open_bus in (False, True):
        with pytest.raises(BusError, match="must begin with tcp/, tls/, quic/"):
            check(endpoint, open_bus)


def test_an_endpoint_brings_no_certificates_of_its_own() -> None:
    for open_bus in (False, True):
        with pytest.raises(BusError, match="no settings of its own"):
            check("tls/192.168.1.2:1#enable_mtls=false", open_bus)


def test_the_default_is_encrypted_where_there_are_keys() -> None:
    assert default_bus({}) == "tcp/127.0.0.1:47802"
    assert default_bus({"PHALANX_KEYS": ""}) == "tcp/127.0.0.1:47802"
    assert default_bus({"PHALANX_KEYS": "/anywhere"}) == "tls/127.0.0.1:47802"


@pytest.mark.parametrize(
    ("output", "received_from", "reached"),
    [
        ("tls/0.0.0.0:47802", "192.168.1.2", "tls/192.168.1.2:47802"),
        ("tls/192.168.7.7:47802", "192.168.1.2", "tls/192.168.7.7:47802"),
        ("tcp/127.0.0.1:1", "192.168.1.2", "tcp/127.0.0.1:1"),
        ("tls/0.0.0.0:47802", "nonsense:1", "tls/0.0.0.0:47802"),
        ("", "192.168.1.2", ""),
    ],
)
def test_who_listens_everywhere_is_where_it_was_heard(output: str, received_from: str, reached: str) -> None:
    assert reached_at(output, received_from) == reached


def test_hosts_and_ports_are_read_off_any_endpoint() -> None:
    assert (host_of("tls/[::1]:47802"), port_of("tls/[::1]:47802")) == ("::1", 47802)
    assert (host_of("tls/pc.local:1?rel=1"), port_of("tls/pc.local:1?rel=1")) == (
        "pc.local",
        1,
    )
    assert port_of("tls/pc.local") == 0
    assert encrypted("tls/x:1")
    assert not encrypted("tcp/x:1")
