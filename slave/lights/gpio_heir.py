"""Darkens two GPIO lines when the slave that lit them has died, of whatever: a process of its own, started beside it.

    python gpio_heir.py FD        standard input: a pipe that the slave holds and never writes to

It inherits the slave's request of the lines. While it lives the kernel does not give them back; when the pipe ends,
because the slave closed it or is gone, it sets both lines inactive and ends. It imports nothing that could hold it up,
and no signal of a terminal or of a service's stop ends it earlier: then the slave ends first, and in order.
"""

import fcntl
import os
import signal
import struct
import sys

SET_VALUES = 0xC010B40F  # GPIO_V2_LINE_SET_VALUES_IOCTL of linux/gpio.h: _IOWR(0xB4, 0x0F, two 64-bit words)
BOTH = 0b11  # lines of the request, in its order
INACTIVE = 0


def main() -> int:
    """Wait for the end of standard input; 0: the lines are dark, 1: they are not there any more."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    lines = int(sys.argv[1])
    while os.read(0, 1):
        pass
    try:
        fcntl.ioctl(lines, SET_VALUES, struct.pack("=QQ", INACTIVE, BOTH))  # bits, mask
    except OSError:
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
