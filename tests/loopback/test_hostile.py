"""Whoever has a device's own key says what he likes to a real master: it goes on, and so do all others.

One hand before two honest cameras; a third camera of it, a tracker, and a second hand's wrist device are stolen
(`tests.faults.hostile`). `make hostile` is the same with many times as many messages. Then
what a device reports on the bus, and what it asks there: nobody's terminal, report or master suffers.
"""

import json
import subprocess
import sys
import time
from collections.abc import Generator, Mapping
from pathlib import Path
from shutil import copytree

import msgspec
import pytest
import zenoh

from bench.rigs.rooms import ROOM
from common.link.handshake import EchoAnswer
from common.messages import (
    Command,
    Health,
    MarkerDetections,
    TagDetections,
    encode,
)
from tests.faults.hostile import ROOT, STOLEN, HostileRig, Limits, all_attacked, row
from tests.faults.hostile_sender import raw_bus
from tests.hostile_rigs import (
    LEAST,
    MARKERS,
    MOST,
    SEQUENCE,
    SESSION,
    UNASKED,
    Rigs,
    counts,
    refused,
    stolen,
    unharmed,
)
from tests.network_helpers import PATIENCE_S, until

MESSAGES, PER_S = 8_000, 2500.0
COUNTED_S, FLOOD_S = 3.0, 1.5
OWNED = "pi\x1b]0;owned\x07\u202e"
GENEROUS = Limits(
    lost=0.3, silent_s=20.0
)  # of a machine that has other things to do; the bench holds its own


@pytest.fixture(scope="module")
def rigs(tmp_path_factory: pytest.TempPathFactory) -> Generator[Rigs]:
    made = Rigs(tmp_path_factory.mktemp("hostile"))
    yield made
    made.close()


@pytest.fixture
def rig(rigs: Rigs) -> HostileRig:
    return rigs.well()


def test_thousands_of_hostile_messages_of_every_kind_cost_the_others_nothing(rig: HostileRig) -> None:
    outcomes = all_attacked(rig, tuple(STOLEN), MESSAGES, PER_S, seed=2, calm_s=1.5, limits=GENEROUS)
    shown = "\n".join(row(one) for one in outcomes)
    assert len(outcomes) == len(STOLEN), shown
    assert sum(one.messages for one in outcomes) == MESSAGES, shown
    assert not any(one.broken for one in outcomes), shown


def test_an_echo_that_nobody_asked_for_is_refused_and_ends_nothing(rig: HostileRig) -> None:
    with stolen(rig, "cam02") as sender, unharmed(rig) as rise:
        for t2_ns in (MOST, LEAST, 0):
            before = refused(counts(rig), UNASKED)
            time.sleep(0.3)  # good ones came before
            for t1_ns in (LEAST, LEAST // 2, -1, 0, 1, MOST // 2, MOST):
                sender.send_message(EchoAnswer, t1_ns=t1_ns, t2_ns=t2_ns, t3_ns=MOST)
                sender.send_message(EchoAnswer, t1_ns=t1_ns // 4, t2_ns=t2_ns // 4, t3_ns=t2_ns // 4)
            time.sleep(0.3)
            for _ in range(10):
                sender.send_message(MarkerDetections)
            assert until(lambda least=before + 5: refused(counts(rig), UNASKED) >= least, COUNTED_S), t2_ns
    assert rise["cam02.received"] >= 15, "its clock is still known"


def test_a_slave_whose_rig_has_other_markers_is_refused_by_name_with_the_fix(
    rig: HostileRig, tmp_path: Path
) -> None:
    own = tmp_path / "calib"
    copytree(rig.tree, own)
    path, other = own / f"rigs/{ROOM}.json", json.loads((own / "rigs/desk-back3.json").read_text())
    edited = {name: other[name] for name in ("hand", "markers")}
    path.write_text(json.dumps(json.loads(path.read_text()) | edited))
    place = ["--name", "cam02", "--camera", "synthetic", "--rig", ROOM, "--calibration", str(own)]
    link = ["--bind", "127.0.0.1", "--beacon-port", str(rig.beacon_port)]
    with unharmed(rig) as rise, (tmp_path / "slave.log").open("w") as log:
        slave = subprocess.Popen(
            [sys.executable, "-m", "slave", "run", *place, *link],
            cwd=ROOT, env=rig.environment, stdout=log, stderr=log,
        )  # fmt: skip
        try:
            assert until(lambda: says_which_and_what_to_do(rig.log.read_text()), 20.0), rig.log.read_text()
            _, output = rig.command("check")
        finally:
            slave.kill()
            slave.wait()
    assert refused(rise, MARKERS) > 0, rise
    assert says_which_and_what_to_do(output.decode()), output.decode()


def says_which_and_what_to_do(text: str) -> bool:
    """Whether it names the camera, both numbers of markers and the fix."""
    flat = " ".join(text.split())
    return all(word in flat for word in ("cam02", "8 markers", "6", "phalanx fleet deploy"))


def test_a_session_that_is_not_the_hellos_and_a_leaping_seq_are_refused(rig: HostileRig) -> None:
    with stolen(rig, "cam02") as sender, unharmed(rig) as rise:
        for seq in (1, MOST, 0, MOST, 2, MOST - 1, 3):
            sender.send_message(MarkerDetections, seq=seq)
            sender.send_message(TagDetections, seq=seq)
        for session in (0, 1, MOST, 2):
            sender.send_message(MarkerDetections, session=session, seq=MOST * (session % 2))
    assert refused(rise, SESSION) >= 3, rise
    assert refused(rise, SEQUENCE) >= 3, rise
    for command in (("fleet", "status", "--seconds", "1", "--json"), ("check",)):
        code, output = rig.command(*command)
        assert code in (0, 1), output
        assert b"Traceback" not in output


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


def test_commands_that_are_not_for_the_master_or_none_at_all_are_refused(rig: HostileRig) -> None:
    key, none = "phalanx/command/master", encode(Command("master", "no-such-verb"))
    with unharmed(rig), raw_bus(rig.endpoint) as session:
        for verb in ("stop", "report"):
            replies = list(session.get(key, payload=encode(Command("left", verb)), timeout=5.0))
            assert replies, verb
            assert all(reply.ok is None for reply in replies), verb
            assert all(reply.err is not None and b"left" in reply.err.payload.to_bytes() for reply in replies)
        for payload in (b"", b"\xc1", b"\x91" * 10_000, none):
            assert all(one.ok is None for one in session.get(key, payload=payload, timeout=5.0)), payload[:20]
    assert counts(rig)["poses"] > 0
