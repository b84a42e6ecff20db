"""A real `systemd --user` for a test: in a mount namespace of its own, with folders and a control group of its own."""

import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

MANAGER = Path("/lib/systemd/systemd")
_START_S = 30.0
# It runs only where a system was booted with systemd, which a container is not: /run is hidden and says so.
_ALONE = """
mount -t tmpfs none /run && mkdir -p /run/systemd/system
umount -R /sys/fs/cgroup 2>/dev/null
mount -t cgroup2 none /sys/fs/cgroup || exit 1
mkdir -p "/sys/fs/cgroup/$0" && echo $$ > "/sys/fs/cgroup/$0/cgroup.procs" || exit 1
exec {manager} --user --log-target=null
"""
# Last: its processes, however they are, and its control groups.
_CLEAR = """
mount -t cgroup2 none /sys/fs/cgroup || exit 0
echo 1 > "/sys/fs/cgroup/$0/cgroup.kill"; sleep 0.3
find "/sys/fs/cgroup/$0" -depth -type d -exec rmdir {} \\;
"""


def why_not() -> str | None:
    """What keeps this machine from it; None: nothing."""
    if os.geteuid() != 0:
        return "needs root: a service manager is started in a namespace of its own"
    if not MANAGER.exists() or shutil.which("unshare") is None or shutil.which("systemctl") is None:
        return "systemd or unshare is missing: apt install systemd util-linux"
    return None


def _unshared(script: str, group: str) -> list[str]:
    return ["unshare", "--mount", "--propagation", "private", "sh", "-c", script, group]


@contextmanager
def user_manager(more: Mapping[str, str]) -> Generator[dict[str, str] | str, None, None]:
    """The environment in which `systemctl --user` reaches it; or why none can be started here.

    Args:
        more: Variables of the services that it starts.
    """
    folder = Path(tempfile.mkdtemp(prefix="phx"))  # short: the path of a socket has 107 characters at most
    group = folder.name
    environment = os.environ | {"HOME": str(folder), "XDG_RUNTIME_DIR": str(folder / "run")}
    for name in (
        "XDG_CONFIG_HOME",
        "NOTIFY_SOCKET",
        "DBUS_SESSION_BUS_ADDRESS",
        "PHALANX_KEYS",
        "PHALANX_RIG_KEY",
    ):
        environment.pop(name, None)
    (folder / "run").mkdir(mode=0o700)
    log = folder / "log"
    with log.open("wb") as out:
        manager = subprocess.Popen(
            _unshared(_ALONE.format(manager=MANAGER), group),
            env=environment | dict(more),
            stdout=out,
            stderr=out,
            start_new_session=True,
        )
    try:
        deadline = time.monotonic() + _START_S
        while manager.poll() is None and time.monotonic() < deadline:
            if (folder / "run/systemd/private").exists():
                yield environment
                return
            time.sleep(0.05)
        yield f"no service manager of a user can be started here: {log.read_text(errors='replace')[-500:]}"
    finally:
        with suppress(ProcessLookupError):
            manager.send_signal(signal.SIGRTMIN + 24)  # systemd(1): exit now
        with suppress(subprocess.TimeoutExpired):
            manager.wait(10.0)
        subprocess.run(_unshared(_CLEAR, group), check=False, capture_output=True)
        manager.wait(10.0)
        shutil.rmtree(folder, ignore_errors=True)
