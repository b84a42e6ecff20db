"""The table of commands of `phalanx`.

It is called `phalanx-master` where it runs as a service.
"""

import sys
from pathlib import Path

from common.command_line import Command, Family, Program

NAMES = ("phalanx", "phalanx-master")
_TRY, _SET_UP, _RUN, _LOOK = "try", "set up", "run", "look"
_RECORD, _SEND, _FLEET = "record", "send", "fleet"
_CAMERAS, _WRIST = "cameras", "wrist device"

# fmt: off
TABLE: tuple[Command | Family, ...] = (
    Command("demo", _TRY, "run everything on this machine, without hardware",
            "deploy.arguments:add_demo", "deploy.commands:demo"),
    Command("replay", _TRY, "make hands of recorded frames or your own videos, offline",
            "master.cli.run:replay", "master.commands.replay:replay"),
    Family("calibrate", _SET_UP, "measure cameras, hand, wrist device, object or tracker"),
    Command("camera", _SET_UP, "show or change the settings of a running camera",
            "master.cli.rig:camera", "master.commands.camera:camera"),
    Command("gestures", _SET_UP, "teach a pose of the hand, forget one, or list them",
            "master.cli.rig:gestures", "master.gestures.command:gestures"),
    Command("run", _RUN, "track live, or install that as a service",
            "master.cli.run:run", "master.commands.run:run"),
    Command("view", _LOOK, "show a running master in the Rerun viewer",
            "master.cli.rig:view", "master.commands.view:view"),
    Command("console", _LOOK, "watch, tune, record and set up in a browser",
            "master.cli.rig:console", "master.commands.view:console"),
    Command("check", _LOOK, "list what is wrong with a running rig, and what to do",
            "master.cli.rig:check", "master.checklist.files:check"),
    Command("info", _LOOK, "show what is in a recording of messages",
            "master.cli.rig:info", "master.recording.lines:info"),
    Command("record", _RECORD, "record what a running master receives and solves, in a file",
            "master.cli.run:record", "master.recording.record:record"),
    Command("play", _RECORD, "play such a file again, as from a live master",
            "master.cli.run:play", "master.recording.play:play"),
    Command("export", _RECORD, "convert recorded hands for other tools: CSV, Parquet, BVH, glTF, Rerun",
            "master.cli.run:export", "master.recording.export.command:export"),
    Command("send", _SEND, "send live hands to other programs: OSC, VMC, ROS 2, LSL, WebSocket",
            "master.cli.run:send", "master.outputs.network.sender:send"),
    Family("fleet", _FLEET, "manage slaves on their machines, keys, and masters of several sites"),
    Command("calibrate board", _CAMERAS, "print a board, or a box of tags to glue on an object",
            "master.cli.calibrate:board", "master.calibrate.cameras.board_print:board"),
    Family("calibrate cameras", _CAMERAS, "measure lenses and places of cameras by a board, and how late frames are"),
    Command("calibrate cameras capture", _CAMERAS, "take pictures of the board with the running slaves",
            "master.cli.calibrate:capture", "master.calibrate.cameras.capture:capture_views"),
    Command("calibrate cameras intrinsics", _CAMERAS, "measure the lens of each camera by itself",
            "master.cli.calibrate:intrinsics", "master.calibrate.cameras.commands:intrinsics"),
    Command("calibrate cameras stereo", _CAMERAS, "measure where all cameras of a rig stand, and their lenses",
            "master.cli.calibrate:stereo", "master.calibrate.cameras.commands:stereo"),
    Command("calibrate cameras time", _CAMERAS, "measure how late the frames of each camera are, by a moving hand",
            "master.cli.calibrate:time", "master.calibrate.time_offsets:time_command"),
    Command("calibrate depth", _CAMERAS, "fit depth to disparity by a target at known distances, or verify it",
            "master.cli.calibrate:depth", "master.calibrate.depth.verify:depth_command"),
    Command("calibrate hand", "hand", "measure the bone lengths of your hand",
            "master.cli.calibrate:hand", "master.calibrate.hand.commands:hand_command"),
    Family("calibrate wrist", "hand", "measure a wrist device: laser, light, how it sits, who wears it"),
    Command("calibrate wrist laser-plane", _WRIST, "measure the plane of the laser",
            "master.cli.calibrate_devices:laser_plane", "master.calibrate.wrist.laser_plane:laser_plane"),
    Command("calibrate wrist flat-field", _WRIST, "measure how evenly LEDs and lens light the image",
            "master.cli.calibrate_devices:flat_field", "master.calibrate.wrist.flat_field:flat_field"),
    Command("calibrate wrist curl", _WRIST, "measure along which line the laser point of each finger moves",
            "master.cli.calibrate_devices:curl", "master.calibrate.wrist.curl:curl"),
    Command("calibrate wrist palm", _WRIST, "measure where the palm is, by a board that lies on it",
            "master.cli.calibrate_devices:palm", "master.calibrate.wrist.palm:palm"),
    Command("calibrate wrist subject", _WRIST,
            "measure who wears it: palm pose, knuckles, thickness and lengths of fingers",
            "master.cli.calibrate_devices:subject", "master.calibrate.wrist.subject:subject"),
    Command("calibrate wrist extrinsics", _WRIST,
            "measure how it sits, how its IMU lies, and its clocks, before marker cameras",
            "master.cli.calibrate_devices:extrinsics", "master.calibrate.extrinsics.extrinsics:extrinsics"),
    Command("calibrate object", "object", "measure where the beads of an object sit",
            "master.cli.calibrate_devices:object_options", "master.calibrate.object.command:object_command"),
    Command("calibrate tracker", "object", "find where a tracking system (Lighthouse) lies in the rig",
            "master.cli.calibrate_devices:tracker", "master.calibrate.tracker.registration:tracker"),
    Command("fleet deploy", "machines", "install slaves on their machines by ssh",
            "deploy.arguments:add_deploy", "deploy.commands:deploy_slaves"),
    Command("fleet status", "machines", "show the state of each process of the rig, or wait for its datagrams",
            "master.cli.rig:status", "master.commands.fleet:status"),
    Command("fleet rollback", "machines", "put machines back to what they had before the last deployment",
            "deploy.arguments:add_rollback", "deploy.commands:rollback"),
    Command("fleet uninstall", "machines", "remove slaves from their machines",
            "deploy.arguments:add_uninstall", "deploy.commands:uninstall_slaves"),
    Command("fleet wheels", "machines", "download what a slave needs, for machines without a network",
            "deploy.arguments:add_wheels", "deploy.commands:wheels"),
    Command("fleet keys", "keys and sites", "show, make, renew or revoke the rig key, secrets and certificates",
            "master.cli.rig:keys", "master.commands.keys:keys"),
    Command("fleet relay", "keys and sites", "show several masters in one place",
            "master.cli.rig:relay", "master.commands.keys:relay"),
)
# fmt: on
# The calibrations by their last word, which is theirs alone.
CALIBRATIONS = {
    entry.name.rpartition(" ")[2]: entry
    for entry in TABLE
    if isinstance(entry, Command) and entry.name.startswith("calibrate ")
}
_ABOUT = """\
Hand tracking from cameras that anyone can buy: detections of cameras, or of a wrist device, become a hand of 26 joints.

  phalanx demo                        without hardware: two simulated cameras and the master
  phalanx run --rig desk              the master of a rig whose slaves run
  phalanx console                     set a rig up from nothing, in a browser"""


def program() -> Program:
    """The program, under the name that it was started by."""
    called = Path(sys.argv[0]).name
    name = called if called in NAMES else NAMES[0]
    return Program(name, _ABOUT, TABLE, "install the master's packages, pip install '.[master]'")
