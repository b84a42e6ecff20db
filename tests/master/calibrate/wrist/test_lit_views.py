"""Views by what lit them, and how what was left out of them is told."""

from master.calibrate.wrist.device import grouped_by_reason


def test_each_reason_is_reported_once_with_its_views() -> None:
    assert grouped_by_reason({}) == []
    assert grouped_by_reason({"3": "no board found", "6": "the hand moved", "9": "no board found"}) == [
        "views 3, 9: no board found",
        "view 6: the hand moved",
    ]


def test_of_many_views_the_first_are_named() -> None:
    assert grouped_by_reason({str(k): "no board found" for k in range(56)}) == [
        "views 0, 1, 2, 3, 4, 5 and 50 more: no board found"
    ]
