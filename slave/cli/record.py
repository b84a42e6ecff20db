"""Options of `phalanx-slave record`."""

from argparse import ArgumentParser
from pathlib import Path

from common.option_types import count, megabytes, positive
from slave.cli.options import add_camera, add_place, add_simulated
from slave.drivers import CAMERAS, IMU_UNITS, REAL_IMUS


def record(command: ArgumentParser) -> None:
    """Write raw frames of a camera to disk, and a real IMU beside it.

    Without master or network: one folder per
    camera. Or makes a recording of those of several cameras (--join), of videos or pictures that other programs made
    (--from), or imu.csv of the table of an IMU (--imu-csv).

    Examples:
      phalanx-slave record --name left --rig desk --camera synthetic --seconds 10 -o recordings/wave-left
      phalanx-slave record --name wrist --rig wrist --camera synthetic --imu ximu3:/dev/ttyACM0 --seconds 10 -o out
            the rig's IMU beside the camera, as imu.csv on the clock of the frames
      phalanx-slave record --join recordings/wave-left recordings/wave-right -o recordings/wave
            one recording of all cameras, for `phalanx replay` and the calibrations
      phalanx-slave record --join recordings/grasp-left recordings/grasp-right recordings/grasp-wrist -o grasp
            of marker cameras and a wrist device: one of kind both
      phalanx-slave record --from left.mp4 right.mp4 --calibration calib_json -o recordings/wave
            videos named as the cameras of the rig; `phalanx replay left.mp4 right.mp4 ...` does this by itself
      phalanx-slave record --from takes/7 --calibration calib_json --times takes/7/times.csv -o recordings/take7
            a folder with a video, or a folder of pictures, for each camera; times.csv: camera,frame,time (seconds)
      phalanx-slave record --from left=GOPR0012.MP4 right=GOPR0944.MP4 --calibration calib_json -o recordings/gopro
            whose each one is, where its name does not state it
      phalanx-slave record --imu-csv walk.csv --gyro-unit deg/s -o recordings/walk
            reads a CSV with a header (docs/imu.md), reports its rate, gaps, bias and orientation, and writes imu.csv;
            against a quaternion in it, how right the tilt is. Without -o it is only looked at
    """
    what = command.add_mutually_exclusive_group(required=True)
    what.add_argument("--camera", metavar="DRIVER", help=CAMERAS)
    what.add_argument(
        "--join", type=Path, nargs="+", metavar="RECORDING", help="recordings to join, one folder per camera"
    )
    what.add_argument(
        "--from",
        dest="foreign",
        nargs="+",
        metavar="[NAME=]PATH",
        help="a video or a folder of pictures for each camera NAME (default: that of its name, else in the order of "
        "the rig), or a folder of these",
    )
    what.add_argument(
        "--imu-csv", type=Path, metavar="FILE", help="a CSV with a header: time, rates, forces of an IMU"
    )
    command.add_argument(
        "-o", "--output", type=Path, metavar="FOLDER", help="new or empty; with --from also a former one"
    )
    add_place(
        command,
        "camera of this slave, a member of the rig; with --imu-csv its IMU (default: imu)",
        rig="desk; with --from the one with these cameras",
    )
    command.add_argument("--seconds", type=positive, metavar="S", help="default: until Ctrl-C")
    command.add_argument("--frames", type=count, metavar="N", help="end after so many recorded frames")
    command.add_argument(
        "--imu",
        nargs="?",
        const="synthetic",
        metavar="DRIVER",
        help=f"samples of the rig's IMU, too, as imu.csv: {REAL_IMUS}; without a driver, that of a synthetic camera",
    )
    command.add_argument(
        "--every-frame",
        action="store_true",
        help="a synthetic camera does not keep time but draws every frame, however long that takes; all cameras of one "
        "scene need the same --scene-epoch-ns",
    )
    command.add_argument("--note", default="", metavar="TEXT", help="kept in recording.json")
    command.add_argument(
        "--reserve-mb", type=megabytes, default=200.0, metavar="MB", help="stay free (default: %(default)g)"
    )
    command.add_argument(
        "--queue-mb", type=megabytes, default=128.0, metavar="MB", help="may wait (default: %(default)g)"
    )
    command.add_argument(
        "--by-wall-clock",
        action="store_true",
        help="of --join: recorded on several machines: trust their wall clocks (keep them together by NTP or PTP)",
    )
    command.add_argument(
        "--times",
        type=Path,
        metavar="FILE.csv",
        help="of --from: when each frame was taken: camera,frame,time; frames from 0, time in seconds, or t_ns "
        "(default: NAME.csv beside NAME.mp4, without the camera; else the video's time stamps, else the frame rate)",
    )
    table = command.add_argument_group("table of an IMU (--imu-csv)").add_argument
    for measured, units in IMU_UNITS.items():
        text = f"unit of {measured} where the header does not say it"
        table(f"--{measured}-unit", choices=units, help=text)
    table(
        "--rate-hz",
        type=positive,
        metavar="HZ",
        help="samples per second of a table without a column of time",
    )
    add_camera(command)
    add_simulated(command)
