"""The house rules that a machine can check. Every guard is shown a planted violation first, so that it bites."""

import ast
import functools
import graphlib
import os
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, TypeVar

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("common", "slave", "master", "deploy")
OURS = frozenset(PACKAGES)
DRIVERS = frozenset({"serial", "smbus2", "picamera2", "libcamera", "gpiod", "openvr"})

# Who may not import whom. `rerun` in master and the drivers in slave have files of their own, see ONLY_IN.
FORBIDDEN: dict[str, frozenset[str]] = {
    "common": frozenset({"slave", "master", "deploy", "rerun"}) | DRIVERS,
    "slave": frozenset({"master", "deploy", "rerun"}),
    "master": frozenset({"slave", "deploy"}) | DRIVERS,
    "deploy": frozenset({"common", "slave", "master", "rerun", "zenoh"}) | DRIVERS,
}
# The only files that know a library.
ONLY_IN: dict[str, tuple[str, ...]] = {
    "zenoh": (
        "common/bus/zenoh_bus.py",
        "master/outputs/network/ros2.py",
    ),  # the second: ROS 2's own network
    "nicegui": ("master/console/*.py",),
    "rerun": ("master/outputs/rerun*.py",),
    "rerun_cli": ("master/outputs/rerun*.py",),
    "serial": ("slave/imu/*.py",),
    "smbus2": ("slave/imu/*.py", "slave/lights/*.py"),
    "c3d": ("master/mocap/read.py",),
    "gpiod": ("slave/lights/gpio*.py",),
    "picamera2": ("slave/cameras/picamera2*.py",),
    "libcamera": ("slave/cameras/picamera2*.py",),
    "numba": ("common/kernels.py", "slave/markers/fast*.py"),
    "openvr": ("slave/objects/openvr*.py",),
    "pylsl": ("master/outputs/network/lsl*.py",),
    "pythonosc": ("master/outputs/network/osc*.py",),
}
NEVER = frozenset({"pickle", "cPickle", "marshal", "shelve", "dill", "cloudpickle", "joblib"})
# Import name -> name in pyproject.toml, where they differ. picamera2 and libcamera come with the Pi's system.
DISTRIBUTION = {
    "cv2": "opencv-python-headless",
    "zenoh": "eclipse-zenoh",
    "serial": "pyserial",
    "pythonosc": "python-osc",
    "rerun": "rerun-sdk",
    "rerun_cli": "rerun-sdk",
}
SYSTEM = frozenset({"picamera2", "libcamera"})
# Files of common that the slave never loads may use what only the PC has.
PC_ONLY = {
    "common/kernels.py": frozenset({"numba"}),
    "common/recording/messages.py": frozenset({"mcap"}),
    "common/recording/mcap_file.py": frozenset({"mcap", "zstandard"}),
}
# Words of version 0.1 for what estimation, vision, robotics and networking have words for.
PRIVATE = frozenset(
    {
        "told",
        "foretold",
        "tells",
        "telling",
        "belief",
        "beliefs",
        "believed",
        "habit",
        "habits",
        "doubt",
        "doubts",
        "certainty",
        "misfit",
        "surprise",
        "surprised",
        "heir",
        "warden",
        "hurry",
        "twin",
        "twins",
        "whereabouts",
        "rival",
        "rivals",
        "wearer",
        "sighting",
        "sightings",
        "instant",
        "instants",
        "afresh",
        "peek",
        "stray",
        "strayed",
        "valley",
        "valleys",
        "mind",
        "worth",
        "heard",
        "hear",
        "hears",
        "says",
        "said",
        "stranger",
        "strangers",
        "tally",
        "gauges",
        "lesson",
        "lessons",
        "taught",
        "lasting",
        "corridor",
        "corridors",
        "relit",
        "picker",
        "picking",
        "flesh",
        "mounting",
    }
)
# Numbers of formulas, sizes of what hands and vectors have, and units; what is less or more is of rounding or ns.
FORMULA = frozenset({3, 4, 5, 6, 7, 8, 12, 36, 576, 1e2, 1e3})
ROUNDING, HUGE, JOINTS = 1e-5, 1e9, 26
SHAPES = frozenset(
    {"range", "array", "part", "empty", "zeros", "ones", "full", "eye", "arange", "reshape", "slice"}
)
FIRST_LINE, FILE_LINES = 79, 580
SHARED = frozenset({"common"})  # nothing enters or leaves the language of both sides
# No more than there are: each change leaves fewer.
MODULE_CONSTANTS, PROTOCOLS = 560, 11
FILES, LINES, FOLDER_FILES, BENCH_LINES = 450, 105_566, 20, 9_064
# Calls that touch the world; none may run because a module is imported.
DEVICES = frozenset(
    {
        "open",
        "socket",
        "create_connection",
        "VideoCapture",
        "Serial",
        "SMBus",
        "Picamera2",
        "Thread",
        "Process",
        "Popen",
        "run",
        "sleep",
        "read_text",
        "read_bytes",
        "write_text",
        "write_bytes",
        "mkdir",
        "setNumThreads",
        "basicConfig",
        "seed",
        "spawn",
        "init",
    }
)


