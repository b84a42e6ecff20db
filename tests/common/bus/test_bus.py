"""The bus: the same behaviour from the bus in one process and from the one between processes."""

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from common.bus.bus import MOST_SENDERS, Bus, Inbox
from common.bus.zenoh_bus import ZenohBus
from common.errors import BusError
from common.messages import Command, Health, encode
from tests.memory_bus import LoopbackBus
from tests.network_helpers import free_endpoint, health, until


@dataclass
class Pair:
    master: Bus
    slave: Bus


@pytest.fixture(params=["loopback", "zenoh"])
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    if request.param == "loopback":
        master = LoopbackBus()
        both = Pair(master, master.join())
    else:
        endpoint = free_endpoint()
        listener = ZenohBus(endpoint, None)
        other = ZenohBus(None, endpoint)
        assert until(lambda: other.peers == 1)
        both = Pair(listener, other)
    yield both
    both.slave.close()
    both.master.close()


def test_a_message_arrives_with_its_content_and_only_under_its_name(pair: Pair) -> None:
    everybody = pair.master.subscribe("health")
    right_only = pair.master.subscribe("health", "right")
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline:  # a subscription needs a moment to reach the other process
        pair.slave.publish("health", "left", health("left", 7))
        got = everybody.get(0.05)
        if got is not None:
            break
    else:
        pytest.fail("nothing arrived")
    assert isinstance(got, Health)
    assert (got.source, got.counts, got.metrics) == ("left", {"frames": 7}, {"rate_hz": 60.0})
    assert right_only.get(0.05) is None
    pair.slave.publish("health", "right", health("right"))
    got = right_only.get(60.0)
    assert isinstance(got, Health)
    assert got.source == "right"


def test_a_slow_reader_gets_the_newest_and_a_count(pair: Pair) -> None:
    slow = pair.master.subscribe("health", depth=4)
    fast = pair.master.subscribe("health", depth=64)
    deadline = time.monotonic() + 5
    while fast.get(0.05) is None and time.monotonic() < deadline:
        pair.slave.publish("health", "left", health("left", 0))
    while slow.get(0.05) is not None or fast.get(0.0) is not None:
        pass
    before = slow.dropped
    seen: list[int] = []
    for i in range(1, 11):
        # Each arrives before the next leaves: a burst may be dropped on the way where the machine is busy.
        pair.slave.publish("health", "left", health("left", i))
        message = fast.get(60.0)
        assert isinstance(message, Health)
        seen.append(message.counts["frames"])
    assert fast.get(0.0) is None
    assert seen == list(range(1, 11))
    assert until(lambda: slow.dropped - before == 6)
    kept: list[int] = []
    while (message := slow.get(0.05)) is not None:
        assert isinstance(message, Health)
        kept.append(message.counts["frames"])
    assert kept == [7, 8, 9, 10]


def test_a_command_is_answered_by_its_target(pair: Pair) -> None:
    orders: list[str] = []

    def handler(command: Command) -> Health:
        orders.append(command.verb)
        return health(command.target, len(orders))

    pair.slave.serve("left", handler)
    for i, verb in enumerate(("report", "stop"), start=1):
        answer = pair.master.ask(Command("left", verb), timeout_s=5)
        assert (answer.source, answer.counts["frames"]) == ("left", i)
    assert orders == ["report", "stop"]


def test_a_refusal_reaches_the_asker_and_the_target_goes_on(pair: Pair) -> None:
    def handler(command: Command) -> Health:
        if command.verb != "report":
            raise BusError("I only know 'report'")
        return health("left")

    pair.slave.serve("left", handler)
    with pytest.raises(BusError, match="I only know 'report'"):
        pair.master.ask(Command("left", "fly"), timeout_s=5)
    assert pair.master.ask(Command("left", "report"), timeout_s=5).source == "left"


def test_nobody_there_is_an_error_that_says_so(pair: Pair) -> None:
    with pytest.raises(BusError, match="no answer from 'ghost' to 'report'"):
        pair.master.ask(Command("ghost", "report"), timeout_s=0.2)


def test_the_living_are_listed_until_they_leave(pair: Pair) -> None:
    pair.master.announce("master")
    pair.slave.announce("left")
    assert until(lambda: pair.master.alive() == {"master", "left"})
    assert until(lambda: pair.slave.alive() == {"master", "left"})
    pair.slave.close()
    assert until(lambda: pair.master.alive() == {"master"})


def test_what_does_not_belong_on_the_bus_is_refused(pair: Pair) -> None:
    with pytest.raises(
        ValueError, match="streams on it: checklist, command, contact, device, gesture, hand, health"
    ):
        pair.master.subscribe("markers")
    with pytest.raises(ValueError, match="streams on it"):
        pair.master.publish("nonsense", "left", health("left"))
    with pytest.raises(ValueError, match="carries HandPose, not Health"):
        pair.master.publish("hand", "left", health("left"))
    with pytest.raises(ValueError, match="depth=0"):
        pair.master.subscribe("health", depth=0)


def test_closing_wakes_a_reader_and_is_safe_twice(pair: Pair) -> None:
    subscription = pair.master.subscribe("health")
    got: list[object] = []
    reader = threading.Thread(target=lambda: got.append(subscription.get(30)))
    reader.start()
    pair.master.close()
    reader.join(60.0)
    assert not reader.is_alive()
    assert got == [None]
    pair.master.close()
    subscription.close()
    with pytest.raises(BusError, match="closed"):
        pair.master.publish("health", "left", health("left"))


def test_a_foreign_payload_is_counted_and_skipped() -> None:
    inbox = Inbox("health", 8, lambda _: None)
    for payload in (b"", b"\xc1", encode(Command("left", "report")), encode(health("left"))[:-1]):
        inbox.put("left", payload)
    inbox.put("right", encode(health("left")))  # in another's name
    inbox.put("left", encode(health("left")))
    assert isinstance(inbox.get(0.0), Health)
    assert inbox.refused == 5


def test_of_one_who_reports_without_end_a_few_are_taken_and_of_the_others_all() -> None:
    inbox = Inbox("health", 64, lambda _: None)
    for _ in range(1000):
        inbox.put("flood", encode(health("flood")))
    for name in ("left", "right"):
        inbox.put(name, encode(health(name)))
    got = [message.source for _ in range(64) if isinstance(message := inbox.get(0.0), Health)]
    assert got[-2:] == ["left", "right"]
    assert 20 <= len(got) - 2 <= 30
    assert inbox.dropped == 1000 - (len(got) - 2)


def test_names_that_are_invented_share_one_rate_and_no_memory() -> None:
    inbox = Inbox("health", 8, lambda _: None)
    for k in range(2000):
        inbox.put(f"n{k}", b"")
    assert len(inbox._buckets) <= MOST_SENDERS + 1
    assert inbox.dropped > 1000


def test_what_is_no_message_keeps_nobody_waiting() -> None:
    inbox = Inbox("hand", 16, lambda _: None)
    ended = threading.Event()

    def junk() -> None:
        while not ended.wait(0.02):
            inbox.put("left", b"\xc1")

    sender = threading.Thread(target=junk)
    sender.start()
    began = time.monotonic()
    assert inbox.get(0.2) is None
    assert inbox.get(0.0) is None
    took_s = time.monotonic() - began
    ended.set()
    sender.join()
    assert inbox.refused > 0
    assert took_s < 5.0
