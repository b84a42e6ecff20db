"""docs/security.md says who listens where: here against the defaults in the code, live against the kernel."""

from ipaddress import ip_address

import pytest

from common.bus.endpoints import default_bus
from common.calibration.output_settings import OutputSettings
from master.commands.options import CALIB_JSON, HERE_BEACON, HERE_BIND
from master.console.state import ConsoleSettings
from master.outputs.rerun import viewer_arguments
from slave.uplink import ANYWHERE
from tests.sockets import PAGE, Listener, rows, undocumented


def addresses(program: str, protocol: str) -> set[str]:
    """What the table says of a program."""
    return {row.address for row in rows() if (row.program, row.protocol) == (program, protocol)}


def test_the_table_has_the_defaults_of_the_code() -> None:
    console, outputs = ConsoleSettings(CALIB_JSON), OutputSettings(version=1, name="default")
    assert addresses("master run", "udp") == {HERE_BIND}
    for environment in ({}, {"PHALANX_KEYS": "/keys"}):
        assert addresses("master run", "tcp") == {default_bus(environment).split("/")[1]}
    assert addresses("master console", "tcp") == {f"{console.host}:{console.port}"}
    assert f"{outputs.web.host}:{outputs.web.port}" in addresses("master send", "tcp")
    assert {one.rpartition(":")[0] for one in addresses("slave *", "udp")} == {ANYWHERE}
    assert any(one.endswith(HERE_BEACON.rpartition(":")[2]) for one in addresses("slave *", "udp"))
    for arguments in (viewer_arguments(1, None), viewer_arguments(1, 2)):
        assert arguments[arguments.index("--bind") + 1] == "127.0.0.1"


def test_only_slaves_and_lsl_listen_beyond_this_machine() -> None:
    beyond = {row.program for row in rows() if not ip_address(row.address.rpartition(":")[0]).is_loopback}
    assert beyond == {"slave *", "master send"}
    assert "liblsl itself listens on every network" in PAGE.read_text()


@pytest.mark.parametrize(
    ("listener", "known"),
    [
        (Listener("master run", "tcp", "127.0.0.1", 47802), True),
        (Listener("master run", "tcp", "0.0.0.0", 47802), False),
        (Listener("master run", "udp", "::", 1), False),
        (Listener("master export", "tcp", "127.0.0.1", 1), False),
        (Listener("slave run", "udp", "0.0.0.0", 47800), True),
        (Listener("slave run", "tcp", "127.0.0.1", 22), False),
    ],
)
def test_what_the_table_does_not_have_is_seen(listener: Listener, known: bool) -> None:
    assert (undocumented({listener}, rows()) == []) == known
