"""Checks of the service itself, as systemd reports it.

Does it run, how often was it restarted, what did it print last.
"""

from dataclasses import dataclass

from slave.doctor.finding import Finding, fail, ok, unseen, warn
from slave.doctor.system import System, pairs

ASKED = ("LoadState", "ActiveState", "SubState", "UnitFileState", "NRestarts", "ExecMainStatus", "StatusText")
# Ends before the program begins (systemd.exec(5)): what is wrong, and what mends it.
BEFORE = {
    "203": ("its program cannot be run", "phalanx-slave install, or phalanx fleet deploy"),
    "216": ("a group of the unit is missing", "sudo systemd-sysusers"),
    "243": ("a key of /etc/phalanx/keys is missing", "phalanx fleet deploy brings the keys"),
}


@dataclass(frozen=True, slots=True)
class Unit:
    """How a service is.

    Attributes:
        finding: For people.
        runs: Whether it has its device.
    """

    finding: Finding
    runs: bool


def check_unit(system: System, name: str) -> Unit:
    """The service of the slave `name`."""
    unit, check = f"phalanx-slave@{name}.service", "service"
    asked = system.run(("systemctl", "show", unit, *(f"--property={one}" for one in ASKED)), 10.0)
    if asked.code != 0:
        return Unit(unseen(check, f"{unit}: systemd does not answer here"), False)
    stated = pairs(asked.out)
    if stated.get("LoadState") != "loaded":
        install = "phalanx-slave install --master HOST, or phalanx fleet deploy from the PC"
        return Unit(warn(check, f"{unit}: not installed", install), False)
    state, status = stated.get("ActiveState", ""), stated.get("ExecMainStatus", "")
    restarts, words = stated.get("NRestarts", "0"), stated.get("StatusText", "")
    log = f"journalctl -u {unit} -n 50"
    if state == "active":
        if restarts != "0":
            return Unit(warn(check, f"{words}; restarted {restarts} times since it was started", log), True)
        if stated.get("UnitFileState") != "enabled":
            return Unit(warn(check, f"{words}; not started at boot", f"sudo systemctl enable {unit}"), True)
        return Unit(ok(check, words or "active"), True)
    if state == "inactive":
        return Unit(fail(check, f"{unit}: stopped", f"sudo systemctl start {unit}"), False)
    why, fix = BEFORE.get(status, (words or f"it ended with {status}", log))
    runs = state == "activating" and stated.get("SubState") == "start"
    return Unit(fail(check, f"{state}, {restarts} restarts: {why}", fix), runs)
