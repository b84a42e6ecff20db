"""Web sockets of the console carry camera pictures, and hands for the 3D view.

Each message is sent when the page has shown the one before, so a slow page or network sees fewer, never old
ones. An open socket is a look at the camera: when it closes, the camera stops showing itself within seconds.
"""

import asyncio
import struct
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, suppress
from typing import Annotated

import msgspec
from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from nicegui import app as nicegui_app

from common.messages import MAX_MARKERS, HandPose, Name
from common.messages.streams import sender_of
from master.console.state import ConsoleState
from master.outputs.web import object_json, static_dir, three_js_path, webxr_json

_POLL_S = 0.03
_TIME = struct.Struct(">q")  # before each picture: when it was taken [ns]


class _MaskRequest(msgspec.Struct):
    mask: Annotated[tuple[Name, ...], msgspec.Meta(max_length=MAX_MARKERS)]


class Shown:
    """Whether the page has shown the last message, and which markers it wants tinted."""

    def __init__(self) -> None:
        self.ready = True
        self.mask: tuple[str, ...] = ()

    def on_text(self, text: str) -> None:
        """Take one message of the page; what is none of ours is left alone."""
        if text == "next":
            self.ready = True
        elif len(text) <= 8192:
            with suppress(msgspec.MsgspecError, RecursionError):
                self.mask = msgspec.json.decode(text, type=_MaskRequest).mask


def serve_sockets(app: FastAPI, state: ConsoleState) -> None:
    """Add the web sockets to `app`, and the files of the 3D view to the pages."""
    nicegui_app.add_static_file(local_file=three_js_path(), url_path="/hand-view/three.js")
    nicegui_app.add_static_files("/hand-view", static_dir())

    async def camera_socket(socket: WebSocket, camera: str) -> None:
        if camera not in {*state.cameras(), *state.alive}:
            not_ours = 4004
            await socket.close(not_ours)
            return
        async with _page(socket) as shown:
            await _send_pictures(socket, state, camera, shown)

    async def hands_socket(socket: WebSocket) -> None:
        async with _page(socket) as shown:
            await _send_hands(socket, state, shown)

    app.add_api_websocket_route("/console/camera/{camera}", camera_socket)
    app.add_api_websocket_route("/console/hands", hands_socket)


@asynccontextmanager
async def _page(socket: WebSocket) -> AsyncGenerator[Shown]:
    """Accept the page's socket and listen while the block runs, until the page goes."""
    await socket.accept()
    shown = Shown()
    sending = asyncio.current_task()

    async def listen() -> None:
        try:
            while True:
                shown.on_text(await socket.receive_text())
        except (WebSocketDisconnect, RuntimeError, KeyError):
            if sending is not None:
                sending.cancel()

    listener = asyncio.create_task(listen())
    try:
        yield shown
    except (asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
        pass  # the page is gone
    finally:
        listener.cancel()


async def _send_pictures(socket: WebSocket, state: ConsoleState, camera: str, shown: Shown) -> None:
    loop = asyncio.get_running_loop()
    look_at, last_ns, note = 0.0, None, None
    asked = shown.mask
    while True:
        if loop.time() >= look_at or shown.mask != asked:
            asked, look_at = shown.mask, loop.time() + 1.0
            state.look(camera, shown.mask)
        picture = state.preview(camera)
        if picture is None:
            why = state.preview_error(camera) or "waiting for a picture …"
            if why != note:
                await socket.send_text(note := why)
                shown.ready = True
        elif shown.ready and picture.t_ns != last_ns:
            shown.ready, last_ns, note = False, picture.t_ns, None
            await socket.send_bytes(_TIME.pack(picture.t_ns) + picture.jpeg)
        await asyncio.sleep(_POLL_S)


async def _send_hands(socket: WebSocket, state: ConsoleState, shown: Shown) -> None:
    last: dict[tuple[str, str], int] = {}  # (type, name) -> time of the pose that was sent
    while True:
        new = [
            pose
            for pose in (*state.poses.values(), *state.objects.values())
            if last.get((type(pose).__name__, sender_of(pose))) != pose.t_ns
        ]
        if shown.ready and new:
            last |= {(type(pose).__name__, sender_of(pose)): pose.t_ns for pose in new}
            shown.ready = False
            lines = [webxr_json(pose) if isinstance(pose, HandPose) else object_json(pose) for pose in new]
            await socket.send_text(b"\n".join(lines).decode())
        await asyncio.sleep(_POLL_S)
