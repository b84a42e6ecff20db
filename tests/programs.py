"""Programs of the system that tests run besides Python: a test that lacks one says which, and is skipped."""

import shutil

import pytest

# The Debian packages of those whose names are others.
_PACKAGES = {
    "cc": "gcc libc6-dev",
    "depmod": "kmod",
    "ip": "iproute2",
    "mke2fs": "e2fsprogs",
    "qemu-system-aarch64": "qemu-system-arm",
    "qemu-system-x86_64": "qemu-system-x86",
    "ssh": "openssh-client",
    "ssh-keygen": "openssh-client",
    "systemd-analyze": "systemd",
    "systemd-nspawn": "systemd-container",
    "systemd-sysusers": "systemd",
}


def missing(*programs: str) -> str | None:
    """Which of these programs are not on the PATH, and what installs them; None: all are there."""
    absent = [program for program in programs if shutil.which(program) is None]
    if not absent:
        return None
    packages = sorted({_PACKAGES.get(program, program) for program in absent})
    return f"missing here: {', '.join(absent)} (Debian: apt install {' '.join(packages)})"


def needs(*programs: str) -> None:
    """Skip the test, or all that use the fixture, where one of these programs is not on the PATH."""
    __tracebackhide__ = True  # what is listed as skipped is the test, not this line
    if (reason := missing(*programs)) is not None:
        pytest.skip(reason)
