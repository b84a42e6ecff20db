"""Options of commands that watch or set a running rig and its fleet.

Those of the other commands of `phalanx fleet` stand in `deploy.arguments`.
"""

from argparse import ArgumentParser

from common.command_line import number, whole
from master.commands.options import (
    add_bus,
    add_calibration,
    add_flag,
    add_hand,
    add_link,
    add_names,
    add_number,
    add_path,
    add_rig,
    add_rigs,
    add_site,
    add_text,
    site_name,
)


def view(command: ArgumentParser) -> None:
    """Show a running master in Rerun.

    A process of its own, which may come and go; it waits for the master.

    Examples:
      phalanx view --rig desk
      phalanx view --rig desk --rig wrist
      phalanx view --rig desk --keys DIR --bus tls/192.168.1.2:47802 --web
      phalanx view --rig desk --keys DIR --bus tls/192.168.2.1:47810 --site room-a
    """
    add_rigs(command)
    add_calibration(command)
    add_hand(command)
    add_bus(command)
    add_site(command)
    add_flag(command, "--web", "serve the viewer to a browser on 127.0.0.1 instead of a window")
    add_number(command, "--web-port", "PORT", "TCP port of that page", whole(1, 65535), default=9090)
    add_path(command, "--save", "FILE", "write an .rrd instead of showing anything")


def console(command: ArgumentParser) -> None:
    """Serve the console: watch, tune, record and set up in a browser.

    A process of its own, which may come and go.

    Needs no master and no file: the page sets a rig up from nothing. --beacon, --bind and the key are those of the
    processes that the page starts.

    Examples:
      phalanx console
      phalanx console --rig desk --rig wrist --port 8081
      phalanx console --keys DIR --bus tls/192.168.1.2:47802
      phalanx console --host 0.0.0.0
    """
    add_calibration(command)
    add_text(
        command,
        "--rig",
        "NAME",
        "rig that runs, once for each (default: desk, once its file is there)",
        action="append",
    )
    add_bus(command)
    add_link(command)
    add_number(
        command, "--port", "PORT", "TCP port of the page; 0: a free one", whole(0, 65535), default=8080
    )
    host = "address to serve on; elsewhere than on this machine the page asks for a password"
    add_text(command, "--host", "ADDRESS", host, default="127.0.0.1")
    add_path(
        command,
        "--password-file",
        "FILE",
        "ask for the password in the first line of this file (default: one is made and printed once)",
    )


def check(command: ArgumentParser) -> None:
    """List what is wrong with a running rig, and what to do.

    Exit code 1 if there is anything, 0 if all is well. Where no master runs, the files of the rig are looked at.

    What each line means, how it is measured and what to do: docs/checklist.md.

    Examples:
      phalanx check
      phalanx check --watch
      phalanx check --rig wrist --calibration DIR
      phalanx check --keys DIR --bus tls/192.168.1.2:47802 && echo ready
    """
    add_rigs(command)
    add_calibration(command)
    add_bus(command)
    add_site(command)
    add_flag(command, "--watch", "go on until Ctrl-C, and print the list whenever it changes")


def info(command: ArgumentParser) -> None:
    """Show what is in a recording of messages.

    Streams, rates, length, files, and what happened.

    Examples:
      phalanx info out/wave.mcap
    """
    add_path(command, "file", "FILE.mcap", "the recording")


