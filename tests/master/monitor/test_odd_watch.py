"""Which camera a running master names as knocked: the one mostly left out for five seconds, and once."""

from collections import Counter

import numpy as np

from master.monitor.report import ExtrinsicsMonitor
from tests.master.monitor.test_camera_outlier import THREE, messages, rig, solve


def looks(watch: ExtrinsicsMonitor, counts: Counter[str], seconds: int, **per_second: int) -> list[str]:
    out: list[str] = []
    for _ in range(seconds):
        counts.update({name.replace("__", "."): number for name, number in per_second.items()})
        out += watch.look(counts)
    return out


def test_a_camera_that_is_mostly_rejected_is_named_once() -> None:
    watch, counts = ExtrinsicsMonitor(("left", "right", "top")), Counter[str]()
    assert not looks(watch, counts, 20, poses=60)
    assert not looks(watch, counts, 4, poses=60, mostly_rejected__right=60)
    assert not looks(watch, counts, 1, poses=60)  # a short while is no knock
    assert not looks(watch, counts, 30, poses=60, mostly_rejected__top=25)
    [line] = looks(watch, counts, 300, poses=60, mostly_rejected__right=50)
    assert line.startswith("camera right: its rays miss")
    assert "calibrate cameras stereo" in line


def test_a_master_that_solves_nothing_names_nobody() -> None:
    watch, counts = (
        ExtrinsicsMonitor(("left", "right")),
        Counter[str](poses=10, **{"mostly_rejected.left": 9}),
    )
    assert not looks(watch, counts, 30)


def test_what_the_pipeline_counts_is_what_is_watched() -> None:
    watch = ExtrinsicsMonitor(THREE)
    _, counts = solve(rig(THREE, "top", np.radians([1.4, 1.4, 0.0])), messages(THREE))
    lines: list[str] = []
    for second in range(1, 6):
        lines += watch.look({name: second * number for name, number in counts.items()})
    assert len(lines) == 1
    assert "camera top" in lines[0]
