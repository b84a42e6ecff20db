"""The socket of OSC and VMC: it sends whether somebody listens or not, and takes nothing in."""

import os
import socket

import pytest

from common.errors import PhalanxError
from master.outputs.network.osc import UdpSender
from tests.network_helpers import free_udp_port
from tests.sockets import listeners


def test_it_sends_to_nobody_and_loses_nothing_when_somebody_comes() -> None:
    port = free_udp_port()
    before = listeners(os.getpid())
    sender = UdpSender("127.0.0.1", port, "osc")
    for _ in range(5):
        sender.send(b"into the void")
    assert listeners(os.getpid()) == before, "it listens to nobody"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", port))
        receiver.settimeout(10.0)
        for k in range(5):
            sender.send(b"%d" % k)
        assert [receiver.recv(64) for _ in range(5)] == [b"0", b"1", b"2", b"3", b"4"]
    sender.close()


def test_an_unknown_host_is_reported_with_the_key_of_the_file() -> None:
    with pytest.raises(PhalanxError, match=r"vmc\.host"):
        UdpSender("no-such-host.invalid", 9, "vmc")