def camera(command: ArgumentParser) -> None:
    """Show how a running camera is set, or set it otherwise.

    A change is made at once, read back and compared. What the camera does not take is refused by name, and it goes
    back to what it had.

    Examples:
      phalanx camera left
      phalanx camera left --exposure-us 4000 --gain 2
      phalanx camera left --colour-gains 1.1,1.6 --save
      phalanx camera left --rate-hz 30 --roi-margin 0.08
      phalanx camera left --pick index@310,204 --save
      phalanx camera left --load new/left.json --save
    """
    add_text(command, "name", "NAME", "name of a camera whose slave is running")
    add_number(command, "--exposure-us", "US", "exposure in microseconds")
    add_number(command, "--gain", "N", "analogue gain")
    add_text(command, "--colour-gains", "RED,BLUE", "gains of red and blue relative to green")
    add_number(command, "--rate-hz", "HZ", "frames a second")
    add_number(
        command, "--roi-margin", "N", "how far a marker may be from where it is expected, share of the width"
    )
    add_text(
        command, "--pick", "MARKER@U,V", "colour of a marker from a pixel on its paint, in the newest frame"
    )
    add_path(
        command, "--load", "FILE", "camera file to use in place of the present content", dest="load_file"
    )
    add_flag(command, "--save", "write what is in use to the slave's camera file")
    add_bus(command)


def gestures(command: ArgumentParser) -> None:
    """List the poses that a hand is known by, and what is asked of each.

    Or teach one, forget one, or list which gestures a recorded hand makes, from when to when.

    To teach a pose, show it a few times before a running master, or give its time in a recorded run. The hand is
    known by it at once: a running master follows the file. A pose too similar to another is refused, and the
    file stays as it was.

    Examples:
      phalanx gestures
      phalanx gestures --teach thumbs_up
      phalanx gestures --teach vulcan --within open_palm --examples 8
      phalanx gestures --teach horns --poses out/poses.npz --range 1.0-1.8 --range 4.2-5 --range 7.5-8.1
      phalanx gestures --forget horns
      phalanx gestures --poses out/demo/poses.npz                            the gestures of a recorded hand
      phalanx gestures --poses out/poses.npz --settings mine.json --hand me.json --every
    """
    what = command.add_mutually_exclusive_group()
    what.add_argument("--teach", metavar="NAME", help="teach this pose; one of that name is replaced")
    what.add_argument("--forget", metavar="NAME", help="take this pose out of the file")
    add_path(
        command,
        "--poses",
        "FILE",
        "poses.npz of a run: report its gestures; with --teach, where the examples are, each in a --range",
    )
    add_flag(command, "--every", "with --poses: every message as a line of JSON, too")
    add_number(
        command, "--examples", "N", "with --teach: how many, before a running master", whole(3, 10), default=5
    )
    add_names(
        command,
        "--range",
        "FROM-TO",
        "with --teach: seconds after the first pose of --poses; once for each example",
        dest="ranges",
    )
    add_text(
        command,
        "--within",
        "NAME",
        "with --teach: the pose is a special case of this one, and wins where both fit",
    )
    add_path(command, "--settings", "FILE", "gestures file (default: CALIBRATION/gestures/default.json)")
    add_path(
        command, "--out", "FILE", "with --teach: gestures file to write (default: the one that was read)"
    )
    add_path(
        command, "--hand", "FILE", "hand profile (default: the one that the poses name, in CALIBRATION/hands)"
    )
    add_text(
        command,
        "--hand-name",
        "NAME",
        "with --teach: of two hands before a running master, the one that shows it",
    )
    add_calibration(command, "gestures/ and hands/")
    add_bus(command)


def status(command: ArgumentParser) -> None:
    """Show each process of the rig: machine, version, temperature, clock, rate.

    A row for each camera, IMU and tracker that has keys or reports itself; a dash where nothing is known.

    With --wait it waits until datagrams of these senders come: at the master that runs or, where none does, here; it
    ends with 1 if one of them is not received.

    Examples:
      phalanx fleet status                           once, as a table
      phalanx fleet status --watch                   again each second
      phalanx fleet status --watch --json | jq -c '.devices[] | [.name, .state]'
      phalanx fleet status --bus tls/192.168.1.2:47802 --keys ~/.config/phalanx/keys
      phalanx fleet status --wait left --wait right --keys ~/.config/phalanx/keys
      phalanx fleet status --wait wrist --wait imu --rig wrist --bind 0.0.0.0:47801 --beacon 192.168.1.255:47800
    """
    add_bus(command)
    add_number(
        command,
        "--seconds",
        "S",
        "how long it listens (default: 3; with --wait at most 20)",
        number(0.5, 3600.0),
    )
    add_flag(command, "--watch", "again each second, until Ctrl-C")
    add_flag(
        command,
        "--json",
        "as JSON; with --wait datagrams a second by name, and whether a master runs",
        dest="as_json",
    )
    add_names(command, "--wait", "NAME", "wait for datagrams of this camera or IMU; once for each")
    add_rig(command)
    add_calibration(command)
    add_link(command)