@functools.cache
def sources(package: str) -> list[tuple[str, str]]:
    """(path below the root, text) of every file of one package."""
    files = sorted((ROOT / package).rglob("*.py"))
    assert files, f"no files under {package}/: the check would pass on nothing"
    return [(path.relative_to(ROOT).as_posix(), path.read_text()) for path in files]


@functools.cache
def tree_of(text: str) -> ast.Module:
    """The syntax tree of a text, once for all guards."""
    return ast.parse(text)


@functools.cache
def by_type(text: str) -> dict[type[ast.AST], list[ast.AST]]:
    """All nodes of a text, by their types: a walk takes far longer than what a guard then looks at."""
    found: dict[type[ast.AST], list[ast.AST]] = {}
    for node in ast.walk(tree_of(text)):
        found.setdefault(type(node), []).append(node)
    return found


NodeT = TypeVar("NodeT", bound=ast.AST)


def nodes(text: str, *kinds: type[NodeT]) -> Iterator[NodeT]:
    """All nodes of a text of these types."""
    for kind in kinds:
        yield from (node for node in by_type(text).get(kind, []) if isinstance(node, kind))


def called(node: ast.Call) -> str:
    """`f` of `f()` and of `a.b.f()`."""
    name = node.func
    return name.id if isinstance(name, ast.Name) else name.attr if isinstance(name, ast.Attribute) else ""


@functools.cache
def imported(text: str) -> frozenset[str]:
    """Top-level names of all imports, also those inside functions."""
    found = {alias.name.split(".")[0] for node in nodes(text, ast.Import) for alias in node.names}
    for node in nodes(text, ast.ImportFrom):
        if node.module is not None and node.level == 0:
            found.add(node.module.split(".")[0])
    for node in nodes(text, ast.Call):
        if called(node) in {"__import__", "import_module"}:
            found |= {str(arg.value).split(".")[0] for arg in node.args[:1] if isinstance(arg, ast.Constant)}
    return frozenset(found)


def wrong_side(path: str, text: str) -> set[str]:
    """Imports that this package, or this file, may not have."""
    names = imported(text)
    unexpected = {
        name
        for name, files in ONLY_IN.items()
        if name in names and not any(fnmatch(path, file) for file in files)
    }
    return unexpected | (names & (FORBIDDEN[path.split("/")[0]] | NEVER))


def undeclared(path: str, text: str) -> set[str]:
    """Third-party imports that pyproject.toml does not promise to this package."""
    project = _project()
    promised = [*project["dependencies"]]
    if path.startswith(("master/", "deploy/")):
        promised += project["optional-dependencies"]["master"]
    if fnmatch(path, "slave/lights/gpio*.py"):
        promised += project["optional-dependencies"]["wrist"]
    if fnmatch(path, "slave/markers/fast*.py"):
        promised += project["optional-dependencies"]["fast"]
    if fnmatch(path, "slave/objects/openvr*.py"):
        promised += project["optional-dependencies"]["vive"]
    if fnmatch(path, "master/outputs/network/lsl*.py"):
        promised += project["optional-dependencies"]["lsl"]
    have = {re.split(r"[\[<>=~!; ]", item)[0] for item in promised} | SYSTEM | PC_ONLY.get(path, frozenset())
    names = imported(text) - OURS - sys.stdlib_module_names
    return {name for name in names if DISTRIBUTION.get(name, name) not in have}


@functools.cache
def _project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def relative_imports(path: str, text: str) -> set[str]:
    """`from . import x`."""
    return {ast.unparse(node) for node in nodes(text, ast.ImportFrom) if node.level > 0}


