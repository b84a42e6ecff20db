"""The examples are programs beside the packages, not in them: tests load them from their files."""

import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType


def example(root: Path, name: str) -> ModuleType:
    """The module docs/examples/<name>.py."""
    spec = importlib.util.spec_from_file_location(name, root / "docs" / "examples" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    """Look again until it holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.02)
