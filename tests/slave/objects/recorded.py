"""Lines as survive-cli writes them (libsurvive, src/survive_recording.c), CR LF and all, and who says them."""

from pathlib import Path

HEAD = (
    b"Info: Loaded drivers: GlobalSceneSolver, HTCVive\n"
    b"0.001000 INFO LOG Recording to stdout\r\n"
    b"0.001222 OPTION center-on-lh0 b 0\n"
    b"0.001234 OPTION max-error f 0.100000\n"
    b'0.331402 WM0 CONFIG {    "acc_bias": [-0.02, 0.01, 0.1],     "device_class": "generic_tracker",'
    b'     "device_serial_number": "LHR-1A2B3C4D",     "mb_serial_number": "42T1234567890" }\r\n'
    b"1.442087 WM0 Y 3 1234567 0 1\n"
    b"1.442099 WM0 W 3 11 1234600 0\n"
    b"1.442110 WM0 B 3 11 1234600 0 0.214401 \n"
    b"7.120011 0 LH_POSE -1.204411 0.883012 2.101774 0.801122 -0.112233 0.300011 -0.505744 \r\n"
    b"7.991002 INFO LOG Using LH 0 (3d74fc7e) as reference lighthouse\r\n"
)


def pose(
    t_s: float, device: str = "WM0", place: tuple[float, ...] = (-0.284080, 0.936063, 0.374069)
) -> bytes:
    """A pose, turned by a quarter about z: w first, 0.707107 0 0 0.707107."""
    x, y, z = place
    return (
        f"{t_s:.6f} {device} POSE {x:.6f} {y:.6f} {z:.6f} 0.707107 0.000000 0.000000 0.707107 \r\n"
        f"{t_s:.6f} {device} VELOCITY 0.001240 -0.000310 0.000771 0.010200 0.000040 -0.003300 \r\n"
    ).encode()


def program(folder: Path, script: str) -> str:
    """An executable that stands for survive-cli; the script sees its options as any shell script does."""
    path = folder / "survive-cli"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return str(path)
