"""The demo as a benchmark: rate, loss, latency and accuracy over real processes, against an idle relay."""

import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from bench.row import Row
from master.summary import read_summary

_ROOT = Path(__file__).parent.parent
_SECONDS = 30
_ECHO = """
import socket, sys
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); s.bind(("127.0.0.1", 0))
print(s.getsockname()[1], flush=True)
while True:
    data, address = s.recvfrom(2048)
    if data == b"end": break
    s.sendto(data, address)
"""


def rows() -> list[Row]:
    """Thirty seconds of the standard scene with an idle datagram relay beside it."""
    relay: list[float] = []
    stop = threading.Event()
    thread = threading.Thread(target=_relay, args=(stop, relay))
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            "-m",
            "deploy",
            "demo",
            "--headless",
            "--seconds",
            str(_SECONDS),
            "--out",
            folder,
        ]
        thread.start()
        subprocess.run(command, check=True, cwd=_ROOT, stdout=subprocess.DEVNULL)
        stop.set()
        thread.join()
        summary = read_summary(Path(folder) / "summary.json")
    p50, p99 = np.percentile(relay, [50, 99])
    out = [
        Row("idle relay, there and back, median", float(p50), "ms", "baseline, same machine, same time"),
        Row("idle relay, there and back, 99 %", float(p99), "ms", "baseline"),
    ]
    for key, label, unit, goal in _FIGURES:
        if isinstance(value := summary.get(key), int | float):
            out.append(Row(label, float(value), unit, goal))
    return out


_FIGURES = (
    ("poses_per_s", "poses", "/s", "goal 55"),
    ("lost", "datagrams lost", "", "goal 0"),
    ("latency_p50_ms", "latency, median", "ms", "goal: sum of the parts + 1 ms"),
    ("latency_p99_ms", "latency, 99 %", "ms", "goal: 99 % of the relay + 3 ms"),
    ("joint_mm_visible", "joints of visible fingers, mean", "mm", "goal 6"),
    ("pip_deg_visible", "PIP of visible fingers, mean", "deg", "goal 7.5"),
    ("joint_mm", "all joints, mean", "mm", "goal 10"),
    ("marker_raw_mm", "caps, median, before the filter", "mm", ""),
)


def _relay(stop: threading.Event, out: list[float]) -> None:
    """Round trips of a small datagram through another Python process, 60 a second."""
    with subprocess.Popen([sys.executable, "-c", _ECHO], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        address = ("127.0.0.1", int(child.stdout.readline()))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            link.settimeout(1.0)
            while not stop.wait(1 / 60):
                start = time.perf_counter_ns()
                link.sendto(b"x" * 300, address)
                link.recv(2048)
                out.append((time.perf_counter_ns() - start) * 1e-6)
            link.sendto(b"end", address)
