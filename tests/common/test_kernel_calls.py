"""What has no door from Python is called by kernels alone: the interpreter would die of it, not raise."""

import ast
import re
from pathlib import Path

import pytest

CLOSED, KERNELS = {"inner", "inlined"}, {"kernel", "inner", "inlined"}


def decorated(node: ast.FunctionDef, names: set[str]) -> bool:
    return any(isinstance(one, ast.Name) and one.id in names for one in node.decorator_list)


def closed_functions(trees: dict[Path, ast.Module]) -> set[tuple[str, str]]:
    """Module and name of each function that only kernels may call."""
    return {
        (".".join(path.with_suffix("").parts), node.name)
        for path, tree in trees.items()
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and decorated(node, CLOSED)
    }


def called_from_python(path: Path, tree: ast.Module, closed: set[tuple[str, str]]) -> list[str]:
    """Calls of closed functions outside of kernels, as `file:line name`."""
    here = ".".join(path.with_suffix("").parts)
    known = {name for module, name in closed if module == here}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            known |= {a.asname or a.name for a in node.names if (node.module, a.name) in closed}
    kernels = [
        node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and decorated(node, KERNELS)
    ]
    within = {id(node) for kernel in kernels for node in ast.walk(kernel)}
    return [
        f"{path}:{node.lineno} {node.func.id}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in known
        and id(node) not in within
    ]


@pytest.fixture(scope="module")
def trees(root: Path) -> dict[Path, ast.Module]:
    """Files that have such a function or import from one that has: no other can call any, and parsing takes time."""
    rooms = ("common", "master", "slave", "bench", "tests")
    paths = [path for room in rooms for path in (root / room).rglob("*.py")]
    texts = {path.relative_to(root): path.read_text() for path in paths}
    having = {
        path: ast.parse(text) for path, text in texts.items() if re.search(r"^@(inner|inlined)\b", text, re.M)
    }
    modules = {re.escape(module) for module, _ in closed_functions(having)}
    importing = re.compile(rf"^\s*from ({'|'.join(sorted(modules))}) import\b", re.M)
    users = [path for path, text in texts.items() if path not in having and importing.search(text)]
    return having | {path: ast.parse(texts[path]) for path in users}


def test_python_calls_no_function_that_only_kernels_may_call(trees: dict[Path, ast.Module]) -> None:
    closed = closed_functions(trees)
    assert len(closed) > 20
    assert not [call for path, tree in trees.items() for call in called_from_python(path, tree, closed)]


def test_a_planted_call_is_found() -> None:
    path, planted = (
        Path("common/a.py"),
        "@inner\ndef f(x):\n    return x\n\n@kernel\ndef g(x):\n    return f(x)\n\nf(1)\n",
    )
    trees = {path: ast.parse(planted)}
    assert called_from_python(path, trees[path], closed_functions(trees)) == ["common/a.py:9 f"]
    user = ast.parse("from common.a import f as h\ndef k():\n    return h(2)\n")
    assert called_from_python(Path("master/b.py"), user, closed_functions(trees)) == ["master/b.py:3 h"]
