"""Gather facts about the machine before anything is installed on it.

An old Python runs this too, so that its version is reported instead of a syntax error. Writes nothing.
"""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import pwd
import shutil
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

PACKAGES = ("chrony", "python3-picamera2", "rsync")
OLDEST, NEWEST = (3, 11), (3, 14)
MACHINES = ("aarch64", "x86_64")
RELEASES = "opt/phalanx"
_FIND_CAMERAS = (
    "import json,sys; from picamera2 import Picamera2; "
    "print('CAMERAS', json.dumps([c.get('Model', '?') for c in Picamera2.global_camera_info()]))"
)


def probe(root: Path = Path("/"), camera: str = "") -> dict[str, Any]:
    """The facts, as JSON has them, of the machine whose files are below `root`."""
    release = _os_release(root)
    found: dict[str, Any] = {
        "machine": platform.machine(),
        "bits": struct.calcsize("P") * 8,
        "python": list(sys.version_info[:2]),
        "venv": importlib.util.find_spec("venv") is not None,
        "systemd": (root / "run/systemd/system").is_dir(),
        "free_mb": _free_mb(root / RELEASES),
        **_memory(root),
        "model": _text(root / "proc/device-tree/model").strip("\0\n ") or platform.node(),
        "os": release.get("PRETTY_NAME", "unknown"),
        "codename": release.get("VERSION_CODENAME", ""),
        "user": pwd.getpwuid(os.geteuid()).pw_name,
        "root": os.geteuid() == 0 or _output_of(["sudo", "-k", "-n", "true"]) is not None,
        "sudo": shutil.which("sudo") is not None,
        "packages": [name for name in PACKAGES if _has_package(name)],
        "video": sorted({_text(path).strip() for path in (root / "sys/class/video4linux").glob("*/name")}),
        "cameras": _cameras() if camera.startswith("picamera2") else None,
        "releases": sorted(path.name for path in (root / RELEASES / "releases").glob("[!.]*")),
        "boot_id": _text(root / "proc/sys/kernel/random/boot_id").strip(),
    }
    found["t_unix_ns"] = time.time_ns()  # last: the asker compares it with the moment at which it arrives
    return found


def judge(facts: dict[str, Any], camera: str = "", apt: bool = True) -> str | None:
    """Why nothing can be installed there, and what to do; None: it can."""
    python = tuple(facts["python"])
    if facts["bits"] != 64 or facts["machine"] not in MACHINES:
        fix = "write Raspberry Pi OS (64-bit) to its card"
        if facts["machine"] == "armv6l":
            fix = "its processor has none; a Raspberry Pi Zero 2 W, 3, 4 or 5 has"
        return f"{facts['os']} is a {facts['bits']}-bit system on {facts['machine']}: needs a 64-bit system; {fix}"
    if python < OLDEST:
        have = ".".join(map(str, python))
        return f"its Python is {have}, needs 3.11 or newer: Raspberry Pi OS Bookworm or Trixie has that"
    if python > NEWEST:
        return f"its Python is {'.'.join(map(str, python))}, for which not all wheels are there; needs 3.11 to 3.14"
    if not facts["venv"]:
        return "its Python cannot make virtual environments: apt install python3-venv"
    if not facts["systemd"]:
        return "systemd does not run there, which keeps the slave running: without it start `phalanx-slave run` by hand"
    if not facts["root"] and not facts["sudo"]:
        return f"user {facts['user']} is not root, and there is no sudo: log in as root, USER@HOST"
    least_free_mb = 700.0  # wheels, what they unpack to, and the release before it
    if facts["free_mb"] < least_free_mb and not facts["releases"]:
        return f"{facts['free_mb']:.0f} MB free below /opt, needs {least_free_mb:.0f} MB"
    least_memory_mb = 150.0  # a release that is loaded once takes 120 MB, pip 57 MB before
    if (free_mb := facts["available_mb"] + facts["swap_mb"]) < least_memory_mb:
        return (
            f"{free_mb:.0f} MB of memory and swap free, needs {least_memory_mb:.0f} MB: switch swap on, or write "
            "Raspberry Pi OS Lite to its card, which has no desktop"
        )
    if facts["cameras"] == []:
        return "libcamera finds no camera: look at its cable, then at `rpicam-hello --list-cameras`"
    driver, _, device = camera.partition(":")
    if driver == "picamera2" and facts["cameras"] is None and not apt:
        return (
            "--camera picamera2: the system's Python has none: sudo apt install python3-picamera2 there, leave out "
            "--no-apt, or name another camera"
        )
    if driver == "v4l2" and not facts["video"]:
        return f"--camera {camera}: no V4L2 camera is there ({device or '/dev/video0'}); is it plugged in?"
    return None


def _free_mb(folder: Path) -> float:
    while not folder.exists():
        folder = folder.parent
    return shutil.disk_usage(folder).free * 1e-6


def _memory(root: Path) -> dict[str, float]:
    lines = _text(root / "proc/meminfo").splitlines()
    kb = {line.partition(":")[0]: line.split()[1] for line in lines if len(line.split()) > 1}
    names = {"memory_mb": "MemTotal", "available_mb": "MemAvailable", "swap_mb": "SwapFree"}
    return {name: float(kb.get(key, 0)) * 1024e-6 for name, key in names.items()}


def _os_release(root: Path) -> dict[str, str]:
    lines = _text(root / "etc/os-release").splitlines()
    pairs = (line.partition("=") for line in lines if "=" in line)
    return {key: value.strip().strip('"') for key, _, value in pairs}


def _has_package(name: str) -> bool:
    stated = _output_of(["dpkg-query", "-W", "-f=${db:Status-Status}", name])
    return stated is not None and stated.strip() == "installed"


def _cameras() -> list[str] | None:
    """The cameras that libcamera finds; None: picamera2 is not installed."""
    stated = _output_of(["/usr/bin/python3", "-c", _FIND_CAMERAS])
    for line in (stated or "").splitlines():
        if line.startswith("CAMERAS "):
            return [str(model) for model in json.loads(line.removeprefix("CAMERAS "))]
    return None


def _output_of(command: list[str]) -> str | None:
    """Output of a command; None: it does not exist, failed, or takes too long."""
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60.0, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace")
    except OSError:
        return ""
