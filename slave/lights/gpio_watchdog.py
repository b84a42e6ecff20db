"""Darken two GPIO lines, as a process of its own, when their slave cannot.

    python gpio_watchdog.py FD LONGEST_S        standard input: a pipe; the slave writes `1` before a light goes on
                                            and `0` after it went off

It inherits the slave's request of the lines: while it lives the kernel does not give them back. It sets both lines
inactive where a light is on for `LONGEST_S` (the slave was stopped, or something in it holds up all its threads), and
when the pipe ends, because the slave closed it or has died of whatever; then it ends, too. It imports nothing that
could hold it up, and no signal of a terminal, a service's stop or its watchdog ends it earlier: the slave ends first.
"""

import fcntl
import os
import select
import signal
import struct
import sys

LIT, DARK = b"1", b"0"
SET_VALUES = 0xC010B40F  # GPIO_V2_LINE_SET_VALUES_IOCTL of linux/gpio.h: _IOWR(0xB4, 0x0F, two 64-bit words)


def main() -> int:
    """Watch until standard input ends; 0: the lines are dark, 1: they are gone."""
    for number in (signal.SIGABRT, signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    lines, longest_s = int(sys.argv[1]), float(sys.argv[2])
    state = DARK
    while state:
        received, _, _ = select.select([0], [], [], longest_s if state.endswith(LIT) else None)
        if received:
            state = os.read(0, 4096)
        else:  # again and again until it reports that it is dark: it may light late, when it goes on
            darken(lines)
    return darken(lines)


def darken(lines: int) -> int:
    """Set both lines of a request inactive; 1: it cannot be done."""
    try:
        both = 0b11  # lines of the request, in its order
        inactive = 0
        fcntl.ioctl(lines, SET_VALUES, struct.pack("=QQ", inactive, both))  # bits, mask
    except OSError:
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