def bare_excepts(path: str, text: str) -> set[str]:
    """`except:` and `except BaseException:` that do not raise again."""
    return {
        f"line {node.lineno}"
        for node in nodes(text, ast.ExceptHandler)
        if (node.type is None or ast.unparse(node.type) == "BaseException")
        and not any(isinstance(inner, ast.Raise) for inner in ast.walk(node))
    }


def prints(path: str, text: str) -> set[str]:
    """`print` outside the command lines."""
    if path.endswith("__main__.py"):
        return set()
    calls = nodes(text, ast.Call)
    return {
        f"line {one.lineno}" for one in calls if isinstance(one.func, ast.Name) and one.func.id == "print"
    }


def globals_written(path: str, text: str) -> set[str]:
    """`global x`: state that belongs to no object."""
    return {ast.unparse(node) for node in nodes(text, ast.Global)}


def import_time_work(path: str, text: str) -> set[str]:
    """What a module does when it is imported: bare calls, endless loops, open resources, devices.

    A loop that fills a table of constants is no work in this sense.
    """
    found: set[str] = set()
    for node in _executed(tree_of(text)):
        bare_call = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
        device = isinstance(node, ast.Call) and called(node) in DEVICES
        if bare_call or device or isinstance(node, (ast.While, ast.With, ast.Await)):
            found.add(f"line {getattr(node, 'lineno', 0)}: {ast.unparse(node).splitlines()[0]}")
    return found


