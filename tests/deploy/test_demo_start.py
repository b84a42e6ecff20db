"""When the scene of a demo begins: no hand moves before the processes that watch it are there."""

import os

import pytest

from deploy.demo import lead_s


def test_the_scene_waits_longer_for_more_processes_and_on_a_busy_machine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    assert lead_s(3, 0.0) == 4.0
    assert lead_s(5, 0.0) == 6.0  # 5 processes of 2 s each on 2 cores, and one to know IMU and light
    assert lead_s(5, 6.0) == 12.0
    assert lead_s(5, 100.0) == 20.0  # as long as somebody waits at most for a first pose, nearly
    monkeypatch.setattr(os, "cpu_count", lambda: 16)
    assert lead_s(5, 0.0) == 4.0
