"""`phalanx replay`: recorded frames, detections or messages to hands, offline."""

from argparse import Namespace
from pathlib import Path

from common.command_line import UsageError, echo

_MESSAGES = ".mcap"


def replay(options: Namespace) -> None:
    """Replay a recording of frames, videos of your own, or a recording of messages.

    Raises:
        UsageError: An option has no meaning for what is replayed.
    """
    paths: list[Path] = options.paths
    if any(path.suffix == _MESSAGES for path in paths):
        _replay_messages(options)
        return
    from master.commands.summary import read_summary, summary_lines
    from master.replay.offline import replay_recording

    replay_recording(options, echo)
    if options.detect_only:
        return
    echo()
    for line in summary_lines(read_summary(options.out / "summary.json")):
        echo(f"  {line}")
    echo(f"\nposes   {options.out / 'poses.npz'}\nsummary {options.out / 'summary.json'}")


def _replay_messages(options: Namespace) -> None:
    frames_only = "camera rig times detections detect_only calibration hand only solver_mode solver"
    for name in frames_only.split():
        if getattr(options, name):
            raise UsageError(f"--{name.replace('_', '-')} has no meaning for recorded messages: leave it out")
    if len(options.paths) > 1:
        raise UsageError("recorded messages are replayed from one file")
    from master.recording.play import play

    play(
        Namespace(
            file=options.paths[0],
            speed="max",
            from_s=None,
            to_s=None,
            out=options.out,
            loop=False,
            solved=False,
            no_bus=True,
        )
    )
