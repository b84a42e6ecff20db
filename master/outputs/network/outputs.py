"""Live outputs by name.

What each takes, where it sends to, and how it is made.

An output is a `Sink`. Its file is imported when it is switched on: what its library is, nobody else needs.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass

from common.bus.endpoints import loopback
from common.calibration.output_settings import OutputPart, OutputSettings
from common.messages import Contact, Gesture, HandPose, ObjectPose, ResultMessage
from master.outputs.network.times import Times
from master.outputs.sink import Sink
from master.outputs.web.listening import is_loopback, is_open


@dataclass(frozen=True, slots=True)
class Output:
    """One row of the registry.

    Attributes:
        takes: Types of messages that it is for; others never come to it.
        part: Its settings; where they differ, it is made anew.
        where: Where it sends to, for a person.
        make: Opens it. Called on a thread of its own; a `PhalanxError` or `OSError` is reported, and it is retried.
    """

    takes: tuple[type[ResultMessage], ...]
    part: Callable[[OutputSettings], OutputPart]
    where: Callable[[OutputSettings], str]
    make: Callable[[OutputSettings, Times], Sink]


def _osc(settings: OutputSettings, times: Times) -> Sink:
    from master.outputs.network.osc import OscSink

    return OscSink(settings.osc, times)


def _vmc(settings: OutputSettings, times: Times) -> Sink:
    from master.outputs.network.vmc import VmcSink

    return VmcSink(settings.vmc, times)


def _lsl(settings: OutputSettings, times: Times) -> Sink:
    from master.outputs.network.lsl import LslSink

    return LslSink(settings.lsl, times)


def _ros2(settings: OutputSettings, times: Times) -> Sink:
    from master.outputs.network.ros2 import Ros2Sink

    return Ros2Sink(settings.ros2, times)


def _web(settings: OutputSettings, times: Times) -> Sink:
    from master.outputs.network.web import WebSink

    return WebSink(settings.web)


def _where_web(settings: OutputSettings) -> str:
    from master.outputs.network.web import address_of

    return address_of(settings.web, os.environ)


EVERYTHING: tuple[type[ResultMessage], ...] = (HandPose, ObjectPose, Contact, Gesture)
OUTPUTS: dict[str, Output] = {
    "osc": Output(EVERYTHING, lambda s: s.osc, lambda s: f"udp {s.osc.host}:{s.osc.port}", _osc),
    "vmc": Output((HandPose,), lambda s: s.vmc, lambda s: f"udp {s.vmc.host}:{s.vmc.port}", _vmc),
    "ros2": Output(
        (HandPose, ObjectPose),
        lambda s: s.ros2,
        lambda s: f"router {s.ros2.router}, domain {s.ros2.domain_id}",
        _ros2,
    ),
    "lsl": Output((HandPose,), lambda s: s.lsl, lambda s: f"streams {s.lsl.name}-HAND ({s.lsl.scope})", _lsl),
    "web": Output((HandPose, ObjectPose), lambda s: s.web, _where_web, _web),
}


def who_reads(name: str, settings: OutputSettings) -> str | None:
    """State who else can read an output that leaves this machine.

    Also what they can do; None where the output does not leave it.

    These protocols have no encryption and no login: that they leave the machine is the choice of who wrote the file.
    """
    match name:
        case "osc" | "vmc":
            part = settings.osc if name == "osc" else settings.vmc
            leaves = not is_loopback(part.host)
        case "ros2":
            leaves = not loopback(settings.ros2.router)
        case "lsl":
            leaves = settings.lsl.scope != "machine"
        case _:
            if is_loopback(settings.web.host):
                return None
            if is_open(os.environ):
                return "plain (--open): whoever listens to the network reads the hands and the key"
            return "encrypted, by a certificate of this machine; whoever has the key of the address reads the hands"
    if not leaves:
        return None
    return "leaves this machine unencrypted: whoever is in that network reads it, and can send such messages himself"


def switched_on(settings: OutputSettings) -> dict[str, bool]:
    """Output -> whether its settings have it on."""
    return {name: output.part(settings).on for name, output in OUTPUTS.items()}
