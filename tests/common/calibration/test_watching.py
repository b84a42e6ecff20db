"""A changed file is noticed once, however it was written; one that was only touched is not."""

import os
from pathlib import Path

from common.calibration.files import MonitoredFiles, replacing


def test_the_first_look_reports_and_the_next_does_not(tmp_path: Path) -> None:
    paths = [tmp_path / "a", tmp_path / "b"]
    paths[0].write_text("1")
    watched = MonitoredFiles()
    assert watched.changed(paths)
    assert not watched.changed(paths)


def test_every_way_to_change_a_file_is_noticed_once(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_text("1")
    watched = MonitoredFiles()
    watched.changed([path])

    def replace() -> None:
        with replacing(path) as file:
            file.write(b"3")

    for write in (lambda: path.write_text("2"), replace, path.unlink, lambda: path.write_text("4")):
        write()
        # Written within one step of the file system's clock, as no person can.
        if path.exists():
            os.utime(path, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns + 10**9))
        assert watched.changed([path])
        assert not watched.changed([path])


def test_a_file_with_the_same_content_is_not_changed(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_text("1")
    watched = MonitoredFiles()
    watched.changed([path])
    os.utime(path, ns=(1, 1))
    assert not watched.changed([path])
    path.unlink()
    path.write_text("1")
    assert not watched.changed([path])
