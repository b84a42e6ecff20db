"""Hands and objects for web pages.

JSON by WebSocket in the joint order of WebXR, and the page that shows them.

On this machine it is plain, for whoever is on it. Where other machines reach it, it is encrypted by the certificate of
this machine's pages and wants to be shown a key (docs/security.md); with --open it is plain there, but wants the key.
"""

import os
import secrets
from collections.abc import Mapping

from common.calibration.output_settings import WebOutput
from common.errors import PhalanxError
from common.messages import HandPose, ObjectPose, ResultMessage
from master.outputs.web import object_json, webxr_json
from master.outputs.web.listening import (
    is_loopback,
    is_open,
    page_certificate,
    places_of,
    private_folder,
    read_private,
    write_private,
)
from master.outputs.web.server import RequestFilter, WebServer

KEY_FILE = "web.key"


def request_filter_of(settings: WebOutput, environment: Mapping[str, str]) -> RequestFilter:
    """What stands before the page: nothing on this machine, key and TLS elsewhere.

    Raises:
        PhalanxError: Key or certificate cannot be read or written.
    """
    if is_loopback(settings.host):
        return RequestFilter()
    folder = private_folder(environment)
    key_bytes = 10  # 80 bits: who guesses has to ask us each time
    if not (folder / KEY_FILE).exists():
        write_private(folder / KEY_FILE, secrets.token_hex(key_bytes).encode())
    key = read_private(folder / KEY_FILE).decode("ascii", "replace").strip()
    if len(key) < 2 * key_bytes or not key.isalnum():
        raise PhalanxError(f"{folder / KEY_FILE}: not a key; delete it, and a new one is made")
    tls = None if is_open(environment) else page_certificate(folder, settings.host).context
    return RequestFilter(key, tls)


def address_of(settings: WebOutput, environment: Mapping[str, str]) -> str:
    """What to open in a browser, by blanks: with the key, where one is needed."""
    request_filter = request_filter_of(settings, environment)
    asked = "" if request_filter.key is None else f"?key={request_filter.key}"
    scheme = "http" if request_filter.tls is None else "https"
    return " ".join(f"{scheme}://{place}:{settings.port}/{asked}" for place in places_of(settings.host))


class WebSink:
    """A `Sink` for browsers.

    Attributes:
        server: Who is connected, and how much slow clients skipped.
    """

    def __init__(self, settings: WebOutput, environment: Mapping[str, str] | None = None) -> None:
        """Listen at the address of the settings.

        Raises:
            PhalanxError: The address cannot be had, three.js is not installed, or key or certificate cannot be used.
        """
        request_filter = request_filter_of(settings, os.environ if environment is None else environment)
        self.server = WebServer(settings.host, settings.port, request_filter=request_filter)

    def write(self, message: ResultMessage) -> None:
        """Offer a hand or an object to every client.

        Costs nothing while there is none. Other messages are ignored.

        Raises:
            PhalanxError: The server has ended.
        """
        if self.server.clients == 0:
            return
        if isinstance(message, HandPose):
            self.server.offer(f"hand {message.hand}", webxr_json(message))
        elif isinstance(message, ObjectPose):
            self.server.offer(f"object {message.object}", object_json(message))

    def close(self) -> None:
        """End all connections and free the port. Safe to call twice."""
        self.server.close()
