"""The LSL output: a real outlet read by a real inlet of this machine, and what is said where the library is missing."""

import importlib
import os
import socket
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from msgspec.structs import replace

from common.calibration.output_settings import LslOutput
from common.clock import now_ns
from common.errors import PhalanxError
from common.hand.model import JOINTS
from master.outputs.network.conventions import MasterTimes
from master.outputs.network.lsl import PORTS, LslSink, channels, keep_here, sample_of, sockets
from tests.master.outputs.network.hands import hand_pose


@pytest.fixture(scope="module")
def pylsl() -> ModuleType:
    try:
        return importlib.import_module("pylsl")
    except (ImportError, OSError, RuntimeError) as error:
        pytest.skip(f"no pylsl, or no liblsl for this machine: {error}")


def test_an_inlet_reads_names_units_values_and_the_time_of_the_pose(pylsl: ModuleType) -> None:
    name = f"Test-{now_ns()}"
    sink = LslSink(LslOutput(name=name), MasterTimes())
    pose = hand_pose("right", np.arange(20.0).reshape(5, 4) / 40.0, t_ns=now_ns() - 50_000_000)
    sink.write(pose)  # opens the stream
    _is_kept_to_this_machine()
    (found,) = pylsl.resolve_byprop("name", f"{name}-my-right", timeout=20.0)
    inlet = pylsl.StreamInlet(found)
    inlet.open_stream(timeout=20.0)
    info = inlet.info(20.0)
    assert info.type() == "MoCap"
    assert info.desc().child_value("hand") == "my-right"
    rows = channels()
    for values, part in (
        (info.get_channel_labels(), 0),
        (info.get_channel_types(), 1),
        (info.get_channel_units(), 2),
    ):
        assert values == [row[part] for row in rows]
    valid = pose.valid.copy()
    valid[9] = False
    sink.write(replace(pose, t_ns=pose.t_ns + 7_000_000, valid=valid))
    sample, stamp_s = inlet.pull_sample(timeout=20.0)
    inlet.close_stream()
    sink.close()
    got = dict(zip((row[0] for row in rows), sample, strict=True))
    assert got["thumb.cmc-flexion"] == pytest.approx(1 / 40)
    assert got["little.dip"] == pytest.approx(19 / 40)
    tip = [got[f"index-finger-tip.{axis}"] for axis in "xyz"]
    np.testing.assert_allclose(tip, pose.position_m[JOINTS.index("index-finger-tip")], rtol=1e-6)
    assert np.isnan(got[f"{JOINTS[9]}.x"])
    assert got["wrist.tracked"] == 1.0
    # LSL's clock here is the machine's monotonic one; a receiver on this machine corrects nothing.
    assert stamp_s == pytest.approx(1e-9 * (pose.t_ns + 7_000_000), abs=1e-3)


def sockets_and_groups() -> tuple[set[str], bool]:
    """Addresses at which somebody waits for LSL's queries, and whether an interface has joined its group."""
    rows = [line.split()[1].split(":") for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
    joined = socket.inet_aton("224.0.0.183")[::-1].hex().upper() in Path("/proc/net/igmp").read_text()
    return {address for address, port in rows if int(port, 16) == 16571}, joined


def _is_kept_to_this_machine() -> None:
    """The library itself listens on every network, whatever it is told."""
    devices: list[bytes] = []
    for descriptor, _ in sockets():
        with socket.socket(fileno=os.dup(descriptor)) as one:
            if one.family == socket.AF_INET and one.getsockname()[1] in PORTS:
                assert one.getsockname()[0] == "0.0.0.0"
                devices.append(one.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16))
    assert devices == [b"lo\0"] * 2  # TCP and UDP


def test_a_socket_kept_here_answers_this_machine_and_others_that_were_there_before_are_left() -> None:
    with socket.create_server(("0.0.0.0", 0)) as other:
        before = sockets()
        with socket.create_server(("0.0.0.0", 0)) as one:
            port = int(one.getsockname()[1])
            assert not keep_here(before, range(port + 1, port + 2))
            assert keep_here(before, range(port, port + 1))
            assert one.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16) == b"lo\0"
            socket.create_connection(("127.0.0.1", port), 20.0).close()
        assert not keep_here(before, range(1 << 16))
        assert other.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16) == b""


def test_nobody_on_the_network_is_asked_or_heard(pylsl: ModuleType) -> None:
    del pylsl
    if not Path("/proc/net/igmp").exists():
        pytest.skip("no /proc/net: sockets are not to be seen here")
    before, joined_before = sockets_and_groups()
    sink = LslSink(LslOutput(), MasterTimes())
    sink.write(hand_pose("left"))
    after, joined = sockets_and_groups()
    assert after - before <= {socket.inet_aton("127.0.0.1")[::-1].hex().upper()}
    assert joined is joined_before
    sink.close()
    with pytest.raises(PhalanxError, match=r"lsl\.scope is 'network'.*start `phalanx send` anew"):
        LslSink(LslOutput(scope="network"), MasterTimes())


def test_a_machine_without_the_library_is_shown_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pylsl", None)
    with pytest.raises(PhalanxError, match=r"pip install 'phalanx-hand\[lsl\]'.*PYLSL_LIB"):
        LslSink(LslOutput(), MasterTimes())


def test_a_machine_whose_pylsl_has_no_liblsl_is_shown_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(name: str) -> ModuleType:
        raise RuntimeError(f"{name}: LSL binary library file was not found")  # as pylsl says it

    monkeypatch.setattr(importlib, "import_module", refuse)
    with pytest.raises(PhalanxError, match=r"finds no liblsl.*github\.com/sccn/liblsl.*PYLSL_LIB"):
        LslSink(LslOutput(), MasterTimes())


def test_a_sample_has_a_value_for_every_channel_each_named_once() -> None:
    rows = channels()
    assert len(sample_of(hand_pose("left"))) == len(rows) == len({row[0] for row in rows})
