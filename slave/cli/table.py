"""The table of `phalanx-slave`."""

from common.command_line import Command, Program

ABOUT = """\
The slave stands beside a camera: it finds the painted markers, or the fingers before a wrist device, and sends where
they are. It also sends what an IMU measures, and where a tracker is. Images leave it only as small previews, on
request, while somebody looks.

  phalanx-slave run --name left --rig desk --camera picamera2 --keys keys
  sudo phalanx-slave doctor           checks this device, line by line"""
_TABLE = (
    Command("run", "run", "detect or measure live, and send",
            "slave.cli.options:run", "slave.commands.run:run"),
    Command("record", "record", "write raw frames to disk, join recordings, or take your own videos",
            "slave.cli.options:record", "slave.commands.record:run"),
    Command("colours", "set up", "find the marker colours of a camera in a recording",
            "slave.cli.options:colours", "slave.commands.offline:run"),
    Command("doctor", "set up", "check this device, and test its lights",
            "slave.cli.options:doctor", "slave.doctor.command:run"),
    Command("install", "set up", "install the slave as a service of this machine",
            "slave.install.arguments:add_install", "slave.install.command:run_here"),
)  # fmt: skip
PROGRAM = Program(
    "phalanx-slave",
    ABOUT,
    _TABLE,
    "install it: pip install '.[wrist,fast,vive]' has what lights, numba and trackers need",
    "%(asctime)s %(name)s: %(message)s",
)
