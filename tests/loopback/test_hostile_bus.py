"""What a device says of itself on the bus, and what it asks there: nobody's terminal, report or master suffers."""

import subprocess
import sys
import time
from collections.abc import Generator, Mapping

import msgspec
import pytest
import zenoh

from bench.rigs.hostile import ROOT, HostileRig
from bench.rigs.hostile_sender import raw_bus
from common.messages import Command, Health, encode
from tests.hostile_rigs import Rigs, counts, unharmed
from tests.network_helpers import PATIENCE_S

FLOOD_S = 4.0
OWNED = "pi\x1b]0;owned\x07\u202e"


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Generator[HostileRig]:
    made = Rigs(tmp_path_factory.mktemp("hostile"))
    yield made.well()
    made.close()


def report(session: zenoh.Session, name: str, changes: Mapping[str, object]) -> None:
    """Publish a report of a device with these fields, whatever the types say."""
    whole = encode(Health(name, 1, time.monotonic_ns(), {"frames": 1}, {"rate_hz": 30.0}))
    fields = msgspec.msgpack.decode(whole) | changes
    session.put(f"phalanx/health/{name}", msgspec.msgpack.encode(fields))


def test_what_a_device_says_of_itself_reaches_no_terminal(rig: HostileRig) -> None:
    shown: list[bytes] = []
    commands = (
        ("-m", "master", "check"),
        ("-m", "master", "fleet", "status", "--seconds", "1", "--json"),
        ("-m", "master", "fleet", "status"),
    )
    with unharmed(rig), raw_bus(rig.endpoint) as session:
        running = [
            subprocess.Popen(
                [sys.executable, *command, "--bus", rig.endpoint],
                cwd=ROOT, env=rig.environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            )
            for command in commands
        ]  # fmt: skip
        while any(one.poll() is None for one in running):
            for changes in (
                {"host": OWNED, "version": OWNED},
                {"metrics": {"temperature_c": 1e300}},
                {"metrics": {OWNED: 1.0}},
                {"counts": {"frames": 2**64 - 1}},
                {"version": "9" * 64},
            ):
                report(session, "cam02", changes)
            time.sleep(0.05)
        shown += [one.communicate(timeout=PATIENCE_S)[0] for one in running]
    assert any(b"cam02" in text for text in shown), shown
    for text in (*shown, rig.log.read_bytes()):
        assert b"Traceback" not in text, text
        for sequence in ("\x1b]", "\x07", "\u202e"):
            assert sequence.encode() not in text, text


def test_a_device_that_reports_without_end_keeps_nobody_from_being_heard(rig: HostileRig) -> None:
    body = encode(Health("cam02", 1, 1, {f"n{k}": k for k in range(500)}, {"rate_hz": 30.0}))
    with unharmed(rig) as rise, raw_bus(rig.endpoint) as session:
        ended = time.monotonic() + FLOOD_S
        while time.monotonic() < ended:
            session.put("phalanx/health/cam02", body, congestion_control=zenoh.CongestionControl.BLOCK)
        report(session, "cam00", {"version": "heard"})
        code, output = rig.command("fleet", "status", "--seconds", "1", "--json")
    assert rise["bus.dropped"] > 0, rise
    assert code == 0, output


@pytest.mark.parametrize("verb", ["stop", "report"])
def test_a_command_for_another_that_comes_under_the_masters_key_is_not_obeyed(
    rig: HostileRig, verb: str
) -> None:
    with unharmed(rig), raw_bus(rig.endpoint) as session:
        replies = list(
            session.get("phalanx/command/master", payload=encode(Command("left", verb)), timeout=5.0)
        )
    assert replies
    assert all(reply.ok is None for reply in replies)
    assert all(reply.err is not None and b"left" in reply.err.payload.to_bytes() for reply in replies)


@pytest.mark.parametrize(
    "payload", [b"", b"\xc1", b"\x91" * 10_000, encode(Command("master", "no-such-verb"))]
)
def test_a_command_that_is_none_is_refused(rig: HostileRig, payload: bytes) -> None:
    with unharmed(rig), raw_bus(rig.endpoint) as session:
        replies = list(session.get("phalanx/command/master", payload=payload, timeout=5.0))
    assert all(reply.ok is None for reply in replies)
    assert counts(rig)["poses"] > 0
