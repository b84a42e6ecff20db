"""Runs our code as on a system that is not Linux: `python tests/elsewhere.py master run ...`; `import`: all modules.

What Windows lacks is missing for our modules alone; what they import sees the real system. So it shows what our code
asks of a system, not that another system has it all.
"""

import ast
import builtins
import importlib
import os
import sys
import sysconfig
import types
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
OURS = ("common", "slave", "master", "deploy")
# The only files that may ask for Linux: the demo's processes, hosts, services; drivers of the kernel's devices; which
# boot a recording is of; who has a camera, and may read its frames; who opens a console without password.
LINUX = (
    "deploy/*",
    "slave/install/*",
    "slave/doctor/*",
    "slave/lights/*",
    "slave/imu/*",
    "slave/cameras/v4l2*",
    "slave/objects/survive.py",
    "slave/recorder.py",
    "slave/shared.py",
    "slave/cameras/picamera2_settings.py",
    "master/console/serving.py",
)
# Of them those that ask when they run, and not when they are imported.
LATE = ("slave/recorder.py", "slave/shared.py", "slave/cameras/picamera2_settings.py")
MODULES = frozenset(
    ("fcntl", "grp", "posix", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty")
)
# Names that Windows has not (the Python library reference, "Availability: Unix" or narrower).
MISSING = {
    "os": "O_CLOEXEC O_DIRECTORY O_NOFOLLOW O_NONBLOCK O_SYNC PRIO_PROCESS SCHED_FIFO SCHED_RR WNOHANG chown "
    "chroot ctermid eventfd fchmod fchown fdatasync fork forkpty getegid geteuid getgid getgroups "
    "getloadavg getpgid getpgrp getpriority getsid getuid killpg lchown lockf memfd_create mkfifo mknod "
    "nice openpty pidfd_open pipe2 posix_fadvise posix_fallocate posix_spawn pread preadv pwrite "
    "register_at_fork sched_getaffinity sched_setaffinity sched_setscheduler sched_yield sendfile setgid "
    "setpgid setpriority setsid setuid statvfs sync sysconf tcgetpgrp ttyname uname wait waitid",
    "signal": "SIGALRM SIGCHLD SIGCONT SIGHUP SIGIO SIGKILL SIGPIPE SIGQUIT SIGRTMIN SIGSTOP SIGTSTP SIGUSR1 "
    "SIGUSR2 SIGWINCH alarm getitimer pause pidfd_send_signal pthread_kill pthread_sigmask setitimer "
    "siginterrupt sigpending sigtimedwait sigwait sigwaitinfo",
    "socket": "AF_NETLINK AF_PACKET AF_UNIX AF_VSOCK IP_PKTINFO MSG_DONTWAIT MSG_NOSIGNAL SCM_RIGHTS SOCK_CLOEXEC "
    "SOCK_NONBLOCK SO_BINDTODEVICE SO_PEERCRED SO_PRIORITY SO_REUSEPORT SO_TIMESTAMP SO_TIMESTAMPNS "
    "recv_fds send_fds",
    "time": "CLOCK_BOOTTIME CLOCK_MONOTONIC CLOCK_REALTIME CLOCK_TAI clock_getres clock_gettime clock_gettime_ns "
    "clock_settime pthread_getcpuclockid tzset",
    "select": "EPOLLIN POLLIN epoll poll",
    "mmap": "MAP_PRIVATE MAP_SHARED PROT_READ PROT_WRITE",
    "errno": "EREMOTEIO",
}
METHODS = frozenset({"recvmsg", "recvmsg_into", "sendmsg"})
OTHER = {"os": {"name": "nt"}, "sys": {"platform": "win32"}}
PLACES = ("/proc", "/sys", "/dev", "/run")


def asks_for_linux(path: str, text: str) -> set[str]:
    """What a file of ours takes from a module, or from a place, that only Linux has."""
    if any(fnmatch(path, one) for one in LINUX):
        return set()
    found: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {one.name for one in node.names if one.name in MODULES}
        elif isinstance(node, ast.ImportFrom):
            missing = MISSING.get(node.module or "", "").split()
            found |= {one.name for one in node.names if node.module in MODULES or one.name in missing}
        elif isinstance(node, ast.Attribute):
            module = node.value.id if isinstance(node.value, ast.Name) else ""
            if node.attr in METHODS or node.attr in MISSING.get(module, "").split():
                found.add(node.attr)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found |= {node.value} if node.value.startswith(tuple(f"{one}/" for one in PLACES)) else set()
    return found


class Lacking(types.ModuleType):
    """A module without what another system lacks."""

    def __init__(self, real: types.ModuleType) -> None:
        super().__init__(real.__name__)
        object.__setattr__(self, "_real", real)

    def __getattribute__(self, name: str) -> Any:
        module: str = object.__getattribute__(self, "__name__")
        if name in MISSING.get(module, "").split():
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        other = OTHER.get(module, {})
        return other[name] if name in other else getattr(object.__getattribute__(self, "_real"), name)


def leave_linux() -> None:
    """Show our modules another system from now on."""
    real_import = builtins.__import__
    lacking = {name: Lacking(importlib.import_module(name)) for name in {*MISSING, *OTHER}}

    def elsewhere(name: str, *rest: Any, **named: Any) -> Any:
        asks = rest[0] if rest else named.get("globals")
        if str((asks or {}).get("__name__")).split(".")[0] in OURS:
            if name.split(".")[0] in MODULES:
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)
            if name in lacking:
                return lacking[name]
        return real_import(name, *rest, **named)

    builtins.__import__ = elsewhere
    sys.addaudithook(refuse_places)


def refuse_places(event: str, arguments: tuple[Any, ...]) -> None:
    """Let no file of the kernel be found by our code; what libraries read is theirs."""
    if event not in ("open", "os.listdir") or not str(arguments[0]).startswith(PLACES):
        return
    frame, library = sys._getframe(1), sysconfig.get_path("stdlib")
    while frame is not None and (
        frame.f_code.co_filename.startswith((library, "<"))
        and "site-packages" not in frame.f_code.co_filename
    ):
        frame = frame.f_back  # pathlib and its like: who asked them?
    asks = "" if frame is None else frame.f_code.co_filename
    if asks.startswith(tuple(f"{ROOT / one}/" for one in OURS)) and str(arguments[0]) != os.devnull:
        raise FileNotFoundError(2, "No such file or directory", str(arguments[0]))


def modules() -> list[str]:
    """Names of all modules that may not ask for Linux."""
    files = (file.relative_to(ROOT) for one in OURS for file in sorted((ROOT / one).rglob("*.py")))
    kept = (file for file in files if str(file) in LATE or not any(fnmatch(str(file), one) for one in LINUX))
    return [
        ".".join(file.with_suffix("").parts)
        for file in kept
        if file.name not in ("__init__.py", "__main__.py")
    ]


def main(words: list[str]) -> int:
    """Run one of the programs, all imports, or a planted text."""
    leave_linux()
    sys.path.insert(0, str(ROOT))
    if words[0] == "plant":
        exec(compile(words[1], str(ROOT / "common/planted.py"), "exec"), {"__name__": "common.planted"})
        return 0
    if words[0] == "import":
        for name in modules():
            importlib.import_module(name)
        print(len(modules()))  # noqa: T201
        return 0
    sys.argv = words
    return int(importlib.import_module(f"{words[0]}.__main__").main())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
