"""A bad network by the kernel's own netem on the slave's card: loss, jitter, order and doubles, and their end."""

import json
import time

from tests.hosts.board import BoardRig
from tests.hosts.measured import Measured

BAD_S, BACK_S = 20.0, 2.0
BAD = "loss 20% delay 60ms 50ms reorder 10% 50% duplicate 5%"


def card(rig: BoardRig) -> str:
    """Name of the network card."""
    return rig.board.run("ls /sys/class/net | grep -v lo").split()[0]


def netem_counts(rig: BoardRig) -> dict[str, int]:
    """What netem counted."""
    one = json.loads(rig.board.run(f"tc -s -j qdisc show dev {card(rig)} root"))[0]
    return {name: int(one[name]) for name in ("packets", "drops")}


def test_a_bad_network_ends_nothing_and_leaves_nothing(rig: BoardRig, measured: Measured) -> None:
    tap, address = rig.board.tap, rig.board.address
    assert tap.wait(address, time.monotonic(), 120.0) is not None, rig.board.journal()
    before, pid = tap.rate_hz(address, 10.0), rig.board.main_pid()
    rig.board.run("modprobe sch_netem")
    rig.board.run(f"tc qdisc add dev {card(rig)} root netem {BAD}")
    bad = tap.rate_hz(address, BAD_S)
    counted = netem_counts(rig)
    rig.board.run(f"tc qdisc del dev {card(rig)} root", 300.0)
    good = time.monotonic()
    back = tap.wait(address, good, 60.0)
    assert back is not None, rig.board.journal()
    after = tap.rate_hz(address, 10.0)
    measured("datagrams before netem", before, "Hz")
    measured("  ... under 20 % loss, 60 ± 50 ms, reorder, duplicates", bad, "Hz")
    measured("  ... after it", after, "Hz")
    measured(
        "share of packets that netem dropped",
        counted["drops"] / max(counted["packets"] + counted["drops"], 1),
        "",
    )
    assert counted["drops"] > 0
    # The emulated machine has no rate of its own: it has what this one gives it, before and after.
    assert 0.25 * min(before, after) < bad < 1.1 * max(before, after)
    assert after > 0.6 * before
    assert measured.at_most(BACK_S, "back after netem", back - good)
    assert rig.board.main_pid() == pid, f"the slave was started again:\n{rig.board.journal()}"
