"""The uplink by itself: it waits, it never blocks, it shares the beacon's port."""

import socket
import time
from collections.abc import Iterator

import numpy as np
import pytest

from common.clock import SystemClock
from common.errors import BusError
from common.messages import Health, MarkerDetections
from slave.uplink import LOG_NS, News, Uplink
from tests.network_helpers import detections, free_udp_port, until

KEY = bytes(range(32))


@pytest.fixture
def port() -> int:
    return free_udp_port()


@pytest.fixture
def uplink(port: int) -> Iterator[Uplink]:
    uplink = Uplink("left", KEY, SystemClock(), port, "127.0.0.1")
    yield uplink
    uplink.close()


def test_without_a_master_it_waits_and_drops(uplink: Uplink) -> None:
    assert not uplink.wait_for_start(0.05)
    assert not uplink.started
    assert uplink.start_t_ns is None
    assert uplink.zenoh_endpoint is None
    for seq in range(10):
        uplink.send(detections("left", uplink.session, seq))
    assert uplink.counts == {"sent": 0, "unsent": 10, "would_block": 0, "send_failed": 0}
    assert 0 <= uplink.session < 2**63


def test_two_slaves_hear_one_broadcast_on_one_port(uplink: Uplink, port: int) -> None:
    other = Uplink("right", KEY, SystemClock(), port, "127.0.0.1")
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as unknown_peer:
            unknown_peer.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            unknown_peer.bind(("127.0.0.1", 0))
            unknown_peer.sendto(b"not a beacon", ("127.255.255.255", port))
        for slave in (uplink, other):
            assert until(lambda one=slave: one.counts.get("refused.foreign") == 1)
    finally:
        other.close()


def test_bound_to_every_network_it_hears_loopback_too(port: int) -> None:
    slave = Uplink("left", KEY, SystemClock(), port)
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as unknown_peer:
            unknown_peer.sendto(b"not a beacon", ("127.0.0.1", port))
        assert until(lambda: slave.counts.get("refused.foreign") == 1)
    finally:
        slave.close()


def test_close_ends_the_wait_and_frees_the_port(port: int) -> None:
    slave = Uplink("left", KEY, SystemClock(), port, "127.0.0.1")
    slave.close()
    slave.close()
    began = time.monotonic()
    assert not slave.wait_for_start(30)
    assert time.monotonic() - began < 25
    again = Uplink("left", KEY, SystemClock(), port, "127.0.0.1")
    assert again.session != slave.session
    again.close()


def test_an_address_that_is_not_ours_is_an_error(port: int) -> None:
    with pytest.raises(BusError, match=r"cannot bind UDP 192\.0\.2\.1"):
        Uplink("left", KEY, SystemClock(), port, "192.0.2.1")
    with pytest.raises(BusError, match="'nonsense': must be an IPv4 address"):
        Uplink("left", KEY, SystemClock(), port, "nonsense")


def test_a_wrong_key_is_refused_at_start(port: int) -> None:
    with pytest.raises(ValueError, match="32"):
        Uplink("left", b"", SystemClock(), port, "127.0.0.1")


def test_messages_of_any_type_may_be_sent(uplink: Uplink) -> None:
    uplink.send(Health("left", 1, 0, {}, {}))
    empty = np.zeros(0)
    uv = empty.reshape(0, 2)
    uplink.send(MarkerDetections("left", 1, 0, 0, 0, uv, empty, empty, empty, uv))
    assert uplink.counts["unsent"] == 2


def test_a_line_is_said_once_and_who_alternates_two_does_not_fill_the_log() -> None:
    news = News()
    assert [news.is_new(line, t) for t, line in enumerate((None, "a", "a", None))] == [
        False,
        True,
        False,
        False,
    ]
    output = [
        t
        for t in range(0, 10 * LOG_NS, LOG_NS // 100)
        if news.is_new("ab"[t * 100 // LOG_NS % 2], LOG_NS + t)
    ]
    assert 1 < len(output) <= 10
    assert not news.is_new("c", 10 * LOG_NS + LOG_NS // 2)
    assert news.is_new("c", 0)  # a clock that was set back makes it no quieter
