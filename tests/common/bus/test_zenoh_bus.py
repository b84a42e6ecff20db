"""What only the bus between processes can get wrong: absent peers, restarts, listening too widely."""

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from common.bus.keys import access_of
from common.bus.zenoh_bus import ZenohBus
from common.errors import BusError
from common.messages import Command, Health
from tests.network_helpers import free_endpoint, health, until


def listening_sockets() -> set[str]:
    """Local addresses (hex) of every TCP socket of this process that listens."""
    inodes: set[str] = set()
    for link in Path("/proc/self/fd").iterdir():
        try:
            target = str(link.readlink())
        except OSError:
            continue
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    rows: list[list[str]] = []
    for table in ("/proc/self/net/tcp", "/proc/self/net/tcp6"):
        path = Path(table)
        if path.exists():
            rows += [line.split() for line in path.read_text().splitlines()[1:]]
    return {row[1] for row in rows if row[3] == "0A" and row[9] in inodes}


def test_nothing_listens_that_was_not_asked_for() -> None:
    before = listening_sockets()
    endpoint = free_endpoint()
    port = int(endpoint.rsplit(":", 1)[1])
    client = ZenohBus(None, endpoint)
    try:
        assert listening_sockets() == before
        master = ZenohBus(endpoint, None)
        try:
            assert listening_sockets() - before == {f"0100007F:{port:04X}"}  # 127.0.0.1 and nothing else
        finally:
            master.close()
    finally:
        client.close()


def test_an_absent_master_neither_blocks_nor_stays_unnoticed() -> None:
    bus = ZenohBus(None, free_endpoint())
    try:
        assert bus.peers == 0
        with pytest.raises(BusError, match=r"no process is connected\. Is the master running"):
            bus.ask(Command("master", "report"), timeout_s=0.2)
        bus.publish("health", "left", health("left"))  # into the void, without an error
    finally:
        bus.close()


def test_everything_declared_holds_again_after_the_master_restarts() -> None:
    endpoint = free_endpoint()
    slave = ZenohBus(None, endpoint)
    slave.serve("left", lambda command: health(command.target, 3))
    slave.announce("left")
    inbox = slave.subscribe("health", "master")
    try:
        for _ in range(2):
            master = ZenohBus(endpoint, None)
            try:
                assert master.ask(Command("left", "report"), timeout_s=5).counts == {"frames": 3}
                assert until(lambda bus=master: "left" in bus.alive())

                def received(bus: ZenohBus = master) -> bool:
                    bus.publish("health", "master", health("master"))
                    return inbox.get(0.05) is not None

                assert until(received)
            finally:
                master.close()
            assert until(lambda: slave.peers == 0)
    finally:
        slave.close()


KILLED = """
import sys, time
from common.bus.zenoh_bus import ZenohBus
bus = ZenohBus(None, sys.argv[1])
bus.announce("left")
time.sleep(60)
"""


def test_a_killed_process_leaves_the_list_of_the_living() -> None:
    endpoint = free_endpoint()
    master = ZenohBus(endpoint, None)
    process = subprocess.Popen([sys.executable, "-c", KILLED, endpoint], cwd=Path(__file__).parents[3])
    try:
        assert until(lambda: master.alive() == {"left"}, timeout_s=20)
        process.kill()
        assert until(lambda: not master.alive())
    finally:
        process.kill()
        process.wait()
        master.close()


@pytest.mark.parametrize(
    "endpoint", ["udp/127.0.0.1:1", "127.0.0.1:47802", "tcp/nonsense", "tcp/127.0.0.1:99999999"]
)
def test_a_wrong_endpoint_is_an_error_that_names_it(endpoint: str) -> None:
    with pytest.raises(BusError, match=endpoint):
        ZenohBus(endpoint, None)


