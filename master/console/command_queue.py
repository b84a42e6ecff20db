"""Queue that sends a page's changes to a process, one at a time, newest only.

Dragging a slider therefore floods nobody.
"""

import asyncio
from collections.abc import Callable, Mapping
from typing import Generic, TypeVar

from nicegui import background_tasks

from common.errors import PhalanxError

AnswerT = TypeVar("AnswerT")


class CommandQueue(Generic[AnswerT]):
    """Queue of pending changes, merged by key, while the last one is being sent."""

    def __init__(
        self,
        send: Callable[[Mapping[str, object]], AnswerT],
        on_answer: Callable[[AnswerT], object],
        on_error: Callable[[str], object],
    ) -> None:
        """Start with an empty queue.

        Args:
            send: Sends a change and waits for the answer, on a thread.
            on_answer: Called with the answer, on the page's loop, unless more is to be sent already.
            on_error: Called with the error's text as it is.
        """
        self._send, self._on_answer, self._on_error = send, on_answer, on_error
        self._waiting: dict[tuple[str, str | None], object] = {}
        self._task: asyncio.Task[None] | None = None

    @property
    def busy(self) -> bool:
        """Whether something is on its way."""
        return self._task is not None and not self._task.done()

    def change(self, key: str, value: object, part: str | None = None) -> None:
        """Send `key: value` soon.

        With `part`, only one entry of the map `key` is sent. The newest value of each counts.
        """
        self._waiting[key, part] = value
        if not self.busy:
            self._task = background_tasks.create(self._work(), name="commands")

    async def _work(self) -> None:
        while self._waiting:
            quiet_s = 0.12  # so long nothing more changes until the change is sent
            await asyncio.sleep(quiet_s)
            waiting, self._waiting = self._waiting, {}
            try:
                answer = await asyncio.to_thread(self._send, _merged(waiting))
            except PhalanxError as error:
                self._on_error(str(error))
            else:
                if not self._waiting:
                    self._on_answer(answer)


def _merged(waiting: Mapping[tuple[str, str | None], object]) -> dict[str, object]:
    """Keys and values; the parts of one key as a map."""
    out: dict[str, object] = {key: value for (key, part), value in waiting.items() if part is None}
    for key in {key for key, part in waiting if part is not None}:
        out[key] = {
            part: value for (other, part), value in waiting.items() if other == key and part is not None
        }
    return out
