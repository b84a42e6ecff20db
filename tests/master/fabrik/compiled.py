"""How many types of arguments the kernels of rooms are compiled for: none is compiled while a hand is tracked."""

import importlib
import pkgutil
from types import ModuleType
from typing import Any


def compiled(*rooms: ModuleType) -> dict[str, int]:
    """The count of each kernel, by its name."""
    counts: dict[str, int] = {}
    for room in rooms:
        for module in pkgutil.iter_modules(room.__path__, f"{room.__name__}."):
            if module.name.endswith("__main__"):
                continue
            kernels: dict[str, Any] = vars(importlib.import_module(module.name))
            counts |= {
                f"{module.name}.{name}": len(kernel.signatures)
                for name, kernel in kernels.items()
                if hasattr(kernel, "signatures")
            }
    return counts
