"""`phalanx-master check`: the checklist of a running master in the terminal; the exit code says whether all is well."""

import sys
from typing import Annotated

import typer

from common.bus import Subscription
from common.errors import BusError
from common.messages import CheckItem, Checklist
from common.streams import MASTER
from master.master_bus import join_bus
from master.options import HERE_BUS, BusEnd, Site

ANSWER_S = 3.0  # a master tells once a second


def check(
    bus: BusEnd = HERE_BUS,
    site: Site = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="Go on until Ctrl-C, and print the list whenever it changes.")
    ] = False,
) -> None:
    """Print what is not as it should be; exit code 1 if there is anything, 0 if all is well.

    What each line means, how it is measured and what to do: docs/checklist.md.

    Examples:

      phalanx-master check

      phalanx-master check --watch

      phalanx-master check --keys DIR --bus tls/192.168.1.2:47802 && echo ready
    """
    items: tuple[CheckItem, ...] = ()
    connection = join_bus(bus, site)
    try:
        lists = connection.subscribe("checklist", MASTER)
        items = newest(lists, bus)
        typer.echo("\n".join(lines(items)))
        while watch:
            items = _follow(lists, items, bus)
    except KeyboardInterrupt:
        pass
    finally:
        connection.close()
    if items:
        sys.exit(1)


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
        typer.echo("\n".join(["", *lines(items)]))
    return items
