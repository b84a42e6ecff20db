"""An eyes-free volume dial: grip the air as if round a knob, and turn it.

Run a master (or `phalanx demo --scene gestures --bus tcp/127.0.0.1:47802`), and beside it

    python docs/examples/volume_dial.py --output wpctl

Only the dial grip starts it: a hand that does anything else leaves the volume as it is. It goes in detents, each with a
click whose pitch tells how loud it is now, and a low one at either end, so no screen is needed. What sets the volume is
chosen by name; where that is missing this ends and says so. `--output print` changes nothing and prints the volume.
"""

import argparse
import math
import re
import shutil
import signal
import subprocess
import sys
import threading
from array import array

from common.bus.bus import Bus
from common.bus.zenoh_bus import ZenohBus
from common.errors import PhalanxError
from common.messages import Gesture
from common.messages.streams import MASTER

SINK, OLD, RATE_HZ = "@DEFAULT_AUDIO_SINK@", "@DEFAULT_SINK@", 48000
APLAY = ["aplay", "-q", "-t", "raw", "-f", "S16_LE", "-r", f"{RATE_HZ}"]
PAPLAY = ["paplay", "--raw", "--format=s16le", "--channels=1", f"--rate={RATE_HZ}"]
# name: how to read the volume, how to set it, what plays the click
PROGRAMS = {
    "wpctl": (["wpctl", "get-volume", SINK], ["wpctl", "set-volume", SINK, "{}%"], APLAY),
    "pactl": (["pactl", "get-sink-volume", OLD], ["pactl", "set-sink-volume", OLD, "{}%"], PAPLAY),
    "amixer": (["amixer", "-M", "get", "Master"], ["amixer", "-M", "set", "Master", "{}%"], APLAY),
}
SILENT_NS = 1_000_000_000  # a grip that says nothing for so long has ended unheard


class Dial:
    """Turns gestures into detents; holds whose grip turns it, when that spoke last, and where the last detent was."""

    def __init__(self, detent_deg: float) -> None:
        self._step_rad = math.radians(detent_deg)
        self._grip: tuple[str, int] | None = None
        self._t_ns, self._at_rad = 0, 0.0

    def push(self, gesture: Gesture) -> int:
        """Detents (clockwise > 0) that a message brings. One hand turns it at a time; each grip begins at 0."""
        if gesture.kind != "dial" or math.isnan(gesture.angle_rad):
            return 0
        grip = (gesture.hand, gesture.began_t_ns)
        if grip != self._grip:
            taken = self._grip is not None and gesture.hand != self._grip[0]
            if taken and gesture.t_ns - self._t_ns < SILENT_NS:
                return 0
            self._at_rad = gesture.angle_rad
        # Back over the same edge takes a whole detent: a hand that trembles on an edge does not rattle.
        detents = math.trunc((gesture.angle_rad - self._at_rad) / self._step_rad)
        self._at_rad += detents * self._step_rad
        self._grip, self._t_ns = (None if gesture.phase == "end" else grip), gesture.t_ns
        return detents


class Printed:
    """Changes nothing: prints the volume."""

    percent = 50  # what was written last

    def read(self) -> int:
        """What was written last [%]."""
        return self.percent

    def write(self, percent: int, *, at_end: bool) -> None:
        """One line on standard output, with the bell of the terminal."""
        self.percent = percent
        sys.stdout.write(f"volume {percent} %{', the end' if at_end else ''}\a\n")
        sys.stdout.flush()


class Program:
    """Sets the volume of this machine by a program, and clicks."""

    def __init__(self, name: str) -> None:
        """Raises PhalanxError: a program is not there, or tells no volume."""
        self._get, self._set, self._play = PROGRAMS[name]
        for program in (self._get[0], self._play[0]):
            if shutil.which(program) is None:
                raise PhalanxError(f"{program} is not installed; --output has {', '.join(PROGRAMS)}, print")
        self.read()

    def read(self) -> int:
        """The volume now [%]. Raises PhalanxError: it cannot be read."""
        output = subprocess.run(self._get, stdout=subprocess.PIPE, text=True, check=True).stdout
        if (found := re.search(r"(\d+)%|Volume: (\d+\.\d+)", output)) is None:
            raise PhalanxError(f"{' '.join(self._get)}: tells no volume: {output.strip()}")
        return int(found[1]) if found[1] else round(100 * float(found[2]))

    def write(self, percent: int, *, at_end: bool) -> None:
        """Set it, then click: two octaves from silent to loud, low at an end."""
        command = [word.format(percent) for word in self._set]
        subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
        sound = click(110.0 if at_end else 440.0 * 4.0 ** (percent / 100))
        subprocess.run(self._play, input=sound, capture_output=True, check=False)


def click(hertz: float, seconds: float = 0.03) -> bytes:
    """One short tone that dies away, 16 bit, one channel."""
    count = round(seconds * RATE_HZ)
    tone = (math.sin(math.tau * hertz * i / RATE_HZ) * math.exp(-5.0 * i / count) for i in range(count))
    return array("h", [round(12000 * value) for value in tone]).tobytes()


def run(bus: Bus, dial: Dial, output: Printed | Program, percent: int, stop: threading.Event) -> None:
    """Follow the gestures, `percent` a detent, until `stop`; say what is waited for."""
    feed, text = bus.subscribe("gesture", depth=256), ""
    while not stop.is_set():
        message, detents = feed.get(0.3), 0
        if message is None and (state := "a dial grip" if MASTER in bus.alive() else "a master") != text:
            text = state
            sys.stderr.write(f"waiting for {state} ...\n")
        while isinstance(message, Gesture):  # what came while the volume was set is one turn
            detents += dial.push(message)
            message = feed.get(0.0)
        if detents:
            before = output.read()
            wanted = before + percent * detents
            output.write(min(max(wanted, 0), 100), at_end=not 0 <= wanted <= 100)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--output", choices=(*PROGRAMS, "print"), required=True, help="what sets the volume")
    parser.add_argument("--bus", default="tcp/127.0.0.1:47802", help="tls/ with keys (default: %(default)s)")
    parser.add_argument("--detent-deg", type=float, default=6.0, help="its turn (default: %(default)s)")
    parser.add_argument("--percent", type=int, default=2, help="of each detent (default: %(default)s)")
    options = parser.parse_args()
    stop = threading.Event()
    signal.signal(signal.SIGINT, lambda number, frame: stop.set())
    try:
        output = Printed() if options.output == "print" else Program(options.output)
        run(ZenohBus(None, options.bus), Dial(options.detent_deg), output, options.percent, stop)
    except (PhalanxError, subprocess.CalledProcessError) as error:
        sys.exit(f"volume_dial: {error}")


if __name__ == "__main__":
    main()
