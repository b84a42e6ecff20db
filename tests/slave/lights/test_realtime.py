"""The strobe's process has real-time priority where that is allowed; where not it is counted, and lights go on."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.programs import needs

ROOT = Path(__file__).resolve().parents[3]
LIBRARY = ROOT / "tests/slave/lights/library"
STROBE_CONF = (ROOT / "slave/install/files/strobe.conf").read_text()
ALLOWED = int(re.findall(r"^LimitRTPRIO=(\d+)$", STROBE_CONF, re.MULTILINE)[0])

# A strobe with stamps of frames, and what its thread is. argv: whether real time is forbidden as by RestrictRealtime=,
# by a filter of system calls (seccomp(2)) that refuses sched_setscheduler with any policy but the ordinary ones.
PROGRAM = """
import ctypes, json, os, platform, struct, sys, time
from common.clock import SkewedClock
from slave.lights.strobed import StrobeProcess
from tests.slave.lights.stage import CAMERA, PERIOD_NS, RIG

def restrict_real_time():
    call = {"x86_64": 144, "aarch64": 119}[platform.machine()]
    load, equal, give = 0x20, 0x15, 0x06  # BPF_LD|W|ABS; BPF_JMP|JEQ|K with jumps if so, if not; BPF_RET|K
    lines = [(load, 0, 0, 0), (equal, 0, 5, call), (load, 0, 0, 24)]  # number of the call; its second argument
    lines += [(equal, 3 - k, 0, policy) for k, policy in enumerate((0, 3, 5))]  # OTHER, BATCH, IDLE
    lines += [(give, 0, 0, 0x50001), (give, 0, 0, 0x7FFF0000)]  # EPERM; allowed
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *line) for line in lines))
    program = struct.pack("HxxxxxxP", len(lines), ctypes.addressof(code))
    libc = ctypes.CDLL(None, use_errno=True)
    for arguments in ((38, 1, 0, 0, 0), (22, 2, program, 0, 0)):  # PR_SET_NO_NEW_PRIVS, PR_SET_SECCOMP
        if libc.prctl(*arguments):
            raise OSError(ctypes.get_errno(), "prctl")

if sys.argv[1] == "restricted":
    restrict_real_time()

clock = SkewedClock(0, 0.0)
strobe = StrobeProcess("gpio:0:17,27", RIG, CAMERA, clock)
first_ns, k = clock.now_ns(), 0
while strobe.counts()["lights.pulses"] < 2 and k < 5400:
    stamp_ns = first_ns + round(k * PERIOD_NS)
    time.sleep(max((stamp_ns - clock.now_ns()) * 1e-9, 0.0))
    strobe.push(k, stamp_ns)
    k += 1
tasks = [int(one) for one in os.listdir(f"/proc/{strobe._process.pid}/task")]
policies = sorted({os.sched_getscheduler(one) for one in tasks})
priority = os.sched_getparam(tasks[0]).sched_priority
own = sorted({os.sched_getscheduler(int(one)) for one in os.listdir("/proc/self/task")})
found = {"policies": policies, "priority": priority, "own": own, **strobe.counts()}
strobe.close()
print(json.dumps(found))
"""


def strobe(
    log: Path, limit: int, capability: bool = False, restricted: bool = False
) -> tuple[dict[str, Any], str]:
    """What a process without rights is granted, and what it logs.

    `limit` is RLIMIT_RTPRIO, as LimitRTPRIO= sets it; `capability` keeps CAP_SYS_NICE of all rights of root.
    """
    needs("setpriv", "prlimit")
    root = os.geteuid() == 0
    if capability and not root:
        pytest.skip("CAP_SYS_NICE is of root alone")
    raised = subprocess.run(["prlimit", f"--rtprio={limit}", "true"], capture_output=True, check=False)
    if raised.returncode != 0:
        pytest.skip(f"RLIMIT_RTPRIO cannot be raised to {limit} here: no CAP_SYS_RESOURCE")
    kept = "-all,+sys_nice" if capability else "-all"
    plain = ["setpriv", f"--bounding-set={kept}", "--inh-caps=-all"] if root else []
    command = ["prlimit", f"--rtprio={limit}", *plain, sys.executable, "-c", PROGRAM]
    done = subprocess.run(
        [*command, "restricted" if restricted else "free"],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": f"{LIBRARY}:{ROOT}", "PHALANX_FAKE_GPIO": str(log)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), done.stderr


@pytest.mark.parametrize(("limit", "capability"), [(ALLOWED, False), (0, True)])
def test_its_process_alone_has_it_where_it_is_allowed(tmp_path: Path, limit: int, capability: bool) -> None:
    found, log = strobe(
        tmp_path / "lines", limit, capability, restricted="RestrictRealtime=no" not in STROBE_CONF
    )
    assert (found["policies"], found["priority"]) == ([os.SCHED_FIFO], ALLOWED)
    assert found["own"] == [os.SCHED_OTHER]  # the detector's do not
    assert found["lights.not_realtime"] == 0
    assert found["lights.pulses"] >= 2
    assert log == ""


@pytest.mark.parametrize(
    ("limit", "capability", "restricted"),
    [(0, False, False), (ALLOWED - 1, False, False), (0, True, True), (ALLOWED, False, True)],
)
def test_where_it_is_refused_it_is_counted_and_logged_and_lights_go_on(
    tmp_path: Path, limit: int, capability: bool, restricted: bool
) -> None:
    found, log = strobe(tmp_path / "lines", limit, capability, restricted)
    assert (found["policies"], found["lights.not_realtime"]) == ([os.SCHED_OTHER], 1)
    assert found["lights.pulses"] >= 2
    assert "no real-time priority for the strobe (Operation not permitted)" in log
    assert "strobe.conf" in log
