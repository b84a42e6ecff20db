"""Where a page is found that listens everywhere: at addresses that a browser can open, each of this machine."""

import socket

import pytest

from master.outputs.web.listening import places_of


@pytest.mark.parametrize(
    ("host", "place"), [("192.168.1.2", "192.168.1.2"), ("fe80::1", "[fe80::1]"), ("rig", "rig")]
)
def test_a_page_at_one_address_is_found_there(host: str, place: str) -> None:
    assert places_of(host) == (place,)


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_a_page_everywhere_is_found_at_each_address_of_this_machine(host: str) -> None:
    *beyond, here = places_of(host)
    assert here == "127.0.0.1"
    assert len(set(beyond)) == len(beyond)
    for place in (*beyond, here):
        with socket.create_server((place, 0)):  # only of this machine can be listened on
            assert not place.startswith("0.")
    assert not any(place.startswith("127.") for place in beyond)
