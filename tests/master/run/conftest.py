"""What ends with a test of a live master."""

from collections.abc import Iterator
from contextlib import ExitStack

import pytest


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    """What is put there is closed with the test."""
    with ExitStack() as stack:
        yield stack
