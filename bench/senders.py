"""Many slaves in one process, for the benchmark of the master.

Usage: python -m bench.senders COUNT RATE_HZ SECONDS BEACON_PORT KEY
"""

import sys

import numpy as np

from common.clock import SystemClock, Ticker
from common.messages import MarkerDetections
from slave.uplink import Uplink


def main() -> None:
    """Wait for the start, then send from every slave at the rate."""
    count, rate, seconds, port = (int(text) for text in sys.argv[1:5])
    key = bytes.fromhex(sys.argv[5])
    clock = SystemClock()
    uplinks = [Uplink(f"camera{k}", key, clock, port, "127.0.0.1") for k in range(count)]
    for uplink in uplinks:
        if not uplink.wait_for_start(20.0):
            raise SystemExit("no master")
    uv = np.tile(np.array([[320.0, 240.0]]), (6, 1))
    full, sigma, nowhere = np.ones(6), np.full(6, 0.1), np.full((6, 2), np.nan)
    ticker = Ticker(10**9 // rate, clock)
    for seq in range(rate * seconds):
        t_ns = ticker.next()
        for k, uplink in enumerate(uplinks):
            seen = (uv, full, full, sigma, nowhere)
            uplink.send(MarkerDetections(f"camera{k}", uplink.session, seq, t_ns, t_ns, *seen))
    for uplink in uplinks:
        uplink.close()


if __name__ == "__main__":
    main()
