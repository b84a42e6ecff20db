"""`phalanx check`: the checklist of a running master in the terminal.

The exit code states whether all is well.
"""

from argparse import Namespace

from common.bus.bus import Subscription
from common.command_line import echo
from common.errors import BusError
from common.messages import CheckItem, Checklist
from common.messages.streams import MASTER
from master.run.process import join_bus

ANSWER_S = 3.0  # a master reports once a second


def check(options: Namespace) -> int:
    """Print current problems; return exit code 1 if there is any, else 0."""
    items: tuple[CheckItem, ...] = ()
    connection = join_bus(options.bus, options.site)
    try:
        lists = connection.subscribe("checklist", MASTER)
        items = newest(lists, options.bus)
        echo("\n".join(lines(items)))
        while options.watch:
            items = _follow(lists, items, options.bus)
    except KeyboardInterrupt:
        pass
    finally:
        connection.close()
    return 1 if items else 0


def newest(lists: Subscription, where: str) -> tuple[CheckItem, ...]:
    """The next list.

    Raises:
        BusError: None comes.
    """
    answer = lists.get(ANSWER_S)
    if not isinstance(answer, Checklist):
        raise BusError(f"no checklist on {where} for {ANSWER_S:g} s: does a master run there?")
    return answer.items


def lines(items: tuple[CheckItem, ...]) -> list[str]:
    """The list for a person."""
    if not items:
        return ["all is well"]
    wide = max(len(item.code) for item in items)
    out: list[str] = []
    for item in items:
        out += [f"{item.code:<{wide}}  {item.subject}", f"  {item.sentence}", f"  -> {item.fix}"]
    return out


def _follow(lists: Subscription, before: tuple[CheckItem, ...], where: str) -> tuple[CheckItem, ...]:
    """Wait for a list; print it where it is another one."""
    items = newest(lists, where)
    if [(one.code, one.subject) for one in items] != [(one.code, one.subject) for one in before]:
        echo("\n".join(["", *lines(items)]))
    return items
