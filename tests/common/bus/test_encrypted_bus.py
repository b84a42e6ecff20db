"""The encrypted bus: who is let in, who may say what, and that whoever is not let in is told why."""

import logging
import shutil
from collections.abc import Callable, Generator
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from common.bus.bus import Subscription
from common.bus.keys import MASTER, OPERATOR, Access
from common.bus.zenoh_bus import ZenohBus
from common.errors import BusError
from common.messages import Command, Gesture, Health
from master.commands.keys import make
from tests.network_helpers import free_endpoint, health, until

NOW = datetime(2026, 1, 1, tzinfo=UTC)
REPORT = Command("left", "report")


def tls_endpoint() -> str:
    """A free endpoint with certificates on both sides."""
    return free_endpoint().replace("tcp/", "tls/")


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The keys folder of a rig of two cameras."""
    folder = tmp_path_factory.mktemp("keys") / "rig"
    make(folder, ["left", "right"], NOW)
    return folder


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys of another rig, whose cameras have the same names."""
    folder = tmp_path_factory.mktemp("foreign") / "rig"
    make(folder, ["left"], NOW)
    return folder


def access(role: str, folder: Path) -> Access:
    """Access without anything in the environment."""
    return Access(role, folder, open=False, environment={})


def gesture() -> Gesture:
    """Something that only a master says."""
    nowhere = np.full(3, np.nan)
    return Gesture("hand", 1, "tap", "star", "end", 1, 1.0, np.nan, np.nan, np.nan, nowhere, nowhere)


class Rig:
    """A master, a camera `left` that answers, a camera `right` whose own side obeys no rule, and a viewer."""

    def __init__(self, keys: Path) -> None:
        self._stack = ExitStack()
        self.keys, self.endpoint = keys, tls_endpoint()
        self.master = self.opened(lambda: ZenohBus(self.endpoint, None, access(MASTER, keys)))
        self.left, self.right = (self.opened(lambda n=n: self.device(n)) for n in ("left", "right"))
        self.viewer = self.opened(self.view)
        self.left.announce("left")
        self.left.serve("left", lambda command: health("left", 7))
        self.master.serve(MASTER, lambda command: health(MASTER, 1))

    def opened(self, make_bus: Callable[[], ZenohBus]) -> ZenohBus:
        """A bus that closes with the rig."""
        bus = make_bus()
        self._stack.callback(bus.close)
        return bus

    def device(self, name: str) -> ZenohBus:
        """A camera's connection."""
        return ZenohBus(None, self.endpoint, access(name, self.keys))

    def view(self) -> ZenohBus:
        """A viewer's connection."""
        return ZenohBus(None, self.endpoint, access(OPERATOR, self.keys), beyond=True)

    def close(self) -> None:
        """All of them go."""
        self._stack.close()


def arrives(bus: ZenohBus, inbox: Subscription, name: str) -> bool:
    """Publish the health of `name`; whether anything comes."""
    bus.publish("health", name, health(name))
    return inbox.get(0.05) is not None


def all_received(inbox: Subscription) -> set[str]:
    """Of whom else there was something, until nothing comes any more."""
    names: set[str] = set()
    while isinstance(message := inbox.get(0.2), Health):
        names.add(message.source)
    return names


@pytest.fixture
def rig(keys: Path) -> Generator[Rig, None, None]:
    """A rig that runs."""
    rig = Rig(keys)
    yield rig
    rig.close()


def test_commands_of_master_and_viewer_reach_a_camera_also_after_the_master_restarted(rig: Rig) -> None:
    for _ in range(2):
        assert rig.master.ask(REPORT, 5.0).counts == {"frames": 7}
        assert until(lambda: "left" in rig.viewer.alive())
        assert rig.viewer.ask(REPORT, 5.0).counts == {"frames": 7}
        received = rig.viewer.subscribe("health", "left")

        assert until(lambda inbox=received: arrives(rig.left, inbox, "left"))
        received.close()
        rig.master.close()
        rig.master = rig.opened(lambda: ZenohBus(rig.endpoint, None, access(MASTER, rig.keys)))
        assert until(lambda: "left" in rig.master.alive())


def test_a_camera_commands_nobody_and_hears_nobody(rig: Rig) -> None:
    assert rig.master.ask(REPORT, 5.0).counts == {"frames": 7}
    secret = rig.right.subscribe("health")
    open_one = rig.viewer.subscribe("health")
    for target in ("left", MASTER):
        with pytest.raises(BusError, match="no answer"):
            rig.right.ask(Command(target, "report"), 0.3)
    assert until(lambda: arrives(rig.left, open_one, "left"))
    assert until(lambda: arrives(rig.master, open_one, MASTER))
    assert not all_received(secret)


def test_a_camera_speaks_for_itself_alone(rig: Rig) -> None:
    received = rig.master.subscribe("health")
    rig.right.announce("right")
    rig.right.announce("master")
    rig.right.serve("outputs", lambda command: health("outputs", 666))
    assert until(lambda: arrives(rig.right, received, "right"))
    for name in ("left", MASTER, "right"):
        rig.right.publish("health", name, health(name))
    assert all_received(received) == {"right"}
    assert rig.master.alive() == {"left", "right"}
    for asker in (rig.master, rig.viewer):
        with pytest.raises(BusError, match="no answer"):
            asker.ask(Command("outputs", "report"), 0.3)


