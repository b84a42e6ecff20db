"""What the tests of datagrams share."""

import socket
from collections.abc import Iterator

import pytest


@pytest.fixture(scope="module")
def ear() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as received:
        received.bind(("127.0.0.1", 0))
        received.settimeout(10.0)
        yield received
