"""Hands and objects for web pages: JSON by WebSocket in the joint order of WebXR, and the page that shows them."""

from common.messages import HandPose, ObjectPose, Told
from common.output_settings import WebOutput
from master.web import object_json, webxr_json
from master.web.server import WebServer


class WebSink:
    """A `Sink` for browsers.

    Attributes:
        server: Who is connected, and how much slow clients skipped.
    """

    def __init__(self, settings: WebOutput) -> None:
        """Listen at the address of the settings.

        Raises:
            PhalanxError: The address cannot be had, or three.js is not installed.
        """
        self.server = WebServer(settings.host, settings.port)

    def write(self, message: Told) -> None:
        """Offer a hand or an object to every client; costs nothing while there is none. Others are left alone.

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
