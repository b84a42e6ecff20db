"""docs/hardware.md: the sums of its parts, its cables, and holders that OpenSCAD makes and a printer can print."""

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float
from tests.programs import needs

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs/hardware.md").read_text()
FOLDER = ROOT / "docs/hardware"
HOLDERS = ("camera_bar", "wrist_bracket")
CAMERAS = re.findall(r'^ {2}\["(\w+)", ', (FOLDER / "cameras.scad").read_text(), re.MULTILINE)
BED_MM, WALL_MM = 180.0, 1.2  # of the smallest common printer; three lines of a nozzle of 0.4 mm


def tables() -> list[tuple[int, int]]:
    """Sum of the parts of each table that has one, and what it states [US dollars]; its lines are right, too."""
    found: list[tuple[int, int]] = []
    total = 0
    for line in PAGE.splitlines():
        if part := re.match(r"\|[^|]+\| (\d+) \| \$(\d+) \| \$(\d+) \|", line):
            number, each, together = (int(text) for text in part.groups())
            assert number * each == together, line
            total += together
        elif stated := re.match(r"\| \| \| \| \*\*≈ \$(\d+)\*\* \|", line):
            found.append((total, int(stated[1])))
            total = 0
    assert total == 0, "a table without its sum"
    return found


def test_the_parts_of_both_devices_add_up() -> None:
    (desk, stated_desk), (wrist, stated_wrist) = tables()
    assert (desk, wrist) == (stated_desk, stated_wrist)
    quoted = re.search(
        r"about \$(\d+) for two cameras, \$(\d+) for a wrist", (ROOT / "README.md").read_text()
    )
    assert quoted is not None
    assert (int(quoted[1]), int(quoted[2])) == (round(desk, -1), round(wrist, -1))


def test_every_part_that_a_camera_needs_is_on_the_list() -> None:
    for device in PAGE.split("## Wrist device"):
        listed = device.partition("**Wiring**")[0].partition("**Wiring.**")[0]
        assert all(word in listed for word in ("Raspberry Pi", "camera cable", "microSD", "supply", "holder"))
    assert [
        line.count("15 to 22") for line in PAGE.splitlines() if line.startswith(("| 5 (two", "| Zero 2 W"))
    ] == [1, 1]


def test_the_page_has_every_camera_of_the_holders() -> None:
    listed = re.findall(r"^\| `(\w+)` \| [^|]+ \| [^|]*M2", PAGE, re.MULTILINE)
    assert listed == CAMERAS


def mesh(folder: Path, holder: str, *options: str) -> Float:
    """Triangles of a holder (T, 3, 3) [mm], as OpenSCAD exports them."""
    needs("openscad")
    out = folder / "holder.stl"
    command = ["openscad", "-q", *options, "-o", str(out), str(FOLDER / f"{holder}.scad")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    corners = re.findall(r"vertex (\S+) (\S+) (\S+)", out.read_text())
    return np.array(corners, np.float64).reshape(-1, 3, 3)


def open_edges(triangles: Float) -> int:
    """How many edges have not exactly one triangle on either side."""
    _, index = np.unique(triangles.reshape(-1, 3).round(5), axis=0, return_inverse=True)
    faces = index.reshape(-1, 3)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ways = {tuple(edge) for edge in edges.tolist()}
    return sum((b, a) not in ways for a, b in ways) + len(edges) - len(ways)


def volume(triangles: Float) -> float:
    """What is inside [mm^3]; negative where the surface is inside out."""
    a, b, c = triangles.transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6.0)


def thickness(triangles: Float) -> Float:
    """How far it is from each triangle's middle straight in to the next surface [mm].

    Of triangles of more than 0.2 mm^2; Moeller and Trumbore, "Fast, Minimum Storage Ray-Triangle Intersection", 1997.
    """
    a, b, c = triangles.transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1) / 2.0
    used = area > 0.2
    inward = -normals[used] / (2.0 * area[used, None])
    starts = triangles[used].mean(axis=1) + 1e-4 * inward
    found = np.full(len(starts), np.inf)
    for k, (start, way) in enumerate(zip(starts, inward, strict=True)):
        p = np.cross(way, c - a)
        det = ((b - a) * p).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = ((start - a) * p).sum(axis=1) / det
            q = np.cross(start - a, b - a)
            v, t = (q @ way) / det, ((c - a) * q).sum(axis=1) / det
            hit = (np.abs(det) > 1e-12) & (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9) & (t > 0.0)
        found[k] = t[hit].min(initial=np.inf)
    return found


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("holder", HOLDERS)
def test_a_holder_for_each_camera_can_be_printed(tmp_path: Path, holder: str, camera: str) -> None:
    triangles = mesh(tmp_path, holder, "-D", f'camera="{camera}"')
    size = np.ptp(triangles.reshape(-1, 3), axis=0)
    assert size.max() <= BED_MM
    assert open_edges(triangles) == 0
    assert 5_000.0 < volume(triangles) < 0.6 * size.prod()
    assert thickness(triangles).min() >= WALL_MM - 1e-3


def test_a_thin_wall_and_an_open_surface_would_be_seen(tmp_path: Path) -> None:
    triangles = mesh(tmp_path, "camera_bar", "-D", "bar_z=1.0")
    assert thickness(triangles).min() < WALL_MM
    assert open_edges(triangles[1:]) == 3
    assert volume(triangles[:, ::-1]) < 0.0


def test_a_camera_that_no_holder_knows_is_refused() -> None:
    needs("openscad")
    command = ["openscad", "-q", "-D", 'camera="x"', "-o", "/dev/null", "--export-format", "stl"]
    command.append(str(FOLDER / "camera_bar.scad"))
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode != 0
    assert 'camera = "x": there are ["module", "gs", "ov9281", "ov9281_32"]' in done.stderr