def test_a_camera_publishes_no_poses_and_nothing_in_the_name_of_another(rig: Rig) -> None:
    """Also not inside a message that travels under its own name, nor under a name that stands for several."""
    subscriptions = {
        stream: rig.viewer.subscribe(stream) for stream in ("health", "hand", "gesture", "taken")
    }
    assert until(lambda: arrives(rig.right, subscriptions["health"], "right"))
    for name in ("right", "*", "r$*"):
        rig.right.publish("gesture", name, gesture())
        rig.right.publish("taken", name, gesture())
        rig.right.publish("health", name, health("left"))
    rig.right.serve("right", lambda command: health("left", 666))
    assert until(lambda: arrives(rig.right, subscriptions["health"], "right"))
    assert all_received(subscriptions["health"]) <= {"right"}
    assert all(subscriptions[stream].get(0.0) is None for stream in ("hand", "gesture", "taken"))
    with pytest.raises(BusError, match="not its health report"):
        rig.master.ask(Command("right", "report"), 5.0)


def test_a_viewer_is_a_program_of_its_own_but_publishes_no_poses_and_speaks_for_no_camera(rig: Rig) -> None:
    rig.viewer.announce("outputs")
    rig.viewer.serve("outputs", lambda command: health("outputs", 5))
    assert rig.master.ask(Command("outputs", "report"), 5.0).counts == {"frames": 5}
    assert until(lambda: "outputs" in rig.master.alive())
    rig.viewer.serve("right", lambda command: health("right", 666))
    with pytest.raises(BusError, match="no answer"):
        rig.master.ask(Command("right", "report"), 0.3)
    received, gestures = rig.master.subscribe("health"), rig.master.subscribe("gesture")
    assert until(lambda: arrives(rig.viewer, received, "outputs"))
    rig.viewer.publish("gesture", "hand", gesture())
    for name in ("left", MASTER, "outputs"):
        rig.viewer.publish("health", name, health(name))
    rig.viewer.publish("health", "*", health("left"))
    assert all_received(received) == {"outputs"}
    assert gestures.get(0.0) is None


def test_a_device_is_heard_once_the_master_knows_its_name(tmp_path: Path) -> None:
    folder, there, endpoint = tmp_path / "keys", tmp_path / "device", tls_endpoint()
    make(folder, [], NOW)
    report = Command("late", "report")
    with ExitStack() as stack:
        master = ZenohBus(endpoint, None, access(MASTER, folder))
        make(folder, ["late"], NOW)
        there.mkdir(mode=0o700)  # as on a device
        (folder / "devices" / "late.pem").rename(there / "device-late.pem")
        (folder / "devices" / "late.key").rename(there / "device-late.key")
        shutil.copy(folder / "ca.pem", there)
        late = ZenohBus(None, endpoint, access("late", there))
        stack.callback(late.close)
        late.serve("late", lambda command: health("late", 3))
        assert until(lambda: late.peers == 1)
        with pytest.raises(BusError, match="no answer"):
            master.ask(report, 0.3)
        master.close()
        subscriptions = ZenohBus(endpoint, None, access(MASTER, folder), devices=["late"])
        stack.callback(subscriptions.close)
        assert subscriptions.ask(report, 5.0).counts == {"frames": 3}


def test_without_a_certificate_of_the_rig_nobody_comes_in_and_hears_why(
    rig: Rig, foreign: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(BusError, match="no certificate of this rig's master"):
        ZenohBus(None, rig.endpoint, access(OPERATOR, foreign), beyond=True)
    monkeypatch.delenv("PHALANX_KEYS", raising=False)
    with pytest.raises(BusError, match="no keys: give --keys"):
        ZenohBus(None, rig.endpoint)
    monkeypatch.setenv("PHALANX_KEYS", str(rig.keys))
    assert until(lambda: "left" in rig.opened(lambda: ZenohBus(None, rig.endpoint, beyond=True)).alive())
    plain = rig.endpoint.replace("tls/", "tcp/")
    with pytest.raises(BusError, match="cannot open the bus"):
        ZenohBus(None, plain, beyond=True)
    with caplog.at_level(logging.WARNING):
        unknown_peer = rig.opened(lambda: ZenohBus(None, rig.endpoint, access("left", foreign)))
        assert until(lambda: "another rig's" in caplog.text)
    assert unknown_peer.peers == 0
    with pytest.raises(BusError, match="no certificate of this rig's master"):
        unknown_peer.ask(Command(MASTER, "report"), 0.1)


def test_a_certificate_of_the_rig_that_its_authority_did_not_sign_is_refused_by_the_master(
    rig: Rig, foreign: Path, tmp_path: Path
) -> None:
    """Whoever knows the rig's ca.pem, which is no secret, and signs himself."""
    forged = tmp_path / "forged"
    forged.mkdir(mode=0o700)
    for name in ("operator.pem", "operator.key"):
        (forged / name).write_bytes((foreign / name).read_bytes())
    (forged / "operator.key").chmod(0o600)
    (forged / "ca.pem").write_bytes((rig.keys / "ca.pem").read_bytes())
    with pytest.raises(BusError, match="refused the certificate of 'operator'"):
        ZenohBus(None, rig.endpoint, access(OPERATOR, forged), beyond=True)


@pytest.mark.parametrize("role", ["left", OPERATOR])
def test_nobody_but_the_master_may_listen(keys: Path, role: str) -> None:
    endpoint = tls_endpoint()
    thief = ZenohBus(endpoint, None, access(role, keys))
    try:
        with pytest.raises(BusError, match="no certificate of this rig's master"):
            ZenohBus(None, endpoint, access(OPERATOR, keys), beyond=True)
    finally:
        thief.close()
