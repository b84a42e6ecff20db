"""The documents agree with the code where a machine can tell."""

import contextlib
import functools
import io
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import msgspec
import pytest

from bench.__main__ import ALL
from common.calibration import HandProfile, RigCalibration, parse
from common.errors import PhalanxError
from common.hand.model import FINGERS, JOINTS, HandModel
from common.hand.profiles import generated_profile
from master.cli.table import program
from slave.cli.table import PROGRAM

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted({*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "calib_json").rglob("*.md")})
FOLDERS = (".ci", "bench", "calib_json", "common", "deploy", "docs", "master", "slave", "tests")
TEXTS = {".c", ".css", ".html", ".js", ".json", ".md", ".py", ".scad", ".toml", ".txt", ".yml"}

# Row numbers of a list that no reader has, of three letters with 33, 25 and 18 rows. In quotes it is a value.
ROW = re.compile(r'(?<!["\w])(?:K(?:3[0-3]|[12]\d|[1-9])|D(?:2[0-5]|1\d|[1-9])|I(?:1[0-8]|[1-9]))(?!["\w])')

SOURCES = ROOT / "docs" / "theory" / "sources.md"
DATA = ("exact", "simulated", "rendered", "stand-in", "emulated", "real recordings", "not built")


def broken_links(page: Path, text: str) -> list[str]:
    """Relative links of `text` that lead nowhere."""
    links = [link.split("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in link]
    return [link for link in links if link and not (page.parent / link).exists()]


def test_every_link_leads_somewhere() -> None:
    found = {page.relative_to(ROOT).as_posix(): broken_links(page, page.read_text()) for page in PAGES}
    assert len(found) > 20
    assert {page: links for page, links in found.items() if links} == {}


def test_the_link_check_sees_a_broken_link() -> None:
    assert broken_links(ROOT / "README.md", "[x](docs/none.md#y) [z](https://example.org)") == [
        "docs/none.md"
    ]


def test_the_joint_table_is_the_joint_order() -> None:
    cells = re.findall(r"\| (\d+) \| ([a-z-]+) ", (ROOT / "docs" / "frames.md").read_text())
    assert tuple(name for _, name in sorted(cells, key=lambda cell: int(cell[0]))) == JOINTS
    assert [int(number) for number, _ in cells] == list(range(len(JOINTS)))


def test_the_finger_order_is_written_as_it_is() -> None:
    assert f"rows {', '.join(FINGERS)}" in (ROOT / "docs" / "frames.md").read_text()


def hand_examples() -> list[str]:
    return re.findall(r"```json\n(.*?)\n```", (ROOT / "docs" / "hand.md").read_text(), re.DOTALL)


def test_the_example_of_an_imu_loads() -> None:
    (example,) = (example for example in hand_examples() if '"imu"' in example)
    rig = msgspec.json.decode(
        (ROOT / "calib_json" / "rigs" / "desk.json").read_bytes(), type=dict[str, object]
    )
    keys = msgspec.json.decode(f"{{{example}}}", type=dict[str, object])
    imu = parse(msgspec.json.encode(rig | keys), RigCalibration, "hand.md").imu
    assert imu is not None
    assert imu.placed
    assert imu.heading_sigma_rad is None


def test_the_examples_of_a_hand_profile_load() -> None:
    examples = [example for example in hand_examples() if '"imu"' not in example]
    assert len(examples) == 3
    profile = msgspec.json.decode(
        msgspec.json.encode(generated_profile("mine", "right")), type=dict[str, object]
    )
    models: list[HandModel] = []
    for example in examples:
        keys = msgspec.json.decode(f"{{{example}}}", type=dict[str, object])
        if "index" in keys:
            keys = {"limits_rad": dict.fromkeys(FINGERS, keys["index"])}
        models.append(HandModel.of(parse(msgspec.json.encode(profile | keys), HandProfile, "hand.md")))
    assert [model.dip_per_pip for model in models] == [0.84, 0.6667, 2 / 3]
    assert [model.neighbours for model in models] == [True, False, True]
    assert models[2].spread_at_full_flexion.tolist() == [0.625] * 5


def unknown_benchmarks(text: str) -> list[str]:
    """Names behind `python -m bench` that it does not have; a module of its own, as by `-m bench.NAME`, is none."""
    named = re.findall(r"python -m bench((?:\.| +)[a-z][\w.]*)", text)
    return [name for one in named if (name := one.strip()) not in ALL]


def test_every_benchmark_named_on_a_page_exists() -> None:
    found = {str(page): unknown_benchmarks(page.read_text()) for page in (*PAGES, ROOT / "Makefile")}
    assert {page: names for page, names in found.items() if names} == {}


def test_the_check_of_benchmarks_sees_what_does_not_exist() -> None:
    text = "`python -m bench depth none`, `python -m bench.depth`, `python -m bench  none`, `python -m bench --help`"
    assert unknown_benchmarks(text) == [".depth", "none"]


@functools.cache
def texts() -> dict[Path, str]:
    """Every text file of the project, with what stands in it."""
    paths = [path for path in ROOT.iterdir() if path.suffix in TEXTS or path.name == "Makefile"]
    for folder in FOLDERS:
        files = (path for path in (ROOT / folder).rglob("*") if path.is_file())
        paths += [path for path in files if path.suffix in TEXTS or folder == ".ci"]
    return {path: path.read_text(errors="replace") for path in paths}


def row_references(text: str) -> list[str]:
    """References to rows of a list that the reader does not have."""
    return ROW.findall(text)


def test_papers_are_cited_by_name_and_not_by_row() -> None:
    found = {
        path.relative_to(ROOT).as_posix(): rows
        for path, text in texts().items()
        if (rows := row_references(text))
    }
    assert found == {}


def test_the_row_check_sees_a_planted_reference() -> None:
    planted = [f"row D{16}", f"(K{11})", f"rows I{5}, D{7}."]
    assert [row_references(text) for text in planted] == [["D16"], ["K11"], ["I5", "D7"]]
    assert row_references('illuminant D65, I2C, preset K, the byte "D1", SD1') == []


def paths_named(text: str) -> list[str]:
    """Files and folders of the project that stand between backticks, commands aside."""
    return [
        span
        for span in re.findall(r"`([^`]+)`", text)
        if " " not in span and span.split("/")[0] in FOLDERS and "/" in span
    ]


def missing_paths(text: str) -> list[str]:
    return [path for path in paths_named(text) if not (ROOT / path).exists()]


def commands_named(text: str) -> list[str]:
    """Commands that stand between backticks."""
    return [
        span
        for span in re.findall(r"`([^`]+)`", text)
        if span.split()[0] in ("pytest", "python", "make", "phalanx", "phalanx-master", "phalanx-slave")
        and span not in ("pytest FILE",)
    ]


def unknown_in(command: str) -> list[str]:
    """The words of a command that name nothing: test files, sections, modules, targets, options."""
    program, *rest = command.split()
    if program == "pytest":
        return [path for path in rest if not (ROOT / path).exists()]
    if program == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        return [target for target in rest if target not in targets]
    if program == "python":
        module, *sections = rest[1:]
        if module == "bench":
            return [name for name in sections if name not in ALL]
        return [] if (ROOT / f"{module.replace('.', '/')}.py").exists() else [module]
    verbs = [word for word in rest if word.islower() and not word.startswith("-")][:1]
    known = help_of(program, *verbs)
    return [word for word in rest if word.startswith("-") and word not in known] if known else verbs


@functools.cache
def help_of(program: str, *verbs: str) -> str:
    """What a command prints as its help; empty where it is unknown."""
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    module, name = scripts[program].split(":")
    code = f"import sys; from {module} import {name}; sys.exit({name}())"
    run = subprocess.run(
        [sys.executable, "-c", code, *verbs, "--help"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return run.stdout if run.returncode == 0 else ""


def test_what_the_page_of_sources_names_exists() -> None:
    text = SOURCES.read_text()
    commands = sorted(set(commands_named(text)))
    assert len(commands) > 50
    assert len(paths_named(text)) > 100
    assert missing_paths(text) == []
    assert {command: bad for command in commands if (bad := unknown_in(command))} == {}


def test_the_check_of_names_sees_what_does_not_exist() -> None:
    assert missing_paths("`master/none.py`, `master/fabrik`, `one word`, `f(x)`") == ["master/none.py"]
    planted = {
        "pytest tests/none.py tests/test_docs.py": ["tests/none.py"],
        "python -m bench depth none": ["none"],
        "python -m bench.none": ["bench.none"],
        "make none": ["none"],
        "phalanx demo --none": ["--none"],
        "phalanx none": ["none"],
    }
    assert {command: unknown_in(command) for command in planted} == planted
    assert commands_named("`make test`, `none`, `phalanx demo --wrist`") == [
        "make test",
        "phalanx demo --wrist",
    ]


def rows_of(text: str) -> list[list[str]]:
    """Cells of each capability and slip."""
    return [
        [cell.strip() for cell in line.strip("|").split(" | ")]
        for line in text.splitlines()
        if line.startswith('| <a id="')
    ]


def test_every_source_has_module_command_and_data() -> None:
    rows = rows_of(SOURCES.read_text())
    assert len(rows) == 77  # 34 and 25 capabilities, 18 slips
    for title, paper, phalanx, command, *data in rows:
        assert paper, title
        assert paths_named(phalanx), title
        assert commands_named(command), title
        assert all(cell.startswith(DATA) for cell in data), title


def test_every_reference_to_a_source_has_its_anchor() -> None:
    anchors = re.findall(r'<a id="([^"]+)">', SOURCES.read_text())
    assert len(set(anchors)) == len(anchors)
    own = set(re.findall(r"\]\(#([^)]+)\)", SOURCES.read_text()))
    others = {name for text in texts().values() for name in re.findall(r"sources\.md#([\w-]+)", text)}
    assert others
    assert (own | others) - set(anchors) == set()


def commands_of(page: str) -> list[list[str]]:
    """Command lines of ours in the blocks of a page, without the remark behind them; a line's first word leads."""
    fenced = re.findall(r"```\w*\n(.*?)```", page, re.DOTALL)
    lines = "".join([*fenced, *re.findall(r"(?:^    \S.*\n)+", page, re.MULTILINE)]).replace("\\\n", " ")
    found = re.findall(r"^[ $#]*(?:sudo )?(?:\S*/)?(phalanx(?:-slave)?) ([^&|;#\n]*)", lines, re.MULTILINE)
    remark = r" {2,}(?![-$])(?!.* -)\S.*"  # two blanks, and no option behind them
    return [shlex.split(f"{name} {re.sub(remark, '', words)}") for name, words in found]


def refused(words: list[str]) -> str:
    """Why the program does not take the words; empty: it does, or a file of the example is not here."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        try:
            (program() if words[0] == "phalanx" else PROGRAM).parse(words[1:])
        except SystemExit as end:
            return said.getvalue() if end.code else ""
        except PhalanxError as error:
            return "" if "no such folder" in str(error) else str(error)
    return ""


# What stands for words of the reader's.
STANDS_FOR = {"$T0": "0", "csv|parquet|bvh|gltf|rrd": "csv"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_command_of_a_page_is_one(page: Path) -> None:
    text = page.read_text() if page.name != "CHANGELOG.md" else ""  # of commands that were
    for mark, word in STANDS_FOR.items():
        text = text.replace(mark, word)
    found = [words for words in commands_of(text) if not {"...", "$S"} & {*words}]
    assert {" ".join(words): why for words in found if (why := refused(words))} == {}


def test_the_check_of_commands_sees_what_is_none() -> None:
    page = "```\nphalanx check --wach   looks\nsudo phalanx-slave doctor\nphalanx run \\\n    --rig desk  # so\n```\n"
    words = commands_of(page)
    assert words == [
        ["phalanx", "check", "--wach"],
        ["phalanx-slave", "doctor"],
        ["phalanx", "run", "--rig", "desk"],
    ]
    assert [bool(refused(one)) for one in words] == [True, False, False]
