"""The slave's programs on real aarch64 binaries, emulated: they import, and give the same bytes as on this machine.

Times under emulation mean nothing and are never asserted; results are. tests/aarch64/test_instructions.py counts there.
"""

import hashlib
import json
import platform
import subprocess
import sys
from typing import Any

import pytest

from tests.aarch64 import given
from tests.aarch64.machine import ROOT, guest_or_skip
from tests.aarch64.report import opened

Report = dict[str, Any]
# What a slave may lack: the fast engine; and what recordings of messages need, which a master makes.
OPTIONAL = {"numba", "mcap", "zstandard"}


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Report, Report, bytes]:
    """What the emulated machine and this one tell of the same frames, and what the sealed datagrams say."""
    guest = guest_or_skip()
    folder = tmp_path_factory.mktemp("given")
    bodies = given.write(folder)
    program = ["-m", "tests.aarch64.report", str(folder)]
    with guest.start(program) as there:
        here = subprocess.run(
            [sys.executable, *program], capture_output=True, text=True, cwd=ROOT, check=True
        )
        output, errors = there.communicate(timeout=600)
    assert there.returncode == 0, errors
    return json.loads(output), json.loads(here.stdout), bodies


def test_it_is_the_other_architecture(both: tuple[Report, Report, bytes]) -> None:
    there, here, _ = both
    assert (there["machine"], here["machine"]) == ("aarch64", platform.machine())


def test_everything_a_slave_needs_imports(both: tuple[Report, Report, bytes]) -> None:
    absent: dict[str, str] = both[0]["absent"]
    assert set(absent.values()) <= OPTIONAL, absent
    assert not [name for name in absent if name.startswith("slave.") and "fast" not in name], absent


@pytest.mark.parametrize(
    ("what", "seen", "least"), [("markers", "markers_seen", 40), ("cycles", "laser_seen", 6)]
)
def test_detections_are_equal_bit_by_bit(
    both: tuple[Report, Report, bytes], what: str, seen: str, least: int
) -> None:
    if sys.version_info[:2] != (3, 11):
        pytest.skip("Python 3.12 and later add floats otherwise than the emulated 3.11")
    there, here, _ = both
    assert there[seen] == here[seen] >= least
    assert there[what] == here[what]


def test_messages_are_the_same_bytes_encoded_and_sealed(both: tuple[Report, Report, bytes]) -> None:
    there, here, _ = both
    assert there["sealed"] == here["sealed"]
    assert len(there["sealed"]) > 10


def test_each_architecture_opens_what_the_other_sealed(both: tuple[Report, Report, bytes]) -> None:
    there, _, bodies = both
    assert there["opened"] == hashlib.sha256(bodies).hexdigest()
    assert opened([bytes.fromhex(one) for one in there["sealed"]])
