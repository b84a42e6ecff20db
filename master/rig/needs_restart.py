"""Changes of a rig's files that a running master cannot follow.

They concern what slaves, files and viewers were started with.
"""

from collections.abc import Sequence

from common.errors import CalibrationError
from master.rig.setup import RigSetup

_OF_CAMERA = ("width_px", "height_px")
_ALL = "give all processes of the rig the same files, then restart them"
_MASTER = "restart the master"


def refuse_other_hands(old: Sequence[RigSetup], new: Sequence[RigSetup]) -> None:
    """Refuse other hands than those that are solved.

    Raises:
        CalibrationError: With both lists.
    """
    was, now = (tuple(setup.hand.profile.name for setup in setups) for setups in (old, new))
    if was != now:
        raise _refusal(f"rig {new[0].rig.name!r}: hand", was, now, _MASTER)


def refuse_restart(old: RigSetup, new: RigSetup) -> None:
    """Refuse what slaves, files and viewers were started with.

    Raises:
        CalibrationError: With the key, and what to restart.
    """
    where = f"rig {new.rig.name!r}"
    if old.rig.kind != new.rig.kind:
        raise _refusal(f"{where}: kind", (old.rig.kind,), (new.rig.kind,), _ALL)
    for key, was, now in (
        ("cameras", old.camera_names, new.camera_names),
        ("markers", old.markers, new.markers),
    ):
        if was != now:
            raise _refusal(f"{where}: {key}", was, now, _ALL)
    if old.rows != new.rows:
        raise CalibrationError(f"{where}: markers: cannot stand in another order while it runs: {_ALL}")
    was, now = (tuple(one.name for one in setup.objects) for setup in (old, new))
    if was != now:
        raise _refusal(f"{where}: objects", was, now, _ALL)
    if old.trackers != new.trackers:
        raise _refusal(f"{where}: tracker of its objects", old.trackers, new.trackers, _MASTER)
    if old.imus != new.imus:
        raise _refusal(f"{where}: imu.name", old.imus, new.imus, _MASTER)
    for name, camera in new.cameras.items():
        for key in _OF_CAMERA:
            was, now = getattr(old.cameras[name], key), getattr(camera, key)
            if was != now:
                raise _refusal(f"camera {name!r}: {key}", (str(was),), (str(now),), _ALL)


def _refusal(key: str, was: Sequence[str], now: Sequence[str], remedy: str) -> CalibrationError:
    return CalibrationError(
        f"{key}: {', '.join(was) or 'none'} cannot become {', '.join(now) or 'none'} while it runs: {remedy}"
    )
