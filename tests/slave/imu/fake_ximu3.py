"""An x-IMU3 at the other end of a pseudo terminal: answers commands, and sends what a test tells it to.

Closing the terminal is the unplugged cable; a new one behind the same link is the cable plugged in again.
"""

import os
import struct
import threading
import time
import tty
from pathlib import Path

import msgspec

from slave.imu.ximu3 import END, ESC, ESC_END, ESC_ESC, Kind, plain


def stuff(message: bytes) -> bytes:
    """A binary data message, without its end, as it is sent."""
    return message.replace(ESC, ESC_ESC).replace(END, ESC_END) + END


FACTORY: dict[str, object] = {
    "binary_mode_enabled": True,
    "usb_data_messages_enabled": True,
    "serial_data_messages_enabled": True,
    "inertial_message_rate_divisor": 8,
    "magnetometer_message_rate_divisor": 1,
    "temperature_message_rate_divisor": 5,
    "battery_message_rate_divisor": 5,
    "ahrs_message_rate_divisor": 8,
    "high_g_accelerometer_message_rate_divisor": 32,
    "gyroscope_offset_correction_enabled": True,
}


class FakeXimu3:
    """Holds the terminal, its settings, and what it was asked."""

    def __init__(self, link: Path, **behaviour: object) -> None:
        """Plug it in at `link`; `behaviour`: mute, refuses (a key), interface, begins_us, streams (in real time)."""
        self._behaviour = behaviour
        self.settings = {plain(key): value for key, value in FACTORY.items()}
        self.asked: list[dict[str, object]] = []
        self.applied = 0
        self.now_us = int(str(behaviour.get("begins_us", 5_000_000)))
        self._near, far = os.openpty()
        tty.setraw(far)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(far))
        self._far: int | None = far  # until somebody has opened it: a terminal nobody holds reports its end
        self._plugged = threading.Event()
        self._plugged.set()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    @property
    def period_us(self) -> int:
        """Time between two inertial messages [us]."""
        return 2500 * int(str(self.settings["inertialmessageratedivisor"]))

    def unplug(self) -> None:
        """Pull the cable."""
        self._plugged.clear()
        self._thread.join()
        for end in (self._near, self._far):
            if end is not None:
                os.close(end)
        self._far = None

    def send(self, kind: Kind, *values: float, text: bytes = b"", t_us: int | None = None) -> None:
        """Send one binary message."""
        head = struct.pack("<BQ", 0x80 + ord(kind.letter), self.now_us if t_us is None else t_us)
        self.write(stuff(head + struct.pack(f"<{len(values)}f", *values) + text))

    def inertial(self, count: int = 1, gyro: tuple[float, ...] = (0.0, 0.0, 0.0)) -> None:
        """Send so many inertial messages, each a period after the last."""
        for _ in range(count):
            self.now_us += self.period_us
            self.send(Kind.INERTIAL, *gyro, 0.0, 0.0, 1.0)

    def write(self, data: bytes) -> None:
        """Send bytes as they are, all of them, or none where there is no room for the first."""
        sent = os.write(self._near, data)
        while sent < len(data) and self._plugged.is_set():
            try:
                sent += os.write(self._near, data[sent:])
            except BlockingIOError:
                time.sleep(0.001)

    def _work(self) -> None:
        rest = b""
        os.set_blocking(self._near, False)
        began_us = self.now_us - time.monotonic_ns() // 1000
        while self._plugged.is_set():
            try:
                rest += os.read(self._near, 4096)
            except BlockingIOError:
                time.sleep(0.001)
            *lines, rest = rest.split(b"\n")
            for line in lines:
                self._obey(line)
            if self._behaviour.get("streams") and self.applied:
                now_us = began_us + time.monotonic_ns() // 1000
                try:
                    while self.now_us + self.period_us <= now_us:
                        self.inertial(gyro=(5.0, 0.0, -3.0))
                except BlockingIOError:  # nobody reads: what it measures meanwhile is gone
                    continue

    def _obey(self, line: bytes) -> None:
        if self._behaviour.get("mute"):
            return
        [(key, value)] = msgspec.json.decode(line, type=dict[str, object]).items()
        self.asked.append({key: value})
        known = plain(key)
        if key == self._behaviour.get("refuses"):
            self._answer(key, {"error": "Unknown key"})
        elif key == "ping":
            interface = self._behaviour.get("interface", "USB")
            self._answer(key, {"interface": interface, "name": "x-IMU3", "sn": "0123-4567"})
        elif key == "apply":
            self.applied += 1
            self._answer(key, None)
        elif known in self.settings:
            self.settings[known] = value if value is not None else self.settings[known]
            self._answer(key, self.settings[known])
        else:
            self._answer(key, {"error": "Unknown key"})

    def _answer(self, key: str, value: object) -> None:
        self.write(msgspec.json.encode({key: value}) + b"\n")
