"""Checks of the libraries of the service, made by its own Python.

Libraries that are installed for another Python do not help the service.
"""

import sys
from collections.abc import Iterator, Sequence

from slave.doctor.finding import Finding, fail, ok, warn
from slave.doctor.system import System, pairs

CURRENT = "/opt/phalanx/current"
TIMEOUT_S = 60.0  # numpy and cv2 from a cold SD card
NEEDED = ("numpy", "cv2", "zenoh", "cryptography", "msgspec")
# One name after another, each printed before the next is tried: one that crashes prints nothing.
PROBE = """
import ctypes, importlib, sys
for name in sys.argv[1:]:
    try:
        if name == "libstdc++":
            ctypes.CDLL("libstdc++.so.6")
            said = "yes"
        else:
            said = "yes " + str(getattr(importlib.import_module(name), "__version__", ""))
    except BaseException as error:
        said = "no " + type(error).__name__ + ": " + str(error)
    print(name, " ".join(said.split()), flush=True)
"""
FIXES = {
    "picamera2": "sudo apt install python3-picamera2 --no-install-recommends; the service's environment must see the "
    "system's packages (python3 -m venv --system-site-packages), and not bring a numpy of another major version",
    "libstdc++": "sudo apt install libstdc++6",
    "numba": "pip install 'phalanx-hand[fast]' into the service's environment, or leave --engine numba away",
    "gpiod": "sudo apt install python3-libgpiod, version 2",
}


def check_programs(system: System, extra: Sequence[str]) -> Iterator[Finding]:
    """Whether the service's Python can import what a slave needs, and `extra`."""
    python = system.path(CURRENT) / "bin/python"
    if python.exists():
        where = f"in {CURRENT}"
    else:
        python, where = sys.executable, "in the doctor's own environment"
        yield warn(
            "installed",
            f"no {CURRENT}: it is asked {where}",
            "phalanx-slave install --master HOST, or phalanx fleet deploy from the PC",
        )
    names = ("libstdc++", *NEEDED, *extra)
    asked = system.run((str(python), "-c", PROBE, *names), TIMEOUT_S)
    stated = pairs(asked.out, " ")
    for name in names:
        fix = FIXES.get(
            name, f"install again: the service's environment {where} lacks it, or has it for another Python"
        )
        if name not in stated:
            end = asked.error.strip().splitlines()[-1:] or [f"it ended with {asked.code}"]
            yield fail(name, f"crashed while it was imported {where}: {end[0]}", fix)
            return
        found, _, text = stated[name].partition(" ")
        yield ok(name, text or "there") if found == "yes" else fail(name, f"{text} ({where})", fix)