def test_a_bus_that_leaves_the_machine_as_plain_text_is_wished_for_and_said(
    caplog: pytest.LogCaptureFixture,
) -> None:
    here = free_endpoint()
    everywhere = here.replace("127.0.0.1", "0.0.0.0")
    with pytest.raises(BusError, match="--open"):
        ZenohBus(everywhere, None)
    master, slave = ZenohBus(everywhere, None, access_of({}, "master", open_bus=True)), ZenohBus(None, here)
    try:
        assert f"OPEN BUS: {everywhere}" in caplog.text
        assert master.open
        assert not slave.open
        assert until(lambda: slave.peers == 1)
    finally:
        slave.close()
        master.close()


def test_a_taken_address_is_an_error() -> None:
    endpoint = free_endpoint()
    first = ZenohBus(endpoint, None)
    try:
        with pytest.raises(BusError, match="taken"):
            ZenohBus(endpoint, None)
    finally:
        first.close()


def test_a_handler_that_fails_is_reported_and_goes_on_serving() -> None:
    endpoint = free_endpoint()
    master = ZenohBus(endpoint, None)
    slave = ZenohBus(None, endpoint)
    calls: list[str] = []

    def handler(command: Command) -> Health:
        calls.append(command.verb)
        if len(calls) == 1:
            raise KeyError("a fault of ours")
        return health("left")

    slave.serve("left", handler)
    try:
        with pytest.raises(BusError, match="internal fault: KeyError"):
            master.ask(Command("left", "report"), timeout_s=5)
        assert master.ask(Command("left", "report"), timeout_s=5).source == "left"
    finally:
        slave.close()
        master.close()


def test_a_target_that_never_answers_is_a_timeout_that_names_the_living() -> None:
    endpoint = free_endpoint()
    master = ZenohBus(endpoint, None)
    slave = ZenohBus(None, endpoint)
    slave.announce("left")

    ended = threading.Event()

    def sleepy(command: Command) -> Health:
        ended.wait(20.0)
        return health(command.target)

    slave.serve("left", sleepy)
    assert until(lambda: "left" in master.alive())
    try:
        with pytest.raises(BusError, match="alive: left"):
            master.ask(Command("left", "report"), timeout_s=0.3)
    finally:
        ended.set()
        slave.close()
        master.close()


LEFT_OPEN = """
import sys
from common.bus.zenoh_bus import ZenohBus
from tests.network_helpers import free_endpoint, health
bus = ZenohBus(free_endpoint(), None)
bus.subscribe("health")
bus.serve("left", lambda command: health("left"))
sys.exit(3)
"""


def test_a_program_that_ends_without_closing_is_not_aborted() -> None:
    root = Path(__file__).parents[3]
    done = subprocess.run(
        [sys.executable, "-c", LEFT_OPEN], cwd=root, capture_output=True, timeout=30, check=False
    )
    assert (done.returncode, done.stderr) == (3, b"")


def test_a_client_reaches_beyond_the_master_and_still_does_after_its_restart() -> None:
    endpoint = free_endpoint()
    with pytest.raises(BusError, match="Is the master running") as refused:
        ZenohBus(None, endpoint, beyond=True)
    assert ".rs" not in str(refused.value)  # no lines of zenoh's source
    master, slave = ZenohBus(endpoint, None), ZenohBus(None, endpoint)
    viewer, unknown_peer = ZenohBus(None, endpoint, beyond=True), ZenohBus(None, endpoint)
    try:
        slave.announce("left")
        slave.serve("left", lambda command: health("left", 7))
        seen, unseen = viewer.subscribe("health"), unknown_peer.subscribe("health")
        for _ in range(2):
            assert viewer.ask(Command("left", "report"), 10.0).counts == {"frames": 7}
            assert until(lambda: "left" in viewer.alive())

            def arrives() -> bool:
                slave.publish("health", "left", health("left"))
                return seen.get(0.1) is not None

            assert until(arrives, 10.0)
            master.close()
            master = ZenohBus(endpoint, None)
        assert unseen.get(0.1) is None  # a peer sees only the one it is connected to
        assert "left" not in unknown_peer.alive()
    finally:
        for bus in (viewer, unknown_peer, slave, master):
            bus.close()
