"""Assignment of machines to cameras.

The hosts of a command line, read with the rig's file.
"""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

_HOST = re.compile(r"(?:[A-Za-z0-9._-]+@)?[A-Za-z0-9.:-]+")


class DeployError(Exception):
    """Error for a deployment that is not possible.

    The text is one line that states why, and what to do.
    """


@dataclass(frozen=True, slots=True)
class Target:
    """A machine, and the cameras and IMUs of the rig that it serves."""

    host: str
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RigFile:
    """A rig's file, as far as it matters here."""

    name: str
    kind: str
    cameras: tuple[str, ...]
    imu: str | None
    files: tuple[str, ...]  # below calib_json, of this rig

    @property
    def names(self) -> tuple[str, ...]:
        """All that send."""
        return self.cameras + (() if self.imu is None else (self.imu,))


def read_rig(calibration: Path, name: str) -> RigFile:
    """Read `rigs/NAME.json`.

    Raises:
        DeployError: It is missing or broken.
    """
    path = calibration / "rigs" / f"{name}.json"
    try:
        rig = cast(dict[str, object], json.loads(path.read_text()))
        cameras = tuple(str(one) for one in cast(list[object], rig["cameras"]))
        imu = cast(dict[str, object] | None, rig.get("imu"))
        objects = cast(list[object], rig.get("objects") or [])
        files = [
            f"rigs/{name}.json",
            *(f"cameras/{one}.json" for one in cameras),
            f"hands/{rig['hand']}.json",
        ]
        files += [f"objects/{one}.json" for one in objects]
        return RigFile(name, str(rig["kind"]), cameras, str(imu["name"]) if imu else None, tuple(files))
    except (OSError, ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
        raise DeployError(
            f"{path}: cannot read the rig ({error}); give --calibration DIR and --rig NAME"
        ) from error


def targets_of(hosts: Sequence[str], rig: RigFile) -> list[Target]:
    """Parse `HOST` or `NAME[+NAME...]=HOST` of each host.

    Hosts without a name take the rig's cameras in their order.

    The IMU of a rig goes to the host of its first camera, unless it is named.

    Raises:
        DeployError: A name is none of the rig's, stands twice, or there are more hosts than cameras.
    """
    split = [host.rpartition("=") for host in hosts]
    named = [name for names, _, _ in split for name in names.split("+") if names]
    free = [camera for camera in rig.cameras if camera not in named]
    targets: list[Target] = []
    for names, _, host in split:
        if not _HOST.fullmatch(host) or host.startswith("-"):
            raise DeployError(f"{host!r}: not a host; write HOST, USER@HOST or NAME=HOST")
        if not names and not free:
            raise DeployError(
                f"{host}: rig {rig.name!r} has no camera left for it; it has {', '.join(rig.cameras)}"
            )
        own = tuple(names.split("+")) if names else (free.pop(0),)
        if rig.imu is not None and rig.imu not in named and own[0] == rig.cameras[0]:
            own += (rig.imu,)
        targets.append(Target(host, own))
    given = [name for target in targets for name in target.names]
    for name in given:
        if name not in rig.names:
            raise DeployError(
                f"rig {rig.name!r} has no camera or IMU {name!r}; it has {', '.join(rig.names)}"
            )
        if given.count(name) > 1:
            raise DeployError(f"{name}: stands twice; each camera has one host")
    if len({target.host for target in targets}) < len(targets):
        raise DeployError("a host stands twice: write NAME+NAME=HOST for two cameras of one machine")
    return targets
