"""The subscriber of docs/examples as a program of its own, beside a bus on which a hand is published."""

import ast
import subprocess
import sys
import threading
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from common.bus.keys import access_of
from common.bus.zenoh_bus import ZenohBus
from common.hand.model import JOINTS
from master.commands.keys import make
from tests.master.outputs.network.hands import hand_pose
from tests.network_helpers import free_endpoint

_OWN_KEYS = (
    "#root_ca_certificate_file={K}/ca.pem;connect_certificate_file={K}/operator.pem;"
    "connect_private_key_file={K}/operator.key;enable_mtls=true;verify_name_on_connect=false"
)


def test_the_page_of_keys_says_how(root: Path) -> None:
    page = (root / "docs" / "keys.md").read_text().replace("\\\n", "")
    assert _OWN_KEYS.format(K="$K") in page


@pytest.mark.parametrize("scheme", ["tcp", "tls"])
def test_it_prints_the_tip_of_the_index_finger(root: Path, tmp_path: Path, scheme: str) -> None:
    endpoint, keys = free_endpoint().replace("tcp", scheme), tmp_path / "keys"
    make(keys, [], datetime.now(UTC))
    bus = ZenohBus(endpoint, None, access_of({}, "master", keys))
    if scheme == "tls":  # as docs/keys.md says
        endpoint += _OWN_KEYS.format(K=keys)
    pose = hand_pose("right", t_ns=12_345_000_000)
    program = subprocess.Popen(
        [sys.executable, str(root / "docs" / "examples" / "subscriber.py"), endpoint],
        stdout=subprocess.PIPE,
        text=True,
        cwd=root / "docs",  # from where nothing of ours can be imported
    )
    received = threading.Event()

    def publish() -> None:
        while not received.wait(0.05):
            bus.publish("hand", "my-right", pose)

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        assert program.stdout is not None
        line = program.stdout.readline()
    finally:
        received.set()
        thread.join()
        program.kill()
        program.wait()
        bus.close()
    name, at, unit, x, y, z, _ = line.split()
    assert (name, at, unit) == ("my-right", "12.345", "s:")
    tip = pose.position_m[JOINTS.index("index-finger-tip")]
    np.testing.assert_allclose([float(x), float(y), float(z)], tip, atol=5.1e-5)


def test_it_is_at_most_20_lines_and_needs_nothing_of_ours(root: Path) -> None:
    text = (root / "docs" / "examples" / "subscriber.py").read_text()
    assert len(text.splitlines()) <= 20
    imports = {
        alias.name
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Import)
        for alias in node.names
    }
    assert imports == {"json", "struct", "sys", "msgspec", "zenoh"}
