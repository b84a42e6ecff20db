"""Checks of the system's clock.

It matters for cameras in step and for people who read logs. Phalanx itself measures the clocks of its link.

`chronyc -c tracking` is a line of 14 fields (chronyc(1)); the offset is seconds that the system is ahead of NTP.
"""

from collections.abc import Iterator

from slave.doctor.finding import Finding, fail, ok, unseen, warn
from slave.doctor.system import System, pairs

INSTALL = (
    "sudo apt install chrony; the installer adds /etc/chrony/conf.d/phalanx.conf with the master's machine"
)


def check_clock(system: System, master: str | None) -> Iterator[Finding]:
    """What keeps the clock, and how well."""
    asked = system.run(("chronyc", "-c", "-n" if master is None else "-N", "tracking"), 5.0)
    if asked.code is None:
        yield _without_chrony(system)
        return
    fields = asked.out.strip().split(",")
    # fields
    if asked.code != 0 or len(fields) != 14:
        stated = (asked.error or asked.out).strip().splitlines()[-1:] or ["no answer"]
        yield warn("clock", f"chronyd: {stated[0]}", "sudo systemctl enable --now chrony")
        return
    try:
        # offset s
        # rms s
        offset_s, rms_s = float(fields[4]), float(fields[6])
    except ValueError:
        yield warn("clock", f"chronyd reports {asked.out.strip()!r}", "sudo systemctl restart chrony")
        return
    yield _tracking(fields, offset_s, rms_s, master)


def _tracking(fields: list[str], offset_s: float, rms_s: float, master: str | None) -> Finding:
    reference, stratum, leap = 1, 2, 13
    who = fields[reference] or "nobody"
    if fields[leap] == "Not synchronised":
        fix = "is the master's machine on, with `local stratum 8` and `allow` in its chrony.conf? `chronyc sources`"
        return warn("clock", "chrony has found no time yet", fix)
    stated = (
        f"{offset_s * 1e6:+.0f} µs off {who} (stratum {fields[stratum]}), {rms_s * 1e6:.0f} µs in the mean"
    )
    far_s = 1e-3  # libcamera brings cameras in step by the system's clock: its error adds to theirs
    if abs(offset_s) > far_s:
        return warn(
            "clock", stated, "wait some minutes; then `chronyc sources -v`, or `sudo chronyc makestep`"
        )
    if master is not None and who != master:
        return warn(
            "clock", f"{stated}; not by {master}", "see /etc/chrony/conf.d/phalanx.conf, `chronyc sources`"
        )
    return ok("clock", stated)


def _without_chrony(system: System) -> Finding:
    asked = system.run(("timedatectl", "show", "--property=NTP", "--property=NTPSynchronized"), 5.0)
    if asked.code is None or asked.code != 0:
        return unseen("clock", "neither chronyc nor timedatectl answers")
    stated = pairs(asked.out)
    if stated.get("NTPSynchronized") == "yes":
        return warn("clock", "by NTP, but how far off is not known without chrony", INSTALL)
    return fail("clock", "nothing keeps it", INSTALL)