def keys(command: ArgumentParser) -> None:
    """Make the secrets of a rig: keys for datagrams, certificates for its bus.

    docs/keys.md lists who has which.

    Prints who has a certificate, what for, until when, and which device has no secret for its datagrams. --make
    makes a keys folder, or adds what is missing: what is there stays as it is. `phalanx fleet deploy` does that, and
    brings each device its part.

    --renew makes all keys anew, for everybody; then deploy again and restart the programs of the PC. With --device it
    makes only a new certificate for that device; its old one stays valid and its secret stays, so not for a lost one.

    --revoke locks out devices that were lost, sold or stolen: all keys are made anew, and these get none. A lost device
    reads and forges nothing of the others. But it has the rig key and a certificate, and counts as itself: nothing
    less keeps it out.

    Examples:
      phalanx fleet keys ~/.config/phalanx/keys
      phalanx fleet keys ~/.config/phalanx/keys --make
      phalanx fleet keys ~/.config/phalanx/keys --make --device left --device right
      phalanx fleet keys ~/.config/phalanx/keys --renew
      phalanx fleet keys ~/.config/phalanx/keys --renew --device left
      phalanx fleet keys ~/.config/phalanx/keys --revoke --device left
    """
    add_path(command, "folder", "DIR", "keys folder; keep it private, and out of calib_json")
    add_names(
        command,
        "--device",
        "NAME",
        "name of a camera, IMU or tracker as the rig has it; once for each",
        dest="devices",
    )
    what = command.add_mutually_exclusive_group()
    what.add_argument("--make", action="store_true", help="make the folder, or add what is missing")
    what.add_argument("--renew", action="store_true", help="make all keys anew, or one certificate")
    what.add_argument("--revoke", action="store_true", help="make all keys anew, and lock out --device")


def relay(command: ArgumentParser) -> None:
    """Show several masters in one place, and let nothing reach down to them.

    Two of these programs work together:

    At that place, with --listen, a router: it passes on what several masters publish, each under the name of its site,
    and readers name the site. Routers that are connected are one: a reader at any of them sees every site. One that was
    away is joined again by itself, and so is everybody at it. docs/scale.md describes when one is needed.

    Beside each master, with --site and --router, a relay: it repeats at the router what the master publishes: hands,
    objects, contact, gestures, health and the checklist. No command comes down, nothing that cameras send goes up. A
    process of its own; it waits for both, goes on when either was away, and counts what a slow link had no room for.

    Examples:
      phalanx fleet relay --listen tls/0.0.0.0:47810 --keys DIR
      phalanx fleet relay --listen tls/0.0.0.0:47810 --connect tls/192.168.2.1:47810 --keys DIR
      phalanx fleet relay --site room-a --router tls/192.168.2.1:47810 --keys DIR
      phalanx view --site room-a --bus tls/192.168.2.1:47810 --keys DIR --rig desk
    """
    role = command.add_mutually_exclusive_group(required=True)
    role.add_argument(
        "--listen", metavar="ENDPOINT", help="be a router: where relays, readers and other routers connect"
    )
    role.add_argument(
        "--site", type=site_name, metavar="NAME", help="be a relay: name of the site, as readers give it"
    )
    add_names(command, "--connect", "ENDPOINT", "of a router: another one to be joined with; once for each")
    add_text(command, "--router", "ENDPOINT", "of a relay: the router")
    add_bus(command)
