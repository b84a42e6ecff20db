"""QEMU's Raspberry Pi 3B: Debian's kernel, the board's device tree, and a memory disk with Python and the slave.

QEMU has the board's processor, interrupts, mailbox, serial lines and SD card, but no camera, no I2C device and no
network of it. So what can be seen here is that kernel and program run on that board and tell what is missing.
"""

import io
import os
import shutil
import stat
import subprocess
import time
from pathlib import Path

from tests.aarch64.sysroot import PYTHON, Sysroot
from tests.cached import made_once
from tests.hosts.board_image import MIRROR, SUITE, run
from tests.hosts.debian import cache
from tests.hosts.rig import ROOT

BOARD = "raspi3b"
TREE = "bcm2837-rpi-3-b.dtb"
END = "PHALANX-END"
OMIT = {
    "doc",
    "man",
    "locale",
    "info",
    "__pycache__",
    "tests",
    "include",
    "ensurepip",
    "idlelib",
    "pydoc_data",
}
# Runs in the place of an init: the kernel starts it as it starts any script.
INIT = """#!/usr/bin/python{python}
import ctypes, os, subprocess
libc = ctypes.CDLL(None, use_errno=True)
for kind, place in (("proc", "/proc"), ("sysfs", "/sys"), ("devtmpfs", "/dev"), ("tmpfs", "/tmp"), ("tmpfs", "/run")):
    os.makedirs(place, exist_ok=True)
    libc.mount(kind.encode(), place.encode(), kind.encode(), 0, None)
os.environ.update(PATH="/usr/bin:/bin", PYTHONPATH="/wheels:/phalanx", OPENBLAS_NUM_THREADS="1", HOME="/tmp")
console = os.open("/dev/{console}", os.O_WRONLY | os.O_NOCTTY)
def told(name, command):
    done = subprocess.run(command, capture_output=True, text=True)
    os.write(console, f"\\nPHALANX-{{name}} {{done.returncode}}\\n{{done.stdout}}{{done.stderr}}\\n".encode())
told("MODEL", ["/usr/bin/python{python}", "-c", "print(open('/proc/device-tree/model').read())"])
told("MACHINE", ["/usr/bin/python{python}", "-c", "import platform, os; print(platform.machine(), os.cpu_count())"])
told("DOCTOR", ["/usr/bin/python{python}", "-m", "slave", "doctor", "--json", "--name", "left", "--camera", "v4l2"])
os.write(console, b"\\n{end}\\n")
while True:
    libc.pause()
"""


def started(
    made: Sysroot, folder: Path, console: str = "ttyS1", timeout_s: float = 900.0
) -> tuple[str, float]:
    """Start the board, and return what it wrote to its serial line, and after how long its program had ended [s].

    Raises:
        RuntimeError: A tool failed, or the program did not end; with what the board wrote.
    """
    kernel, tree = _kernel()
    memory, log = folder / "initrd", folder / "serial.log"
    _write_memory_disk(made, memory, console)
    # Init's environment: at the first start there is no /dev yet, from which Python would take its random numbers.
    words = f"console={console},115200 rdinit=/init nokaslr loglevel=4 mitigations=off PYTHONHASHSEED=0"
    begin = time.monotonic()
    with subprocess.Popen(
        [
            *("qemu-system-aarch64", "-machine", BOARD, "-accel", "tcg,thread=multi"),
            *("-kernel", str(kernel), "-dtb", str(tree), "-initrd", str(memory), "-append", words),
            *(
                "-serial",
                "null",
                "-serial",
                f"file:{log}",
                "-display",
                "none",
                "-monitor",
                "none",
                "-no-reboot",
            ),
        ],
        stdin=subprocess.DEVNULL,
    ) as board:
        try:
            while END not in (output := log.read_text(errors="replace") if log.exists() else ""):
                if (
                    board.poll() is not None
                    or "Kernel panic" in output
                    or time.monotonic() - begin > timeout_s
                ):
                    raise RuntimeError(f"the board's program did not end:\n{output[-3000:]}")
                time.sleep(0.5)
        finally:
            board.kill()
    return output, time.monotonic() - begin


def _kernel() -> tuple[Path, Path]:
    """Kernel and device tree, loaded once."""
    place = made_once(cache() / f"raspi-{SUITE}", _load_kernel)
    return place / "kernel", place / TREE


def _load_kernel(made: Path) -> None:
    work = made.parent
    archive = work / "kernel.tar"
    modes = ["--mode=chrootless", "--skip=check/chrootless,check/qemu", "--variant=extract"]
    what = ["--arch=arm64", "--include=linux-image-arm64"]
    run("mmdebstrap", "--quiet", *modes, *what, SUITE, str(archive), MIRROR)
    names = ["--wildcards", "./boot/vmlinuz-*", f"./usr/lib/linux-image-*/broadcom/{TREE}"]
    run("tar", "-x", "-f", str(archive), "-C", str(work), *names)
    shutil.move(next(work.glob("boot/vmlinuz-*")), made / "kernel")
    shutil.move(next(work.glob(f"usr/lib/linux-image-*/broadcom/{TREE}")), made / TREE)


def _write_memory_disk(made: Sysroot, file: Path, console: str) -> None:
    init = INIT.format(python=PYTHON, console=console, end=END).encode()
    with file.open("wb") as out:
        _entry(out, "init", stat.S_IFREG | 0o755, init)
        for source, name in ((made.root, ""), (made.wheels, "wheels")):
            _add(out, source, name)
        _entry(out, "phalanx", stat.S_IFDIR | 0o755, b"")
        for package in ("common", "slave"):
            _add(out, ROOT / package, f"phalanx/{package}")
        _entry(out, "TRAILER!!!", 0, b"")


def _add(out: io.BufferedWriter, source: Path, name: str) -> None:
    """Add a folder with all that is in it, without what no program reads."""
    if name:
        _entry(out, name, stat.S_IFDIR | 0o755, b"")
    for path in sorted(source.iterdir()):
        inside = f"{name}/{path.name}" if name else path.name
        if path.is_symlink():
            _entry(out, inside, stat.S_IFLNK | 0o777, os.fsencode(path.readlink()))
        elif path.is_dir():
            if path.name not in OMIT:
                _add(out, path, inside)
        elif path.is_file():
            _entry(out, inside, path.stat().st_mode, path.read_bytes())


def _entry(out: io.BufferedWriter, name: str, mode: int, content: bytes) -> None:
    """One file of a cpio archive, format newc (Documentation/driver-api/early-userspace/buffer-format.rst)."""
    path = name.encode() + b"\0"
    fields = (0, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(path), 0)
    head = b"070701" + b"".join(b"%08X" % field for field in fields) + path
    out.write(head + bytes(-len(head) % 4) + content + bytes(-len(content) % 4))
