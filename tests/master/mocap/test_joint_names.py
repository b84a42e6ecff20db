"""Names of motion capture as programs write them, and which joints of ours they mean."""

import pytest

from common.errors import RecordingError
from common.hand.model import JOINTS
from master.mocap.bvh_file import Side
from master.mocap.read import choose_names

PARTS = ("metacarpal", "phalanx-proximal", "phalanx-intermediate", "phalanx-distal", "tip")


def chosen(
    *names: str, side: Side | None = None, ends: tuple[str, ...] = (), **given: str | None
) -> dict[str, str]:
    """Name in the file -> point of ours."""
    own = {key.replace("_", "-"): value for key, value in given.items()}
    found = choose_names(names, frozenset(ends), "file", own, side)
    return {name: point for point, name in found.names.items()}


def index(*parts: int) -> list[str]:
    return [f"index-finger-{PARTS[part]}" for part in parts]


def thumb(*parts: int) -> list[str]:
    return [f"thumb-{('metacarpal', 'phalanx-proximal', 'phalanx-distal', 'tip')[part]}" for part in parts]


@pytest.mark.parametrize(
    ("names", "points"),
    [
        ([f"mixamorig:RightHandIndex{k}" for k in (1, 2, 3, 4)], index(1, 2, 3, 4)),
        ([f"mixamorig:RightHandThumb{k}" for k in (1, 2, 3, 4)], thumb(0, 1, 2, 3)),
        (["RightInHandIndex", *(f"RightHandIndex{k}" for k in (1, 2, 3))], index(0, 1, 2, 3)),
        ([f"Skeleton 001:LThumb{k}" for k in (1, 2, 3)], thumb(0, 1, 2)),
        ([f"index_0{k}_r" for k in (1, 2, 3)], index(1, 2, 3)),
        ([f"rindex{k}" for k in (1, 2, 3)], index(1, 2, 3)),
        ([*(f"Hand_Index{k}" for k in (1, 2, 3)), "Hand_IndexTip"], index(1, 2, 3, 4)),
        ([*(f"Hand_Thumb{k}" for k in (1, 2, 3)), "Hand_Thumb0", "Hand_ThumbTip"], [*thumb(0, 1, 2), "", *thumb(3)]),
        ([f"INDEX_FINGER_{part}" for part in ("MCP", "PIP", "DIP", "TIP")], index(1, 2, 3, 4)),
        ([f"THUMB_{part}" for part in ("CMC", "MCP", "IP", "TIP")], thumb(0, 1, 2, 3)),
        ([f"RightFinger2{part}" for part in ("Metacarpal", "Proximal", "Medial", "Tip")], index(0, 1, 2, 4)),
        ([f"RightFinger1{part}" for part in ("Metacarpal", "Proximal", "Distal", "Tip")], thumb(0, 1, 2, 3)),
        ([f"RightFirst{part}" for part in ("MC", "PP", "DP")], thumb(0, 1, 2)),
        ([f"RightSecond{part}" for part in ("MC", "PP", "MP", "DP")], index(0, 1, 2, 3)),
        ([f"Left Thumb {part}" for part in ("Proximal", "Intermediate", "Distal")], thumb(0, 1, 2)),
        ([f"XR_HAND_JOINT_INDEX_{part}_EXT" for part in ("METACARPAL", "PROXIMAL", "TIP")], index(0, 1, 4)),
        (["XR_HAND_JOINT_WRIST_EXT", "XR_HAND_JOINT_PALM_EXT"], ["wrist", "palm"]),
        (["RightHand", "RightForeArm", "RightToeBase", "Hips"], ["wrist", "", "", ""]),
        (["hand_r", "r_wrist"], ["", "wrist"]),  # a wrist of its own goes before the hand
        (["thumb", "index", "little", "back", "back2"], ["thumb", "index", "little", "back", "back2"]),
        # Markers to the left and right of a glove, and one between two fingers: no hands, no joints.
        (["index_tip", "hand_left", "hand_right", "back_left", "index_middle"], [*index(4), "", "", "", ""]),
    ],
)  # fmt: skip
def test_programs_call_joints_so(names: list[str], points: list[str]) -> None:
    found = chosen(*names)
    assert [found.get(name, "") for name in names] == points


@pytest.mark.parametrize(("ahead", "joined"), [("", "-"), ("", "_"), ("Left_", " ")])
def test_our_own_names_mean_themselves(ahead: str, joined: str) -> None:
    names = [ahead + name.replace("-", joined) for name in JOINTS]
    assert list(chosen(*names).values()) == list(JOINTS)


def test_the_end_of_a_chain_is_a_tip_where_the_chain_has_none() -> None:
    three = [f"RightHandRing{k}" for k in (1, 2, 3)]
    assert (
        chosen(*three, "RightHandRing3_end", ends=("RightHandRing3_end",))["RightHandRing3_end"]
        == "ring-finger-tip"
    )
    four = [*three, "RightHandRing4", "RightHandRing4_end"]
    found = chosen(*four, ends=("RightHandRing4_end",))
    assert found["RightHandRing4"] == "ring-finger-tip"
    assert "RightHandRing4_end" not in found


def test_one_hand_of_two_is_chosen_by_a_person() -> None:
    names = [f"{side}Hand{part}" for side in ("Left", "Right") for part in ("", "Index1", "Index2", "Index3")]
    assert all(name.startswith("Left") for name in chosen(*names, side="left"))
    with pytest.raises(RecordingError, match="both hands: say which with --side"):
        chosen(*names)


def test_a_person_says_which_is_which() -> None:
    found = chosen(
        "P1", "WRIST", "THUMB_CMC_FE", "THUMB_CMC_AA", thumb_metacarpal="THUMB_CMC_AA", index_finger_tip="P1"
    )
    assert found == {"P1": "index-finger-tip", "WRIST": "wrist", "THUMB_CMC_AA": "thumb-metacarpal"}
    assert chosen("WRIST", "index_tip", wrist=None) == {"index_tip": "index-finger-tip"}


def test_what_cannot_be_is_refused_by_name() -> None:
    with pytest.raises(RecordingError, match="THUMB_CMC_FE and THUMB_CMC_AA both mean thumb-metacarpal"):
        chosen("THUMB_CMC_FE", "THUMB_CMC_AA")
    with pytest.raises(RecordingError, match="'pointer' is no joint of ours: palm, wrist"):
        chosen("WRIST", pointer="WRIST")
    with pytest.raises(RecordingError, match="it has no 'P7', but WRIST"):
        chosen("WRIST", wrist="P7")
