"""Ingest at its own port: rubbish from anybody is counted, a slow reader gets what is new."""

import socket
from collections.abc import Iterator

import numpy as np
import pytest

from common.clock import SystemClock
from common.errors import BusError
from common.link.datagram import MAX_DATAGRAM
from common.messages import ImuSample, MarkerDetections, TagDetections, TrackerPose
from master.run.ingest import QUEUE, Ingest
from master.run.link_senders import SensorMessage
from tests.network_helpers import detections, free_udp_port, until

KEY = bytes(range(32))


def new_ingest(bind: tuple[str, int] = ("127.0.0.1", 0)) -> Ingest:
    return Ingest(("left", "right"), KEY, SystemClock(), ("127.255.255.255", free_udp_port()), bind, "")


@pytest.fixture
def ingest() -> Iterator[Ingest]:
    ingest = new_ingest()
    yield ingest
    ingest.close()


def test_rubbish_is_counted_by_reason(ingest: Ingest) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as unknown_peer:
        for datagram in (
            b"GET / HTTP/1.0",
            b"",
            b"PHLX",
            b"PHLX" + bytes(60),
            bytes(MAX_DATAGRAM + 1),
            bytes(60000),
        ):
            unknown_peer.sendto(datagram, ingest.address)
    expected = {"foreign": 2, "cut": 1, "version": 1, "oversized": 2}
    assert until(lambda: ingest.refused == expected)
    assert ingest.counts["refused.oversized"] == 2
    assert ingest.counts["left.received"] == 0
    assert not ingest.connected
    assert not ingest.started
    assert ingest.get(0.0) is None


def test_samples_of_an_imu_drive_no_frame_out(ingest: Ingest) -> None:
    nan = np.full(3, np.nan)
    for seq in range(QUEUE):
        ingest.queue.put([detections("left", 1, seq)])
        for k in range(10):
            ingest.queue.put([ImuSample("palm-imu", 1, 10 * seq + k, 0, nan, nan, nan, np.full(4, np.nan))])
    taken = [ingest.get(0.0) for _ in range(11 * QUEUE)]
    assert [one.seq for one in taken if isinstance(one, MarkerDetections)] == list(range(QUEUE))
    assert ingest.get(0.0) is None
    assert ingest.counts["queue.dropped"] == 0


@pytest.mark.parametrize("kind", ["imu", "tracker", "tags"])
def test_frames_that_pile_up_starve_nothing_else(ingest: Ingest, kind: str) -> None:
    # Two frames come for each that the master has time for, for a long while; what is cheap comes with each.
    taken: list[SensorMessage] = []
    for k in range(6 * QUEUE):
        for message in (detections("left", 1, 2 * k), detections("left", 1, 2 * k + 1), cheap(kind, k)):
            ingest.queue.put([message])
        while (one := ingest.get(0.0)) is not None:
            taken.append(one)
            if isinstance(one, MarkerDetections):
                break
    others = [one.seq for one in taken if not isinstance(one, MarkerDetections)]
    assert others == list(range(len(others)))
    assert len(others) > 5 * QUEUE
    assert len(taken) - len(others) == 6 * QUEUE  # a frame in every round
    assert ingest.counts["queue.dropped"] == 6 * QUEUE - (QUEUE - 1)  # the rest waits


def cheap(kind: str, seq: int) -> SensorMessage:
    nan3, nan4 = np.full(3, np.nan), np.full(4, np.nan)
    if kind == "imu":
        return ImuSample("palm-imu", 1, seq, 0, nan3, nan3, nan3, nan4)
    if kind == "tracker":
        return TrackerPose("puck", 1, seq, 0, nan3, nan4)
    return TagDetections("left", 1, seq, 0, 0, np.zeros(0, np.uint16), np.zeros((0, 4, 2)), np.zeros(0))


def test_close_wakes_a_reader_and_frees_the_port() -> None:
    ingest = new_ingest()
    with pytest.raises(BusError, match="cannot bind UDP"):
        new_ingest(ingest.address)
    ingest.close()
    ingest.close()
    assert ingest.get(30.0) is None
    again = new_ingest(ingest.address)
    again.close()


def test_an_unknown_camera_is_the_callers_error(ingest: Ingest) -> None:
    with pytest.raises(KeyError, match="third"):
        ingest.clock_of("third")
    assert ingest.clock_of("left") is None


def test_a_beacon_that_cannot_be_sent_is_counted_and_survived() -> None:
    ingest = Ingest(("left",), KEY, SystemClock(), ("127.0.0.1", 0), ("127.0.0.1", 0), "")
    try:
        assert until(lambda: ingest.counts["send_failed"] >= 2)
    finally:
        ingest.close()


@pytest.mark.parametrize("host", ["pi.local", "256.0.0.1", ""])
def test_a_beacon_address_that_is_none_is_refused_at_start(host: str) -> None:
    with pytest.raises(BusError, match="must be an IPv4 address"):
        Ingest(("left",), KEY, SystemClock(), (host, 1), ("127.0.0.1", 0), "")


def test_a_wrong_key_is_refused_at_start() -> None:
    with pytest.raises(ValueError, match="rig key of 3 bytes"):
        Ingest(("left",), b"abc", SystemClock(), ("127.255.255.255", 1), ("127.0.0.1", 0), "")
