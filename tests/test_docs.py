"""The documents agree with the code where a machine can tell."""

import re
from pathlib import Path

import msgspec
import pytest

from common.calibration import HandProfile, RigCalibration, parse
from common.hand_model import FINGERS, JOINTS, HandModel
from common.hand_profiles import generated_profile

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted({*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "calib_json").rglob("*.md")})


def broken_links(page: Path, text: str) -> list[str]:
    """Relative links of `text` that lead nowhere."""
    links = [link.split("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in link]
    return [link for link in links if link and not (page.parent / link).exists()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_leads_somewhere(page: Path) -> None:
    assert broken_links(page, page.read_text()) == []


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
