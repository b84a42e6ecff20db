"""The registry has foreign projects called common, master, slave and deploy: ours must be the ones imported."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGES = ("common", "slave", "master", "deploy")


def foreign(packages: tuple[str, ...], root: Path) -> list[str]:
    """Packages whose code does not lie under `root`."""
    wrong: list[str] = []
    for name in packages:
        file = importlib.import_module(name).__file__
        if file is None or not Path(file).resolve().is_relative_to(root / name):
            wrong.append(f"{name}: {file}")
    return wrong


def test_the_packages_in_this_process_are_ours(root: Path) -> None:
    assert foreign(PACKAGES, root) == []


def test_the_check_sees_a_foreign_package(root: Path) -> None:
    assert foreign(("json",), root) != []


def test_an_installed_interpreter_finds_ours_from_any_folder(root: Path, tmp_path: Path) -> None:
    """What the scripts see: no PYTHONPATH, no current folder to help."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    code = f"import importlib.metadata as m, {', '.join(PACKAGES)}; m.distribution('phalanx-hand')\n"
    code += f"print(*(one.__file__ for one in ({', '.join(PACKAGES)})), sep='\\n')"
    result = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if "PackageNotFoundError" in result.stderr or "ModuleNotFoundError" in result.stderr:
        pytest.skip("phalanx-hand is not installed in this interpreter: run the tests by `make test`")
    assert result.returncode == 0, result.stderr
    found = [Path(line).resolve() for line in result.stdout.splitlines()]
    assert found == [root / package / "__init__.py" for package in PACKAGES]