def _executed(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes that run on import: the bodies of functions and lambdas wait, and so does the command line."""
    waits: list[ast.stmt | ast.expr] = []
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
        waits = [*node.body]
    elif isinstance(node, ast.Lambda):
        waits = [node.body]
    elif isinstance(node, ast.If) and "__name__" in ast.unparse(node.test):
        waits = [*node.body]
    for child in ast.iter_child_nodes(node):
        if child not in waits:
            yield child
            yield from _executed(child)


def private_words(path: str, text: str) -> set[str]:
    """Identifiers with a word that the field has another word for."""
    return {name for name in identifiers(text) if not PRIVATE.isdisjoint(_words(name))}


def identifiers(text: str) -> set[str]:
    """Every name that a text gives, reads or imports; what stands in strings and comments is none."""
    found: set[str] = set()
    for kind, same in by_type(text).items():
        for node in () if kind is ast.Constant else same:
            for _, value in ast.iter_fields(node):
                if isinstance(value, str):
                    found.add(value)
                elif isinstance(node, ast.Global | ast.Nonlocal):
                    found.update(value)
    return found


@functools.cache
def _words(name: str) -> frozenset[str]:
    return frozenset(part.lower() for part in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", name))


def numbers(path: str, text: str) -> set[str]:
    """Numbers in the pose's rooms that belong into their settings.

    Anywhere stand 0, 1, 2, a half, -1 and what guards rounding; within an index, slice, shape or range whole numbers
    up to the joints of a hand; within an expression `FORMULA`. What a name alone is set to is a setting, but for a
    layout: several names in capitals at once.
    """
    if not re.match(r"master/(estimator|fabrik)/(?!settings\.py)", path):
        return set()
    return set(_settings_in(tree_of(text), whole=False, inside=False))


def _settings_in(node: ast.AST, *, whole: bool, inside: bool) -> Iterator[str]:
    if (
        isinstance(node, ast.Constant)
        and isinstance(node.value, int | float)
        and type(node.value) is not bool
    ):
        size = abs(node.value)
        plain = size in {0, 0.5, 1, 2} or size <= ROUNDING or size >= HUGE
        in_shape = inside and type(size) is int and size <= JOINTS
        if not (plain or in_shape or (size in FORMULA and not whole)):
            yield f"line {node.lineno}: {node.value}"
    names = ast.unparse(node.targets[0]) if isinstance(node, ast.Assign) else ""
    layout = "," in names and all(name.isupper() for name in re.findall(r"\w+", names))
    for key, value in ast.iter_fields(node):
        bound = key in {"value", "defaults", "kw_defaults"} and not isinstance(
            node, ast.AugAssign | ast.Return
        )
        bound = (bound or (whole and isinstance(node, ast.Tuple | ast.UnaryOp))) and not layout
        index = key == "slice" or (key == "args" and isinstance(node, ast.Call) and called(node) in SHAPES)
        within = inside and isinstance(
            node, ast.BinOp | ast.UnaryOp | ast.Tuple | ast.Slice | ast.Call | ast.Starred
        )
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _settings_in(child, whole=bound, inside=index or layout or within)


def long_first_lines(path: str, text: str) -> set[str]:
    """Docstrings whose first line is longer than 79 characters."""
    lines = [
        (ast.get_docstring(node) or "").partition("\n")[0]
        for node in nodes(text, ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    ]
    return {line for line in lines if len(line) > FIRST_LINE}


def too_long(path: str, text: str) -> set[str]:
    """A file with more lines than a reader holds in mind."""
    lines = text.count("\n")
    return {f"{lines} lines"} if lines > FILE_LINES else set()


def room_without_sentence(path: str, text: str) -> set[str]:
    """A room whose `__init__` does not say what it is for, what enters and what leaves."""
    if not path.endswith("__init__.py"):
        return set()
    sentence = (ast.get_docstring(tree_of(text)) or "").partition("\n")[0]
    said = ":" in sentence and "enter" in sentence and ("leave" in sentence or "go to" in sentence)
    return set() if said or path.removesuffix("/__init__.py") in SHARED else {sentence or "nothing"}


def module_constants(text: str) -> int:
    """How many names of a module are bound to plain numbers."""
    count = 0
    for node in tree_of(text).body:
        targets = node.targets if isinstance(node, ast.Assign) else []
        value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
        if isinstance(node, ast.AnnAssign) and value is not None and _is_number(value):
            count += 1
        elif targets and value is not None and _is_number(value):
            count += len(targets)
        elif targets and isinstance(value, ast.Tuple) and isinstance(targets[0], ast.Tuple):
            count += sum(map(_is_number, value.elts))
    return count


def _is_number(node: ast.expr) -> bool:
    if isinstance(node, ast.UnaryOp):
        return _is_number(node.operand)
    if isinstance(node, ast.BinOp):
        return _is_number(node.left) and _is_number(node.right)
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def protocols(text: str) -> int:
    """How many seams a file declares."""
    return sum(
        any("Protocol" in ast.unparse(base) for base in node.bases) for node in nodes(text, ast.ClassDef)
    )


Guard = Callable[[str, str], set[str]]

# guard, file it is planted in, violation, and a neighbour that is allowed
PLANTED: list[tuple[Guard, str, str, str]] = [
    (wrong_side, "common/x.py", "def late():\n    from master.fabrik import depth\n", "import common.clock"),
    (wrong_side, "common/x.py", "import rerun as rr", "import re"),
    (wrong_side, "common/bus/bus.py", "import zenoh", "import common.bus.zenoh_bus"),
    (wrong_side, "slave/app.py", "from master import ingest", "from common import bus"),
    (wrong_side, "slave/app.py", "import serial", "import common"),
    (wrong_side, "slave/app.py", "from smbus2 import SMBus", "import slave.imu"),
    (wrong_side, "slave/cameras/v4l2.py", "from picamera2 import Picamera2", "import cv2"),
    (wrong_side, "master/run/app.py", "import slave.app", "import master.run.ingest"),
    (
        wrong_side,
        "master/run/app.py",
        "importlib.import_module('slave.app')",
        "importlib.import_module('master.run.app')",
    ),
    (wrong_side, "master/run/app.py", "import rerun", "import master.outputs.rerun"),
    (wrong_side, "master/run/app.py", "if True:\n    import pickle", "import json"),
    (wrong_side, "deploy/demo.py", "import common.clock", "import subprocess"),
    (undeclared, "slave/app.py", "import starlette", "import cv2, numpy, msgspec"),
    (undeclared, "master/run/app.py", "import pandas", "import starlette, rerun, scipy.optimize"),
    (undeclared, "slave/markers/centroid.py", "import numba", "import cv2"),
    (undeclared, "slave/markers/fast.py", "import scipy", "import numba"),
    (relative_imports, "slave/app.py", "from . import cameras", "from slave import cameras"),
    (
        bare_excepts,
        "slave/app.py",
        "try:\n    x()\nexcept:\n    pass",
        "try:\n    x()\nexcept OSError:\n    pass",
    ),
    (
        bare_excepts,
        "slave/app.py",
        "try:\n    x()\nexcept BaseException:\n    pass",
        "try:\n    x()\nexcept:\n    raise",
    ),
    (prints, "slave/app.py", "def f():\n    print('x')", "def f():\n    log.info('x')"),
    (globals_written, "slave/app.py", "def f():\n    global x\n    x = 1", "def f():\n    x = 1"),
    (
        import_time_work,
        "slave/app.py",
        "camera = cv2.VideoCapture(0)",
        "def f():\n    return cv2.VideoCapture(0)",
    ),
    (import_time_work, "slave/app.py", "class A:\n    s = socket.socket()", "class A:\n    n = max(1, 2)"),
    (import_time_work, "slave/app.py", "def f(s=open('x')): ...", "f = lambda: open('x')"),
    (import_time_work, "slave/app.py", "main()", "if __name__ == '__main__':\n    main()"),
    (import_time_work, "slave/app.py", "for i in x:\n    f(i)", "for i in x:\n    y[i] = f(i)"),
    (import_time_work, "slave/app.py", "while x:\n    y = x.pop()", "y = [f(i) for i in x]"),
    (import_time_work, "slave/app.py", "if X:\n    with lock:\n        y = 1", "if X:\n    y = 1"),
    (private_words, "master/x.py", "def f(told_at): ...", "def f(result_at): ..."),
    (private_words, "master/x.py", "class HandBelief: ...", "class HandPrior: ..."),
    (private_words, "master/x.py", "def f():\n    global told", "def f():\n    global x  # told 'doubt'"),
    (private_words, "master/x.py", "from a import doubt as x", "x = 'doubt'"),
    (numbers, "master/fabrik/x.py", "def f(x):\n    return x < 0.02", "def f(x):\n    return x < 1e-9"),
    (numbers, "master/estimator/x.py", "gate = 4.0", "root = sqrt(4.0 * a)"),
    (numbers, "master/estimator/x.py", "def f(most=5): ...", "x = np.empty((26, 3))[:, 20]"),
    (numbers, "master/estimator/x.py", "NODES = 16", "FIRST, LAST = 9, 18"),
    (numbers, "master/estimator/x.py", "f(wide=-7.0)", "GATE = SETTINGS.gate"),
    (long_first_lines, "master/x.py", f'"""{80 * "x"}"""', f'"""{79 * "x"}\n\n{80 * "x"}"""'),
    (too_long, "master/x.py", 581 * "\n", 580 * "\n"),
    (
        room_without_sentence,
        "master/x/__init__.py",
        '"""All of x."""',
        '"""All of x: pixels enter, hands leave."""',
    ),
]
GUARDS: list[Guard] = list(dict.fromkeys(guard for guard, *_ in PLANTED))


@pytest.mark.parametrize(("guard", "path", "violation", "neighbour"), PLANTED)
def test_the_guard_bites_a_planted_violation_only(
    guard: Guard, path: str, violation: str, neighbour: str
) -> None:
    assert guard(path, violation)
    assert not guard(path, neighbour)


@pytest.mark.parametrize(
    ("name", "path"),
    [
        ("zenoh", "common/bus/zenoh_bus.py"),
        ("rerun", "master/outputs/rerun_viewer.py"),
        ("smbus2", "slave/imu/icm20948.py"),
        ("picamera2", "slave/cameras/picamera2.py"),
    ],
)
def test_the_one_file_of_a_library_may_use_it(name: str, path: str) -> None:
    assert not wrong_side(path, f"import {name}")


def test_only_the_command_line_prints() -> None:
    assert not prints("slave/__main__.py", "print('x')")


@pytest.mark.parametrize("guard", GUARDS, ids=lambda guard: guard.__name__)
def test_the_product_keeps_the_rule(guard: Guard) -> None:
    files = (file for package in PACKAGES for file in sources(package))
    assert not {path: bad for path, text in files if (bad := guard(path, text))}


def full_folders(paths: list[str]) -> set[str]:
    """Folders with more files than one finds one's way in."""
    counted = Counter(path.rpartition("/")[0] for path in paths)
    return {f"{folder}: {count} files" for folder, count in counted.items() if count > FOLDER_FILES}


def test_folders_stay_small_and_the_product_does_not_grow() -> None:
    assert full_folders([f"master/x/{k}.py" for k in range(21)])
    assert not full_folders([f"master/x/{k}.py" for k in range(20)])
    product = [(path, text) for package in PACKAGES for path, text in sources(package)]
    assert not full_folders([path for path, _ in product])
    assert len(product) <= FILES
    assert sum(text.count("\n") for _, text in product) <= LINES
    assert 1000 < sum(text.count("\n") for _, text in sources("bench")) <= BENCH_LINES


def test_numbers_at_the_top_of_files_and_seams_become_fewer() -> None:
    texts = [text for package in PACKAGES for _, text in sources(package)]
    assert module_constants("A = 1\nB, C = 2.0, -3 * 4\nD = f(5)\nE: int = 6") == 4
    assert protocols("class A(Protocol): ...\nclass B(Generic[T]): ...") == 1
    assert sum(map(module_constants, texts)) <= MODULE_CONSTANTS
    assert sum(map(protocols, texts)) <= PROTOCOLS


def test_the_page_of_the_architecture_has_the_sentence_of_every_room() -> None:
    page = (ROOT / "docs/architecture.md").read_text()
    rooms = {
        path.removesuffix("__init__.py"): (ast.get_docstring(tree_of(text)) or "").partition("\n")[0]
        for package in PACKAGES
        for path, text in sources(package)
        if path.endswith("__init__.py")
    }
    assert len(rooms) > 40
    assert not {room for room, sentence in rooms.items() if f"| `{room}` | {sentence} |" not in page}


QUIET = """
import importlib, sys, threading
def refuse(event, arguments):
    if event in {"socket.__new__", "subprocess.Popen", "os.system", "os.fork", "os.posix_spawn"}:
        raise RuntimeError(f"an import did {event} {arguments}")
sys.addaudithook(refuse)
for name in sys.argv[1:]:
    importlib.import_module(name)
    assert threading.active_count() == 1, f"{name} started a thread"
"""


def import_in_silence(modules: list[str], path: Path) -> subprocess.CompletedProcess[str]:
    """Import `modules` in a process where sockets, processes and threads are refused."""
    environment = os.environ | {"PYTHONPATH": str(path)}
    command = [sys.executable, "-c", QUIET, *modules]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def test_importing_every_module_touches_nothing() -> None:
    # Matplotlib asks the system for its fonts when it is imported for the first time on a machine.
    subprocess.run([sys.executable, "-c", "import matplotlib.font_manager"], check=True)
    # Drivers of hardware and the viewer load foreign libraries, which may do what they like.
    foreign = {pattern for patterns in ONLY_IN.values() for pattern in patterns}
    modules = [
        path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        for package in PACKAGES
        for path, _ in sources(package)
        if not any(fnmatch(path, pattern) for pattern in foreign)
    ]
    result = import_in_silence(modules, ROOT)
    assert result.returncode == 0, result.stderr


def imported_first(text: str) -> Iterator[str]:
    """Full names of what a module imports while it is imported itself; of `from a import b` both a and a.b."""
    types_only = {
        id(inner)
        for node in nodes(text, ast.If)
        if "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    for node in _executed(tree_of(text)):
        if id(node) in types_only:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def cycle_of_imports(files: dict[str, str]) -> list[str]:
    """Modules that import each other in a ring, from {path: text}; none if each can be imported first."""
    modules = {path.removesuffix(".py").removesuffix("/__init__").replace("/", "."): path for path in files}
    graph = {
        name: {other for other in imported_first(files[path]) if other in modules and other != name}
        for name, path in modules.items()
    }
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


def test_any_module_may_be_imported_first() -> None:
    """A cycle of imports shows only to those who enter it at the wrong place."""
    assert cycle_of_imports(dict(file for package in PACKAGES for file in sources(package))) == []


def test_a_planted_cycle_is_met() -> None:
    assert cycle_of_imports({"a/one.py": "from a import two\n", "a/two.py": "from a.one import X\n"})
    later = "def f() -> None:\n    from a.one import X\n"
    assert not cycle_of_imports({"a/one.py": "from a import two\n", "a/two.py": later})


@pytest.mark.parametrize(
    "line",
    [
        "import socket; s = socket.socket()",
        "import threading; threading.Thread(target=threading.Event().wait, daemon=True).start()",
        "import subprocess; subprocess.run(['true'])",
    ],
)
def test_the_silence_is_broken_by_a_planted_module(line: str, tmp_path: Path) -> None:
    (tmp_path / "planted.py").write_text(line + "\n")
    assert import_in_silence(["planted"], tmp_path).returncode != 0
